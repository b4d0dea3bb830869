"""Binary glTF as an output: SPZ in KHR_gaussian_splatting, as CesiumJS reads it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from potr_cl.codec.encoder import Coded
from potr_cl.errors import UsageError
from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes import gltf, gltf_file
from potr_cl.model.scene import Scene
from potr_cl.outputs.output import Request, Rounded, RoundedScene
from potr_cl.outputs.spz import Spz


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
