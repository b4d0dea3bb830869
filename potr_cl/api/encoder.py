"""Encodes from a scene's file to the new file and what is reported of it: :class:`Encoder`.

One orchestration for the command line and for Python: both say what they want, and print or return the results.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from potr_cl.api.inputs import CamerasSource, SceneSource, bytes_of_source, cameras_of, name_of, scene_of
from potr_cl.api.views import log_placed
from potr_cl.errors import DeviceError, PotrError, UsageError
from potr_cl.formats.ladder import DESCRIPTION, Ladder, Rung
from potr_cl.formats.registry import stem_of_scene
from potr_cl.host.atomic_write import make_folder, replacing
from potr_cl.host.mapped import bounded
from potr_cl.host.threads import in_background
from potr_cl.levels.encoding import encode_levels
from potr_cl.model.camera import Camera, within_photographs
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import cameras_or_virtual
from potr_cl.pipeline.encode import encode as run_stages
from potr_cl.pipeline.encoded import Encoded, Proved, SharedOut, proved
from potr_cl.pipeline.forecast import log_forecast
from potr_cl.pipeline.frame import FrameCheck
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.run import Stopwatch, added_up
from potr_cl.pipeline.search import encode_to_target
from potr_cl.pipeline.target import Target
from potr_cl.quality.evaluator import EvaluationViews, Evaluator, judge_by_photographs
from potr_cl.quality.photographs import GroundTruth
from potr_cl.raster.resident import ResidentScene
from potr_cl.report.html import PicturePair, html_report, views_to_show
from potr_cl.report.summary import decibels, encode_report, photographs_report, quality_report, search_report
from potr_cl.stages.refit import Refit
from potr_cl.stages.stage import Progress
from potr_cl.workers.host import ClusterSource, DevicesSource, Workers, open_workers
from potr_cl.workers.pool import Pool, Traffic

if TYPE_CHECKING:
    from typing_extensions import Self

_log = logging.getLogger("potr_cl")


@dataclass(frozen=True)
class _Job:
    """A scene that is ready to be encoded.

    Attributes:
        options: with the size of its file.
        scene: uncompressed.
        cameras: given or virtual.
        frame: the check of the cameras, which goes on.
        judging: the views to judge by; None: nothing is judged.
        workers: what computes; None where no stage looks at views.
        kept: the scene on the devices.
        seconds: that it took, by stage.
    """

    options: EncodeOptions
    scene: Scene
    cameras: Sequence[Camera] | None
    frame: FrameCheck
    judging: EvaluationViews | None
    workers: Workers | None
    kept: ResidentScene | None
    seconds: dict[str, float]

    @property
    def device(self) -> Device | None:
        return None if self.workers is None else self.workers.device

    @property
    def pool(self) -> Pool | None:
        return None if self.workers is None else self.workers.pool

    def encoded(self, progress: Progress | None) -> Encoded:
        run: Callable[..., Encoded] = run_stages
        if self.options.wanted_levels != 1:
            run = partial(encode_levels, judge=self.judging is not None)
        with self.frame.beside(progress) as watched:
            return run(
                self.scene, self.cameras, self.options, watched, self.device, kept=self.kept, in_frame=True,
                tell=_log.info, pool=self.pool,
            )  # fmt: skip

    def searched(self, target: Target, progress: Progress | None) -> tuple[Encoded, dict[str, Any]]:
        """The encode that meets a target, and the report of the search."""
        with self.frame.beside(progress) as watched:
            found = encode_to_target(
                self.scene, self.cameras, target, self.options, watched, self.device, _log.info, in_frame=True,
                pool=self.pool,
            )  # fmt: skip
        return replace(found.encoded, options=found.options), search_report(target, found)


class Encoder:
    """Encodes one scene or several with the same options; devices, cameras and photographs are made ready once.

    Devices are opened in the background, while the first scene is read. To be used as a context. What happens is
    reported to the logger "potr_cl", as the command line prints it.

    Args:
        options: of the encode.
        target: a size or PSNR to reach; None: the quality is that of the options.
        cameras: or their file; None: virtual ones are placed where a stage looks at views.
        beside: whether each scene has cameras of its own, see :meth:`look_from`.
        virtual_views: how many views to place without cameras.
        device, cluster: see :func:`potr_cl.workers.host.open_workers`.
        judge: whether to render and compare what was encoded.
        trust, antialiased: as of :func:`potr_cl.load_scene`.

    Raises:
        UsageError: photographs are to be fitted to, but cameras or the re-fit are missing; and as :func:`cameras_of`.
    """

    def __init__(
        self,
        options: EncodeOptions,
        target: Target | None = None,
        cameras: CamerasSource | None = None,
        *,
        beside: bool = False,
        virtual_views: int | None = None,
        device: DevicesSource = None,
        cluster: ClusterSource = None,
        judge: bool = False,
        trust: bool = False,
        antialiased: bool | None = None,
    ) -> None:
        self._options, self._target, self._virtual_views, self._judge = options, target, virtual_views, judge
        self._named, self._trust, self._antialiased = (device, cluster), trust, antialiased
        self._check_photographs(beside or cameras is not None)
        if target is not None and options.wanted_levels != 1:
            raise UsageError("--max-size and --min-psnr are for files of one level of detail: give -q with --levels")
        self._opened: Future[Workers] | None = None
        looks = any(s.asked_for and s.needs_views and not s.serves_others for s in options.stages)
        self._looks = looks or (judge and (beside or cameras is not None))
        self._cameras: Sequence[Camera] | None = None
        self._photographs: GroundTruth | None = None
        if not beside:
            self.look_from(cameras_of(cameras, virtual_views))

    def _check_photographs(self, cameras: bool) -> None:
        refit = self._options.stage(Refit)
        if refit.ground_truth is not None and not (cameras and refit.asked_for):
            raise UsageError("--photos needs --cameras, the views that the photographs show, and a re-fit")

    def look_from(self, cameras: Sequence[Camera] | None) -> None:
        """Choose the cameras of the scenes that follow.

        Raises:
            UsageError: there are none, and photographs are to be fitted to, or none of them is there.
        """
        folder = self._options.stage(Refit).ground_truth
        self._check_photographs(cameras is not None)
        if folder is not None and cameras is not None:
            cameras = within_photographs(cameras)
            self._photographs = GroundTruth(folder, cameras, self._options.background)
        self._cameras = cameras

    def __enter__(self) -> Self:
        if self._looks:
            self._opened = in_background(self._open)
        return self

    def __exit__(self, *_: object) -> None:
        if self._opened is not None:
            with suppress(PotrError):
                self._opened.result().close()

    def _open(self) -> Workers:
        workers = open_workers(*self._named)
        for device in workers.devices:
            device.prepare_for(f"encode {self._options.preset}")  # what the last encode with this preset has needed
        return workers

    @property
    def workers(self) -> Workers | None:
        """What computes; None where nothing looks at views.

        Raises:
            DeviceError: there is no device, or it does not work.
        """
        return None if self._opened is None else self._opened.result()

    @contextmanager
    def _prepared(self, source: SceneSource, progress: Progress | None) -> Iterator[_Job]:
        nbytes = bytes_of_source(source)
        options = self._options if nbytes is None else self._options.changed(source_bytes=nbytes)
        cameras, watch = self._cameras, Stopwatch(progress)
        with ExitStack() as stack:
            stack.enter_context(bounded(options.memory))
            scene = scene_of(source, self._trust, self._antialiased)
            looks = options.look_at_views(scene)
            kept = None
            frame = FrameCheck(scene, cameras, options.cameras_anyway)
            with frame.before_errors():
                workers = self.workers if looks else None
                if workers is not None and self._target is None:
                    others = () if workers.pool is None else workers.pool.devices
                    kept = stack.enter_context(ResidentScene(workers.device, scene, options.memory, others))
            if workers is not None:
                if cameras is None:
                    cameras = self._placed(source, scene, options, watch, workers.device)
                if cameras is not None:
                    log_forecast(workers.device, scene, cameras, options, kept)
            judging = EvaluationViews.of(cameras) if cameras is not None and self._judge else None
            yield _Job(options, scene, cameras, frame, judging, workers, kept, watch.seconds)

    def _placed(
        self, source: SceneSource, scene: Scene, options: EncodeOptions, watch: Stopwatch, device: Device
    ) -> Sequence[Camera] | None:
        cameras = cameras_or_virtual(scene, None, options, watch, device=device, count=self._virtual_views)
        if cameras is not None:
            log_placed(source, cameras)
        return cameras

    def __call__(
        self,
        source: SceneSource,
        output: str | os.PathLike[str] | None = None,
        *,
        name: Path | None = None,
        report: str | os.PathLike[str] | None = None,
        report_view: str | None = None,
        progress: Progress | None = None,
        command: str | None = None,
    ) -> Encoded:
        """Encode a scene. Its report, ``Encoded.report``, is what the command ``encode`` prints.

        Args:
            source: the scene.
            output: the file to write; None: the result has the bytes.
            name: what the report calls the scene; by default its path.
            report, report_view: as of :func:`potr_cl.encode`.
            progress: called with what is done and the part of it that is done.
            command: the command line, for the report.

        Raises:
            As :func:`potr_cl.encode`.
        """
        began = time.perf_counter()
        if report is None and report_view is not None:
            raise UsageError("--report-view needs --report, the page that shows it")
        with ExitStack() as stack:
            page = None if report is None else stack.enter_context(replacing(report))
            own = stack.enter_context(ExitStack())
            file = None if output is None else own.enter_context(replacing(self._options.output.place(output)))
            job = stack.enter_context(self._prepared(source, progress))
            if report_view is not None and job.judging is not None:
                job.judging.named(report_view)  # an unknown name is reported before the work
            before = Traffic() if job.pool is None else replace(job.pool.traffic)
            search: dict[str, Any] | None = None
            if self._target is None:
                encoded = job.encoded(progress)
            else:
                encoded, search = job.searched(self._target, progress)
            watch = Stopwatch(progress)
            quality: dict[str, Any] | str = "not judged, as asked"
            if self._judge and job.judging is None:
                quality = "not judged: there are no cameras to look from"
            pictures: list[PicturePair] = []
            photographs = None
            if file is not None or page is not None or job.judging is not None:
                if job.judging is not None:
                    watch("evaluate", 0.0)  # what is judged is what is read
                # What cannot be decoded must not replace what can.
                judged_on = None if job.judging is None else encoded.device
                written = stack.enter_context(proved(encoded, self._trust, judged_on))
                if file is not None and output is not None:
                    encoded.options.output.write(encoded.pieces, file, Path(output))
                    own.close()  # whatever fails now takes nothing from the file
                if job.judging is not None:
                    quality, pictures = self._judged(job, job.judging, encoded, written, watch, page, report_view)
                photographs = self._by_photographs(job, encoded, written)
            if job.pool is not None:
                encoded = replace(encoded, shared=SharedOut.by(job.pool, before))  # with what judging has added
            seconds = added_up(job.seconds, encoded.seconds, watch.seconds) | {"total": time.perf_counter() - began}
            target = Path(output) if output is not None else Path("(in memory)")
            document = encode_report(
                name or name_of(source), job.scene, target, encoded, job.options.source_bytes, search, quality, seconds,
                photographs, command,
            )  # fmt: skip
            if page is not None:
                page.write(html_report(document, pictures).encode())
        return replace(encoded, report=document)

    def _judged(
        self,
        job: _Job,
        views: EvaluationViews,
        encoded: Encoded,
        written: Proved,
        watch: Stopwatch,
        page: object,
        chosen: str | None = None,
    ) -> tuple[dict[str, Any] | str, list[PicturePair]]:
        """The figures, or why there are none; and pictures for the page, if there is one.

        A device that fails now must not take the finished file with it.
        """
        watch("evaluate", 0.0)
        try:
            workers = self.workers
            device = encoded.device or (Device() if workers is None else workers.device)
            pool = None if workers is None else workers.pool
            scene, background = job.kept or job.scene, job.options.background
            with Evaluator(device, scene, views, background, pool, remember=False) as evaluator:
                # The end is reported when all is there.
                found = evaluator.judge(
                    written.scene, lambda _, done: watch("evaluate", min(done, 0.99)), written.coded
                )
                quality = quality_report(views, *found)
                shown = [] if page is None else views_to_show(quality, chosen)
                numbers = [views.named(view["name"]) for _, view in shown]
                pairs = evaluator.pictures(written.scene, numbers) if shown else []
            watch("evaluate", 1.0)
        except DeviceError as error:
            return f"not judged: {error}", []
        return quality, [
            PicturePair(title, view["name"], view["psnr"], *pair, self._photograph(views.views[number]))
            for (title, view), pair, number in zip(shown, pairs, numbers, strict=True)
        ]

    def _photograph(self, view: Camera) -> FloatArray | None:
        found = [] if self._photographs is None else self._photographs.of([view])
        return self._photographs.picture(found[0]) if self._photographs is not None and found else None

    def _by_photographs(self, job: _Job, encoded: Encoded, written: Proved) -> dict[str, Any] | None:
        """What photographs say of the file, where it was fitted to them."""
        if self._photographs is None or job.cameras is None:
            return None
        try:
            device = encoded.device or job.device or Device()
            scenes = job.kept or job.scene, written.scene
            figures = judge_by_photographs(
                self._photographs, job.cameras, scenes, device, job.options.background, job.pool
            )
        except DeviceError as error:
            _log.warning("not judged by photographs: %s", error)
            return None
        found = photographs_report(encoded, self._photographs.missing, figures)
        if found["missing"] is not None:
            _log.warning("%s", found["missing"])
        lost = found["uncompressed"] - found["file"]
        if lost > 0 and encoded.photographs is not None and encoded.photographs.kept:
            _log.warning("on %s photographs the file is %.2f dB worse than the uncompressed scene", found["kind"], lost)
        return found

    def ladder(
        self,
        source: SceneSource,
        steps: Sequence[float],
        folder: Path,
        *,
        name: Path | None = None,
        progress: Progress | None = None,
    ) -> Ladder:
        """Encode a scene at several qualities; see :func:`potr_cl.encode_ladder`.

        Args:
            steps: the qualities, rising.
            folder: of the files; made if need be.
            source, name, progress: as of a call.

        Raises:
            As :func:`potr_cl.encode_ladder`.
        """
        name = name or name_of(source)
        *files, description = ladder_files(folder, name, steps, self._options.output.suffix)
        for file in (*files, description):
            if file.is_dir():
                raise UsageError(f"cannot write '{file}': it is a directory; write the ladder elsewhere")
        make_folder(folder)
        rungs = []
        # A folder that takes no file is reported before the work.
        with replacing(description) as target, self._prepared(source, progress) as job:
            _log.debug("encoding %d qualities: about %d times as long", len(steps), len(steps))
            for q, file in zip(steps, files, strict=True):
                rungs.append(self._rung(replace(job, options=job.options.changed(q=q)), file, progress))
            judged_by = "" if job.judging is None else str(job.judging)
            ladder = Ladder(description, name.name, job.options.source_bytes, judged_by, tuple(rungs))
            target.write(ladder.encoded())
        return ladder

    def _rung(self, job: _Job, file: Path, progress: Progress | None) -> Rung:
        encoded = job.encoded(progress)
        psnr = ssim = None
        said = ""
        with proved(encoded, self._trust, None if job.judging is None else encoded.device) as written:
            nbytes, splats = len(written.data), len(written.scene)
            with replacing(file) as target:
                target.write(written.data)
            if job.judging is not None:
                quality, _ = self._judged(job, job.judging, encoded, written, Stopwatch(progress), None)
                if isinstance(quality, str):
                    said = f", {quality}"
                else:
                    psnr, ssim = quality["psnr"], quality["ssim"]
                    said = f", {decibels(psnr)}"
        _log.info("%s: q %g, %s bytes, %s splats%s", file, job.options.q, f"{nbytes:,}", f"{splats:,}", said)
        return Rung(job.options.q, file.name, nbytes, splats, psnr, ssim)


def ladder_files(folder: Path, scene: Path, steps: Sequence[float], suffix: str) -> list[Path]:
    """The files that a ladder consists of: those of the qualities, then the description.

    Args:
        folder: that they are in.
        scene: the uncompressed scene's file, which the others are named after.
        steps: the qualities.
        suffix: of the kind of file that is encoded to.

    Raises:
        UsageError: two qualities would have one file.
    """
    stem = stem_of_scene(scene) if scene.suffix or scene.is_dir() else "scene"
    # The description names them, and a name in a file must be printable: this one need not even be UTF-8.
    stem = "".join(each if each.isprintable() else "_" for each in stem)
    names = [f"{stem}_q{q:g}{suffix}" for q in steps]
    if len(set(names)) < len(names):
        raise UsageError("--ladder names qualities that are the same to six digits")
    return [folder / name for name in [*names, DESCRIPTION]]
