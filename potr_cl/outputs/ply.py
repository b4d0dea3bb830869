"""The reduced scene, uncompressed, as an output: float32 as trainers write it, for every program there is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from potr_cl.codec.encoder import Coded
from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes import ply
from potr_cl.model.scene import Scene
from potr_cl.outputs.output import Request, Rounded
from potr_cl.outputs.whole_floats import WholeFloats


@dataclass(frozen=True)
class Ply(WholeFloats):
    """A .ply file."""

    format: ClassVar[SceneFormat] = ply.FORMAT
    bytes_a_splat: ClassVar[float] = 20.0
    splat_bytes: ClassVar[int] = 68

    def file(self, scene: Scene, rounded: Rounded | None, request: Request) -> Coded:
        """See :func:`potr_cl.formats.scenes.ply.pieces`."""
        scene, order = self.reduced(scene, rounded, request)
        return Coded([bytes(piece) for piece in ply.pieces(scene)], order, scene.sh_degree)
