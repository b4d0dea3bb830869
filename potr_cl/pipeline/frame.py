"""Whether cameras are in the scene's frame, asked before anything is computed: :func:`check_frame`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from potr_cl.host.threads import in_background
from potr_cl.model.agreement import require_agreement
from potr_cl.model.camera import Camera, train_views
from potr_cl.model.scene import Scene
from potr_cl.model.virtual_cameras import is_virtual
from potr_cl.quality.evidence import evidence_of


def check_frame(scene: Scene, cameras: Sequence[Camera] | None, anyway: bool) -> None:
    """Refuse cameras that are probably not in the scene's frame, but virtual ones and those that are wanted anyway.

    Raises:
        UsageError: they are not in it, or there is no training view among them.
    """
    if cameras and not anyway and not is_virtual(cameras):
        views = train_views(cameras)
        require_agreement(scene, views, evidence_of(scene, views))


@contextmanager
def frame_checked_beside(scene: Scene, cameras: Sequence[Camera] | None, anyway: bool) -> Iterator[None]:
    """:func:`check_frame` in another thread, while this one opens and fills a device; a wrong frame is told first.

    Raises:
        As :func:`check_frame`, when the context ends.
    """
    checked = in_background(check_frame, scene, cameras, anyway)
    try:
        yield
    finally:
        checked.result()
