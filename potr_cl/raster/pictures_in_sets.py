"""Pictures of many views on a GPU, several at a time: :func:`render_in_sets`."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from potr_cl.errors import DeviceMemoryError
from potr_cl.model.camera import Camera
from potr_cl.opencl.memory import Memory
from potr_cl.raster.preparation import Preparation
from potr_cl.raster.view_set import ViewSet


def render_in_sets(
    preparation: Preparation,
    composite: Callable[[ViewSet], None],
    cameras: Sequence[Camera],
    most: int,
    memory: Memory | None,
) -> None:
    """Prepare and composite views, in sets of about one size: drivers take long to give memory and to take it back.

    Args:
        preparation: of the scene.
        composite: enqueues the pictures of a set, and what becomes of them.
        cameras: of the views.
        most: how many a set has at most; fewer, where the device has no room.
        memory: to prepare views in; None: of their own.

    Raises:
        DeviceMemoryError: a view alone does not fit the device.
    """
    number = 0
    views: ViewSet | None = None
    try:
        while number < len(cameras):
            left = len(cameras) - number
            sets = -(-left // most)
            some = cameras[number : number - (-left // sets)]
            try:
                former, views = views, None
                views = _prepared_instead(preparation, former, some, memory)
            except DeviceMemoryError:
                if most == 1:
                    raise
                most = max(len(some) // 2, 1)
                continue
            composite(views)
            number += len(some)
    finally:
        if views is not None:
            views.close()
            preparation.close()


def _prepared_instead(
    preparation: Preparation, former: ViewSet | None, cameras: Sequence[Camera], memory: Memory | None
) -> ViewSet:
    """Prepared views, in the memory of others that nobody needs any more, if they fit in there."""
    if former is not None:
        fits = False
        try:
            fits = len(former.views) == len(cameras) and preparation.prepare_again(former, cameras)
        finally:
            if not fits:
                former.close()
        if fits:
            return former
    return preparation.prepare_set(cameras, memory)
