"""SPZ files (Niantic's .spz) as an output: what its 8 bits may lose follows from q, as the steps of a .potr file do."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.encoder import Coded
from potr_cl.codec.geometry import distances_to_views
from potr_cl.codec.quantisers import QUANTISERS, Balanced, Paper
from potr_cl.codec.quantize import ZERO_SCALE, HyperParameters, canonical_rotations
from potr_cl.errors import DataError, UsageError
from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes import gltf, gltf_file, spz, spz_values
from potr_cl.host.threads import thread_pool
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.outputs.feedback import rounded_in_turn
from potr_cl.outputs.level_choice import U8, LevelTable, chosen_levels, weight_classes
from potr_cl.outputs.output import Output, Request, Rounded, RoundedScene

#: With what a splat may cost in error this says what a bit may: about the bits that a splat takes, and some, for errors
#: of many splats add up to more than the re-fit's blocks know.
_BITS_A_SPLAT = 250
#: Splats that tell how often levels occur, about.
_SAMPLE = 1 << 15
#: Splats rounded at a time.
_BLOCK = 1 << 14
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
        world = QUANTISERS[parameters.quantiser].in_world_units(parameters, scene, nearest)
        bits, positions = self._positions(scene, np.maximum(world.gamma, world.beta * nearest))
        order = self._order(positions)
        scales, opacities = _scales(world), _opacities(world)
        seen = Scene.blank(len(scene), 1, by_splat=True)
        properties = [np.empty((len(scene), width), np.uint8) for width in _widths(self.version)]

        def fill(start: int) -> None:
            block = slice(start, start + _BLOCK)
            rows = order[block]
            turned, sizes = scene.quaternions.take(rows, axis=0), scene.log_scales.take(rows, axis=0)
            imaginary, log_scales = canonical_rotations(turned, sizes)
            levels = scales[np.clip(np.round((log_scales + np.float32(10)) * np.float32(16)), 0, 255).astype(np.uint8)]
            log_scales = (levels / 16 - 10).astype(np.float32)
            some = Scene(
                (positions.take(rows, axis=0) * 2.0**-bits).astype(np.float32),
                log_scales,
                self._rotations(imaginary, log_scales, world),
                scene.opacity_logits.take(rows),
                np.zeros((len(rows), 1, 3), np.float32),
            )
            stored = spz_values.packed(some, bits, self.version)
            stored[1] = opacities[np.frombuffer(stored[1], np.uint8)].tobytes()
            for whole, part in zip(properties, stored, strict=True):
                whole[block] = np.frombuffer(part, np.uint8).reshape(len(rows), -1)
            there = spz_values.unpacked(stored, len(rows), 1, self.version, bits)
            seen.means[rows], seen.log_scales[rows] = there.means, there.log_scales
            seen.quaternions[rows], seen.opacity_logits[rows] = there.quaternions, there.opacity_logits
            seen.sh[rows] = 0

        with thread_pool(request.threads) as pool:
            list(pool.map(fill, range(0, len(scene), _BLOCK)))
        as_file = tuple(part.tobytes() for part in properties)
        return SpzRounded(parameters, order, replace(seen, antialiased=scene.antialiased), None, bits, as_file)

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
        columns = [column - column.min() for column in positions.T]
        axis = int(np.argmin([len(np.unique(column)) for column in columns]))
        keys = [columns[axis], *(columns[k] for k in range(3) if k != axis)]
        places = int(np.bitwise_or.reduce([np.bitwise_or.reduce(key) for key in keys]))
        unused = (places & -places).bit_length() - 1 if places else 0
        widths = [int(key.max() >> unused).bit_length() for key in keys]
        if sum(widths) > 63:
            return np.lexsort(keys[::-1])
        # One number for all three: quicker to sort.
        first, second, third = (key >> unused for key in keys)
        return np.argsort((first << widths[1] | second) << widths[2] | third, kind="stable")

    def _rotations(self, imaginary: NDArray[np.float64], log_scales: FloatArray, world: HyperParameters) -> FloatArray:
        """(N, 4) unit quaternions w, x, y, z with w largest, on multiples of SPZ's steps."""
        largest = np.exp(log_scales.max(axis=1).astype(np.float64)) * world.sf_scale
        factor = (
            world.sf_rotation * np.sqrt(np.maximum(largest, 1))
            if world.quantiser == Balanced.number
            else world.sf_rotation
        )
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
        if worth is None or sh.shape[1] == 1:
            levels = _ac_levels(sh[:, 1:])
        elif request.blocks is None:
            levels = chosen_levels(
                _ac_levels(sh[:, 1:]), worth[:, 1:] * _bits_of_error(_AC_STEP, request), request.threads
            )
        else:
            fixed, levels = self._fixed_in_turn(sh, worth, request.blocks(), request)
            return replace(rounded, ac=levels, worth=worth), fixed
        fixed = sh.copy()
        fixed[:, 1:] = _values_of_levels(levels)
        return replace(rounded, ac=levels, worth=worth), fixed

    def _fixed_in_turn(
        self, sh: FloatArray, worth: FloatArray, blocks: FloatArray, request: Request
    ) -> tuple[FloatArray, U8]:
        """Coefficients on levels, each chosen so that it makes up for the ones behind it; and the levels."""
        a_level = _bits_of_error(_AC_STEP, request)
        some = slice(None, None, max(len(sh) // _SAMPLE, 1))
        table = LevelTable(_ac_levels(sh[some, 1:]), worth[some, 1:] * a_level)

        def quantise(coefficient: int, wanted: FloatArray, splats: slice) -> FloatArray:
            classes = weight_classes(worth[splats, coefficient] * a_level)
            return _values_of_levels(table(_ac_levels(wanted), classes))

        fixed = rounded_in_turn(sh, blocks, quantise, request.threads)
        levels = np.empty((len(sh), sh.shape[1] - 1, 3), np.uint8)

        def fill(start: int) -> None:
            some = slice(start, start + _BLOCK)
            levels[some] = _levels_of_values(fixed[some, 1:])

        with thread_pool(request.threads) as pool:
            list(pool.map(fill, range(0, len(sh), _BLOCK)))
        return fixed, levels

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
        properties[2] = levels.take(order, axis=0).tobytes()
        properties[5] = rounded.ac.take(order, axis=0).tobytes()
        pieces = spz.pieces(properties, scene, rounded.fractional_bits, self.version)
        request.progress("pack", 1.0)
        return Coded(pieces, order)

    def properties(self, data: bytes) -> dict[str, int]:
        """Of version 4, whose streams are apart."""
        return spz.stream_sizes(data)


def _widths(version: int) -> tuple[int, ...]:
    """Bytes of a splat in each property, without AC coefficients."""
    return 9, 1, 3, 3, 3 if version < 3 else 4, 0


def _ac_levels(sh: FloatArray) -> U8:
    """The nearest levels."""
    values = np.rint(sh * np.float32(128))
    values += 128
    levels: U8 = np.clip(values, 0, 255, out=values).astype(np.uint8)
    return levels


def _values_of_levels(levels: U8) -> FloatArray:
    return (levels.astype(np.float32) - np.float32(128)) * np.float32(1 / 128)


def _levels_of_values(values: FloatArray) -> U8:
    """What :func:`_values_of_levels` was given."""
    return (values * np.float32(128) + np.float32(128)).astype(np.uint8)


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
    values: NDArray[Any] = opacities if world.quantiser == Paper.number else np.log(opacities / (1 - opacities))
    groups = np.floor(values * world.sf_opacity + 0.5)
    return _merged(values * world.sf_opacity, groups, groups)


def _merged(values: NDArray[Any], groups: NDArray[Any], centres: NDArray[Any]) -> U8:
    """(256,) the level of each group that is nearest to the group's centre."""
    table = np.empty(256, np.uint8)
    for group in np.unique(groups):
        members = np.flatnonzero(groups == group)
        table[members] = members[np.abs(values[members] - centres[members]).argmin()]
    return table


@dataclass(frozen=True)
class Gltf(Spz):
    """A .glb file.

    Attributes:
        version: 2 or 3 of SPZ; CesiumJS does not read 4.
    """

    format: ClassVar[SceneFormat] = gltf.FORMAT

    def __post_init__(self) -> None:
        if self.version not in (2, 3):
            raise UsageError(f".glb files hold SPZ of version 2 or 3, not {self.version}")

    @classmethod
    def suffixes(cls) -> tuple[str, ...]:
        """One file only."""
        return (".glb",)

    def file(self, scene: Scene, rounded: Rounded | None, request: Request) -> Coded:
        """The SPZ, within glTF."""
        rounded, sh = self.prepared(scene, rounded, request)
        assert isinstance(rounded, RoundedScene)
        coded = super().file(replace(scene, sh=sh), rounded, request)
        return replace(coded, pieces=gltf_file.binary(replace(scene, means=rounded.scene.means), coded.pieces))
