"""Where decoded splats go: a :class:`Destination`; :class:`SceneArrays`, arrays of the host, is the usual one.

:meth:`potr_cl.codec.decoder.PotrFile.decode_into` hands a destination the integers of a file as they are decoded. What
values they stand for says :class:`potr_cl.codec.dequantizer.Dequantizer`; another destination may find them in another
way (:mod:`potr_cl.ondevice.decode` on a device), but must give the same bits.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.byte_planes import IntegerStream
from potr_cl.codec.colour_factors import ColourFactors
from potr_cl.codec.container import Header
from potr_cl.codec.dequantizer import Dequantizer
from potr_cl.codec.native.values import PackedValues, ValueArrays, packing_rooms
from potr_cl.codec.versions import FormatVersion
from potr_cl.host import mapped
from potr_cl.model.scene import Scene

F32 = NDArray[np.float32]


class Destination(Protocol):
    """Takes what a file holds, part by part and each part once, from several threads at a time."""

    def take_means(self, means: F32) -> None:
        """Centres, (N, 3) float32, world units."""

    def take_scales(self, streams: Sequence[IntegerStream]) -> None:
        """Levels of the scales along each axis."""

    def take_rotations(self, streams: Sequence[IntegerStream], scales: Sequence[IntegerStream]) -> None:
        """Levels of x, y, z; ``scales`` as of :meth:`take_scales`."""

    def take_opacities(self, stream: IntegerStream) -> None:
        """Levels of the opacities."""

    def take_colours(
        self, streams: Sequence[IntegerStream], coefficient: int, differences: bool, factors: ColourFactors
    ) -> None:
        """Levels of Y, Co, Cg of an SH coefficient; of DC what is left of them where the version predicts its values.

        Args:
            streams: three.
            coefficient: 0 for DC.
            differences: whether integers are the differences of levels of splats that follow each other.
            factors: the splats' scale factors.
        """


class Activation(Protocol):
    """What a destination wants instead of logarithms of scales and logits of opacities, value by value.

    It gets quaternions of unit length, which :meth:`rotations` and the native path make.
    """

    def scales(self, log_scales: F32) -> F32:
        """Instead of natural logarithms of standard deviations, of any shape."""

    def opacities(self, logits: F32) -> F32:
        """Instead of logits of opacities."""

    def rotations(self, quaternions: F32) -> F32:
        """(n, 4) quaternions, as long as 1 in double precision, then rounded."""


class Fillable(ABC):
    """A destination with arrays on the host, which values may be written to as they are decoded."""

    @property
    def activation(self) -> Activation | None:
        """Of these values; None: none."""
        return None

    @property
    @abstractmethod
    def values(self) -> ValueArrays:
        """The arrays but the centres."""

    @abstractmethod
    def take_means(self, means: F32) -> None:
        """Centres, (N, 3) float32, world units."""


class BundleTaker(ABC):
    """A destination that takes values bundle by bundle, packed, as they are decoded."""

    @property
    def activation(self) -> Activation | None:
        """Of these values; None: none."""
        return None

    @abstractmethod
    def take_means(self, means: F32) -> None:
        """Centres, (N, 3) float32, world units."""

    @abstractmethod
    def expect_bundles(self) -> None:
        """Bundles will come."""

    def rooms(self, number: int) -> AbstractContextManager[list[PackedValues]]:
        """Memory that so many bundles are packed in, before they are taken."""
        return packing_rooms(number)

    @abstractmethod
    def take_bundle(self, first: int, packed: PackedValues, items: int) -> None:
        """The values of a bundle; all from one thread, that of :meth:`expect_bundles`, and in their order.

        Args:
            first: the number of its first splat.
            packed: the values; the memory is another bundle's afterwards.
            items: how many it has.
        """


class SceneArrays(Fillable):
    """Decoded splats as the arrays of a scene.

    Args:
        header: of the file.
        version: the rules of the file's version.
        sh_count: SH coefficients of a channel that are wanted.
    """

    def __init__(self, header: Header, version: FormatVersion, sh_count: int) -> None:
        n = header.splats
        self._header = header
        self._dequantizer = Dequantizer(header, version)
        self._means = np.empty((0, 3), np.float32)
        self._log_scales = np.empty((n, 3), np.float32)
        self._quaternions = np.empty((n, 4), np.float32)
        self._opacity_logits = np.empty(n, np.float32)
        self._planar = mapped.array((sh_count, 3, n), np.float32, "SH coefficients")

    @property
    def values(self) -> ValueArrays:
        """The arrays but the centres."""
        return ValueArrays(self._log_scales, self._quaternions, self._opacity_logits, self._planar)

    def take_means(self, means: F32) -> None:
        self._means = means

    def take_scales(self, streams: Sequence[IntegerStream]) -> None:
        self._dequantizer.scales(streams, self._log_scales)

    def take_rotations(self, streams: Sequence[IntegerStream], scales: Sequence[IntegerStream]) -> None:
        self._dequantizer.rotations(streams, scales, self._quaternions)

    def take_opacities(self, stream: IntegerStream) -> None:
        self._dequantizer.opacities(stream, self._opacity_logits)

    def take_colours(
        self, streams: Sequence[IntegerStream], coefficient: int, differences: bool, factors: ColourFactors
    ) -> None:
        self._dequantizer.colours(streams, coefficient, differences, factors, self._planar[coefficient])

    @property
    def sh(self) -> F32:
        """(N, M, 3), each coefficient contiguous in memory."""
        return self._planar.transpose(2, 0, 1)

    @property
    def scene(self) -> Scene:
        """The scene, once everything was taken."""
        header = self._header
        return Scene(
            self._means,
            self._log_scales,
            self._quaternions,
            self._opacity_logits,
            self.sh,
            header.antialiased,
            header.low_pass,
        )
