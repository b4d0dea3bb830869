"""The reduced scene, uncompressed, as an output: float32 as trainers write it, for every program there is.

Nothing is rounded; whole SH degrees that are not worth their bytes are left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from potr_cl.codec.encoder import Coded
from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes import ply
from potr_cl.model.scene import SH_COEFFICIENTS, FloatArray, Scene
from potr_cl.outputs.degrees import worthwhile_degree
from potr_cl.outputs.output import Output, Request, Rounded, RoundedScene

#: Bytes of an AC coefficient, and of a splat without any.
_COEFFICIENT, _SPLAT = 12, 68


@dataclass(frozen=True)
class Ply(Output):
    """A .ply file.

    Attributes:
        to_target: as of :func:`~potr_cl.outputs.degrees.worthwhile_degree`.
    """

    format: ClassVar[SceneFormat] = ply.FORMAT
    fixes_ac: ClassVar[bool] = True
    replaces: ClassVar[Mapping[str, float]] = {"drop": 0.0}
    bytes_a_splat: ClassVar[float] = 20.0

    to_target: bool = False

    def to_meet_a_target(self) -> Ply:
        """With degrees left out wherever they are not worth their bytes."""
        return replace(self, to_target=True)

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
