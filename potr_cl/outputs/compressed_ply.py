"""Compressed PLY files (SuperSplat's .compressed.ply) as an output: all splats take the same bytes, q decides how many.

Its finest steps are coarser than those of other formats in one place, the AC coefficients: 1/32. The constant ones are
solved for on what that leaves.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from potr_cl.codec.encoder import Coded
from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes import compressed_ply, compressed_ply_values
from potr_cl.formats.scenes.compressed_ply_values import in_chunks
from potr_cl.formats.scenes.scene_files import unit_quaternions
from potr_cl.host.threads import thread_pool
from potr_cl.model.scene import LOW_PASS, SH_COEFFICIENTS, FloatArray, Scene
from potr_cl.outputs.degrees import worthwhile_degree
from potr_cl.outputs.feedback import rounded_in_turn
from potr_cl.outputs.output import Output, Request, Rounded, RoundedScene

#: Splats rounded at a time, whole chunks.
_BLOCK = 64 * compressed_ply_values.CHUNK
#: Bytes of a splat without AC coefficients, its part of the bounds included, and of a coefficient.
_SPLAT, _COEFFICIENT = 16, 3


@dataclass(frozen=True)
class CompressedPlyRounded(RoundedScene):
    """:class:`RoundedScene` with the words of the file; ``ac`` are the levels of the AC coefficients that it has."""

    packed: compressed_ply_values.PackedGeometry | None = None


@dataclass(frozen=True)
class CompressedPly(Output):
    """A .compressed.ply file.

    Attributes:
        to_target: as of :func:`~potr_cl.outputs.degrees.worthwhile_degree`.
    """

    format: ClassVar[SceneFormat] = compressed_ply.FORMAT
    fixes_ac: ClassVar[bool] = True
    replaces: ClassVar[Mapping[str, float]] = {"drop": 0.0}
    bytes_a_splat: ClassVar[float] = 5.0

    to_target: bool = False

    def to_meet_a_target(self) -> CompressedPly:
        """With degrees left out wherever they are not worth their bytes."""
        return replace(self, to_target=True)

    def losses(self, scene: Scene) -> list[str]:
        """A low-pass filter of the scene's own."""
        return [f"its low-pass filter of {scene.low_pass:g} square pixels"] if scene.low_pass != LOW_PASS else []

    def geometry(self, scene: Scene, request: Request) -> CompressedPlyRounded:
        """Round within the bounds of 256 neighbours."""
        order = in_chunks(scene.means, request.threads)
        seen = Scene.blank(len(scene), 1, by_splat=True)

        def rounded(start: int) -> compressed_ply_values.PackedGeometry:
            rows = order[start : start + _BLOCK]
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
            parts = list(pool.map(rounded, range(0, len(scene), _BLOCK)))
        packed = compressed_ply_values.PackedGeometry.joined(parts)
        there = replace(seen, antialiased=scene.antialiased)
        return CompressedPlyRounded(request.parameters, order, there, None, packed)

    def fix_ac(
        self, rounded: Rounded, sh: FloatArray, worth: FloatArray | None, request: Request
    ) -> tuple[CompressedPlyRounded, FloatArray]:
        """Round them; degrees that are not worth their bytes become zero and are not written."""
        assert isinstance(rounded, CompressedPlyRounded)
        kept = SH_COEFFICIENTS[worthwhile_degree(sh, worth, _COEFFICIENT, _SPLAT, request, self.to_target)]
        whole, sh = sh, sh[:, :kept]
        if request.blocks is not None and kept == whole.shape[1]:
            sh = rounded_in_turn(sh, request.blocks(), _quantise, request.threads)
        levels = np.empty((len(sh), kept - 1, 3), np.uint8)
        fixed = np.zeros_like(whole)

        def fill(start: int) -> None:
            rows = slice(start, start + _BLOCK)
            levels[rows] = compressed_ply_values.packed_sh(sh[rows, 1:])
            fixed[rows, 0] = sh[rows, 0]
            fixed[rows, 1:kept] = compressed_ply_values.unpacked_sh(levels[rows])

        with thread_pool(request.threads) as pool:
            list(pool.map(fill, range(0, len(sh), _BLOCK)))
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
