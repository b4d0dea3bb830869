"""PLY files as outputs: plain ones, in which nothing is rounded, and compressed ones.

Whole SH degrees that are not worth their bytes are left out of both.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.encoder import Coded
from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes import compressed_ply, compressed_ply_values, ply
from potr_cl.formats.scenes.compressed_ply_values import in_chunks
from potr_cl.formats.scenes.scene_files import unit_quaternions
from potr_cl.host.threads import thread_pool
from potr_cl.model.scene import LOW_PASS, SH_COEFFICIENTS, FloatArray, Scene
from potr_cl.outputs.feedback import rounded_in_turn
from potr_cl.outputs.output import Output, Request, Rounded, RoundedScene

if TYPE_CHECKING:
    from typing_extensions import Self

#: Splats worked on at a time.
_BLOCK = 1 << 14


def worthwhile_degree(
    sh: FloatArray,
    worth: FloatArray | None,
    bytes_a_coefficient: int,
    other_bytes: int,
    request: Request,
    to_target: bool = False,
) -> int:
    """The SH degree up to which the coefficients are kept.

    To leave out a degree saves bytes of all splats, as to remove some splats does. It is worth it if it costs less
    error than the splats of as many bytes would, each of which may cost ``delta_mse_max``. That alone would give up the
    highlights of a few splats for the bytes of all, and the file would look worse than other files of the same q. So
    all that goes must also cost no more than what those give up: single coefficients, each where it is not worth its
    bytes.

    Args:
        sh: (N, M, 3) coefficients.
        worth: as of :meth:`potr_cl.outputs.output.Output.fix_ac`; None: nobody knows, so the degree stays.
        bytes_a_coefficient: of all three channels.
        other_bytes: of a splat, its geometry and its constant coefficients.
        request: whose parameters say what a splat may cost.
        to_target: only the worth of bytes counts, because somebody has asked for a size or a PSNR.
    """
    degree = SH_COEFFICIENTS.index(sh.shape[1])
    if worth is None:
        return degree
    limit = request.parameters.delta_mse_max
    price = limit * bytes_a_coefficient / (other_bytes + bytes_a_coefficient * (sh.shape[1] - 1))

    def errors_of(start: int) -> NDArray[np.float64]:
        some = slice(start, start + _BLOCK)
        each = worth[some] * np.square(sh[some]).sum(axis=2)
        return np.stack([each.sum(axis=0, dtype=np.float64), np.minimum(each, price).sum(axis=0, dtype=np.float64)])

    with thread_pool(request.threads) as pool:
        errors, given_up = sum(pool.map(errors_of, range(0, len(sh), _BLOCK)), np.zeros((2, sh.shape[1])))
    left = np.inf if to_target else given_up[1:].sum()
    while degree > 0:
        first, end = SH_COEFFICIENTS[degree - 1], SH_COEFFICIENTS[degree]
        splat = other_bytes + bytes_a_coefficient * (end - 1)
        removed = len(sh) * bytes_a_coefficient * (end - first) / splat
        cost = errors[first:end].sum()
        if cost > min(limit * removed, left):
            break
        left -= cost
        degree -= 1
    return degree


@dataclass(frozen=True)
class _WholeDegrees(Output):
    """Files in which all splats have coefficients of the same SH degree.

    Attributes:
        to_target: as of :func:`worthwhile_degree`.
    """

    fixes_ac: ClassVar[bool] = True
    replaces: ClassVar[Mapping[str, float]] = {"drop": 0.0}

    to_target: bool = False

    def to_meet_a_target(self) -> Self:
        """With degrees left out wherever they are not worth their bytes."""
        return replace(self, to_target=True)


#: Bytes of an AC coefficient, and of a splat without any.
_COEFFICIENT, _SPLAT = 12, 68


@dataclass(frozen=True)
class Ply(_WholeDegrees):
    """A .ply file: float32 as trainers write it, for every program there is."""

    format: ClassVar[SceneFormat] = ply.FORMAT
    bytes_a_splat: ClassVar[float] = 20.0

    def geometry(self, scene: Scene, request: Request) -> RoundedScene:
        """As it is."""
        return RoundedScene(request.parameters, np.arange(len(scene)), scene)

    def fix_ac(
        self, rounded: Rounded, sh: FloatArray, worth: FloatArray | None, request: Request
    ) -> tuple[RoundedScene, FloatArray]:
        """Degrees that are not worth their bytes become zero and are not written."""
        assert isinstance(rounded, RoundedScene)
        degree = worthwhile_degree(sh, worth, _COEFFICIENT, _SPLAT, request, self.to_target)
        kept = SH_COEFFICIENTS[degree]
        rounded = replace(rounded, ac=kept)
        if kept == sh.shape[1]:
            return rounded, sh
        fixed = sh.copy()
        fixed[:, kept:] = 0
        return rounded, fixed

    def file(self, scene: Scene, rounded: Rounded | None, request: Request) -> Coded:
        """See :func:`potr_cl.formats.scenes.ply.pieces`."""
        rounded, sh = self.prepared(scene, rounded, request)
        assert isinstance(rounded, RoundedScene)
        reduced = replace(scene, sh=sh[:, : rounded.ac])
        return Coded([bytes(piece) for piece in ply.pieces(reduced)], rounded.order, reduced.sh_degree)


#: Splats rounded at a time, whole chunks.
_PACKED = 64 * compressed_ply_values.CHUNK
#: Bytes of a splat without AC coefficients, its part of the bounds included, and of a coefficient.
_PACKED_SPLAT, _PACKED_COEFFICIENT = 16, 3


@dataclass(frozen=True)
class CompressedPlyRounded(RoundedScene):
    """:class:`RoundedScene` with the words of the file; ``ac`` are the levels of the AC coefficients that it has."""

    packed: compressed_ply_values.PackedGeometry | None = None


@dataclass(frozen=True)
class CompressedPly(_WholeDegrees):
    """A .compressed.ply file (SuperSplat's): all splats take the same bytes, q decides how many.

    Its finest steps are coarser than those of other formats in one place, the AC coefficients: 1/32. The constant ones
    are solved for on what that leaves.
    """

    format: ClassVar[SceneFormat] = compressed_ply.FORMAT
    bytes_a_splat: ClassVar[float] = 5.0

    def losses(self, scene: Scene) -> list[str]:
        """A low-pass filter of the scene's own."""
        return [f"its low-pass filter of {scene.low_pass:g} square pixels"] if scene.low_pass != LOW_PASS else []

    def geometry(self, scene: Scene, request: Request) -> CompressedPlyRounded:
        """Round within the bounds of 256 neighbours."""
        order = in_chunks(scene.means, request.threads)
        seen = Scene.blank(len(scene), 1, by_splat=True)

        def rounded(start: int) -> compressed_ply_values.PackedGeometry:
            rows = order[start : start + _PACKED]
            some = Scene(
                scene.means.take(rows, axis=0),
                scene.log_scales.take(rows, axis=0),
                scene.quaternions.take(rows, axis=0),
                scene.opacity_logits.take(rows),
                np.zeros((len(rows), 1, 3), np.float32),
            )
            packed = compressed_ply_values.packed_geometry(unit_quaternions(some))
            there = compressed_ply_values.unpacked_geometry(packed)
            seen.means[rows], seen.log_scales[rows] = there.means, there.log_scales
            seen.quaternions[rows], seen.opacity_logits[rows] = there.quaternions, there.opacity_logits
            seen.sh[rows] = 0
            return packed

        with thread_pool(request.threads) as pool:
            parts = list(pool.map(rounded, range(0, len(scene), _PACKED)))
        packed = compressed_ply_values.PackedGeometry.joined(parts)
        there = replace(seen, antialiased=scene.antialiased)
        return CompressedPlyRounded(request.parameters, order, there, None, packed)

    def fix_ac(
        self, rounded: Rounded, sh: FloatArray, worth: FloatArray | None, request: Request
    ) -> tuple[CompressedPlyRounded, FloatArray]:
        """Round them; degrees that are not worth their bytes become zero and are not written."""
        assert isinstance(rounded, CompressedPlyRounded)
        kept = SH_COEFFICIENTS[
            worthwhile_degree(sh, worth, _PACKED_COEFFICIENT, _PACKED_SPLAT, request, self.to_target)
        ]
        whole, sh = sh, sh[:, :kept]
        if request.blocks is not None and kept == whole.shape[1]:
            sh = rounded_in_turn(sh, request.blocks(), _quantise, request.threads)
        levels = np.empty((len(sh), kept - 1, 3), np.uint8)
        fixed = np.zeros_like(whole)

        def fill(start: int) -> None:
            rows = slice(start, start + _PACKED)
            levels[rows] = compressed_ply_values.packed_sh(sh[rows, 1:])
            fixed[rows, 0] = sh[rows, 0]
            fixed[rows, 1:kept] = compressed_ply_values.unpacked_sh(levels[rows])

        with thread_pool(request.threads) as pool:
            list(pool.map(fill, range(0, len(sh), _PACKED)))
        return replace(rounded, ac=levels), fixed

    def file(self, scene: Scene, rounded: Rounded | None, request: Request) -> Coded:
        """The constant coefficients, within the bounds of 256 neighbours, and the bytes."""
        request.progress("pack", 0.0)
        rounded, sh = self.prepared(scene, rounded, request)
        assert isinstance(rounded, CompressedPlyRounded)
        assert rounded.packed is not None
        colours = compressed_ply_values.packed_colours(sh[rounded.order, 0])
        pieces = compressed_ply.pieces(
            rounded.packed, colours, rounded.ac.take(rounded.order, axis=0), scene.antialiased
        )
        request.progress("pack", 1.0)
        return Coded(pieces, rounded.order, SH_COEFFICIENTS.index(1 + rounded.ac.shape[1]))

    def read(self, data: bytes, trust: bool = False) -> Scene:
        """See :func:`potr_cl.formats.scenes.compressed_ply.scene_of`."""
        return compressed_ply.scene_of(data)


def _quantise(coefficient: int, wanted: FloatArray, splats: slice) -> FloatArray:
    return compressed_ply_values.unpacked_sh(compressed_ply_values.packed_sh(wanted))
