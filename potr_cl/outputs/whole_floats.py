"""What outputs of float32 share: nothing is rounded, whole SH degrees that are not worth their bytes are left out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.scene import SH_COEFFICIENTS, FloatArray, Scene
from potr_cl.outputs.degrees import worthwhile_degree
from potr_cl.outputs.output import Output, Request, Rounded, RoundedScene

_COEFFICIENT = 12


@dataclass(frozen=True)
class WholeFloats(Output):
    """An output whose files have the values as they are.

    Attributes:
        splat_bytes: of a splat without AC coefficients.
        to_target: as of :func:`~potr_cl.outputs.degrees.worthwhile_degree`.
    """

    fixes_ac: ClassVar[bool] = True
    replaces: ClassVar[Mapping[str, float]] = {"drop": 0.0}
    splat_bytes: ClassVar[int]

    to_target: bool = False

    def to_meet_a_target(self) -> WholeFloats:
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
        degree = worthwhile_degree(sh, worth, _COEFFICIENT, self.splat_bytes, request, self.to_target)
        kept = SH_COEFFICIENTS[degree]
        rounded = replace(rounded, ac=kept)
        if kept == sh.shape[1]:
            return rounded, sh
        fixed = sh.copy()
        fixed[:, kept:] = 0
        return rounded, fixed

    def reduced(self, scene: Scene, rounded: Rounded | None, request: Request) -> tuple[Scene, NDArray[np.int64]]:
        """What the file holds, and the number in ``scene`` of each of its splats."""
        rounded, sh = self.prepared(scene, rounded, request)
        assert isinstance(rounded, RoundedScene)
        return replace(scene, sh=sh[:, : rounded.ac]), rounded.order
