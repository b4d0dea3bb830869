"""What photographs bring: fits to the training photographs, judged by the photographs of test views.

    python -m tools.study.photographs SCENE [--trials TRIAL …] [--looks 5] [--limit SECONDS] [--json FILE]

A SCENE is a folder with point_cloud.ply, cameras.json and images. A trial is where it starts, then options, then
qualities: "uncompressed:steps=2000,rate=0.3@0.5" fits the uncompressed scene to its training photographs, and then
encodes what came of it at q = 0.5. "q0.5:…@0.5" starts from what pruning leaves at q = 0.5, "smallest0.5:…" from what
pruning and fit of that preset leave; these are only re-fitted and coded afterwards. "…@smallest0.5" encodes with that
preset, "…@photos0.5" with --photos, too. "uncompressed:…>smallest0.5:…@0.59" prunes and fits what the first fit has
made, and fits that to photographs again. Without options the start itself is encoded. Options:

steps, batch, last   as of the fit; rate: part of its rates
ac                   part of the rate of AC coefficients, on top of that
groups               the kinds of parameters that move, as means+dc
between              renders of the uncompressed scene beside the photographs: so many views a step, of views between
decay                what AC coefficients lose in a step of full rate
average              the mean of the parameters in so large a last part of the steps is kept
hold                 1: every eighth photograph is held out; else the fit looks at all training photographs
loss                 mse, or l1+dssim: 0.8 L1 + 0.2 (1 - SSIM), which 3D Gaussian Splatting is trained with

Columns: PSNR against photographs of training views that are fitted to, of training views held out, and of test views,
at equal distances on the way; then bytes and PSNR of files. --crop N looks at windows of N pixels around the scene's
middle instead of whole pictures, and leaves out what they do not show: for CPUs, not for publication.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl
from pyopencl import array as cl_array

from potr_cl.codec.decoder import decode
from potr_cl.formats.images import read_ground_truth
from potr_cl.model.camera import Camera, test_views, train_views
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.model.views_between import views_between
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner, Scratch
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.run import Run
from potr_cl.pipeline.stopwatch import Stopwatch
from potr_cl.quality.compare import find_ground_truth
from potr_cl.quality.metrics import psnr, ssim
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.code import Code
from potr_cl.stages.fit import Fit
from potr_cl.stages.fitting.adam import Adam, Limits, Rates
from potr_cl.stages.fitting.derivatives import PictureDerivatives
from potr_cl.stages.fitting.fit import RATES
from potr_cl.stages.fitting.photographs import longer
from potr_cl.stages.fitting.pictures import TargetPictures
from potr_cl.stages.fitting.views import batches
from potr_cl.stages.prune import Prune
from potr_cl.stages.refit import Refit
from potr_cl.stages.refitting.photographs import hold_out
from potr_cl.stages.refitting.targets import RenderedTargets, Targets
from potr_cl.stages.stage import State
from potr_cl.stages.views_between import Between
from tools.results import Column, Results, Table
from tools.workloads import read, scene_parser

_KERNELS = "fit/dssim.cl"
#: Kernels of this study, for :class:`potr_cl.opencl.device.Device`.
VARIANTS = {_KERNELS: Path(__file__).with_name("dssim.cl")}
COLUMNS = (
    Column("scene"),
    Column("trial"),
    Column("splats", format=",d"),
    Column("fitted photographs", "dB"),
    Column("held-out ones", "dB"),
    Column("test photographs", "dB"),
    Column("SSIM", format=".4f"),
    Column("test pictures against the uncompressed scene's", "dB", ".2f"),
    Column("bytes", format=",d"),
    Column("fit", "s", ".2f"),
)
#: Training views, evenly spread, that stand for all of them where they are judged.
_MOST_JUDGED = 25


@dataclass(frozen=True)
class Trial:
    """One fit, and what is encoded after it.

    Attributes:
        text: as it was given.
        start: "uncompressed", or a preset's name, if it is not best, and q.
        files: of the encodes, as the start.
        then: what is done after it to what came of it.
    """

    text: str
    start: str
    files: tuple[str, ...]
    steps: int = 0
    batch: int = 4
    last: float = 0.1
    rate: float = 0.3
    ac: float = 1.0
    groups: str = ""
    between: int = 0
    decay: float = 0.0
    average: float = 0.0
    hold: int = 0
    loss: str = "mse"
    seed: int = 0
    then: Trial | None = None

    @staticmethod
    def of(text: str) -> Trial:
        """Read from a command line.

        Raises:
            ValueError, TypeError: it is no trial.
        """
        what, *files = text.split("@")
        what, _, then = what.partition(">")
        start, _, rest = what.partition(":")
        options: dict[str, Any] = {}
        for part in filter(None, rest.split(",")):
            name, _, value = part.partition("=")
            options[name] = type(getattr(Trial, name))(value)
        return Trial(text, start, tuple(files), then=Trial.of(then) if then else None, **options)

    @property
    def rates(self) -> Rates:
        """Of the first step."""
        rates = {each.name: self.rate * getattr(longer(RATES), each.name) for each in dataclasses.fields(Rates)}
        rates["ac"] *= self.ac
        moving = self.groups.split("+") if self.groups else list(rates)
        return Rates(**{name: rate if name in moving else 0.0 for name, rate in rates.items()})


def options_of(text: str) -> EncodeOptions:
    """Of a preset, best if none is named, and a q: "smallest0.5"."""
    preset = text.rstrip("0123456789.")
    quality = float(text.removeprefix(preset))
    return EncodeOptions.for_preset("best" if preset in ("", "q") else preset, q=quality)  # type: ignore[arg-type]


class Photographed(Owner):
    """A scene with its photographs on a device.

    Args:
        folder: of the scene.
        device: to compute on.
        crop: pixels of a window to look at instead of whole pictures.
        views: take so many training views, evenly spread; None: all.
    """

    def __init__(self, folder: Path, device: Device, crop: int | None = None, views: int | None = None) -> None:
        self.name, self.device, self.images = folder.resolve().name, device, folder / "images"
        self.scene, cameras = read(folder)
        paths = find_ground_truth(self.images, cameras)
        cameras = [camera for camera in cameras if camera.name in paths]
        pictures = {camera.name: read_ground_truth(paths[camera.name], (0.0, 0.0, 0.0)) for camera in cameras}
        if crop is not None:
            middle = np.median(self.scene.means, axis=0)
            cropped = [_window(camera, pictures[camera.name], middle, crop) for camera in cameras]
            cameras = [camera for camera, _ in cropped]
            pictures = {camera.name: picture for camera, picture in cropped}
            self.scene = _shown(self.scene, cameras)
        self._pictures = pictures
        self.train, self.test = train_views(cameras), test_views(cameras)
        if views is not None:
            self.train = [self.train[round(place)] for place in np.linspace(0, len(self.train) - 1, views)]
        self.source = Rasterizer(device, self.scene)
        self.renders = [np.clip(self.source.render(camera)[0], 0, 1) for camera in self.test]

    def picture(self, camera: Camera) -> FloatArray:
        """(H, W, 3) float32, the photograph of a view."""
        return self._pictures[camera.name]

    def psnr(self, rasterizer: Rasterizer, cameras: Sequence[Camera]) -> float | None:
        """Mean against the photographs, decibels; None without a view."""
        if not cameras:
            return None
        shown = [rasterizer.render(camera)[0] for camera in cameras]
        return _mean_of(psnr, shown, [self.picture(camera) for camera in cameras])

    def judged(self, scene: Scene) -> tuple[float, float, float]:
        """PSNR and SSIM of test views against photographs, PSNR against the uncompressed scene."""
        with Rasterizer(self.device, scene) as rasterizer:
            shown = [np.clip(rasterizer.render(camera)[0], 0, 1) for camera in self.test]
        photographs = [self.picture(camera) for camera in self.test]
        own = _mean_of(psnr, shown, self.renders)
        return _mean_of(psnr, shown, photographs), _mean_of(ssim, shown, photographs), min(own, 999.0)

    def close(self) -> None:
        """Give the device's memory back."""
        self.source.close()


def _mean_of(
    measure: Callable[[FloatArray, FloatArray], float], some: Sequence[FloatArray], others: Sequence[FloatArray]
) -> float:
    """Of pairs of pictures."""
    with ThreadPoolExecutor() as threads:
        return float(np.mean(list(threads.map(measure, some, others))))


def _window(camera: Camera, picture: FloatArray, middle: FloatArray, size: int) -> tuple[Camera, FloatArray]:
    """The part of a view and its photograph around a point of the world."""
    t = camera.rotation @ middle + camera.translation
    left = int(np.clip(camera.fx * t[0] / t[2] + camera.cx - size / 2, 0, camera.width - size))
    top = int(np.clip(camera.fy * t[1] / t[2] + camera.cy - size / 2, 0, camera.height - size))
    part = np.ascontiguousarray(picture[top : top + size, left : left + size])
    return dataclasses.replace(
        camera, width=size, height=size, cx=camera.cx - left, cy=camera.cy - top, image_path=None
    ), part


def _shown(scene: Scene, cameras: Sequence[Camera]) -> Scene:
    """The splats whose centres lie in or beside the picture of some view."""
    seen = np.zeros(len(scene), bool)
    for camera in cameras:
        t = scene.means @ camera.rotation.T + camera.translation
        with np.errstate(all="ignore"):
            u, v = (camera.fx * t[:, 0] / t[:, 2] + camera.cx, camera.fy * t[:, 1] / t[:, 2] + camera.cy)
        seen |= (t[:, 2] > 0.2) & (u > -20) & (u < camera.width + 20) & (v > -20) & (v < camera.height + 20)
    return scene.subset(np.flatnonzero(seen))


class _Mixed:
    """Photographs of the first views, and renders of the uncompressed scene for the others."""

    def __init__(self, photographed: Photographed, views: Sequence[Camera], count: int) -> None:
        self._photographed, self._views, self._count = photographed, views, count
        self._renders: Targets = RenderedTargets(photographed.source, views)

    def into(self, numbers: Sequence[int], buffer: cl.Buffer) -> None:
        """See :class:`Targets`; one view at a time."""
        (number,) = numbers
        if number >= self._count:
            self._renders.into(numbers, buffer)
            return
        picture = np.ascontiguousarray(self._photographed.picture(self._views[number]), np.float32)
        cl.enqueue_copy(self._photographed.device.queue, buffer, picture, is_blocking=True)


class Loss(Owner):
    """What photographs are compared by: v of :class:`PictureDerivatives`, of the views of one step.

    Args:
        device: to compute on.
        rasterizer: of the scene that changes.
        part: of SSIM in the loss, as 0.2 of 3D Gaussian Splatting's; the other part is L1.
    """

    def __init__(self, device: Device, rasterizer: Rasterizer, part: float) -> None:
        self._device, self._rasterizer, self._part = device, rasterizer, part
        self._shown, self._moments, self._result = (Scratch(device, f"a loss's {what}") for what in "abc")
        self._first, self._second = (device.shared_kernel(_KERNELS, name) for name in ("moments", "differences"))

    def of(self, cameras: Sequence[Camera], target: cl.Buffer) -> cl.Buffer:
        """(pixels, 3) float32: v, half the loss's derivative by each pixel, for views of one size."""
        width, height = cameras[0].width, cameras[0].height
        pixels = width * height * len(cameras)
        self._shown.reserve(12 * pixels)
        self._moments.reserve(36 * pixels)
        self._result.reserve(12 * pixels)
        self._rasterizer.render_into(list(cameras), self._shown.buffer)
        shape = {"width": width, "height": height, "shown": self._shown.buffer, "target": target}
        size = (-(-3 * width // 64) * 64, height, len(cameras))
        self._first.bind(**shape, moments=self._moments.buffer)
        self._first.launch(size, (64, 1, 1))
        self._second.bind(**shape, moments=self._moments.buffer, part=self._part, result=self._result.buffer)
        self._second.launch(size, (64, 1, 1))
        return self._result.buffer

    def close(self) -> None:
        """Give all device memory back."""
        for scratch in (self._shown, self._moments, self._result):
            scratch.close()


@dataclass(frozen=True)
class Course:
    """What a fit has come to: PSNR of fitted, held-out and test photographs on the way, and its seconds."""

    scene: Scene
    fitted: list[float]
    held_out: list[float]
    test: list[float]
    seconds: float


def fit(at: Photographed, start: Scene, trial: Trial, looks: int) -> Course:
    """Fit a scene as a trial says."""
    fit_to, judging = hold_out(at.train) if trial.hold else (at.train, [])
    views = [*fit_to]
    if trial.between:
        views += views_between(at.scene, at.train, 1.0)
    some = [fit_to[round(place)] for place in np.linspace(0, len(fit_to) - 1, min(_MOST_JUDGED, len(fit_to)))]
    rates = dataclasses.replace(trial.rates, means=trial.rates.means * _usual_size(start))
    limits = Limits(
        (float(start.log_scales.min()), float(start.log_scales.max())),
        (-5.5, max(16.0, float(start.opacity_logits.max()))),
    )
    found: tuple[list[float], list[float], list[float]] = ([], [], [])
    spent = 0.0
    device, queue = at.device, at.device.queue
    with (
        Memory(device) as memory,
        PictureDerivatives(device, start) as derivatives,
        TargetPictures(device, views, _Mixed(at, views, len(fit_to)), 8e9) as pictures,
        Loss(device, derivatives.rasterizer, 0.2) as loss,
        Adam(device, start, derivatives.rasterizer.parameters, derivatives.columns, rates, limits) as adam,
    ):
        rasterizer, columns = derivatives.rasterizer, derivatives.columns
        shape = (columns.count, rasterizer.stride)
        values = cl_array.Array(queue, shape, np.float32, data=adam.values)
        ac = cl_array.Array(
            queue, (columns.count - 14, shape[1]), np.float32, data=adam.values, offset=4 * 14 * shape[1]
        )
        mean = cl_array.zeros(queue, shape, np.float32)
        weight = 0
        order = batches(range(len(fit_to)), trial.batch, trial.seed)
        others = batches(range(len(fit_to), len(views)), trial.between, trial.seed) if trial.between else None
        slowing = trial.last ** (1 / max(trial.steps - 1, 1))
        marks = {round(trial.steps * n / looks) for n in range(looks + 1)}
        began = time.perf_counter()
        for step in range(trial.steps + 1):
            if step in marks:
                queue.finish()
                spent += time.perf_counter() - began
                if step == trial.steps and weight:
                    mean /= np.float32(weight)
                    cl.enqueue_copy(queue, adam.values, mean.data)
                    adam.give()
                for each, cameras in zip(found, (some, judging, at.test), strict=True):
                    if cameras:
                        each.append(at.psnr(rasterizer, cameras) or 0.0)
                began = time.perf_counter()
            if step == trial.steps:
                break
            part = slowing**step
            numbers = next(order)
            if trial.loss == "mse":
                numbers = [*numbers, *next(others)] if others else numbers
                derivatives.add([views[n] for n in numbers], pictures.of(numbers), unit=8.0)
            else:
                cameras = [views[n] for n in numbers]
                derivatives.add(cameras, loss.of(cameras, pictures.of(numbers)), given=True)
                if others:
                    numbers = next(others)
                    derivatives.add([views[n] for n in numbers], pictures.of(numbers), unit=8.0)
            adam.step(derivatives.gradient, part)
            if trial.decay:
                ac *= np.float32(1 - trial.decay * part)
            if step >= (1 - trial.average) * trial.steps:
                mean += values
                weight += 1
        adam.keep()
        memory.close()
        return Course(adam.kept(), *found, spent)


def _usual_size(scene: Scene) -> float:
    """The median of the splats' middle standard deviations, world units."""
    return float(np.exp(np.median(np.sort(scene.log_scales, axis=1)[:, 1])))


class Bench:
    """Trials with one scene.

    Args:
        at: the scene with its photographs.
        table: for the rows.
        looks: at how many points of a fit photographs are compared.
    """

    def __init__(self, at: Photographed, table: Table, looks: int) -> None:
        self._at, self._table, self._looks = at, table, looks
        self._starts: dict[str, State] = {}

    def _start(self, name: str) -> State:
        """Where trials of this name start."""
        if name not in self._starts:
            self._starts[name] = self._begun(self._at.scene, name)
        return self._starts[name]

    def _begun(self, scene: Scene, name: str) -> State:
        state = State.of(scene, self._at.train)
        if name == "uncompressed":
            return state
        return Run(options_of(name), Stopwatch(), self._at.device).stages(state, [Between, Prune, Fit])

    def measure(self, trial: Trial) -> None:
        """Do a trial and put its rows into the table."""
        state = self._start(trial.start)
        text, last = trial.text.partition("@")[0], trial
        while True:
            course = fit(self._at, state.scene, last, self._looks) if last.steps else None
            state = dataclasses.replace(state, scene=state.scene if course is None else course.scene)
            self._row(text, state.scene, course, None)
            if last.then is None:
                break
            last = last.then
            state = self._begun(state.scene, last.start)
        for file in trial.files:
            self._row(f"{text}@{file}", *self._encoded(state, last.start, file))

    def _encoded(self, state: State, start: str, file: str) -> tuple[Scene, None, int]:
        options = options_of(file.removeprefix("photos"))
        if file.startswith("photos"):
            options = options.changed(refit={"ground_truth": self._at.images})
        if start == "uncompressed":
            views = [*self._at.train, *self._at.test] if file.startswith("photos") else self._at.train
            data = encode(state.scene, views, options, device=self._at.device).data
        else:
            # The re-fit comes back to what the photographs have made of the scene.
            again = dataclasses.replace(State.of(state.scene, state.views), added=state.added)
            coded = Run(options, Stopwatch(), self._at.device).stages(again, [Refit, Code])
            data = b"".join(coded.learnt["code"].pieces)
        return decode(data, trust=True), None, len(data)

    def _row(self, text: str, scene: Scene, course: Course | None, nbytes: int | None) -> None:
        truth, alike, own = self._at.judged(scene)
        kinds = ((), (), ()) if course is None else (course.fitted, course.held_out, course.test)
        fitted, held_out, test = (" ".join(f"{value:.2f}" for value in kind) for kind in kinds)
        self._table.add(
            self._at.name, text, len(scene), fitted, held_out, test or f"{truth:.2f}", alike, own, nbytes,
            None if course is None else course.seconds,
        )  # fmt: skip


def main() -> None:
    parser = scene_parser(__doc__)
    parser.add_argument("--trials", nargs="+", type=Trial.of, default=[Trial.of("uncompressed")])
    parser.add_argument("--looks", type=int, default=5, metavar="N")
    parser.add_argument("--crop", type=int, metavar="PIXELS")
    parser.add_argument("--views", type=int, metavar="N")
    parser.add_argument("--limit", type=float, default=np.inf, metavar="SECONDS")
    args = parser.parse_args()
    began = time.perf_counter()
    device = Device(args.device, variants=VARIANTS)
    table = Results(device.info, args.json).table("photographs", "Fits to photographs", *COLUMNS)
    for folder in args.scenes:
        with Photographed(folder, device, args.crop, args.views) as at:
            bench = Bench(at, table, args.looks)
            for trial in args.trials:
                if time.perf_counter() - began > args.limit:
                    return
                bench.measure(trial)


if __name__ == "__main__":
    main()
