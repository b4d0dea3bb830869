"""What is seen from where, found on a device: :func:`shown_from`, :func:`resolved_by`, and :func:`unresolved`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.model.splat_groups import bounds
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory
from potr_cl.opencl.structs import struct_dtype
from potr_cl.placement.space import NEAR, Space

F64 = NDArray[np.float64]

_SOURCE = "placement/rays.cl"
_GROUP = 64
#: Pairs of places and targets at a time.
_PAIRS = 1 << 26


def shown_from(
    device: Device, space: Space, places: F64, resolved: F64, targets: F64, sizes: F64, near: float, hardly: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
    """Which targets are seen from which places, and how well.

    Args:
        device: computes.
        space: what is in the way.
        places: (P, 3) world units.
        resolved: (P,) from how far a size of 1 is resolved.
        targets: (K, 3) points on surfaces; sizes: (K,) of splats there; world units.
        near: what is nearer is not drawn.
        hardly: what is farther than this many times the distance at which it is resolved does not count.

    Returns:
        The numbers of the places, ascending, and of the targets of all pairs that see each other; and how well, 0 to
        1: the square of the part of its size that a target has, of that at which it is resolved.
    """
    count, at_once = len(targets), max(_PAIRS // max(len(targets), 1), 1)
    kernel = device.shared_kernel(_SOURCE, "shown")
    found = []
    with Memory(device) as memory:
        where = space.in_cells(places, resolved)
        worth = memory.allocate(min(at_once, len(places)) * count, "what is seen")
        distance = memory.upload(space.distance, "the space")
        theirs = memory.upload(space.in_cells(targets, sizes / space.cell), "the targets")
        for first in range(0, len(places), at_once):
            some = where[first : first + at_once]
            own = memory.upload(some, "the places")
            kernel.bind(
                distance=distance, grid=_grid(space), places=own, targets=theirs, count=count,
                near=near / space.cell, hardly=hardly, worth=worth,
            )  # fmt: skip
            kernel.launch((-(-count // _GROUP) * _GROUP, len(some)), (_GROUP, 1))
            parts = device.download(worth, (len(some), count), np.uint8)
            memory.free(own)
            place, target = np.nonzero(parts)
            found.append((place + first, target, parts[place, target].astype(np.float32) / 255))
    place, target, well = (np.concatenate(each) for each in zip(*found, strict=True))
    return place, target, well


def resolved_by(
    device: Device,
    space: Space,
    cameras: Sequence[Camera],
    points: F64,
    sizes: F64,
    pixels: float,
    near: float,
    enough: int,
) -> NDArray[np.uint8]:
    """How many views resolve points, (n,), at most ``enough``.

    Args:
        device, space, points, sizes, near: as :func:`shown_from` takes them.
        cameras: the views.
        pixels: that a size must have in a view.
    """
    if not len(points):
        return np.zeros(0, np.uint8)
    lookers = np.zeros(len(cameras), struct_dtype(_SOURCE, "Looker"))
    for looker, camera in zip(lookers, cameras, strict=True):
        looker["rotation"] = camera.rotation.ravel()
        looker["translation"] = (camera.rotation @ space.origin + camera.translation) / space.cell
        looker["centre"] = (camera.centre - space.origin) / space.cell
        for axis, (low, high) in enumerate(bounds(camera)):
            looker["low"][axis], looker["high"][axis] = low, high
        looker["resolved"] = camera.fx / pixels
    with Memory(device) as memory:
        found = memory.allocate(max(len(points), 1), "the points that are seen")
        device.shared_kernel(_SOURCE, "resolved_by").bind(
            distance=memory.upload(space.distance, "the space"),
            grid=_grid(space),
            lookers=memory.upload(lookers, "the views"),
            views=len(cameras),
            points=memory.upload(space.in_cells(points, sizes / space.cell), "the points"),
            count=len(points),
            near=near / space.cell,
            enough=enough,
            found=found,
        ).launch((-(-len(points) // _GROUP) * _GROUP,), (_GROUP,))
        return device.download(found, (len(points),), np.uint8)


def _grid(space: Space) -> NDArray[np.void]:
    grid = np.zeros((), struct_dtype(_SOURCE, "Grid"))
    grid["shape"] = space.shape
    return grid


#: Pixels that the larger standard deviation of a splat of median size must have, and the views in which it must.
_PIXELS, _VIEWS = 1.2, 2
#: Who stands has so many free cells around; and what lies farther than this from there, in cells, is buried.
_CLEAR, _DEEP = 2, 3
#: Splats at a time.
_BLOCK = 1 << 20


def unresolved(device: Device, scene: Scene, cameras: Sequence[Camera]) -> NDArray[np.bool_]:
    """(N,) which splats of a scene no two views have resolved: nobody knows what these are worth, so they stay.

    Where views were placed and not given, "nobody saw it" is no evidence: the view from which it is seen may be
    missing. A splat is resolved if two views show the place where it is from near enough, with nothing in between. What
    is buried in matter, so deep that nobody could stand anywhere near, needs no view.

    Args:
        device: finds what is seen.
        scene: clean, at least one splat.
        cameras: the views.
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
    seen = resolved_by(device, space, cameras, points, sizes, _PIXELS, NEAR, _VIEWS) >= _VIEWS
    wanting = np.zeros(len(exposed), bool)
    wanting[used] = ~seen[: len(used)]
    found: NDArray[np.bool_] = wanting[np.maximum(cells, 0)] & (cells >= 0)
    found[beyond] = ~seen[len(used) :]
    return found
