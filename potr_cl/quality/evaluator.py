"""How close a compressed scene comes to the uncompressed one, in pictures from views that it is judged by."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from potr_cl.errors import UsageError
from potr_cl.formats.images import Colour
from potr_cl.model.camera import Camera, spread_evenly, test_views, train_views
from potr_cl.model.scene import Scene
from potr_cl.model.virtual_cameras import is_virtual
from potr_cl.opencl.device import Device
from potr_cl.quality.compare import Comparison, comparing, comparison_of, mean_view
from potr_cl.quality.figures import ViewFigures
from potr_cl.quality.judging import Judging, Looks
from potr_cl.quality.photographs import GroundTruth, PhotographFigures
from potr_cl.raster.resident import ResidentScene, SceneHandle
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
            return EvaluationViews(views, "test", len(views), tuple(spread_evenly(training, beside)))
        training = train_views(cameras)
        return EvaluationViews(spread_evenly(training, _MOST_TRAINING_VIEWS), "train", len(training))

    def named(self, name: str) -> int:
        """The number of the view of a name.

        Raises:
            UsageError: there is none.
        """
        for number, camera in enumerate(self.views):
            if camera.name == name:
                return number
        raise UsageError(f"there is no view '{name}' among the {self}: '{self.views[0].name}' is the first of them")

    def __str__(self) -> str:
        if self.kind == "test":
            what = "virtual view" if is_virtual(self.views) else "test view"
            return f"{len(self.views)} held-out {what}{'s' if len(self.views) > 1 else ''}"
        which = "all" if len(self.views) == self.available else f"{len(self.views)} of"
        return f"{which} {self.available} training views, for the cameras name no test views"


class Evaluator(Judging):
    """Compares candidates with one uncompressed scene.

    Args:
        pool: workers that the views are shared out to, of which ``device`` is the first; None: the device does all.
        remember: whether the scene's pictures are kept for the next candidate.

    Raises:
        DeviceError: the kernels cannot be built.
    """

    def __init__(
        self,
        device: Device,
        scene: Drawable | ResidentScene,
        views: EvaluationViews,
        background: Colour,
        pool: Pool | None = None,
        remember: bool = True,
    ) -> None:
        self.views = views
        super().__init__(device, scene, [*views.views, *views.beside], Looks(background, remember=remember), pool)

    def psnr(
        self,
        candidate: Drawable,
        most: int | None = None,
        coded: SceneHandle | None = None,
        progress: Callable[[float], None] = lambda done: None,
    ) -> float:
        """Mean over the views of the PSNR against the uncompressed scene's pictures, in decibels.

        Identical pictures are left out of the mean; it is infinite if all are identical.

        Args:
            candidate: to judge; where it is on a device, that is the evaluator's.
            most: judge by so many of the views, spread evenly; None: by all.
            coded: what the pool's workers on other computers are sent in its place.
            progress: called with the part of the views that is done.
        """
        count = len(self.views.views)
        return _mean_psnr(
            self.figures(candidate, spread_evenly(range(count), count if most is None else most), coded, progress)
        )

    def judge(
        self, candidate: Drawable, progress: Callable[[str, float], None], coded: SceneHandle | None = None
    ) -> tuple[Comparison, float | None]:
        """PSNR and SSIM from every view, and the mean PSNR from the training views beside them, if there are any.

        Args:
            candidate, coded: as of :meth:`psnr`.
            progress: called with the stage and the part of it that is done.
        """
        count = len(self.views.views)
        progress(comparing(count), 0.0)
        found = self.figures(candidate, None, coded, lambda done: progress(comparing(count), done))
        return comparison_of(found[:count]), _mean_psnr(found[count:]) if self.views.beside else None


def _mean_psnr(views: Sequence[ViewFigures]) -> float:
    return mean_view(views).figures["b_against_a"].psnr


def judge_by_photographs(
    ground_truth: GroundTruth,
    cameras: Sequence[Camera],
    scenes: tuple[Scene | ResidentScene, Drawable],
    device: Device,
    background: Colour = (0.0, 0.0, 0.0),
    pool: Pool | None = None,
) -> PhotographFigures:
    """Judge a scene and its file by photographs of test views; where no test view has one, of training views.

    Args:
        cameras: all of the scene's.
        scenes: uncompressed, and as a decoder sees the file.
        pool: workers that views are shared out to, if they are devices of this computer, which has the photographs.

    Raises:
        UsageError, DataError: a photograph cannot be read.
        DeviceError: a view does not fit the device.
    """
    views, kind = ground_truth.of(test_views(cameras)), "test"
    if not views:
        views, kind = ground_truth.of(train_views(cameras)), "train"
    reference, candidate = scenes
    near = pool if pool is not None and pool.in_process else None
    with Judging(device, reference, views, Looks(background), near) as judging:
        psnrs = judging.by_photographs(candidate, ground_truth)
    names = [camera.name for camera in views]
    return PhotographFigures(
        names, kind, [of_reference for of_reference, _ in psnrs], [of_file for _, of_file in psnrs]
    )
