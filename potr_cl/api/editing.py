"""One stage alone, from a scene to a scene: :func:`prune`, :func:`compact`, :func:`refit`."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from potr_cl.api.choices import CompactChoices, PruneChoices, with_choices
from potr_cl.api.encoding import encode_options, views_or_placed
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
from potr_cl.codec.quantize import ac_sparsity
from potr_cl.errors import UsageError
from potr_cl.formats.images import Colour
from potr_cl.host.atomic_write import replacing
from potr_cl.model.camera import Camera, test_views, train_views, within_photographs
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.pipeline.amounts import as_bytes
from potr_cl.pipeline.fallback import on_device
from potr_cl.pipeline.frame import check_frame
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.run import Run
from potr_cl.pipeline.stopwatch import Stopwatch
from potr_cl.quality.evaluator import EvaluationViews, Evaluator
from potr_cl.quality.ground_truth import GroundTruth
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.compact import Compact
from potr_cl.stages.guarded import Unresolved
from potr_cl.stages.prune import Prune
from potr_cl.stages.pruning.schedule import Pruned
from potr_cl.stages.pruning.unseen import Unseen
from potr_cl.stages.refitting.refit import active_coefficients, refit_colours
from potr_cl.stages.refitting.refit_options import RefitOptions, Refitted
from potr_cl.stages.stage import Progress, Stage, State
from potr_cl.views.targets import PhotographTargets, RenderedTargets

#: Coefficients that round to 0 at so many steps a unit are 0, but for what storing R, G and B leaves of them.
_ZERO_SF = 1e5

if TYPE_CHECKING:
    from typing_extensions import Unpack


@dataclass(frozen=True, repr=False)
class Edited:
    """A scene that one stage has changed; functions that take scenes take it too.

    Attributes:
        scene: the changed one.
        source_splats: how many splats it had before.
        device: that did the work.
    """

    scene: Scene
    source_splats: int
    device: Device

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.said}, on {self.device.info.name})"

    @property
    def said(self) -> str:
        """What was done, in a line."""
        return f"{len(self.scene):,} of {self.source_splats:,} splats"

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the scene; see :meth:`potr_cl.model.scene.Scene.save`."""
        self.scene.save(path)

    def _repr_png_(self) -> bytes | None:
        return self.scene._repr_png_()


@dataclass(frozen=True, repr=False)
class PrunedScene(Edited):
    """The result of :func:`prune`.

    Attributes:
        pruned: which splats went, in which order; see :class:`potr_cl.stages.pruning.schedule.Pruned`.
        unseen: the splats that no training view sees.
    """

    pruned: Pruned
    unseen: Unseen | Unresolved

    @property
    def said(self) -> str:
        """What the command line says of it, a line."""
        part = 100 * self.pruned.kept / self.source_splats
        splats = f"kept {self.pruned.kept:,} of {self.source_splats:,} splats ({part:.1f} %)"
        return f"{splats} in {self.pruned.iterations} iterations"


@dataclass(frozen=True, repr=False)
class CompactedScene(Edited):
    """The result of :func:`compact`.

    Attributes:
        sparsity: part of the AC coefficients that quantise to 0, before and after.
    """

    sparsity: tuple[float, float]

    @property
    def said(self) -> str:
        """What the command line says of it, a line."""
        before, after = (100 * part for part in self.sparsity)
        return f"{len(self.scene):,} splats, {after:.1f} % of the AC coefficients quantise to 0, {before:.1f} % before"


@dataclass(frozen=True, repr=False)
class RefittedScene(Edited):
    """The result of :func:`refit`.

    Attributes:
        refitted: steps, and the mean squared errors of the training views before and after.
        views: how many training views.
        held_out: how many views the re-fit has not seen, and what they are called; None where there are none.
        psnr: mean over those of the PSNR before and after, in decibels: against the reference, or with photographs
            against these; None where there are none.
        reference_psnr: the reference's own PSNR against the photographs; None where there are none.
    """

    refitted: Refitted
    views: int
    held_out: str | None = None
    psnr: tuple[float, float] | None = None
    reference_psnr: float | None = None

    @property
    def said(self) -> str:
        """What the command line says of it, a line."""
        before, after = (decibels_of(error) for error in self.refitted.errors)
        views = f"PSNR {after} of {self.views} training views, {before} before"
        return f"{len(self.scene):,} splats re-fitted in {self.refitted.steps} steps, {views}"


@with_choices(PruneChoices)
def prune(
    scene: SceneSource,
    cameras: CamerasSource | None = None,
    *,
    q: float = 0.5,
    output: str | os.PathLike[str] | None = None,
    order: str | os.PathLike[str] | None = None,
    virtual_views: int | None = None,
    memory: float | None = None,
    background: ColourSource = "black",
    device: DeviceSource = None,
    trust: bool = False,
    antialiased: bool | None = None,
    cameras_anyway: bool = False,
    progress: Progress | None = None,
    **choices: Unpack[PruneChoices],
) -> PrunedScene:
    """Remove the splats that no view misses, as the command ``prune`` does; nothing else changes.

    Args:
        scene: or its file.
        cameras: or their file; None: virtual ones are placed.
        q: 0 (fewest splats) to 1.
        output: a file to write the scene to as well.
        order: a .npy file to write the order of removal to: splat numbers, first removed first, kept ones last.
        virtual_views: how many views to place without cameras.
        memory: GiB of device memory to keep views in.
        background: R, G, B from 0 to 1, or a colour's name.
        device: that computes, or what it is called.
        trust, antialiased: as of :func:`potr_cl.load_scene`.
        cameras_anyway: take the cameras even if they do not seem to be in the scene's frame.
        progress: called with what is done and the part of it that is done.
        choices: options of the stage by the name of their flag: ``keep=0.5``, ``iterations=16``.

    Raises:
        UsageError: an option is unknown or out of range, or no camera is a training view.
        DataError: a file is damaged.
        DeviceError: no device does the work.
    """
    options = stage_options(Prune, q, background, memory, choices).changed(cameras_anyway=cameras_anyway)
    write = result_writer(output)
    views, what = cameras_of(cameras, virtual_views), scene_of(scene, trust, antialiased)
    with contextlib.ExitStack() as stack:
        ranks = stack.enter_context(replacing(order)) if order is not None else None
        state, used = _run(what, views, virtual_views, options, Prune, device, progress)
        pruned, unseen = state.learnt.pruned, state.learnt.unseen
        assert pruned is not None
        assert unseen is not None
        if write is not None:
            write(state.scene)
        if ranks is not None:
            np.save(ranks, pruned.order)
    return PrunedScene(state.scene, len(what), used, pruned, unseen)


@with_choices(CompactChoices)
def compact(
    scene: SceneSource,
    cameras: CamerasSource | None = None,
    *,
    q: float = 0.5,
    output: str | os.PathLike[str] | None = None,
    sf_sh: float | None = None,
    virtual_views: int | None = None,
    memory: float | None = None,
    background: ColourSource = "black",
    device: DeviceSource = None,
    trust: bool = False,
    antialiased: bool | None = None,
    cameras_anyway: bool = False,
    progress: Progress | None = None,
    **choices: Unpack[CompactChoices],
) -> CompactedScene:
    """Make the colours' coefficients sparse, as the command ``compact`` does; nothing else changes.

    Args:
        scene, cameras, output, virtual_views, memory, background, device, trust, antialiased, cameras_anyway,
            progress: as of :func:`prune`.
        q: 0 (sparsest) to 1.
        sf_sh: steps a unit of the quantiser to expect.
        choices: options of the stage by the name of their flag: ``lambda_=0.01``, ``one_pass=True``.

    Raises:
        As :func:`prune`.
    """
    options = stage_options(Compact, q, background, memory, choices, sf_sh).changed(cameras_anyway=cameras_anyway)
    write = result_writer(output)
    views, what = cameras_of(cameras, virtual_views), scene_of(scene, trust, antialiased)
    state, used = _run(what, views, virtual_views, options, Compact, device, progress)
    if write is not None:
        write(state.scene)
    before, after = (ac_sparsity(each.sh, options.parameters.sf_sh) for each in (what, state.scene))
    return CompactedScene(state.scene, len(what), used, (before, after))


def stage_options(
    kind: type[Stage],
    q: float,
    background: ColourSource,
    memory: float | None,
    choices: Mapping[str, Any],
    sf_sh: float | None = None,
) -> EncodeOptions:
    """Options of an encode in which one stage alone looks at views, checked.

    Raises:
        UsageError: one is unknown or out of range.
    """
    alone = {stage.name: {"on": isinstance(stage, kind)} for stage in EncodeOptions().stages if stage.needs_views}
    options = EncodeOptions(q=q).changed(**alone)
    options = encode_options(options, None, choices, background=background, memory=memory, stages=[kind])
    if sf_sh is not None:
        options = options.with_parameters(sf_sh=sf_sh)
        _ = options.parameters
    return options


def _run(
    scene: Scene,
    cameras: Sequence[Camera] | None,
    count: int | None,
    options: EncodeOptions,
    kind: type[Stage],
    device: DeviceSource,
    progress: Progress | None,
) -> tuple[State, Device]:
    """What a stage alone makes of a scene, and the device that it was done on."""
    check_frame(scene, cameras, options.cameras_anyway)
    opened = device_of(device)
    views = train_views(views_or_placed(scene, cameras, count, opened))
    run = Run(options, Stopwatch(progress), opened)
    state = run.stages(State.of(scene, views), [kind])
    return state, run.device or opened


def refit(
    scene: SceneSource,
    reference: SceneSource,
    cameras: CamerasSource | None = None,
    *,
    photos: str | os.PathLike[str] | None = None,
    output: str | os.PathLike[str] | None = None,
    steps: int = RefitOptions.steps,
    prior: float = RefitOptions.prior,
    lambda_: float = RefitOptions.lam,
    drop: float = RefitOptions.drop,
    virtual_views: int | None = None,
    memory: float | None = None,
    background: ColourSource = "black",
    device: DeviceSource = None,
    trust: bool = False,
    antialiased: bool | None = None,
    cameras_anyway: bool = False,
    progress: Progress | None = None,
) -> RefittedScene:
    """Solve for the colours of all splats of a reduced scene together, as the command ``refit`` does.

    The training views then look again as those of the reference do, or as the photographs. Nothing else changes, and
    coefficients that are 0 stay 0.

    Args:
        scene: the reduced one, or its file.
        reference: the uncompressed one, or its file.
        photos: a folder of photographs, named after the views, to fit instead of the reference's pictures.
        steps: at the most.
        prior: how strongly coefficients are held where they were.
        lambda_: how strongly AC coefficients are pulled to 0.
        drop: give up an AC coefficient where the mean squared error grows by less.
        cameras, output, virtual_views, memory, background, device, trust, antialiased, cameras_anyway,
            progress: as of :func:`prune`.

    Raises:
        As :func:`prune`; and UsageError if no training view has a photograph, or there are no cameras for them.
    """
    colour = colour_of(background)
    options = RefitOptions(steps=steps, drop=drop, lam=lambda_, prior=prior)
    budget = as_bytes(memory)
    if photos is not None and cameras is None:
        raise UsageError("--photos needs --cameras, the views that the photographs show")
    write = result_writer(output)
    given = cameras_of(cameras, virtual_views)
    if photos is not None and given is not None:
        given = within_photographs(given)
    ground_truth = GroundTruth(Path(photos), given, colour) if photos is not None and given is not None else None
    reduced, original = scene_of(scene, trust, antialiased), scene_of(reference, trust, antialiased)
    check_rendered_alike((str(name_of(scene)), reduced), (str(name_of(reference)), original))
    check_frame(original, given, cameras_anyway)
    opened = device_of(device)
    there = views_or_placed(original, given, virtual_views, opened)
    views = train_views(there)
    if ground_truth is not None:
        views = ground_truth.of(views)
    tell: Progress = progress or (lambda _what, _done: None)

    def work(device: Device, memory: int | None) -> Refitted:
        how = dataclasses.replace(options, memory=memory)
        with contextlib.ExitStack() as stack:
            targets: RenderedTargets | PhotographTargets
            if ground_truth is None:
                rasterizer = stack.enter_context(Rasterizer(device, original, background=colour))
                targets = RenderedTargets(rasterizer, views)
            else:
                targets = PhotographTargets(device, ground_truth, views)
            active = active_coefficients(reduced.sh, _ZERO_SF)
            return refit_colours(
                device, reduced, views, targets, how, active, colour,
                lambda done, most: tell("refit", done / most),
            )  # fmt: skip

    tell("refit", 0.0)
    refitted, used = on_device(opened, budget, work)
    tell("refit", 1.0)
    result = dataclasses.replace(reduced, sh=refitted.sh)
    if write is not None:
        write(result)
    done = RefittedScene(result, len(reduced), used, refitted, len(views))
    held_out = test_views(there) if ground_truth is None else ground_truth.of(test_views(there))
    if not held_out:
        return done
    if ground_truth is not None:
        scenes = (original, reduced, result)
        of_reference, before, after = (_psnr_of_photographs(used, s, held_out, ground_truth, colour) for s in scenes)
        return dataclasses.replace(
            done,
            held_out=f"{len(held_out)} held-out photographs",
            psnr=(before, after),
            reference_psnr=of_reference,
        )
    with Evaluator(used, original, EvaluationViews.of(held_out), colour) as evaluator:
        before, after = (evaluator.psnr(each) for each in (reduced, result))
        return dataclasses.replace(done, held_out=str(evaluator.views), psnr=(before, after))


def _psnr_of_photographs(
    device: Device, scene: Scene, views: Sequence[Camera], ground_truth: GroundTruth, background: Colour
) -> float:
    with Rasterizer(device, scene, background=background) as rasterizer:
        return ground_truth.psnr(rasterizer, views)


def decibels_of(error: float) -> str:
    """The PSNR of a mean squared error of colours from 0 to 1, for people."""
    return f"{-10 * math.log10(error):.2f} dB" if error > 0 else "infinite"


def check_rendered_alike(reduced: tuple[str, Scene], original: tuple[str, Scene]) -> None:
    """Refuse to fit the pictures of an antialiased scene to those of a classic one, or the other way round.

    Args:
        reduced, original: what each scene is called, and the scene.

    Raises:
        UsageError: one is antialiased and the other is not.
    """
    if reduced[1].antialiased != original[1].antialiased:
        yes, no = (reduced, original) if reduced[1].antialiased else (original, reduced)
        raise UsageError(
            f"'{yes[0]}' says that it is antialiased and '{no[0]}' does not, so their pictures cannot be alike: "
            "give --antialiased yes or no for both"
        )
