"""All parameters of a reduced scene fitted to the pictures of the uncompressed one: :func:`fit`."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from dataclasses import dataclass

from potr_cl.api.editing import Edited, check_rendered_alike
from potr_cl.api.encoding import views_or_placed
from potr_cl.api.files import result_writer
from potr_cl.api.inputs import (
    CamerasSource,
    ColourSource,
    DeviceSource,
    SceneSource,
    cameras_of,
    colour_of,
    device_of,
    name_of,
    scene_of,
)
from potr_cl.errors import UsageError
from potr_cl.host.signals import first_interrupt_asks
from potr_cl.model.camera import test_views, train_views
from potr_cl.model.views_between import views_between as place_between
from potr_cl.model.virtual_cameras import is_virtual
from potr_cl.opencl.device import Device
from potr_cl.pipeline.amounts import as_bytes
from potr_cl.pipeline.fallback import on_device
from potr_cl.pipeline.frame import check_frame
from potr_cl.quality.evaluator import EvaluationViews, Evaluator
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.fitting.fit import FitOptions, Fitted, fit_scene
from potr_cl.stages.stage import Progress
from potr_cl.views.targets import RenderedTargets

#: The most views between that may be asked for, for each training view.
_MOST_BETWEEN = 100


@dataclass(frozen=True, repr=False)
class FittedScene(Edited):
    """The result of :func:`fit`.

    Attributes:
        fitted: steps, and the errors of the training views that were held out, round by round.
        views: how many training views, and added: how many between them.
        judged_by: the test views, which the fit has not seen; None where there are none.
        psnr: mean over those of the PSNR against the reference before and after, in decibels; None where there are
            none.
    """

    fitted: Fitted
    views: int
    added: int
    judged_by: str | None = None
    psnr: tuple[float, float] | None = None

    @property
    def said(self) -> str:
        """What the command line says of it, a line."""
        return f"{len(self.scene)} splats, {self.fitted}"


def fit(
    scene: SceneSource,
    reference: SceneSource,
    cameras: CamerasSource | None = None,
    *,
    output: str | os.PathLike[str] | None = None,
    steps: int = FitOptions.steps,
    views_between: int = 0,
    virtual_views: int | None = None,
    memory: float | None = None,
    background: ColourSource = "black",
    device: DeviceSource = None,
    trust: bool = False,
    antialiased: bool | None = None,
    cameras_anyway: bool = False,
    progress: Progress | None = None,
    tell: Callable[[str], None] | None = None,
) -> FittedScene:
    """Move, turn, scale, fade and colour the splats of a reduced scene, as the command ``fit`` does.

    The views then look again as those of the reference do. Some training views are held out, and the scene that matches
    them best is kept: at worst the one that was given. Splats that no view shows stay as they are.

    Args:
        scene: the reduced one, or its file.
        reference: the uncompressed one, or its file.
        steps: at the most.
        views_between: for each training view, how many views between it and its neighbours to look at besides.
        cameras, output, virtual_views, memory, background, device, trust, antialiased, cameras_anyway,
            progress: as of :func:`potr_cl.prune`.
        tell: called with a line for each round.

    Raises:
        As :func:`potr_cl.prune`; and UsageError if there are fewer than two training views.
    """
    colour = colour_of(background)
    options, budget = check_fit(steps, views_between), as_bytes(memory)
    write = result_writer(output)
    given = cameras_of(cameras, virtual_views)
    reduced, original = scene_of(scene, trust, antialiased), scene_of(reference, trust, antialiased)
    check_rendered_alike((str(name_of(scene)), reduced), (str(name_of(reference)), original))
    check_frame(original, given, cameras_anyway)
    opened = device_of(device)
    there = views_or_placed(original, given, virtual_views, opened)
    views = train_views(there)
    added = [] if is_virtual(views) or len(views) < 2 else place_between(original, views, views_between)
    looked_at = [*views, *added]
    tell_part: Progress = progress or (lambda _what, _done: None)

    def work(device: Device, memory: int | None) -> Fitted:
        with (
            first_interrupt_asks() as asked,
            Rasterizer(device, original, background=colour) as rasterizer,
        ):
            return fit_scene(
                device,
                reduced,
                looked_at,
                RenderedTargets(rasterizer, looked_at),
                dataclasses.replace(options, memory=memory),
                len(added),
                colour,
                lambda done, most: tell_part("fit", 0.99 * done / most),
                tell,
                asked,
            )

    tell_part("fit", 0.0)
    fitted, used = on_device(opened, budget, work)
    tell_part("fit", 1.0)
    if write is not None:
        write(fitted.scene)
    done = FittedScene(fitted.scene, len(reduced), used, fitted, len(views), len(added))
    held_out = test_views(there)
    if not held_out:
        return done
    with Evaluator(used, original, EvaluationViews.of(held_out), colour) as evaluator:
        before, after = (evaluator.psnr(each) for each in (reduced, fitted.scene))
        return dataclasses.replace(done, judged_by=str(evaluator.views), psnr=(before, after))


def check_fit(steps: int, views_between: int) -> FitOptions:
    """Options of the fit, checked.

    Raises:
        UsageError: a number is out of range.
    """
    if not 0 <= views_between <= _MOST_BETWEEN:
        raise UsageError(f"--views-between is {views_between}, it must be from 0 to {_MOST_BETWEEN}")
    return FitOptions(steps=steps)
