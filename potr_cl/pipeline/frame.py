"""Whether cameras are in the scene's frame: :func:`check_frame`; beside other work: :class:`FrameCheck`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from potr_cl.host.threads import in_background
from potr_cl.model.agreement import require_agreement
from potr_cl.model.camera import Camera, train_views
from potr_cl.model.scene import Scene
from potr_cl.model.virtual_cameras import is_virtual
from potr_cl.quality.evidence import evidence_of
from potr_cl.stages.stage import Progress


def check_frame(scene: Scene, cameras: Sequence[Camera] | None, anyway: bool) -> None:
    """Refuse cameras that are probably not in the scene's frame, but virtual ones and those that are wanted anyway.

    Raises:
        UsageError: they are not in it, or there is no training view among them.
    """
    if cameras and not anyway and not is_virtual(cameras):
        views = train_views(cameras)
        require_agreement(scene, views, evidence_of(scene, views))


class FrameCheck:
    """:func:`check_frame` in another thread, which takes up to a second. A wrong frame is told before other errors."""

    def __init__(self, scene: Scene, cameras: Sequence[Camera] | None, anyway: bool) -> None:
        self._checked = in_background(check_frame, scene, cameras, anyway)

    @contextmanager
    def before_errors(self) -> Iterator[None]:
        """A context whose errors are told only if the cameras are right."""
        try:
            yield
        except BaseException:
            self._checked.result()
            raise

    @contextmanager
    def beside(self, progress: Progress | None) -> Iterator[Progress]:
        """A context of work that ends early if the cameras are wrong, when it next reports to what this yields.

        Raises:
            As :func:`check_frame`, at the end of the context at the latest.
        """

        def watched(what: str, done: float) -> None:
            if self._checked.done():
                self._checked.result()
            if progress is not None:
                progress(what, done)

        with self.before_errors():
            yield watched
        self._checked.result()
