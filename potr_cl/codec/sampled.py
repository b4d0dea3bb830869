"""Some splats of a file as a scene, while all are decoded to another place: :class:`Sampled`, :class:`Both`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.byte_planes import IntegerStream
from potr_cl.codec.colour_factors import ColourFactors
from potr_cl.codec.container import Header
from potr_cl.codec.dequantizer import Dequantizer
from potr_cl.codec.destination import F32, Destination, SceneArrays
from potr_cl.codec.versions import FormatVersion
from potr_cl.model.scene import Scene


class Sampled:
    """Takes some of a file's splats (:class:`potr_cl.codec.destination.Destination`).

    Args:
        header: of the file.
        version: the rules of the file's version.
        sh_count: SH coefficients of a channel that are wanted.
        rows: (n,) int64, the numbers of the splats in the file.
    """

    def __init__(self, header: Header, version: FormatVersion, sh_count: int, rows: NDArray[np.int64]) -> None:
        self._rows = rows
        self._splats = header.splats
        self._whole = Dequantizer(header, version)
        self._arrays = SceneArrays(replace(header, splats=len(rows)), version, sh_count)

    @property
    def scene(self) -> Scene:
        """Those splats, once everything was taken."""
        return self._arrays.scene

    def take_means(self, means: F32) -> None:
        self._arrays.take_means(means[self._rows])

    def take_scales(self, streams: Sequence[IntegerStream]) -> None:
        self._arrays.take_scales(self._some(streams))

    def take_rotations(self, streams: Sequence[IntegerStream], scales: Sequence[IntegerStream]) -> None:
        self._arrays.take_rotations(self._some(streams), self._some(scales))

    def take_opacities(self, stream: IntegerStream) -> None:
        self._arrays.take_opacities(_Some(stream, self._rows))

    def take_colours(
        self, streams: Sequence[IntegerStream], coefficient: int, differences: bool, factors: ColourFactors
    ) -> None:
        if coefficient:
            self._arrays.take_colours(self._some(streams), coefficient, differences, factors.of_rows(self._rows))
            return
        # DC may be what a prediction from the splats before has left.
        values = np.empty((3, self._splats), np.float32)
        self._whole.colours(streams, coefficient, differences, factors, values)
        self._arrays.sh[:, 0] = values[:, self._rows].T

    def _some(self, streams: Sequence[IntegerStream]) -> list[IntegerStream]:
        return [_Some(stream, self._rows) for stream in streams]


class Both:
    """Hands on what it takes to two destinations."""

    def __init__(self, one: Destination, other: Destination) -> None:
        self._all = (one, other)

    def take_means(self, means: F32) -> None:
        for each in self._all:
            each.take_means(means)

    def take_scales(self, streams: Sequence[IntegerStream]) -> None:
        for each in self._all:
            each.take_scales(streams)

    def take_rotations(self, streams: Sequence[IntegerStream], scales: Sequence[IntegerStream]) -> None:
        for each in self._all:
            each.take_rotations(streams, scales)

    def take_opacities(self, stream: IntegerStream) -> None:
        for each in self._all:
            each.take_opacities(stream)

    def take_colours(
        self, streams: Sequence[IntegerStream], coefficient: int, differences: bool, factors: ColourFactors
    ) -> None:
        for each in self._all:
            each.take_colours(streams, coefficient, differences, factors)


@dataclass(frozen=True)
class _Some:
    """Some integers of a stream."""

    stream: IntegerStream
    rows: NDArray[np.int64]

    @cached_property
    def joined(self) -> NDArray[Any]:
        return self.stream.joined[self.rows]

    @cached_property
    def _values(self) -> NDArray[np.integer]:
        return self.stream.part(0, len(self.stream.joined))[self.rows]

    def part(self, start: int, stop: int) -> NDArray[np.integer]:
        return self._values[start:stop]
