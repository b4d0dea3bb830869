"""Binary glTF with KHR_gaussian_splatting as an output: float32 as in a PLY, so q only decides what is left."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from potr_cl.codec.encoder import Coded
from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes import gltf, gltf_writer
from potr_cl.model.scene import Scene
from potr_cl.outputs.output import Request, Rounded
from potr_cl.outputs.whole_floats import WholeFloats


@dataclass(frozen=True)
class Gltf(WholeFloats):
    """A .glb file."""

    format: ClassVar[SceneFormat] = gltf.FORMAT
    bytes_a_splat: ClassVar[float] = 19.0
    splat_bytes: ClassVar[int] = 56

    @classmethod
    def suffixes(cls) -> tuple[str, ...]:
        """One file only."""
        return (".glb",)

    def losses(self, scene: Scene) -> list[str]:
        """How antialiased scenes are rendered: the extension knows no word for it."""
        return ["that it is antialiased: viewers will draw it as the others"] if scene.antialiased else []

    def file(self, scene: Scene, rounded: Rounded | None, request: Request) -> Coded:
        """See :func:`potr_cl.formats.scenes.gltf_writer.pieces`."""
        scene, order = self.reduced(scene, rounded, request)
        return Coded(gltf_writer.pieces(scene), order, scene.sh_degree)
