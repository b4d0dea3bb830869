"""How close a compressed scene comes to the uncompressed one, in pictures from views that it is judged by."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Literal

import numpy as np

from potr_cl.errors import UsageError
from potr_cl.formats.images import Colour
from potr_cl.model.camera import Camera, test_views, train_views
from potr_cl.model.scene import FloatArray
from potr_cl.model.virtual_cameras import is_virtual
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner
from potr_cl.quality.compare import Comparison, comparing, comparison_of, mean_view
from potr_cl.quality.figures import ViewFigures
from potr_cl.quality.judging import Looks
from potr_cl.quality.shared_judging import SharedJudging
from potr_cl.raster.carried import Carried
from potr_cl.raster.kept_scene import KeptScene
from potr_cl.raster.scene_buffers import Drawable
from potr_cl.workers.pool import Pool

#: So many training views, spread evenly, stand for all of them where there are no test views.
_MOST_TRAINING_VIEWS = 32
#: Beside held-out views so many training views are judged, as a part of them, and at least, and at most.
_BESIDE, _LEAST_BESIDE, _MOST_BESIDE = 1 / 8, 4, 16


@dataclass(frozen=True)
class EvaluationViews:
    """The views that a scene is judged by.

    Attributes:
        views: at least one.
        kind: "test", held out of encoding, or "train", which encoding has looked at.
        available: how many of that kind the cameras hold.
        beside: a few training views, which tell whether held-out ones are matched worse; none if there are none, or if
            training views judge anyway.
    """

    views: list[Camera]
    kind: Literal["test", "train"]
    available: int
    beside: tuple[Camera, ...] = ()

    @staticmethod
    def of(cameras: Sequence[Camera]) -> EvaluationViews:
        """All test views; without any, up to 32 training views spread evenly.

        Raises:
            UsageError: there is no camera.
        """
        views = test_views(cameras)
        if views:
            training = [camera for camera in cameras if camera.split == "train"]
            beside = min(max(round(_BESIDE * len(views)), _LEAST_BESIDE), _MOST_BESIDE)
            return EvaluationViews(views, "test", len(views), tuple(_evenly(training, beside)))
        training = train_views(cameras)
        return EvaluationViews(_evenly(training, _MOST_TRAINING_VIEWS), "train", len(training))

    def named(self, name: str) -> Camera:
        """The view of a name.

        Raises:
            UsageError: there is none.
        """
        for camera in self.views:
            if camera.name == name:
                return camera
        raise UsageError(f"there is no view '{name}' among the {self}: '{self.views[0].name}' is the first of them")

    def __str__(self) -> str:
        if self.kind == "test":
            what = "virtual view" if is_virtual(self.views) else "test view"
            return f"{len(self.views)} held-out {what}{'s' if len(self.views) > 1 else ''}"
        which = "all" if len(self.views) == self.available else f"{len(self.views)} of"
        return f"{which} {self.available} training views, for the cameras name no test views"


def _evenly(views: Sequence[Camera], most: int) -> list[Camera]:
    """So many of some views at most, from the first to the last."""
    return [views[k] for k in np.linspace(0, len(views) - 1, min(len(views), most)).round().astype(int)]


class Evaluator(Owner):
    """Compares candidates with one uncompressed scene.

    Args:
        device: to render on.
        scene: the uncompressed one.
        views: to judge by.
        background: behind both.
        pool: workers that the views are shared out to, of which ``device`` is the first; None: the device does all.
        remember: whether the scene's pictures are kept for the next candidate.

    Attributes:
        device, views: as given.

    Raises:
        DeviceError: the kernels cannot be built.
    """

    def __init__(
        self,
        device: Device,
        scene: Drawable | KeptScene,
        views: EvaluationViews,
        background: Colour,
        pool: Pool | None = None,
        remember: bool = True,
    ) -> None:
        self.views = views
        self.device = device
        looks = Looks(background, remember=remember)
        self._judging = SharedJudging(device, scene, [*views.views, *views.beside], looks, pool)

    def psnr(
        self,
        candidate: Drawable,
        most: int | None = None,
        coded: Carried | None = None,
        progress: Callable[[float], None] = lambda done: None,
    ) -> float:
        """:meth:`psnr_of` the views, or of so many of them, spread evenly."""
        views = self.views.views
        return self.psnr_of(views if most is None else _evenly(views, most), candidate, coded, progress)

    def psnr_of(
        self,
        views: Sequence[Camera],
        candidate: Drawable,
        coded: Carried | None = None,
        progress: Callable[[float], None] = lambda done: None,
    ) -> float:
        """Mean over some views of the PSNR against the uncompressed scene's pictures, in decibels.

        Identical pictures are left out of the mean; it is infinite if all are identical.

        Args:
            views: any.
            candidate: to judge; where it is on a device, that is the evaluator's.
            coded: what the pool's workers on other computers are sent in its place.
            progress: called with the part of the views that is done.
        """
        return _mean_psnr(self._judging.figures(candidate, views, coded, lambda done: progress(done / len(views))))

    def judge(
        self, candidate: Drawable, progress: Callable[[str, float], None], coded: Carried | None = None
    ) -> tuple[Comparison, float | None]:
        """PSNR and SSIM from every view, and the mean PSNR from the training views beside them, if there are any.

        Args:
            candidate, coded: as of :meth:`psnr_of`.
            progress: called with the stage and the part of it that is done.
        """
        views, beside = self.views.views, self.views.beside
        stage, together = comparing(len(views)), [*views, *beside]
        progress(stage, 0.0)
        found = self._judging.figures(candidate, together, coded, lambda done: progress(stage, done / len(together)))
        return comparison_of(found[: len(views)]), _mean_psnr(found[len(views) :]) if beside else None

    def pictures(self, candidate: Drawable, names: Sequence[str]) -> list[tuple[FloatArray, FloatArray]]:
        """(H, W, 3) float32 pictures of both scenes from the named views.

        Raises:
            UsageError: there is no such view.
        """
        return self._judging.pictures(candidate, [self.views.named(name) for name in names])

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._judging.__exit__(kind, error, trace)

    def close(self) -> None:
        """Give all device memory back."""
        self._judging.close()


def _mean_psnr(views: Sequence[ViewFigures]) -> float:
    return mean_view(views).figures["b_against_a"].psnr
