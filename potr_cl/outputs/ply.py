"""The reduced scene, uncompressed, as an output: float32 as trainers write it, for every program there is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from potr_cl.codec.encoder import Coded
from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes import ply
from potr_cl.model.scene import Scene
from potr_cl.outputs.output import Output, Request, Rounded, RoundedScene


@dataclass(frozen=True)
class Ply(Output):
    """A .ply: nothing is rounded, so q only decides which splats are left."""

    format: ClassVar[SceneFormat] = ply.FORMAT
    replaces: ClassVar[Mapping[str, float]] = {"drop": 0.0}
    bytes_a_splat: ClassVar[float] = 20.0

    def geometry(self, scene: Scene, request: Request) -> RoundedScene:
        """As it is."""
        return RoundedScene(request.parameters, np.arange(len(scene)), scene)

    def file(self, scene: Scene, rounded: Rounded | None, request: Request) -> Coded:
        """See :func:`potr_cl.formats.scenes.ply.save`."""
        return Coded([bytes(piece) for piece in ply.pieces(scene)], np.arange(len(scene)))
