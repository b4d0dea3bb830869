"""SPZ files (Niantic's .spz) as an output: what its 8 bits may lose follows from q, as the steps of a .potr file do."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.encoder import Coded
from potr_cl.codec.geometry import distances_to_views
from potr_cl.codec.quantize import ZERO_SCALE, HyperParameters, canonical_rotations
from potr_cl.codec.versions import VERSIONS
from potr_cl.errors import DataError, UsageError
from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes import spz, spz_values
from potr_cl.host.threads import thread_pool
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.outputs.feedback import rounded_in_turn
from potr_cl.outputs.level_choice import U8, LevelTable, chosen_levels
from potr_cl.outputs.output import Output, Request, Rounded, RoundedScene

#: With what a splat may cost in error this says what a bit may: about the bits that a splat takes, and some, for errors
#: of many splats add up to more than the re-fit's blocks know.
_BITS_A_SPLAT = 250
#: Splats that tell how often levels occur, about.
_SAMPLE = 1 << 15
#: A level of AC coefficients, and of constant ones.
_AC_STEP, _DC_STEP = 1 / 128, 1 / (255 * 0.15)


@dataclass(frozen=True)
class SpzRounded(RoundedScene):
    """:class:`RoundedScene` with what the file has of it.

    Attributes:
        fractional_bits: of positions.
        properties: bytes of geometry and opacities in the order of the file, as
            :func:`potr_cl.formats.scenes.spz_values.packed` makes them; those of colours are of no account.
        worth: as :meth:`Output.fix_ac` got it; None if there were no views.
    """

    fractional_bits: int = 12
    properties: tuple[bytes, ...] = ()
    worth: FloatArray | None = None


@dataclass(frozen=True)
class Spz(Output):
    """A .spz file.

    Attributes:
        version: 2, 3 or 4 of the format.
    """

    format: ClassVar[SceneFormat] = spz.FORMAT
    choices: ClassVar[frozenset[str]] = frozenset({"gamma", "beta", "sf_opacity", "sf_rotation", "sf_scale"})
    fixes_ac: ClassVar[bool] = True
    bytes_a_splat: ClassVar[float] = 1.4

    version: int = 2

    def __post_init__(self) -> None:
        if self.version not in spz.FORMAT.versions:
            raise UsageError(f"SPZ is written in version 2, 3 or 4, not {self.version}")

    def geometry(self, scene: Scene, request: Request) -> SpzRounded:
        """Round to the steps of ``request.parameters`` where SPZ's own are finer."""
        parameters = request.parameters
        with thread_pool(request.threads) as pool:
            nearest = distances_to_views(scene.means, request.views, pool.map)
        world = VERSIONS[parameters.version].in_world_units(parameters, scene, nearest)
        bits, positions = self._positions(scene, np.maximum(world.gamma, world.beta * nearest))
        order = self._order(positions)
        scales = _scales(world)
        imaginary, log_scales = canonical_rotations(scene.quaternions[order], scene.log_scales[order])
        levels = scales[np.clip(np.round((log_scales + np.float32(10)) * np.float32(16)), 0, 255).astype(np.uint8)]
        log_scales = (levels / 16 - 10).astype(np.float32)
        quaternions = self._rotations(imaginary, log_scales, world)
        sorted_scene = replace(
            scene.subset(order),
            means=(positions[order] * 2.0**-bits).astype(np.float32),
            log_scales=log_scales,
            quaternions=quaternions,
            sh=np.zeros((len(scene), 1, 3), np.float32),
        )
        properties = spz_values.packed(sorted_scene, bits, self.version)
        properties[1] = _opacities(world)[np.frombuffer(properties[1], np.uint8)].tobytes()
        seen = spz_values.unpacked(properties, len(scene), 1, self.version, bits)
        back = np.empty_like(order)
        back[order] = np.arange(len(order))
        seen = replace(seen.subset(back), antialiased=scene.antialiased)
        return SpzRounded(parameters, order, seen, None, bits, tuple(properties))

    def _positions(self, scene: Scene, tolerance: NDArray[np.float64]) -> tuple[int, NDArray[np.int64]]:
        """Fractional bits and positions in their steps; each is a multiple of a power of two that it can do with.

        ``tolerance`` is how far a centre may move: half the diagonal of a cube of steps.
        """
        step = np.floor(np.log2(2 / np.sqrt(3) * np.maximum(tolerance, 1e-30)))
        largest = float(np.abs(scene.means).max())
        room = int(np.floor(np.log2(spz_values.POSITION_LIMIT / max(largest, 1e-30))))
        most = min(room, spz_values.MOST_FRACTIONAL_BITS)
        if most < 1:
            raise DataError(f"SPZ cannot hold a splat {largest:.3g} units from the origin")
        finest = -int(np.clip(np.median(step), -most, -1))
        coarser = np.clip(step + finest, 0, 8) - finest
        steps = np.round(scene.means * 2.0 ** -coarser[:, None]).astype(np.int64)
        # More fractional bits than needed: the lowest byte is 0 throughout where there is room.
        bits = min(most, finest + 8)
        return bits, steps << (coarser + bits).astype(np.int64)[:, None]

    def _order(self, positions: NDArray[np.int64]) -> NDArray[np.int64]:
        """By one coordinate: the splats of a slab repeat its bytes, which a general compressor sees."""
        axis = int(np.argmin([len(np.unique(column)) for column in positions.T]))
        others = [k for k in range(3) if k != axis]
        return np.lexsort([positions[:, others[1]], positions[:, others[0]], positions[:, axis]])

    def _rotations(self, imaginary: NDArray[np.float64], log_scales: FloatArray, world: HyperParameters) -> FloatArray:
        """(N, 4) unit quaternions w, x, y, z with w largest, on multiples of SPZ's steps."""
        largest = np.exp(log_scales.max(axis=1).astype(np.float64)) * world.sf_scale
        factor = world.sf_rotation * np.sqrt(np.maximum(largest, 1)) if world.version > 1 else world.sf_rotation
        unit, offset = (127.5, 0.5) if self.version < 3 else (511 * np.sqrt(2), 0.0)
        coarser = 2.0 ** np.maximum(np.round(np.log2(unit / factor)), 0) * np.ones(len(imaginary))
        levels = np.round((imaginary * unit - offset) / coarser[:, None])
        levels[np.ptp(log_scales, axis=1) == 0] = 0
        parts = (levels * coarser[:, None] + offset) / unit
        real = np.sqrt(np.maximum(1 - (parts * parts).sum(axis=1), 0))
        return np.column_stack([real, parts]).astype(np.float32)

    def fix_ac(
        self, rounded: Rounded, sh: FloatArray, worth: FloatArray | None, request: Request
    ) -> tuple[SpzRounded, FloatArray]:
        """Levels by what an error costs and by what a level takes."""
        assert isinstance(rounded, SpzRounded)
        fixed, levels = sh.copy(), _ac_levels(sh[:, 1:])
        if worth is not None and levels.size:
            cost = worth[:, 1:] * _bits_of_error(_AC_STEP, request)
            if request.blocks is None:
                levels = chosen_levels(levels, cost, request.threads)
            else:
                some = slice(None, None, max(len(sh) // _SAMPLE, 1))
                table = LevelTable(levels[some], cost[some])

                def quantise(coefficient: int, wanted: FloatArray, splats: slice) -> FloatArray:
                    chosen = table(_ac_levels(wanted), cost[splats, coefficient - 1])
                    return (chosen.astype(np.float32) - np.float32(128)) / np.float32(128)

                fixed = rounded_in_turn(sh, request.blocks(), quantise, request.threads)
                levels = _ac_levels(fixed[:, 1:])
        fixed[:, 1:] = (levels.astype(np.float32) - np.float32(128)) / np.float32(128)
        return replace(rounded, ac=levels, worth=worth), fixed

    def file(self, scene: Scene, rounded: Rounded | None, request: Request) -> Coded:
        """Levels of the constant coefficients, then the bytes."""
        request.progress("pack", 0.0)
        rounded, sh = self.prepared(scene, rounded, request)
        assert isinstance(rounded, SpzRounded)
        levels = np.clip(np.round(sh[:, :1] / np.float32(_DC_STEP) + np.float32(127.5)), 0, 255).astype(np.uint8)
        if rounded.worth is not None:
            levels = chosen_levels(levels, rounded.worth[:, :1] * _bits_of_error(_DC_STEP, request), request.threads)
        order = rounded.order
        properties = list(rounded.properties)
        properties[2] = levels[order].tobytes()
        properties[5] = rounded.ac[order].tobytes()
        pieces = spz.pieces(properties, scene, rounded.fractional_bits, self.version)
        request.progress("pack", 1.0)
        return Coded(pieces, order)

    def properties(self, data: bytes) -> dict[str, int]:
        """Of version 4, whose streams are apart."""
        return spz.stream_sizes(data)


def _ac_levels(sh: NDArray[np.floating]) -> U8:
    levels: U8 = np.clip(np.round(sh * 128) + 128, 0, 255).astype(np.uint8)
    return levels


def _bits_of_error(step: float, request: Request) -> np.float32:
    """Bits that an error of one step is worth, for a worth of 1."""
    a_bit = max(request.parameters.delta_mse_max, 1e-30) / _BITS_A_SPLAT
    return np.float32(step * step / a_bit)


def _scales(world: HyperParameters) -> U8:
    """(256,) the level of a scale that stands for each; small ones, which linear steps do not tell apart, share one."""
    scales = np.exp(np.arange(256) / 16 - 10) * world.sf_scale
    groups = np.floor(scales + 0.5)
    return _merged(scales, groups, np.where(groups == 0, ZERO_SCALE, groups))


def _opacities(world: HyperParameters) -> U8:
    """(256,) the level of an opacity that stands for each; steps are those of logits but in version 1."""
    opacities = np.clip(np.arange(256) / 255, 1e-4, 1 - 1e-4)
    values: NDArray[Any] = opacities if world.version == 1 else np.log(opacities / (1 - opacities))
    groups = np.floor(values * world.sf_opacity + 0.5)
    return _merged(values * world.sf_opacity, groups, groups)


def _merged(values: NDArray[Any], groups: NDArray[Any], centres: NDArray[Any]) -> U8:
    """(256,) the level of each group that is nearest to the group's centre."""
    table = np.empty(256, np.uint8)
    for group in np.unique(groups):
        members = np.flatnonzero(groups == group)
        table[members] = members[np.abs(values[members] - centres[members]).argmin()]
    return table
