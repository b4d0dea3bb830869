"""The splats that no view's picture reaches: :func:`unseen_splats`. Pure NumPy.

These are the splats beside, behind or right in front of every camera, whatever hides the others. Views cannot say what
they are worth: perhaps nothing, perhaps the other half of the scene, of which somebody gave no cameras.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from potr_cl.host.threads import Run
from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene, opacities_of
from potr_cl.model.splat_groups import SplatGroups, largest_scales

#: The renderer's near plane, world units: a splat whose centre is nearer is not drawn.
NEAR = 0.2
#: How far splats reach, in standard deviations, and what a renderer adds to that, in pixels.
REACH, _PIXELS = 3.5, 2.0
#: Splats looked at at a time.
_BLOCK = 1 << 16


def unseen_splats(
    scene: Scene, cameras: Sequence[Camera], groups: SplatGroups | None = None, run: Run = map
) -> NDArray[np.bool_]:
    """Which splats lie outside of every view's picture.

    Args:
        scene: clean.
        cameras: the views; without any, no splat is seen.
        groups: of the scene, where they are known: most views show nothing of a neighbourhood of a large scene.
        run: shares the work out.

    Returns:
        (N,) whether it is unseen. A splat of which any part may touch a picture is not, even if others hide it.
    """
    unseen = np.ones(len(scene), bool)
    order = views_in_turn(len(cameras))
    shown = np.zeros((0, 0), bool) if groups is None else groups.visible_by(cameras, NEAR, run)

    def look(start: int) -> None:
        """Find out which of a block of splats are seen."""
        stop = min(start + _BLOCK, len(scene))
        left = np.arange(start, stop) if groups is None else groups.order[start:stop]
        among = None if groups is None else np.searchsorted(groups.starts, np.arange(start, stop), "right") - 1
        means = scene.means[left].astype(np.float64)
        with np.errstate(over="ignore"):
            reach = REACH * np.exp(np.minimum(largest_scales(scene.log_scales[left]), 80).astype(np.float64))
        for view in order:
            if among is None:
                seen = _shows(cameras[view], means, reach)
            else:
                if not shown[view][among[0] : among[-1] + 1].any():
                    continue
                near = np.flatnonzero(shown[view][among])
                if not len(near):
                    continue
                seen = np.zeros(len(left), bool)
                seen[near] = _shows(cameras[view], means[near], reach[near])
            unseen[left[seen]] = False
            left, means, reach = left[~seen], means[~seen], reach[~seen]
            among = None if among is None else among[~seen]
            if not len(left):
                break

    for _ in run(look, range(0, len(scene), _BLOCK)):
        pass
    return unseen


def views_in_turn(count: int) -> NDArray[np.int64]:
    """The numbers of views, those far from each other first: what one does not see the next one may."""
    return np.argsort((np.arange(count) * (math.sqrt(5) - 1) / 2) % 1, kind="stable")


def bounds(camera: Camera) -> tuple[tuple[float, float], tuple[float, float]]:
    """The planes left and right of a view's picture, and above and below it, as positions at a depth of 1."""
    x, y = (
        ((-_PIXELS - centre) / focal, (pixels + _PIXELS - centre) / focal)
        for focal, centre, pixels in (
            (camera.fx, camera.cx, camera.width),
            (camera.fy, camera.cy, camera.height),
        )
    )
    return x, y


def opacity_weighted_areas(scene: Scene, run: Run = map) -> NDArray[np.float64]:
    """(N,) area of each splat's largest cross-section times its opacity, up to a common factor; for shares of a scene.

    The factor makes the largest of them 1, so that no scene's units are too large. ``run`` shares the work out.
    """
    areas = np.empty(len(scene))
    starts = range(0, len(scene), _BLOCK)

    def largest_two(start: int) -> float:
        a, b, c = scene.log_scales[start : start + _BLOCK].T.astype(np.float64)
        low, high = np.minimum(a, b), np.maximum(a, b)
        some = areas[start : start + _BLOCK]
        some[:] = np.maximum(low, np.minimum(high, c)) + np.maximum(high, c)
        return float(some.max())

    largest = max(run(largest_two, starts), default=-math.inf)

    def area(start: int) -> None:
        some = areas[start : start + _BLOCK]
        some[:] = np.exp(some - largest) * opacities_of(scene.opacity_logits[start : start + _BLOCK])

    for _ in run(area, starts):
        pass
    return areas


def _shows(camera: Camera, means: NDArray[np.float64], reach: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which spheres touch the pyramid that a view sees; their centres in front of the near plane."""
    with np.errstate(over="ignore", invalid="ignore"):
        x, y, depth = camera.rotation @ means.T + camera.translation[:, None]
        shown = depth > NEAR
        for along, (low, high) in zip((x, y), bounds(camera), strict=True):
            shown &= along - low * depth > -reach * math.hypot(1, low)
            shown &= along - high * depth < reach * math.hypot(1, high)
    return np.asarray(shown)
