"""Which splats look the same from wherever somebody stands, as the sky does: :class:`Surroundings`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.camera import Camera, camera_centres
from potr_cl.model.scene import Scene

#: What is so many times as far as the farthest camera and as the median splat is at infinity: from one camera to the
#: middle of all, it shifts by less than 6 degrees.
_FAR = 10.0
#: The largest part of a scene's splats that may be there: they are drawn whatever the budget is.
_MOST = 0.1


@dataclass(frozen=True)
class Surroundings:
    """All that is farther than a distance from a point.

    Attributes:
        middle: (3,) of the cameras.
        distance: from there, world units; infinite where nothing is far.
    """

    middle: NDArray[np.float64]
    distance: float

    @staticmethod
    def of(scene: Scene, views: Sequence[Camera]) -> Surroundings:
        """Those of a scene that some views look at; nothing is far without any."""
        if not views:
            return Surroundings(np.zeros(3), np.inf)
        centres = camera_centres(views)
        middle = np.median(centres, axis=0)
        away = np.linalg.norm(scene.means - middle, axis=1)
        distance = _FAR * max(float(np.median(away)), float(np.linalg.norm(centres - middle, axis=1).max()))
        return Surroundings(middle, distance if np.mean(away > distance) <= _MOST else np.inf)

    def have(self, scene: Scene) -> NDArray[np.bool_]:
        """(N,) whether each of a scene's splats is in them."""
        found: NDArray[np.bool_] = np.linalg.norm(scene.means - self.middle, axis=1) > self.distance
        return found
