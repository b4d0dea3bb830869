"""Levels to values by NumPy, as arrays (:func:`fill`) or packed bundles (:func:`pack`), and where these go.

That is arrays of the host (:class:`Fillable`), of which those of a scene (:class:`SceneArrays`) are the usual ones, or
packed for a device (:class:`BundleTaker`). All give the same bits. This is the definition of what the native path does
bundle by bundle.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec import quantize
from potr_cl.codec.bundles.layout import BUNDLE, Levels
from potr_cl.codec.container import Block
from potr_cl.codec.native.values import PackedValues, ValueArrays, packing_rooms
from potr_cl.codec.steps.prediction import from_residuals
from potr_cl.codec.steps.rule import ColourSteps, colour_classes, factors
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
        scene = Scene.blank(block.splats, sh_count)
        self._scene = replace(scene, antialiased=block.antialiased, low_pass=block.low_pass)
        self._values = ValueArrays(
            scene.log_scales, scene.quaternions, scene.opacity_logits, scene.sh.transpose(1, 2, 0)
        )

    @property
    def values(self) -> ValueArrays:
        """The arrays but the centres."""
        return self._values

    def take_means(self, means: F32) -> None:
        self._scene = replace(self._scene, means=means)

    @property
    def scene(self) -> Scene:
        """The scene, once everything was taken."""
        return self._scene


#: Splats worked on at a time: a multiple of the runs in which DC is predicted; predictions take a call for each splat
#: of a run.
_AT_A_TIME = 1 << 16


def fill(
    arrays: ValueArrays, block: Block, levels: Levels, steps: ColourSteps | None, activation: Activation | None = None
) -> None:
    """Values of some splats' levels into the arrays that there are.

    Args:
        arrays: of these splats, or of more.
        block: has the quantiser and its scale factors.
        levels: of what the arrays hold.
        steps: of the block's colours; None: the same for all splats.
        activation: what is stored instead of logarithms of scales and logits of opacities; None: these.
    """
    for start in range(0, levels.stop - levels.start, _AT_A_TIME):
        _fill(arrays, block, levels.part(start, start + _AT_A_TIME), steps)
    own = arrays.part(levels.start, levels.stop)
    if activation is not None:
        if own.log_scales is not None:
            own.log_scales[...] = activation.scales(own.log_scales)
        if own.logits is not None:
            own.logits[...] = activation.opacities(own.logits)
        if own.quaternions is not None:
            own.quaternions[...] = activation.rotations(own.quaternions)


def pack(
    destination: BundleTaker, block: Block, sh_count: int, bundles: range, filled: Callable[[ValueArrays], None]
) -> None:
    """Hand the values of some bundles to a destination, in their order; ``filled`` fills arrays of their splats."""
    start, stop = bundles.start * BUNDLE, min(bundles.stop * BUNDLE, block.splats)
    n = stop - start
    arrays = ValueArrays(
        np.empty((n, 3), np.float32),
        np.empty((n, 4), np.float32),
        np.empty(n, np.float32),
        np.empty((sh_count, 3, n), np.float32),
        begin=start,
    )
    filled(arrays)
    packed = PackedValues()
    for first in range(start, stop, BUNDLE):
        items = packed.take(arrays.part(first, min(first + BUNDLE, stop)))
        destination.take_bundle(first, packed, items)


def _fill(arrays: ValueArrays, block: Block, levels: Levels, steps: ColourSteps | None) -> None:
    rules, own, scales = block.rules, arrays.part(levels.start, levels.stop), levels.scales or []
    if own.logits is not None and levels.opacities is not None:
        own.logits[...] = rules.dequantize_opacities(levels.opacities, block.sf_opacity)
    if own.log_scales is not None:
        for axis, level in enumerate(scales):
            own.log_scales[:, axis] = quantize.dequantize_scales(level, block.sf_scale)
    if own.quaternions is not None and levels.rotations is not None:
        quantize.dequantize_rotations(
            levels.rotations, rules.rotation_factors(scales, block.sf_rotation), own.quaternions
        )
    if own.sh is None or levels.dc is None or levels.opacities is None:
        return
    dc = ac = None
    if levels.classes is not None:
        dc, ac = levels.classes
    elif steps is not None:
        dc, ac = colour_classes(steps, scales, levels.opacities, levels.start)
    of_dc: Any = levels.dc
    if levels.predicted:
        nothing = np.zeros(levels.stop - levels.start, np.int8)
        of_dc = from_residuals(np.stack(levels.dc, dtype=np.int64), nothing if dc is None else dc)
    _to_rgb(list(of_dc), factors(block.sf_dc, dc), own.sh[0])
    divisors = factors(block.sf_ac, ac)
    for channels, rgb in zip(levels.dense, own.sh[1:], strict=False):
        _to_rgb(_wider(channels), divisors, rgb)
    own.sh[1 + len(levels.dense) :] = 0
    for items in levels.ac:
        rgb = np.empty(items.channels.shape, np.float32)
        _to_rgb(_wider(list(items.channels)), divisors if len(divisors) == 1 else divisors[items.splats], rgb)
        own.sh[items.coefficients, :, items.splats] = rgb.T


def _wider(levels: list[NDArray[np.integer]]) -> list[NDArray[Any]]:
    """Levels of a type that holds the sums of three of them."""
    most = max(level.dtype.itemsize for level in levels)
    dtype: type[np.signedinteger] = np.int16 if most == 1 else np.int32 if most == 2 else np.int64
    return [level.astype(dtype) for level in levels]


def _to_rgb(channels: list[NDArray[Any]], divisor: F32, out: F32) -> None:
    """Levels of Y, Co, Cg to R, G, B in ``out`` (3, n)."""
    y, co, cg = channels
    r = y - cg
    np.divide(r + co, divisor, out=out[0], dtype=np.float32, casting="unsafe")
    np.divide(y + cg, divisor, out=out[1], dtype=np.float32, casting="unsafe")
    np.divide(r - co, divisor, out=out[2], dtype=np.float32, casting="unsafe")
