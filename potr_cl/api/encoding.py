"""A whole encode in one call, from files or objects, with the options of the command line: :func:`encode`."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from potr_cl.api.choices import EncodeChoices, with_choices
from potr_cl.api.inputs import (
    CamerasSource,
    ColourSource,
    SceneSource,
    bytes_of_source,
    cameras_of,
    colour_of,
    name_of,
    scene_of,
)
from potr_cl.codec.quantize import Preset
from potr_cl.errors import UsageError
from potr_cl.formats.images import Colour
from potr_cl.host.atomic_write import replacing
from potr_cl.host.mapped import bounded
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import several_are_named
from potr_cl.outputs.output import Output
from potr_cl.outputs.registry import OUTPUTS, output_of, output_of_suffix
from potr_cl.pipeline.amounts import as_bytes, size_in_bytes
from potr_cl.pipeline.encode import encode as run_stages
from potr_cl.pipeline.encoded import Encoded, SharedOut
from potr_cl.pipeline.keywords import stage_changes
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.presets import DEFAULT
from potr_cl.pipeline.proof import Proved, proved
from potr_cl.pipeline.search import encode_to_target
from potr_cl.pipeline.stopwatch import Stopwatch
from potr_cl.pipeline.target import Found, Target
from potr_cl.placement.virtual import place_cameras
from potr_cl.quality.by_photographs import judge_by_photographs
from potr_cl.quality.evaluator import EvaluationViews, Evaluator
from potr_cl.quality.ground_truth import GroundTruth
from potr_cl.raster.kept_scene import KeptScene
from potr_cl.raster.scene_buffers import Drawable
from potr_cl.report.html import PicturePair, html_report, views_to_show
from potr_cl.report.summary import encode_report, photographs_report, quality_report, search_report
from potr_cl.stages.code import Code
from potr_cl.stages.refit import Refit
from potr_cl.stages.stage import Progress, Stage, flags
from potr_cl.workers.opening import ClusterSource, DevicesSource, open_workers
from potr_cl.workers.pool import Pool, Traffic

if TYPE_CHECKING:
    from typing_extensions import Unpack


@with_choices(EncodeChoices)
def encode(
    scene: SceneSource,
    cameras: CamerasSource | None = None,
    options: EncodeOptions | None = None,
    progress: Progress | None = None,
    device: DevicesSource = None,
    *,
    cluster: ClusterSource = None,
    q: float | None = None,
    preset: Preset | None = None,
    max_size: int | str | None = None,
    min_psnr: float | None = None,
    virtual_views: int | None = None,
    output: str | os.PathLike[str] | None = None,
    to: str | None = None,
    spz_version: int | None = None,
    title: str | None = None,
    author: str | None = None,
    report: str | os.PathLike[str] | None = None,
    report_view: str | None = None,
    background: ColourSource | None = None,
    memory: float | None = None,
    threads: int | None = None,
    trust: bool = False,
    antialiased: bool | None = None,
    cameras_anyway: bool | None = None,
    tell: Callable[[str], None] | None = None,
    **choices: Unpack[EncodeChoices],
) -> Encoded:
    """Encode a scene, as the command ``encode`` does, with the same options.

    Args:
        scene: to encode, or its file.
        cameras: the training views among them decide which splats may go, and how coarse centres may be; or their
            file. None: virtual ones are placed if the options ask for anything that looks at views; if not, γ alone
            decides about centres.
        options: all at once, instead of the keywords or to be changed by them.
        progress: called with a stage's name and the part of it that is done.
        device: computes, or what it is called; by default the one that should be fastest. If its memory is too small,
            less is kept in it, and if that is not enough, a CPU does the work. A warning says so. Several share the
            views out among them: a list, "all", or "0,1".
        cluster: a Dask cluster whose workers share the views out among them: its scheduler's address, or a client.
        q: quality, 0 (smallest) to 1 (best); 0.5 by default.
        preset: best, smallest, fast or paper; best by default.
        max_size: find the quality that fills this size: bytes, or a text such as "8MB".
        min_psnr: find the quality that just reaches this PSNR in decibels against the uncompressed scene.
        virtual_views: how many views to place without cameras.
        output: a file to write; its suffixes tell the kind, .potr or a format that viewers open (docs/formats.md). An
            existing one is only replaced by what a decoder takes.
        to: the suffix of the kind of file, ".spz", where there is no ``output`` to tell it; .potr by default.
        spz_version: of an .spz file, 2, 3 or 4.
        title, author: shown on a page (.html).
        report: a page of HTML to write: sizes, quality by view, pictures before and after, and the course of pruning.
        report_view: a view to show there besides the worst and the median one.
        background: R, G, B from 0 to 1, or a colour's name; black by default.
        memory: GiB of device memory to keep views in, and for the re-fit; by default half of it, 0.3 of a CPU's. If it
            is given, large arrays of the host lie in temporary files (docs/large_scenes.md).
        threads: on the host; one for each processor by default.
        trust, antialiased: as of :func:`potr_cl.load_scene`.
        cameras_anyway: take the cameras even if they do not seem to be in the scene's frame.
        tell: told a line for every step of a search for a size or a PSNR, and for every round of a fit.
        choices: any option of a stage by the name of its flag: ``keep=0.5`` is ``--keep 0.5``, ``prune=False`` is
            ``--no-prune``, ``refit="off"`` is ``--refit off``; ``lambda_`` stands for ``--lambda``, as lambda is a word
            of Python. A stage's name may be given all its options: ``prune={"iterations": 16}``.

    Raises:
        UsageError: an option is unknown, out of range, or contradicts another; cameras without a training view.
        UnreachableError: no quality meets ``max_size`` or ``min_psnr``.
        DataError: a file is damaged, or a value is too large to quantise.
        DeviceError: no device does the work.
    """
    began = time.perf_counter()
    kind = output_choice(output, to, version=spz_version, title=title, author=author)
    settings = encode_options(
        options, preset, choices, output=kind, q=q, background=background, memory=memory, threads=threads,
        source_bytes=bytes_of_source(scene), cameras_anyway=cameras_anyway,
    )  # fmt: skip
    target = encode_target(q, max_size, min_psnr)
    check_photographs_have_cameras(settings, cameras is not None)
    if report is None and report_view is not None:
        raise UsageError("report_view needs report, the page that shows it")
    views = cameras_of(cameras, virtual_views)
    photographs_of(settings, views)  # a folder without any is told before the work
    with bounded(settings.memory):
        what = scene_of(scene, trust, antialiased)
    if views is None and (virtual_views is not None or report is not None) and settings.look_at_views(what):
        views = place_cameras(what, virtual_views, device=device if isinstance(device, Device) else None)
    judging = EvaluationViews.of(views) if views is not None and report is not None else None
    if report_view is not None and judging is not None:
        judging.named(report_view)  # an unknown name is told before the work
    with contextlib.ExitStack() as stack:
        workers = None
        if device is not None or cluster is not None or several_are_named():
            workers = stack.enter_context(open_workers(device, cluster))
        opened, pool = (None, None) if workers is None else (workers.device, workers.pool)
        before = Traffic() if pool is None else replace(pool.traffic)
        own = stack.enter_context(contextlib.ExitStack())
        file = own.enter_context(replacing(output)) if output is not None else None
        page = stack.enter_context(replacing(report)) if report is not None else None
        found: Found | None = None
        kept: KeptScene | None = None
        if target is None:
            if judging is not None and opened is not None:
                others = () if pool is None else pool.devices
                kept = stack.enter_context(KeptScene(opened, what, settings.memory, others))
            encoded = run_stages(what, views, settings, progress, opened, kept=kept, tell=tell, pool=pool)
        else:
            found = encode_to_target(what, views, target, settings, progress, opened, tell, pool=pool)
            encoded = found.encoded
        if file is None and page is None:
            return encoded
        judged_on = None if judging is None else encoded.device or opened
        written = stack.enter_context(proved(encoded, trust, judged_on))
        if file is not None:
            file.write(written.data)
            own.close()  # a report that fails takes nothing from the file
        if page is not None:
            quality: dict[str, Any] | str = "not judged: there are no cameras to look from"
            pictures: list[PicturePair] = []
            ground_truth: GroundTruth | None = None
            photographs: dict[str, Any] | None = None
            watch = Stopwatch(progress)
            if judging is not None:
                used_device = encoded.device or opened or Device()
                ground_truth = photographs_of(settings, views)
                if ground_truth is not None and views is not None:
                    photographs = by_photographs(
                        ground_truth, views, encoded, (kept or what, written.scene), used_device,
                        encoded.options.background, pool,
                    )  # fmt: skip
                judge = Judge(judging, used_device, encoded.options.background, ground_truth, kept, pool)
                quality, pictures = judge(what, written, watch, report_view, pictures=True)
                if pool is not None:
                    encoded = replace(encoded, shared=SharedOut.by(pool, before))
            seconds = encoded.seconds | watch.seconds | {"total": time.perf_counter() - began}
            source = name_of(scene)
            used = encoded.options.changed(source_bytes=settings.source_bytes)
            search = search_report(target, found) if target is not None and found is not None else None
            document = encode_report(
                source, what, Path(output or "(in memory)"), written, encoded, used, search, quality, seconds,
                photographs,
            )  # fmt: skip
            page.write(html_report(document, pictures).encode())
    return encoded


def encode_options(
    options: EncodeOptions | None,
    preset: Preset | None,
    choices: Mapping[str, Any],
    *,
    q: float | None = None,
    background: ColourSource | None = None,
    memory: float | None = None,
    threads: int | None = None,
    source_bytes: int | None = None,
    cameras_anyway: bool | None = None,
    output: Output | None = None,
    stages: Collection[type[Stage]] | None = None,
) -> EncodeOptions:
    """The options that keywords ask for, checked.

    Args:
        options: to be changed by the others; None: those of the preset.
        choices: of stages, see :func:`potr_cl.pipeline.keywords.stage_changes`.
        stages: of which choices are allowed; None: of all.
        memory: in GiB.
        output: the kind of file.

    Raises:
        UsageError: an option is unknown or out of range, or both options and a preset are given.
    """
    if threads is not None and threads < 0:
        raise UsageError(f"--threads is {threads}, it must be 0 or more")
    changes: dict[str, Any] = {
        "q": q,
        "background": None if background is None else colour_of(background),
        "memory": as_bytes(memory),
        "threads": threads,
        "source_bytes": source_bytes,
        "cameras_anyway": cameras_anyway,
        "output": output,
    }
    changes = {name: value for name, value in changes.items() if value is not None} | stage_changes(choices, stages)
    if options is None:
        options = EncodeOptions.for_preset(preset or DEFAULT, **changes)
    elif not isinstance(options, EncodeOptions):
        raise UsageError(f"the options are an EncodeOptions, not {type(options).__name__}: give a quality as q=0.5")
    elif preset is not None:
        raise UsageError("give either options or a preset: the options have one")
    else:
        options = options.changed(**changes)
    _ = options.parameters  # a wrong option is told before a gigabyte is read
    check_choices(options)
    return options


def output_choice(path: str | os.PathLike[str] | None, to: str | None, **choices: Any) -> Output | None:
    """The kind of file that a name or a suffix asks for; None if nothing does.

    Args:
        path: of the file to write.
        to: a suffix, where there is no path.
        choices: that some outputs have; None where they are not given.

    Raises:
        UsageError: encode does not write such files, or they leave no such choice.
    """
    if path is not None:
        if to is not None:
            raise UsageError(f"'{path}' tells its format itself: leave out 'to'")
        return output_of(Path(path), **choices)
    given = any(choice is not None for choice in choices.values())
    return output_of_suffix(to or OUTPUTS[0].suffixes()[0], **choices) if to is not None or given else None


def check_choices(options: EncodeOptions) -> None:
    """Refuse options of the coder that mean nothing for the kind of file that is asked for.

    Raises:
        UsageError: there are such.
    """
    usual, code = EncodeOptions(preset=options.preset).stage(Code), options.stage(Code)
    for name, flag in flags(Code).items():
        if getattr(code, name) != getattr(usual, name) and name not in options.output.choices:
            kind = options.output
            raise UsageError(
                f"{flag.flag} means nothing for {kind.suffix} files: {kind.format.name} packs in its own way"
            )


def encode_target(q: float | None, max_size: int | str | None, min_psnr: float | None) -> Target | None:
    """What to reach, if anything.

    Raises:
        UsageError: more than one goal is given, or it is out of range.
    """
    if sum(goal is not None for goal in (q, max_size, min_psnr)) > 1:
        raise UsageError("give one of q, max_size and min_psnr: the others follow from it")
    if max_size is not None:
        return Target(max_bytes=size_in_bytes(max_size) if isinstance(max_size, str) else max_size)
    return None if min_psnr is None else Target(min_psnr=min_psnr)


def check_photographs_have_cameras(options: EncodeOptions, cameras: bool) -> None:
    """Refuse photographs to fit without the views that they show.

    Raises:
        UsageError: there are no cameras, or there is no re-fit.
    """
    refit = options.stage(Refit)
    if refit.ground_truth is not None and not (cameras and refit.asked_for):
        raise UsageError("--photos needs --cameras, the views that the photographs show, and a re-fit")


def photographs_of(options: EncodeOptions, cameras: Sequence[Camera] | None) -> GroundTruth | None:
    """The photographs that options name, if they name any: those that are there, found and measured.

    Raises:
        As :class:`potr_cl.quality.ground_truth.GroundTruth`.
    """
    folder = options.stage(Refit).ground_truth
    return None if folder is None or cameras is None else GroundTruth(folder, cameras, options.background)


def by_photographs(
    ground_truth: GroundTruth,
    cameras: Sequence[Camera],
    encoded: Encoded,
    scenes: tuple[Scene | KeptScene, Drawable],
    device: Device,
    background: Colour,
    pool: Pool | None = None,
) -> dict[str, Any]:
    """What photographs say of an encode that was asked to fit to them; see :func:`judge_by_photographs`."""
    figures = judge_by_photographs(ground_truth, cameras, scenes, device, background, pool)
    return photographs_report(encoded, ground_truth.missing, figures)


@dataclass(frozen=True)
class Judge:
    """Says how much an encode has lost, in pictures.

    Attributes:
        views: to judge by.
        device: to render on.
        background: behind the scene.
        ground_truth: photographs to show beside the pictures, if there are any.
        kept: the uncompressed scene, if it lies on the device already.
        pool: workers that views are shared out to, as long as ``device`` is the pool's first; None: it does all.
    """

    views: EvaluationViews
    device: Device
    background: Colour
    ground_truth: GroundTruth | None = None
    kept: KeptScene | None = None
    pool: Pool | None = None

    def __call__(
        self, scene: Scene, written: Proved, watch: Stopwatch, chosen: str | None = None, pictures: bool = False
    ) -> tuple[dict[str, Any], list[PicturePair]]:
        """The figures, and pictures for a report.

        Args:
            scene: uncompressed.
            written: the file; where its scene is on a device, that is the judge's.
            watch: told how far the stage "evaluate" is.
            chosen: a view to show besides the worst and the median one.
            pictures: whether to make any.

        Raises:
            DeviceError: a view does not fit the device, or the device failed.
        """
        watch("evaluate", 0.0)
        reference = self.kept if self.kept is not None and self.kept.is_of(scene) else scene
        with Evaluator(self.device, reference, self.views, self.background, self.pool, remember=False) as evaluator:
            # The end is told when all is there.
            found = evaluator.judge(written.scene, lambda _, done: watch("evaluate", min(done, 0.99)), written.coded)
            quality = quality_report(self.views, *found)
            shown = views_to_show(quality, chosen) if pictures else []
            pairs = evaluator.pictures(written.scene, [view["name"] for _, view in shown]) if shown else []
        watch("evaluate", 1.0)
        return quality, [
            PicturePair(title, view["name"], view["psnr"], *pair, self._photograph(view["name"]))
            for (title, view), pair in zip(shown, pairs, strict=True)
        ]

    def _photograph(self, name: str) -> FloatArray | None:
        found = [] if self.ground_truth is None else self.ground_truth.of([self.views.named(name)])
        return self.ground_truth.picture(found[0]) if self.ground_truth is not None and found else None


def views_or_placed(
    scene: Scene, cameras: Sequence[Camera] | None, count: int | None, device: Device | None = None
) -> Sequence[Camera]:
    """The cameras, or virtual ones."""
    return cameras if cameras is not None else place_cameras(scene, count, device=device)
