"""The stage "refit": colours of all splats together, so that the pictures look again as the uncompressed scene's."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from potr_cl.errors import UsageError
from potr_cl.host.threads import in_background, thread_pool
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.model.virtual_cameras import is_virtual
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import Family
from potr_cl.outputs.output import ColourGrid, Rounded
from potr_cl.quality.photographs import GroundTruth
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.held_out import PhotographChoice, hold_out
from potr_cl.stages.refitting.coefficients import residency_of
from potr_cl.stages.refitting.colour_refit import ColourRefit
from potr_cl.stages.refitting.helpers import colour_shares
from potr_cl.stages.refitting.refit import active_coefficients, chosen_coefficients, refit_colours
from potr_cl.stages.refitting.refit_options import ComingScene, RefitOptions, Refitted
from potr_cl.stages.stage import Flag, Interlude, Stage, State, Workbench, option
from potr_cl.stages.unseen import as_important
from potr_cl.views.shares import HelpFrom
from potr_cl.views.targets import HostTargets, PhotographTargets, PicturesAhead, Targets, targets_of

#: The most steps that "auto" stands for: on a GPU further ones take little time (docs/benchmarks/time_error.md).
STEPS: dict[Family, int] = {"cpu": 6, "gpu": 12}
#: The prior where cameras were placed: people stand elsewhere, so colours should not follow these views too closely.
_PLACED_PRIOR = 0.3
#: A scene that takes more than this part of the memory that is given makes room for the re-fit.
_LARGE = 1 / 16
#: Threads that make of rounded geometry what a decoder sees; with 32 it takes half as long again.
_DECODING = 12


def _steps(text: str) -> int | None:
    if text in ("auto", "off"):
        return None if text == "auto" else 0
    # Python refuses to make a number from thousands of digits; so many steps are not meant anyway.
    if not text.isdecimal() or len(text) > 9:
        raise UsageError(f"--refit is '{text[:40]}': give a number of steps, auto, or off")
    return int(text)


@dataclass(frozen=True)
class Refit(Stage):
    """Re-fit the colours to the training views, on the geometry and opacities that a decoder will see.

    Attributes:
        steps: the most conjugate-gradient steps; with 0 the re-fit is left out. "auto": as many as pay on the device.
        drop: replaces the value that q gives.
        at: parts of the pruning iterations after which colours are re-fitted too, so that later iterations see colours
            that make up for the splats that went.
        at_steps: steps of each of these.
        prior: see :class:`potr_cl.stages.refitting.refit_options.RefitOptions`; None: the usual one, or a larger one
            where cameras were placed.
        ground_truth: folder of the views' photographs, named after the views. The colours are then fitted to the
            photographs instead of the uncompressed scene's pictures, if photographs that are held out agree that this
            is better; but not if a fit of all parameters has come near to them before.

    Raises:
        UsageError: a value is out of range.
    """

    name = "refit"
    title = "re-fit of the colours"

    steps: int | Literal["auto"] = option(
        8,
        Flag(
            "--refit",
            "steps of fitting the colours of all splats together to the uncompressed scene's pictures; off: none",
            "N",
            _steps,
            default="auto, the preset's",
        ),
    )
    drop: float | None = option(
        None,
        Flag(
            "--drop",
            "zero an SH coefficient if that raises the mean squared error by less than X (re-fit only)",
            "X",
            float,
        ),
        parameter=True,
    )
    at: tuple[float, ...] = option(
        (),
        Flag(
            "--refit-at",
            "fractions of the pruning iterations after which to re-fit too: a few percent smaller, slower",
            "PART",
            float,
            many=True,
            default="none",
        ),
    )
    at_steps: int = option(3)
    prior: float | None = option(None)
    ground_truth: Path | None = option(
        None,
        Flag(
            "--photos",
            "photographs, named after the views: match them instead of the uncompressed scene, if that improves "
            "held-out photographs",
            "DIR",
            Path,
            default="the uncompressed scene's pictures",
        ),
    )

    def __post_init__(self) -> None:
        for part in self.at:
            if not 0 <= part <= 1:
                raise UsageError(f"--refit-at is {part:g}, it must lie between 0 and 1")
        if isinstance(self.steps, str) and self.steps != "auto":
            raise UsageError(f"the re-fit's steps are '{self.steps}': give a number, or auto")
        _ = RefitOptions(steps=self.steps_on("gpu"), prior=self._prior([])), RefitOptions(steps=self.at_steps)

    @classmethod
    def from_flags(cls, given: dict[str, Any]) -> dict[str, Any]:
        return {**given, "at": tuple(given["at"])} if "at" in given else given

    @property
    def asked_for(self) -> bool:
        return self.on and self.steps != 0

    def steps_on(self, family: Family) -> int:
        """The most steps on a device of a family."""
        return STEPS[family] if self.steps == "auto" else self.steps

    def _prior(self, views: Sequence[Camera]) -> float:
        if self.prior is not None:
            return self.prior
        return _PLACED_PRIOR if is_virtual(views) else RefitOptions.prior

    def interludes(self, iterations: int) -> Sequence[Interlude]:
        times = sorted({max(round(part * iterations), 1) for part in self.at})
        return [Interlude(after, RefitOnTheWay(steps=self.at_steps)) for after in times]

    def run(self, state: State, bench: Workbench) -> State:
        """Re-fit the colours, and leave a :class:`potr_cl.stages.refitting.refit_options.Refitted` in ``results``.

        With photographs, also a :class:`potr_cl.stages.held_out.PhotographChoice` as "photographs".
        """
        bench.progress("refit", 0.0)
        parameters = bench.parameters
        compacted = state.results.compacted
        active = active_coefficients(state.scene.sh, parameters.sf_sh) if compacted else None
        if state.results.chosen == parameters:
            active = chosen_coefficients(state.scene.sh)
        steps, prior = self.steps_on(bench.opened.family), self._prior(state.views)
        options = RefitOptions(steps=steps, drop=parameters.drop, memory=bench.memory, prior=prior)
        on_grid = bench.output.on_grid(bench.request(state))
        # What has been fitted to photographs already is what the colours should show again once all else is rounded.
        folder = self.ground_truth if state.truth is None else None
        with ExitStack() as stack:
            stack.callback(bench.progress, "refit", 1.0)
            ahead = stack.enter_context(_pictures_ahead(state, bench))
            rounded = in_background(_rounded, state, bench)

            def decode() -> Scene:
                with thread_pool(bench.threads or min(os.cpu_count() or 1, _DECODING)) as pool:
                    return rounded.result().decoded(state.scene.sh, pool.map)

            decoded = ComingScene(state.scene.sh, decode)
            pictures = stack.enter_context(_pictures_of_goal(state, bench, ahead))
            help_from = None
            if bench.pool is not None:
                goal = bench.shared_source(state) if state.truth is None else state.truth
                visibility = state.visibility if bench.pool.in_process and state.truth is None else None
                help_from = HelpFrom(bench.pool, goal if ahead is None else ahead, visibility)
            # With photographs nobody helps: these lie where the master reads them.
            fits: list[tuple[Sequence[Camera], Targets, HelpFrom | None]] = [(state.views, pictures, help_from)]
            if folder is not None:
                given = state.given
                photographs = GroundTruth(folder, given, bench.background)
                fit_to, judging = hold_out(photographs.of(given))
                # Nobody photographed added views. Renders of them beside photographs would ask for colours that leap
                # from one view to the next, and SH can do that: held-out photographs were matched 7 to 13 dB worse.
                fits.append((fit_to, PhotographTargets(bench.opened, photographs, fit_to), None))
            found: list[tuple[Refitted, Rounded]] = []
            for views, targets, helping in fits:
                file = _FileToCome(state, bench, rounded)
                refitted = refit_colours(
                    bench.opened, decoded, views, targets, options, active, bench.background,
                    partial(_told, bench, len(found), len(fits)),
                    fix_ac=None if on_grid or not bench.output.fixes_ac else file.fix_ac,
                    help_from=helping,
                    colour_grid=file.colour_grid if on_grid else None,
                )  # fmt: skip
                found.append((refitted, rounded.result() if file.geometry is None else file.geometry))
            (refitted, geometry), choice = found[0], None
            if folder is not None:
                psnrs = []
                for each, _ in reversed(found):
                    shown = replace(decoded.result(), sh=each.sh)
                    with Rasterizer(bench.opened, shown, background=bench.background) as judged:
                        psnrs.append(photographs.psnr(judged, judging))
                choice = PhotographChoice(len(judging), *psnrs)
                if choice.kept:
                    refitted, geometry = found[1]
        then = replace(state.recoloured(refitted.sh), geometry=geometry).with_results(refitted=refitted)
        return then if choice is None else then.with_results(photographs=choice)


@dataclass
class _FileToCome:
    """What a kind of file makes of colours, with the geometry that goes with them then."""

    state: State
    bench: Workbench
    rounded: Future[Rounded]
    geometry: Rounded | None = None

    def fix_ac(self, sh: FloatArray, refit: ColourRefit) -> FloatArray:
        request = replace(self.bench.request(self.state), blocks=refit.blocks)
        self.geometry, fixed = self.bench.output.fix_ac(self.rounded.result(), sh, refit.worth(), request)
        return fixed

    def colour_grid(self, effects: FloatArray) -> ColourGrid:
        effects, request = as_important(effects, self.state), self.bench.request(self.state)
        self.geometry, grid = self.bench.output.colour_grid(self.rounded.result(), effects, request)
        return grid


def _told(bench: Workbench, number: int, fits: int, done: int, steps: int) -> None:
    bench.progress("refit", (number + done / steps) / fits)


def _rounded(state: State, bench: Workbench) -> Rounded:
    """The geometry of what is left of the scene as the file's readers will see it."""
    geometry = state.geometry
    if geometry is None or geometry.asked != bench.parameters:
        geometry = bench.output.geometry(state.scene, bench.request(state))
    return geometry


@contextmanager
def _pictures_ahead(state: State, bench: Workbench) -> Iterator[PicturesAhead | None]:
    """Pictures of the uncompressed scene, begun now, where it is kept on devices and no cluster helps; else None."""
    device, pool = bench.opened, bench.pool
    kept = bench.kept if state.truth is None and bench.memory is None else None
    if kept is None or not kept.is_of(state.source) or (pool is not None and not pool.in_process):
        yield None
        return
    numbers: dict[Device, Sequence[int]] = {device: range(len(state.views))}
    if pool is not None and (share := colour_shares(pool, len(state.views))).others:
        numbers = {device: share.own, **dict(zip(pool.devices, share.others, strict=False))}
    with PicturesAhead(kept, bench.background, state.views, numbers, state.visibility) as ahead:
        yield ahead


@contextmanager
def _pictures_of_goal(state: State, bench: Workbench, ahead: PicturesAhead | None) -> Iterator[Targets]:
    """The pictures that colours are re-fitted to; where the re-fit needs its room, they are rendered before."""
    device, views = bench.opened, state.views
    little = residency_of(device, len(state.scene), state.scene.sh.shape[1], bench.memory).slice is not None
    little = little or (bench.memory is not None and state.source.nbytes > _LARGE * bench.memory)
    with _rendered(state, state.goal, bench) as rendered:
        targets: Targets = rendered
        if ahead is not None:
            targets = ahead.before(device, targets)
        if state.truth is None:
            targets = bench.rendered_before(state, targets, views)
        if not little or bench.pool is not None:
            yield targets
            return
        remembered = HostTargets(device, targets, views)
    with remembered:
        yield remembered


def _rendered(state: State, scene: Scene, bench: Workbench) -> AbstractContextManager[Targets]:
    """The pictures of a scene in a state's views, which are rendered when they are asked for."""
    visibility = state.visibility if scene is state.source else None
    return targets_of(bench.opened, bench.drawable(scene), state.views, bench.background, visibility)


@dataclass(frozen=True)
class RefitOnTheWay(Stage):
    """A short re-fit while splats are being removed: on the exact geometry, and without giving up coefficients."""

    name = "refit on the way"
    title = ""

    steps: int = 3

    def run(self, state: State, bench: Workbench) -> State:
        bench.progress("refit", 0.0)
        with _rendered(state, state.source, bench) as targets:
            refitted = refit_colours(
                bench.opened,
                state.scene,
                state.views,
                targets,
                RefitOptions(steps=self.steps, memory=bench.memory),
                background=bench.background,
                progress=lambda done, steps: bench.progress("refit", 0.99 * done / steps),
                help_from=None if bench.pool is None else HelpFrom(bench.pool, bench.shared_source(state)),
            )
        bench.progress("refit", 1.0)
        return state.recoloured(refitted.sh)
