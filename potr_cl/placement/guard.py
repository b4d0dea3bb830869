"""The guard: which splats no view has resolved (:func:`unresolved`). Nobody knows what these are worth, so they stay.

Where views were placed and not given, "nobody saw it" is no evidence: the view from which it is seen may be missing. A
splat is resolved if two views show the place where it is from near enough, with nothing in between. What is buried in
matter, so deep that nobody could stand anywhere near, needs no view.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.placement.candidates import NEAR
from potr_cl.placement.rays import resolved_by
from potr_cl.placement.space import Space

#: Pixels that the larger standard deviation of a splat of median size must have, and the views in which it must.
_PIXELS, _ENOUGH = 1.2, 2
#: Who stands has so many free cells around; and what lies farther than this from there, in cells, is buried.
_CLEAR, _DEEP = 2, 3
#: Splats at a time.
_BLOCK = 1 << 20


def unresolved(device: Device, scene: Scene, cameras: Sequence[Camera]) -> NDArray[np.bool_]:
    """(N,) which splats of a scene no two views have resolved.

    Args:
        device: finds what is seen.
        scene: clean, at least one splat.
        cameras: the views.

    Raises:
        DeviceError: the device has no room, or failed.
    """
    space = Space.of(scene)
    exposed = space.near_free(_CLEAR, _DEEP)
    cells = np.concatenate(
        [space.cell_of(scene.means[first : first + _BLOCK]) for first in range(0, len(scene), _BLOCK)]
    )
    beyond = np.flatnonzero(cells < 0)
    used = np.flatnonzero(np.bincount(cells[cells >= 0], minlength=len(exposed)).astype(bool) & exposed)
    points = np.concatenate([space.middles(used), scene.means[beyond].astype(np.float64)])
    own = np.exp(np.clip(scene.log_scales[beyond].max(axis=1).astype(np.float64), -60, 60))
    sizes = np.concatenate([space.sizes_near(points[: len(used)]), own])
    seen = resolved_by(device, space, cameras, points, sizes, _PIXELS, NEAR, _ENOUGH) >= _ENOUGH
    wanting = np.zeros(len(exposed), bool)
    wanting[used] = ~seen[: len(used)]
    found: NDArray[np.bool_] = wanting[np.maximum(cells, 0)] & (cells >= 0)
    found[beyond] = ~seen[len(used) :]
    return found
