"""Where decoded splats go: arrays of the host (:class:`Fillable`), or packed for a device (:class:`BundleTaker`).

:class:`SceneArrays`, the arrays of a scene, is the usual one. All give the same bits.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from contextlib import AbstractContextManager
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.container import Block
from potr_cl.codec.native.values import PackedValues, ValueArrays, packing_rooms
from potr_cl.host import mapped
from potr_cl.model.scene import Scene

F32 = NDArray[np.float32]


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


class Destination(ABC):
    """Takes what a block holds."""

    @property
    def activation(self) -> Activation | None:
        """Of its values; None: none."""
        return None

    @abstractmethod
    def take_means(self, means: F32) -> None:
        """Centres, (N, 3) float32, world units."""


class Fillable(Destination):
    """A destination with arrays on the host, which values may be written to as they are decoded."""

    @property
    @abstractmethod
    def values(self) -> ValueArrays:
        """The arrays but the centres."""


class BundleTaker(Destination):
    """A destination that takes values bundle by bundle, packed, as they are decoded."""

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
        block: says how many there are, and how they are rendered.
        sh_count: SH coefficients of a channel that are wanted.
    """

    def __init__(self, block: Block, sh_count: int) -> None:
        n = block.splats
        self._block = block
        self._means = np.empty((0, 3), np.float32)
        self._values = ValueArrays(
            np.empty((n, 3), np.float32),
            np.empty((n, 4), np.float32),
            np.empty(n, np.float32),
            mapped.array((sh_count, 3, n), np.float32, "SH coefficients"),
        )

    @property
    def values(self) -> ValueArrays:
        """The arrays but the centres."""
        return self._values

    def take_means(self, means: F32) -> None:
        self._means = means

    @property
    def scene(self) -> Scene:
        """The scene, once everything was taken."""
        values, block = self._values, self._block
        assert values.log_scales is not None
        assert values.quaternions is not None
        assert values.logits is not None
        assert values.sh is not None
        return Scene(
            self._means,
            values.log_scales,
            values.quaternions,
            values.logits,
            values.sh.transpose(2, 0, 1),
            block.antialiased,
            block.low_pass,
        )
