"""One stage alone, from a scene to a scene: :func:`prune`, :func:`compact`, :func:`refit`, :func:`fit`.

All four read their scenes, find their views and write their result in the same way (:class:`_Work`).
"""

from __future__ import annotations

import dataclasses
import logging
import math
import os
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, TypeVar

import numpy as np

from potr_cl.api.choices import CompactChoices, PruneChoices, encode_options
from potr_cl.api.files import result_writer, save
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
from potr_cl.api.pictures import preview
from potr_cl.api.views import views_or_placed
from potr_cl.codec.quantize import ac_sparsity
from potr_cl.errors import UsageError
from potr_cl.formats.images import Colour
from potr_cl.host.atomic_write import replacing
from potr_cl.host.process import first_interrupt_asks
from potr_cl.model.camera import Camera, test_views, train_views, within_photographs
from potr_cl.model.scene import Scene
from potr_cl.model.views_between import views_between as place_between
from potr_cl.model.virtual_cameras import is_virtual
from potr_cl.opencl.device import Device
from potr_cl.pipeline.fallback import with_fallback
from potr_cl.pipeline.forecast import log_forecast
from potr_cl.pipeline.frame import check_frame
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.run import Run, Stopwatch
from potr_cl.pipeline.target import as_bytes
from potr_cl.quality.evaluator import EvaluationViews, Evaluator
from potr_cl.quality.photographs import GroundTruth
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.compact import Compact as Compact
from potr_cl.stages.fitting.fit import FitOptions as FitOptions
from potr_cl.stages.fitting.fit import Following, Sight, fit_scene
from potr_cl.stages.fitting.fitted import Fitted
from potr_cl.stages.prune import Prune as Prune
from potr_cl.stages.pruning.schedule import Pruned
from potr_cl.stages.refitting.refit import active_coefficients, refit_colours
from potr_cl.stages.refitting.refit_options import RefitOptions as RefitOptions
from potr_cl.stages.refitting.refit_options import Refitted
from potr_cl.stages.stage import Progress, Stage, State
from potr_cl.stages.unseen import Unresolved, Unseen
from potr_cl.views.targets import PhotographTargets, RenderedTargets

if TYPE_CHECKING:
    from typing_extensions import Unpack

_log = logging.getLogger("potr_cl")
_T = TypeVar("_T")

#: Coefficients that round to 0 at so many steps a unit are 0, but for what storing R, G and B leaves of them.
_ZERO_SF = 1e5
#: The most views between that may be asked for, for each training view.
_MOST_BETWEEN = 100


class EditChoices(TypedDict, total=False):
    """What the functions of all single stages take.

    Attributes:
        output: a file to write the scene to as well.
        virtual_views: how many views to place without cameras.
        memory: limit in GiB for cached views and the re-fit.
        background: R, G, B from 0 to 1, or a colour's name; black by default.
        device: that computes: an index, part of a name, "cpu" or "gpu".
        trust, antialiased: as of :func:`potr_cl.load_scene`.
        cameras_anyway: use the cameras even if they do not seem to be in the scene's frame.
        progress: called with what is done and the part of it that is done.
    """

    output: str | os.PathLike[str] | None
    virtual_views: int | None
    memory: float | None
    background: ColourSource
    device: DeviceSource
    trust: bool
    antialiased: bool | None
    cameras_anyway: bool
    progress: Progress | None


class _PruneKeywords(PruneChoices, EditChoices, total=False):
    pass


class _CompactKeywords(CompactChoices, EditChoices, total=False):
    pass


@dataclass(frozen=True, repr=False)
class Edited:
    """A scene that one stage has changed; functions that take scenes take it too. Printed: what the command prints.

    Attributes:
        scene: the changed one.
        source_splats: how many splats it had before.
        device: that did the work.
    """

    scene: Scene
    source_splats: int
    device: Device

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.summary}, on {self.device.info.name})"

    def __str__(self) -> str:
        return "\n".join(self.lines)

    @property
    def summary(self) -> str:
        """What was done, in a line."""
        return f"{len(self.scene):,} of {self.source_splats:,} splats"

    @property
    def lines(self) -> list[str]:
        """All that the command prints."""
        return [f"{self.summary}, on {self.device.info}"]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the scene; see :func:`potr_cl.save`."""
        save(self.scene, path)

    def _repr_png_(self) -> bytes | None:
        return preview(self.scene)


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
    def summary(self) -> str:
        part = 100 * self.pruned.kept / self.source_splats
        splats = f"kept {self.pruned.kept:,} of {self.source_splats:,} splats ({part:.1f} %)"
        return f"{splats} in {self.pruned.iterations} iterations"

    @property
    def lines(self) -> list[str]:
        return [*super().lines, *([str(self.unseen)] if self.unseen.splats else [])]


@dataclass(frozen=True, repr=False)
class CompactedScene(Edited):
    """The result of :func:`compact`.

    Attributes:
        sparsity: part of the AC coefficients that quantise to 0, before and after.
    """

    sparsity: tuple[float, float]

    @property
    def summary(self) -> str:
        before, after = (100 * part for part in self.sparsity)
        return f"{len(self.scene):,} splats, {after:.1f} % of the AC coefficients quantise to 0, {before:.1f} % before"


@dataclass(frozen=True, repr=False)
class Matched(Edited):
    """A scene that was brought closer to another one.

    Attributes:
        views: how many training views there are.
        held_out: the views that were not looked at, in words; None where there are none.
        psnr: mean over those of the PSNR before and after, in decibels: against the reference, or with photographs
            against these; None where there are none.
        reference_psnr: the reference's own PSNR against the photographs; None where there are none.
    """

    views: int
    held_out: str | None
    psnr: tuple[float, float] | None
    reference_psnr: float | None

    @property
    def lines(self) -> list[str]:
        found = super().lines
        if self.psnr is not None:
            before, after = self.psnr
            own = "" if self.reference_psnr is None else f"{self.reference_psnr:.2f} dB of the reference, "
            found.append(f"{self.held_out}: PSNR {before:.2f} dB before, {after:.2f} dB after, {own}mean over views")
        return found


@dataclass(frozen=True, repr=False)
class RefittedScene(Matched):
    """The result of :func:`refit`.

    Attributes:
        refitted: steps, and the mean squared errors of the training views before and after.
    """

    refitted: Refitted

    @property
    def summary(self) -> str:
        before, after = (_decibels(error) for error in self.refitted.errors)
        views = f"PSNR {after} of {self.views} training views, {before} before"
        return f"{len(self.scene):,} splats re-fitted in {self.refitted.steps} steps, {views}"


@dataclass(frozen=True, repr=False)
class FittedScene(Matched):
    """The result of :func:`fit`.

    Attributes:
        fitted: steps, and the errors of the training views that were held out, round by round.
        added: how many views between the training views were looked at.
    """

    fitted: Fitted
    added: int

    @property
    def summary(self) -> str:
        between = f" and {self.added} between them" if self.added else ""
        return f"{len(self.scene)} splats, {self.fitted} of {self.views} training views{between}"


class _Work:
    """A stage's scenes and views, ready on a device.

    Args:
        scene: to be changed.
        cameras: of the scene, or of the reference where there is one.
        how: what all stages take.
        options: of an encode in which this stage alone takes long, for the forecast.
        reference: the uncompressed scene.
        photos: a folder of photographs to fit to.
    """

    def __init__(
        self,
        scene: SceneSource,
        cameras: CamerasSource | None,
        how: EditChoices,
        options: EncodeOptions,
        reference: SceneSource | None = None,
        photos: str | os.PathLike[str] | None = None,
    ) -> None:
        self.colour: Colour = colour_of(how.get("background", "black"))
        self.memory = as_bytes(how.get("memory"))
        if photos is not None and cameras is None:
            raise UsageError("--photos needs --cameras, the views that the photographs show")
        self._write = result_writer(how.get("output"))
        virtual, source = how.get("virtual_views"), scene if reference is None else reference
        given = cameras_of(cameras, virtual)
        self.truth: GroundTruth | None = None
        if photos is not None and given is not None:
            given = within_photographs(given)
            self.truth = GroundTruth(Path(photos), given, self.colour)
            if self.truth.missing is not None:
                _log.warning("%s", self.truth.missing)
        read = {"trust": how.get("trust", False), "antialiased": how.get("antialiased")}
        self.scene = scene_of(scene, **read)  # type: ignore[arg-type]
        self.original = self.scene
        if reference is not None:
            self.original = scene_of(reference, **read)  # type: ignore[arg-type]
            check_rendered_alike((str(name_of(scene)), self.scene), (str(name_of(reference)), self.original))
        check_frame(self.original, given, how.get("cameras_anyway", False))
        self.opened = device_of(how.get("device"))
        self.progress: Progress = how.get("progress") or (lambda _what, _done: None)
        self.cameras = views_or_placed(source, self.original, given, virtual, self.opened, self.progress)
        self.views = train_views(self.cameras)
        if self.truth is not None:
            self.views = self.truth.of(self.views)
        log_forecast(self.opened, self.scene, self.cameras, options)

    def stage(self, kind: type[Stage], options: EncodeOptions) -> tuple[State, Device]:
        """What a stage makes of the scene, and the device that it was done on."""
        run = Run(options, Stopwatch(self.progress), self.opened)
        state = run.stages(State.of(self.scene, self.views), [kind])
        return state, run.device or self.opened

    def done(self, name: str, work: Callable[[Device, int | None], _T]) -> tuple[_T, Device]:
        """What a function makes on a device, with how much of its memory; again where that is too much."""
        self.progress(name, 0.0)
        made = with_fallback(self.opened, self.memory, work)
        self.progress(name, 1.0)
        return made

    def write(self, scene: Scene) -> None:
        """Write the result, if a file is asked for."""
        if self._write is not None:
            self._write(scene)

    def matched(self, used: Device, result: Scene) -> dict[str, Any]:
        """The fields of :class:`Matched`: how much closer to the reference the scene has come."""
        found: dict[str, Any] = {
            "scene": result, "source_splats": len(self.scene), "device": used, "views": len(self.views),
            "held_out": None, "psnr": None, "reference_psnr": None,
        }  # fmt: skip
        views = test_views(self.cameras) if self.truth is None else self.truth.of(test_views(self.cameras))
        if not views:
            return found
        if self.truth is None:
            with Evaluator(used, self.original, EvaluationViews.of(views), self.colour) as evaluator:
                before, after = (evaluator.psnr(each) for each in (self.scene, result))
                return found | {"held_out": str(evaluator.views), "psnr": (before, after)}
        reference, before, after = (
            self._by_photographs(used, each, views, self.truth) for each in (self.original, self.scene, result)
        )
        called = f"{len(views)} held-out photographs"
        return found | {"held_out": called, "psnr": (before, after), "reference_psnr": reference}

    def _by_photographs(self, device: Device, scene: Scene, views: Sequence[Camera], truth: GroundTruth) -> float:
        with Rasterizer(device, scene, background=self.colour) as rasterizer:
            return truth.psnr(rasterizer, views)


def prune(
    scene: SceneSource,
    cameras: CamerasSource | None = None,
    *,
    q: float = 0.5,
    order: str | os.PathLike[str] | None = None,
    **choices: Unpack[_PruneKeywords],
) -> PrunedScene:
    """Remove the splats that no view misses, as the command ``prune`` does; nothing else changes.

    Args:
        scene: or its file.
        cameras: or their file; None: virtual ones are placed.
        q: 0 (fewest splats) to 1.
        order: a .npy file to write the order of removal to: splat numbers, first removed first, kept ones last.
        choices: options of the stage by the name of their flag: ``keep=0.5``, ``iterations=16``; and output,
            virtual_views, memory, background, device, trust, antialiased, cameras_anyway, progress:
            :class:`EditChoices`.

    Raises:
        UsageError: an option is unknown or out of range, or no camera is a training view.
        DataError: a file is damaged.
        DeviceError: no device does the work.
    """
    how, own = _split(choices)
    options = _stage_options(Prune, q, how, own)
    with ExitStack() as stack:
        ranks = stack.enter_context(replacing(order)) if order is not None else None
        work = _Work(scene, cameras, how, options)
        state, used = work.stage(Prune, options)
        pruned, unseen = state.results.pruned, state.results.unseen
        assert pruned is not None
        assert unseen is not None
        work.write(state.scene)
        if ranks is not None:
            np.save(ranks, pruned.order)
    return PrunedScene(state.scene, len(work.scene), used, pruned, unseen)


def compact(
    scene: SceneSource,
    cameras: CamerasSource | None = None,
    *,
    q: float = 0.5,
    sf_sh: float | None = None,
    **choices: Unpack[_CompactKeywords],
) -> CompactedScene:
    """Make the colours' coefficients sparse, as the command ``compact`` does; nothing else changes.

    Args:
        scene, cameras: as of :func:`prune`.
        q: 0 (sparsest) to 1.
        sf_sh: steps a unit of the quantiser to expect.
        choices: options of the stage by the name of their flag: ``lambda_=0.01``, ``one_pass=True``; and those of
            :class:`EditChoices`.

    Raises:
        As :func:`prune`.
    """
    how, own = _split(choices)
    options = _stage_options(Compact, q, how, own, sf_sh)
    work = _Work(scene, cameras, how, options)
    state, used = work.stage(Compact, options)
    work.write(state.scene)
    before, after = (ac_sparsity(each.sh, options.parameters.sf_sh) for each in (work.scene, state.scene))
    return CompactedScene(state.scene, len(work.scene), used, (before, after))


def _split(choices: Any) -> tuple[EditChoices, dict[str, Any]]:
    """What all stages take, and a stage's own options."""
    how: Any = {name: value for name, value in choices.items() if name in EditChoices.__annotations__}
    return how, {name: value for name, value in choices.items() if name not in how}


def _stage_options(
    kind: type[Stage], q: float, how: EditChoices, own: dict[str, Any], sf_sh: float | None = None
) -> EncodeOptions:
    """Options of an encode in which this stage alone looks at views, checked."""
    alone = {stage.name: {"on": isinstance(stage, kind)} for stage in EncodeOptions().stages if stage.needs_views}
    options = encode_options(
        EncodeOptions(q=q).changed(**alone), None, own, background=how.get("background"), memory=how.get("memory"),
        cameras_anyway=how.get("cameras_anyway"), stages=[kind],
    )  # fmt: skip
    if sf_sh is not None:
        options = options.with_parameters(sf_sh=sf_sh)
        _ = options.parameters
    return options


def refit(
    scene: SceneSource,
    reference: SceneSource,
    cameras: CamerasSource | None = None,
    *,
    photos: str | os.PathLike[str] | None = None,
    steps: int = RefitOptions.steps,
    prior: float = RefitOptions.prior,
    lambda_: float = RefitOptions.lam,
    drop: float = RefitOptions.drop,
    **how: Unpack[EditChoices],
) -> RefittedScene:
    """Solve for the colours of all splats of a reduced scene together, as the command ``refit`` does.

    The training views then look again as those of the reference do, or as the photographs. Nothing else changes, and
    coefficients that are 0 stay 0.

    Args:
        scene: the reduced one, or its file.
        reference: the uncompressed one, or its file.
        cameras: or their file; None: virtual ones are placed.
        photos: a folder of photographs, named after the views, to fit instead of the reference's pictures.
        steps: at the most.
        prior: how strongly coefficients are held where they were.
        lambda_: how strongly AC coefficients are pulled to 0.
        drop: zero an AC coefficient where the mean squared error grows by less.
        how: see :class:`EditChoices`.

    Raises:
        As :func:`prune`; and UsageError if no training view has a photograph, or there are no cameras for them.
    """
    options = RefitOptions(steps=steps, drop=drop, lam=lambda_, prior=prior)
    alone = EncodeOptions(memory=as_bytes(how.get("memory"))).changed(prune=False, refit={"steps": steps})
    work = _Work(scene, cameras, how, alone, reference, photos)

    def solved(device: Device, memory: int | None) -> Refitted:
        with ExitStack() as stack:
            targets: RenderedTargets | PhotographTargets
            if work.truth is None:
                rasterizer = stack.enter_context(Rasterizer(device, work.original, background=work.colour))
                targets = RenderedTargets(rasterizer, work.views)
            else:
                targets = PhotographTargets(device, work.truth, work.views)
            return refit_colours(
                device, work.scene, work.views, targets, dataclasses.replace(options, memory=memory),
                active_coefficients(work.scene.sh, _ZERO_SF), work.colour,
                lambda done, most: work.progress("refit", done / most),
            )  # fmt: skip

    refitted, used = work.done("refit", solved)
    result = dataclasses.replace(work.scene, sh=refitted.sh)
    work.write(result)
    found = RefittedScene(**work.matched(used, result), refitted=refitted)
    if found.psnr is not None and found.reference_psnr is not None and found.psnr[1] < found.reference_psnr:
        _log.warning(
            "on held-out photographs the result is %.2f dB worse than the reference: the training photographs are "
            "fitted too closely (more --prior, fewer --steps), or too much is gone",
            found.reference_psnr - found.psnr[1],
        )
    elif found.psnr is None and photos is not None:
        _log.warning("no view is held out: nothing shows whether the colours are overfitted to the photographs")
    return found


def fit(
    scene: SceneSource,
    reference: SceneSource,
    cameras: CamerasSource | None = None,
    *,
    steps: int = FitOptions.steps,
    views_between: int = 0,
    **how: Unpack[EditChoices],
) -> FittedScene:
    """Move, turn, scale, fade and colour the splats of a reduced scene, as the command ``fit`` does.

    The views then look again as those of the reference do. Some training views are held out, and the scene that matches
    them best is kept: at worst the one that was given. Splats that no view shows stay as they are.

    Args:
        scene, reference, cameras, how: as of :func:`refit`.
        steps: at the most.
        views_between: for each training view, how many views between it and its neighbours to look at besides.

    Raises:
        As :func:`prune`; and UsageError if there are fewer than two training views.
    """
    if not 0 <= views_between <= _MOST_BETWEEN:
        raise UsageError(f"--views-between is {views_between}, it must be from 0 to {_MOST_BETWEEN}")
    options = FitOptions(steps=steps)
    alone = EncodeOptions(memory=as_bytes(how.get("memory"))).changed(
        prune=False, refit=False, fit={"steps": steps}, between={"views": views_between}
    )
    work = _Work(scene, cameras, how, alone, reference)
    added = []
    if not is_virtual(work.views) and len(work.views) > 1:
        added = place_between(work.original, work.views, views_between)
    views = [*work.views, *added]

    def fitted_to(device: Device, memory: int | None) -> Fitted:
        with (
            first_interrupt_asks() as asked,
            Rasterizer(device, work.original, background=work.colour) as rasterizer,
        ):
            sight = Sight(views, RenderedTargets(rasterizer, views), len(added), work.colour)
            following = Following(lambda done, most: work.progress("fit", 0.99 * done / most), _log.info, asked)
            return fit_scene(device, work.scene, sight, dataclasses.replace(options, memory=memory), following)

    fitted, used = work.done("fit", fitted_to)
    work.write(fitted.scene)
    return FittedScene(**work.matched(used, fitted.scene), fitted=fitted, added=len(added))


def _decibels(error: float) -> str:
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
