"""Streams of integers to a scene's values, for whole files: :class:`Dequantizer`.

What a value is made of is up to the file's version; here it is done for many splats: block by block with NumPy, or by
the native path, which gives the same bits.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec import quantize
from potr_cl.codec.bundles.levels import Levels
from potr_cl.codec.byte_planes import IntegerStream
from potr_cl.codec.colour_factors import ColourFactors
from potr_cl.codec.container import Header
from potr_cl.codec.native.functions import Functions
from potr_cl.codec.native.library import native
from potr_cl.codec.native.values import ValueArrays
from potr_cl.codec.steps.prediction import from_residuals, tables
from potr_cl.codec.steps.rule import CLASSES, ColourSteps, factors
from potr_cl.codec.versions import FormatVersion

F32 = NDArray[np.float32]
I8 = NDArray[np.int8]

#: Splats worked on at a time: few enough that temporaries stay in a cache, many enough that threads seldom wait. A
#: multiple of the runs in which DC is predicted.
_BLOCK = 1 << 15
#: The same where the predictions of a block take a call for each splat of a run.
_LARGE_BLOCK = 1 << 16
#: Levels whose values the native path looks up: small tables for levels of one byte, larger ones for others.
_SMALL_TABLE, _LARGE_TABLE = 1 << 8, 1 << 16


@dataclass(frozen=True)
class Dequantizer:
    """Makes values of the integers of one file.

    Attributes:
        header: has the scale factors.
        version: the rules of the file's version.
    """

    header: Header
    version: FormatVersion

    def scales(self, streams: Sequence[IntegerStream], out: F32) -> None:
        """Levels of each axis to natural logarithms of standard deviations in ``out`` (N, 3)."""
        factor = self.header.sf_scale
        functions = native()
        for axis, stream in enumerate(streams):
            if functions is not None:
                self._look_up(functions, self.version.dequantize_scales, stream, factor, out, axis)
                continue
            for block, levels in self._blocks([stream]):
                out[block, axis] = self.version.dequantize_scales(levels[0], factor)

    def opacities(self, stream: IntegerStream, out: F32) -> None:
        """Levels to logits in ``out`` (N,)."""
        factor = self.header.sf_opacity
        functions = native()
        if functions is not None:
            self._look_up(functions, self.version.dequantize_opacities, stream, factor, out[:, None], 0)
            return
        for block, levels in self._blocks([stream]):
            out[block] = self.version.dequantize_opacities(levels[0], factor)

    def rotations(self, streams: Sequence[IntegerStream], scales: Sequence[IntegerStream], out: F32) -> None:
        """Levels of x, y, z to unit quaternions w, x, y, z in ``out`` (N, 4).

        ``scales`` are looked at where the version's rotations need them.
        """
        version, factor = self.version, self.header.sf_rotation
        needed = scales if version.rotations_need_scales else []
        functions = native()
        if functions is not None:
            x, y, z = (stream.joined for stream in streams)
            sizes = [stream.joined for stream in needed]
            for start in range(0, len(out), _BLOCK):
                block = slice(start, start + _BLOCK)
                factors = version.rotation_factors([size[block] for size in sizes], factor)
                functions.rotations([x[block], y[block], z[block]], np.atleast_1d(factors), out[block])
            return
        for block, levels in self._blocks([*streams, *needed]):
            quantize.dequantize_rotations(levels[:3], version.rotation_factors(levels[3:], factor), out[block])

    def colours(
        self,
        streams: Sequence[IntegerStream],
        coefficient: int,
        differences: bool,
        fitting: ColourFactors,
        out: F32,
    ) -> None:
        """Levels of Y, Co, Cg of an SH coefficient to R, G, B in ``out`` (3, N).

        Args:
            streams: three; of DC what is left of its levels, where the version predicts values.
            coefficient: 0 for DC.
            differences: whether integers are the differences of levels of splats that follow each other.
            fitting: the splats' scale factors.
            out: float32.
        """
        functions = native()
        if coefficient == 0 and self.version.colour_steps:
            self._predicted(streams, fitting.classes, out)
            return
        own = fitting.ac if coefficient else fitting.dc
        if functions is not None:
            levels = [stream.joined for stream in streams]
            if differences:
                levels = [_summed(functions, level) for level in levels]
            functions.colours(levels, own, out)
            return
        last = [0, 0, 0]
        for block, parts in self._blocks(streams):
            if differences:
                channels = [part.astype(np.int64) for part in parts]
                for c, channel in enumerate(channels):
                    channel[:1] += last[c]  # an array: unlike a number it wraps round without a warning
                    np.cumsum(channel, out=channel)
                    last[c] = channel[-1]
            else:
                channels = _wider(parts)
            _to_rgb(channels, _part(own, block), out[:, block])

    def _predicted(self, streams: Sequence[IntegerStream], classes: I8, out: F32) -> None:
        """DC from what the prediction has left of its levels."""
        splats = self.header.splats
        functions = native()
        if functions is not None:
            of_classes = factors(self.header.sf_dc, np.arange(-CLASSES, CLASSES).astype(np.int8))
            functions.dc_colours([stream.joined for stream in streams], classes, *tables(), of_classes, out)
            return
        levels = from_residuals(np.stack([stream.part(0, splats).astype(np.int64) for stream in streams]), classes)
        for start in range(0, splats, _BLOCK):
            block = slice(start, start + _BLOCK)
            _to_rgb(list(levels[:, block]), factors(self.header.sf_dc, classes[block]), out[:, block])

    def of_levels(self, levels: Levels, steps: ColourSteps | None, arrays: ValueArrays) -> None:
        """The values of some splats' levels, by NumPy, into the arrays that there are, of all of the file's splats."""
        for start in range(0, levels.stop - levels.start, _LARGE_BLOCK):
            self._of_block(levels.part(start, start + _LARGE_BLOCK), steps, arrays)

    def _of_block(self, levels: Levels, steps: ColourSteps | None, arrays: ValueArrays) -> None:
        version, header = self.version, self.header
        own = arrays.part(levels.start, levels.stop)
        scales = levels.scales or []
        if own.logits is not None and levels.opacities is not None:
            own.logits[...] = version.dequantize_opacities(levels.opacities, header.sf_opacity)
        if own.log_scales is not None:
            for axis, level in enumerate(scales):
                own.log_scales[:, axis] = version.dequantize_scales(level, header.sf_scale)
        if own.quaternions is not None and levels.rotations is not None:
            turning = version.rotation_factors(scales, header.sf_rotation)
            quantize.dequantize_rotations(levels.rotations, turning, own.quaternions)
        if own.sh is None or levels.dc is None or levels.opacities is None:
            return
        own.sh[1:] = 0
        if levels.classes is not None:
            dc, ac = levels.classes
        elif steps is not None:
            dc, ac = steps.classes(scales, levels.opacities, levels.start)
        else:
            dc, ac = np.zeros((2, levels.stop - levels.start), np.int8)
        residuals = np.stack(levels.dc, dtype=np.int64)
        _to_rgb(list(from_residuals(residuals, dc)), factors(header.sf_dc, dc), own.sh[0])
        divisors = factors(header.sf_ac, ac)
        for items in levels.ac:
            rgb = np.empty(items.channels.shape, np.float32)
            _to_rgb(_wider(list(items.channels)), divisors[items.splats], rgb)
            own.sh[items.coefficients, :, items.splats] = rgb.T

    def _blocks(self, streams: Sequence[IntegerStream]) -> Iterator[tuple[slice, list[NDArray[np.integer]]]]:
        """The integers of some streams side by side, block by block."""
        for start in range(0, self.header.splats, _BLOCK):
            stop = min(start + _BLOCK, self.header.splats)
            yield slice(start, stop), [stream.part(start, stop) for stream in streams]

    def _look_up(
        self, functions: Functions, dequantize: Any, stream: IntegerStream, factor: float, out: F32, column: int
    ) -> None:
        """Values of unsigned levels from a table of what ``dequantize`` makes of the first ones."""
        levels = stream.joined
        small = levels.dtype == np.uint8
        table = dequantize(np.arange(_SMALL_TABLE if small else _LARGE_TABLE), factor)
        if functions.look_up(levels, table, out, column):
            beyond = np.flatnonzero(levels >= len(table))
            out[beyond, column] = dequantize(levels[beyond], factor)


def _summed(functions: Functions, levels: NDArray[Any]) -> NDArray[np.int64]:
    differences = functions.widened(levels, True) if levels.dtype == np.uint8 else levels
    return np.cumsum(differences, dtype=np.int64)


def _wider(levels: list[NDArray[np.integer]]) -> list[NDArray[Any]]:
    """Levels of a type that holds the sums of three of them."""
    most = max(level.dtype.itemsize for level in levels)
    dtype: type[np.signedinteger] = np.int16 if most == 1 else np.int32 if most == 2 else np.int64
    return [level.astype(dtype) for level in levels]


def _part(factors: F32, block: slice) -> F32:
    return factors if len(factors) == 1 else factors[block]


def _to_rgb(channels: list[NDArray[Any]], divisor: F32, out: F32) -> None:
    """Levels of Y, Co, Cg to R, G, B in ``out`` (3, n)."""
    y, co, cg = channels
    r = y - cg
    np.divide(r + co, divisor, out=out[0], dtype=np.float32, casting="unsafe")
    np.divide(y + cg, divisor, out=out[1], dtype=np.float32, casting="unsafe")
    np.divide(r - co, divisor, out=out[2], dtype=np.float32, casting="unsafe")
