"""A whole encode: :func:`encode` runs the stages in their order, times them, and repeats one if memory is short."""

from __future__ import annotations

import dataclasses
import json
import logging
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.encoder import Coded
from potr_cl.codec.quantize import HyperParameters
from potr_cl.errors import DataError, PotrError
from potr_cl.host.atomic_write import replacing
from potr_cl.host.mapped import bounded
from potr_cl.host.threads import in_background
from potr_cl.model.agreement import require_agreement
from potr_cl.model.camera import Camera, train_views, within_photographs
from potr_cl.model.scene import Scene
from potr_cl.model.virtual_cameras import is_virtual, place_cameras
from potr_cl.opencl.device import Device
from potr_cl.outputs.coded_scene import CodedScene
from potr_cl.pipeline.fallback import on_device
from potr_cl.pipeline.host_memory import for_views
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.raster.kept_scene import KeptScene
from potr_cl.raster.scene_buffers import Drawable
from potr_cl.stages.between.price import priced
from potr_cl.stages.fit import Fit, LeftOut
from potr_cl.stages.fitting.fit import Fitted
from potr_cl.stages.prune import Prune
from potr_cl.stages.pruning.schedule import Pruned
from potr_cl.stages.pruning.unseen import Unseen
from potr_cl.stages.refit import Refit
from potr_cl.stages.refitting.photographs import PhotographChoice
from potr_cl.stages.refitting.refit_options import Refitted
from potr_cl.stages.stage import Interlude, Progress, Stage, State, Workbench
from potr_cl.stages.views_between import Added
from potr_cl.workers.pool import Pool, Traffic

_log = logging.getLogger("potr_cl")


@dataclass(frozen=True)
class Encoded:
    """A finished encode.

    Attributes:
        pieces: the file's bytes, to be written one after another.
        nbytes: the size of the file.
        order: (N,) index in the source scene of each splat of the file.
        pruned: what pruning did; None if it was left out.
        unseen: the splats that no training view sees; None if pruning was left out.
        fitted: what the fit of all parameters did, or why it was left out; None if it was not asked for.
        refitted: what the re-fit of the colours did; None if it was left out.
        photographs: what held-out photographs say of a fit to photographs; None if none were given.
        between: the views between the training views that were looked at; None if nobody asked for any.
        device: the device that did the work; not the one that was asked for if that had too little memory. None if no
            stage needed a device.
        seconds: wall time by stage.
        options: that it was encoded with: those that were given, or that a search for a size or a PSNR has found.
        source_splats: how many splats the source scene has.
        parameters: the hyper-parameters that the stages took.
        shared: who did the work, where views were shared out.
        left_out: how many of the scene's SH degrees, the highest ones, the file's format has left out.
    """

    pieces: list[bytes]
    nbytes: int
    order: NDArray[np.int64]
    pruned: Pruned | None
    unseen: Unseen | None
    fitted: Fitted | LeftOut | None
    refitted: Refitted | None
    photographs: PhotographChoice | None
    between: Added | None
    device: Device | None
    seconds: dict[str, float]
    options: EncodeOptions
    source_splats: int
    parameters: HyperParameters
    shared: SharedOut | None = None
    left_out: int = 0

    def __repr__(self) -> str:
        q = f"q {self.options.q:.4g} of preset {self.options.preset}"
        splats = f"{len(self.order):,} of {self.source_splats:,} splats"
        return f"Encoded({self.nbytes:,} bytes, {splats}, {q}, {sum(self.seconds.values()):.1f} s)"

    @property
    def data(self) -> bytes:
        """The whole file."""
        return b"".join(self.pieces)

    @property
    def scene(self) -> Scene:
        """What the file's readers will see; it is read anew each time."""
        return self.options.output.read(self.data, trust=True)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the file, whole or not at all; its name does not tell its kind, ``options.output`` does.

        Raises:
            UsageError: it cannot be written there.
            PotrError: the system failed to write.
        """
        with replacing(path) as file:
            for piece in self.pieces:
                file.write(piece)


@dataclass(frozen=True)
class SharedOut:
    """How views were shared out.

    Attributes:
        workers: their names.
        sent, received: bytes that went to them and came from them.
    """

    workers: tuple[str, ...]
    sent: int
    received: int

    @staticmethod
    def by(pool: Pool, before: Traffic) -> SharedOut:
        """What a pool has done since its traffic was ``before``."""
        now = pool.traffic
        return SharedOut(pool.names, now.sent - before.sent, now.received - before.received)

    def __str__(self) -> str:
        megabytes = f"{self.sent / 1e6:,.0f} MB sent, {self.received / 1e6:,.0f} MB received"
        return f"views shared out to {len(self.workers)} worker{'s' if len(self.workers) != 1 else ''}: {megabytes}"


@dataclass(frozen=True)
class Proved:
    """A file that its readers take.

    Attributes:
        data: the whole file.
        scene: what readers see; in a device's memory, where it will be looked at there.
        coded: the file, for other computers' devices to make the scene of.
    """

    data: bytes
    scene: Drawable
    coded: CodedScene


@contextmanager
def proved(encoded: Encoded, trust: bool = False, device: Device | None = None) -> Iterator[Proved]:
    """The file that was made and the scene that a reader makes of it.

    Args:
        encoded: that made it.
        trust: whether it may hold more splats a byte than a real scene has.
        device: on which the scene will be looked at, as long as the context lasts; None: it is an ordinary one.

    Raises:
        PotrError: no reader takes it.
    """
    data, output = encoded.data, encoded.options.output
    with ExitStack() as stack:
        try:
            scene = (
                output.read(data, trust) if device is None else stack.enter_context(output.seen(data, device, trust))
            )
        except DataError as error:
            raise PotrError(
                f"the encoded file cannot be decoded ({error}): nothing was written. If the scene has splats that are "
                "very far away or very large, leave them out"
            ) from error
        yield Proved(data, scene, CodedScene(output, data, trust))


def encode(
    scene: Scene,
    cameras: Sequence[Camera] | None = None,
    options: EncodeOptions | None = None,
    progress: Progress | None = None,
    device: Device | None = None,
    antialiased: bool | None = None,
    kept: KeptScene | None = None,
    in_frame: bool = False,
    pool: Pool | None = None,
    tell: Callable[[str], None] | None = None,
) -> Encoded:
    """Encode a scene.

    Args:
        scene: clean (:meth:`potr_cl.model.scene.Scene.cleaned`), at least one splat.
        cameras: the training views among them decide which splats may go, and how coarse centres may be. None: virtual
            ones are placed if the options ask for anything that looks at views; if not, γ alone decides about centres.
        options: defaults to quality 0.5 of preset best.
        progress: called with a stage's name and the part of it that is done.
        device: computes; by default the best one there is. If its memory is too small, less is kept in it, and if that
            is not enough, a CPU does the work. A warning says so.
        antialiased: whether to take it as an antialiased scene; None: as what it says that it is.
        kept: the scene on the device, if it will be needed there afterwards.
        in_frame: whether :func:`check_frame` has found the cameras to be in the scene's frame.
        pool: workers that views are shared out to, of which ``device`` is the first; None: the device does all.
        tell: told a line for every round of a fit.

    Raises:
        UsageError: options out of range, cameras without a training view, or cameras that are probably not in the
            scene's frame (:func:`potr_cl.model.agreement.judge_cameras`; ``options.cameras_anyway`` takes them).
        DataError: a value too large to quantise.
        DeviceError: no device does the work.
    """
    options = options or EncodeOptions()
    scene = scene.rendered(antialiased)
    tell_losses(scene, options)
    watch = Stopwatch(progress, tell)
    with ExitStack() as stack:
        stack.enter_context(bounded(options.memory))
        with frame_checked_beside(scene, cameras, options.cameras_anyway or in_frame):
            cameras = cameras_or_virtual(scene, cameras, options, watch, in_frame=True)
            if kept is None and cameras and options.look_at_views(scene):
                device = device or (Device() if pool is None else pool.first)
                kept = stack.enter_context(KeptScene(device, scene, options.memory))
        run = Run(options, watch, device, kept, pool)
        encoded = run.finished(run.stages(State.of(scene, train_views(cameras) if cameras else [])))
    tell_left_out(scene, encoded)
    return encoded


def tell_losses(scene: Scene, options: EncodeOptions) -> None:
    """Say in one line what of the scene the kind of file that is asked for cannot hold."""
    losses = options.output.losses(scene)
    if losses:
        _log.warning("%s cannot hold all of this scene: %s", options.output.format.name, "; ".join(losses))


def tell_left_out(scene: Scene, encoded: Encoded) -> None:
    """Say in one line which SH degrees are missing in a file whose format has to keep them for all splats or none."""
    if encoded.left_out:
        first, last = scene.sh_degree - encoded.left_out + 1, scene.sh_degree
        _log.warning(
            "the %s file has no SH coefficients of degree %s: all of them together are not worth their bytes; a higher "
            "quality or a larger size keeps them",
            encoded.options.output.format.name,
            f"{first} to {last}" if first < last else f"{last}",
        )


def cameras_or_virtual(
    scene: Scene,
    cameras: Sequence[Camera] | None,
    options: EncodeOptions,
    watch: Stopwatch,
    in_frame: bool = False,
) -> Sequence[Camera] | None:
    """The cameras; or virtual ones, if there are none and a stage needs views.

    Where a stage fits to photographs, views with a lens look at no more than theirs show.

    Raises:
        UsageError: the training views are probably not in the scene's frame; but with ``options.cameras_anyway``.
    """
    check_frame(scene, cameras, options.cameras_anyway or in_frame)
    if cameras is None and options.look_at_views(scene):
        watch("place cameras", 0.0)
        cameras = place_cameras(scene)
        watch("place cameras", 1.0)
    if cameras is not None and any(getattr(stage, "ground_truth", None) is not None for stage in options.stages):
        return within_photographs(cameras)
    return cameras


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


def check_frame(scene: Scene, cameras: Sequence[Camera] | None, anyway: bool) -> None:
    """Refuse cameras that are probably not in the scene's frame, but virtual ones and those that are wanted anyway.

    Raises:
        UsageError: they are not in it, or there is no training view among them.
    """
    if cameras and not anyway and not is_virtual(cameras):
        require_agreement(scene, train_views(cameras))


class Run:
    """Runs stages one after the other, from the beginning or from any state that one of them has left.

    Args:
        options: the stages, and what they all share.
        watch: keeps the time and passes the progress on.
        device: the first to be tried; by default the best one there is, opened when a stage needs it.
        kept: the uncompressed scene on that device.
        pool: workers that views are shared out to, as long as the work is done on the pool's first device.

    Attributes:
        device: the one on which the last stage ran that needs views; None if none did.
    """

    def __init__(
        self,
        options: EncodeOptions,
        watch: Stopwatch,
        device: Device | None = None,
        kept: KeptScene | None = None,
        pool: Pool | None = None,
    ) -> None:
        self.device: Device | None = None
        self._pool = pool
        self._before = Traffic() if pool is None else dataclasses.replace(pool.traffic)
        self._options, self._watch, self._given, self._kept = options, watch, device, kept
        if kept is not None and pool is not None:
            for other in pool.devices:
                kept.bring_to(other)

    def stages(self, state: State, only: Sequence[type[Stage]] | None = None) -> State:
        """Run the stages, or some of them, in their order.

        Raises:
            As :func:`encode`.
        """
        for stage in self._options.stages:
            if only is None or type(stage) in only:
                state = self._one(stage, state)
        return state

    def _one(self, stage: Stage, state: State) -> State:
        options = as_done(self._options, state)
        bench = Workbench(
            priced(options.parameters, state),
            memory=options.memory,
            background=options.background,
            threads=options.threads,
            interludes=self._interludes(stage, state),
            metadata=lambda last: _metadata(last, as_done(options, last)),
            progress=self._watch,
            tell=self._watch.tell,
            output=options.output,
            kept=self._kept,
            photographs=next((each.ground_truth for each in options.stages if isinstance(each, Refit)), None),
        )
        if not stage.asked_for:
            return state
        if not stage.needs_views:
            return stage.run(state, bench)
        if not state.views or not stage.looks_at(state.scene):
            return state
        if stage.serves_others and not options.look_at_views(state.scene):
            return state

        def work(device: Device, memory: int | None) -> State:
            pool = self._pool if self._pool is not None and device is self._pool.first else None
            room = for_views(device, memory, len(state.source))
            return stage.run(state, dataclasses.replace(bench, device=device, memory=room, pool=pool))

        device = self.device or self._given or Device()
        state, self.device = on_device(device, options.memory, work)
        return state

    def _interludes(self, stage: Stage, state: State) -> tuple[Interlude, ...]:
        """What other stages want done while this one removes splats."""
        if stage.removes_in is None:
            return ()
        wanted = [each for other in self._options.stages if other.on for each in other.interludes(stage.removes_in)]
        return tuple(interlude for interlude in wanted if interlude.stage.looks_at(state.source))

    def finished(self, state: State) -> Encoded:
        """What the stages have made, as the file that it is."""
        coded: Coded = state.learnt["code"]
        return Encoded(
            pieces=coded.pieces,
            nbytes=coded.nbytes,
            order=state.survivors[coded.order],
            pruned=state.learnt.get("prune"),
            unseen=state.learnt.get("unseen"),
            fitted=state.learnt.get("fit"),
            refitted=state.learnt.get("refit"),
            photographs=state.learnt.get("photographs"),
            between=state.learnt.get("between"),
            device=self.device,
            seconds=self._watch.seconds,
            options=self._options,
            source_splats=len(state.source),
            shared=None if self._pool is None else SharedOut.by(self._pool, self._before),
            parameters=priced(as_done(self._options, state).parameters, state),
            left_out=0 if coded.sh_degree is None else state.scene.sh_degree - coded.sh_degree,
        )


def as_done(options: EncodeOptions, state: State) -> EncodeOptions:
    """The options as a state has followed them: only a fit that made up for splats has the others round finer."""
    fitted = state.learnt.get(Fit.name)
    if isinstance(fitted, LeftOut):
        return options.changed(fit=False)
    if isinstance(fitted, Fitted) and not fitted.spared:
        return options.changed(fit={"finer": 0.0})
    return options


class Stopwatch:
    """Passes progress on, and notes how long each stage took. Time of a stage within another is not counted twice.

    Attributes:
        seconds: wall time by stage, in the order in which they began.
        tell: takes lines about the work.
    """

    def __init__(self, progress: Progress | None = None, tell: Callable[[str], None] | None = None) -> None:
        self._progress = progress
        self.tell: Callable[[str], None] = tell or _log.debug
        self._running: str | None = None
        self._last = time.perf_counter()
        self.seconds: dict[str, float] = {}

    def __call__(self, stage: str, done: float) -> None:
        now = time.perf_counter()
        self.seconds.setdefault(stage, 0.0)
        self.seconds[self._running or stage] += now - self._last
        self._running, self._last = stage if done < 1 else None, now
        if self._progress is not None:
            self._progress(stage, done)


def _metadata(state: State, options: EncodeOptions) -> bytes:
    """What the file says of how it was made."""
    parameters, views = priced(options.parameters, state), state.views
    by_name = {stage.name: stage for stage in options.stages if stage.on}
    prune = by_name.get("prune")
    by_threshold = isinstance(prune, Prune) and prune.count is None and prune.keep is None
    compacts = bool(views) and "compact" in by_name
    facts = {
        "q": options.q,
        "cameras": ("virtual" if is_virtual(views) else "given") if views else None,
        "beta": parameters.beta if views else None,
        "gamma": parameters.gamma,
        "delta_mse_max": parameters.delta_mse_max if by_threshold and "prune" in state.learnt else None,
        "lambda": parameters.lam if compacts else None,
        "alpha": parameters.alpha if compacts else None,
        "source_splats": len(state.source),
        "source_bytes": options.source_bytes,
    }
    return json.dumps(facts, separators=(",", ":")).encode()
