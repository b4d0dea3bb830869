"""Does Gauss-Newton fit a pruned scene in less time than Adam?

    python -m tools.study.gauss_newton SCENE [--keep 0.35] [--size 200] [--views 24] [--seconds 60] [--json FILE]

A SCENE is a folder with point_cloud.ply and cameras.json with test views. Its splats are pruned to a part, and then
fitted to the whole scene's renders of training views, by Adam as the stage "fit" does it, and by Levenberg-Marquardt:

- each outer step linearises a batch of views, J; conjugate gradients go towards the least of |r + J x|² + x·D x with
  products J x and Jᵀ v, no matrix (:class:`ConjugateGradients` of the re-fit);
- the preconditioner is each splat's own block of Jᵀ J, 14 x 14 (centre, scales, rotation, opacity, DC), and a diagonal
  for the other SH coefficients. It is estimated: Jᵀ v of random signs v, view by view, has the expected products Jᵀ J;
- D is a part of the blocks' diagonal, which grows where a step has gained less than it promised and falls where it has
  gained what it promised (the trust region). A step that makes the batch worse is taken back.

It tells PSNR on training and on test views against the seconds that a fit has computed (of processors together, where
the device is a CPU); judging is not counted.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl

from potr_cl.model.camera import Camera, resized, test_views, train_views
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.scene_buffers import SPLAT_GROUP
from potr_cl.raster.view_set import ViewSet
from potr_cl.stages.compaction.view_weights import REFERENCE_PIXELS
from potr_cl.stages.fitting.adam import Adam, Limits, Rates
from potr_cl.stages.fitting.derivatives import PictureDerivatives
from potr_cl.stages.fitting.fit import RATES
from potr_cl.stages.fitting.parameters import Parameters
from potr_cl.stages.fitting.pictures import TargetPictures
from potr_cl.stages.fitting.tangents import PictureTangents
from potr_cl.stages.fitting.views import batches
from potr_cl.stages.refitting.conjugate_gradients import ConjugateGradients
from potr_cl.stages.refitting.targets import RenderedTargets
from tools.results import Column, Results
from tools.workloads import read, reduced

_KERNELS = "fit/gauss_newton.cl"
#: Kernels of this study, for :class:`potr_cl.opencl.device.Device`.
VARIANTS = {_KERNELS: Path(__file__).with_name("gauss_newton.cl")}
#: Parameters of a splat that its block has, and elements of the block.
_BLOCK, _TRIANGLE = 14, 105
_DOT_ITEMS = 16384
#: So many times as many random signs the first time, when no earlier batch has left anything.
_FIRST_PROBES = 4
#: The longest step of a parameter: a linearisation says nothing of more. Of centres in standard deviations of a usual
#: splat.
_LONGEST = Rates(means=1.0, log_scales=0.3, quaternions=0.1, opacity_logits=1.0, dc=0.3, ac=0.1)


@dataclasses.dataclass(frozen=True)
class Trust:
    """How Levenberg-Marquardt goes.

    Attributes:
        batch: views of an outer step.
        steps: of conjugate gradients in each.
        probes: random signs for each view of a batch.
        memory: part of the blocks that is remembered from one batch to the next.
        damping: at first.
    """

    batch: int = 16
    steps: int = 8
    probes: int = 2
    memory: float = 0.9
    damping: float = 0.1


class Vectors(Owner):
    """Vectors like the gradient (:class:`potr_cl.stages.refitting.conjugate_gradients.Vectors`)."""

    def __init__(self, device: Device, columns: int, stride: int) -> None:
        self.device, self.length = device, columns * stride
        self._memory = Memory(device)
        self._combine, self._dot = (
            device.shared_kernel("refit/coefficients.cl", name, LANES=1, SH_COUNT=1)
            for name in ("combine", "dot_parts")
        )
        self._parts = self._memory.allocate(12 * _DOT_ITEMS, "a dot product")

    def vector(self, rank: int = 0) -> cl.Buffer:
        """A new vector, 0; it lies on the device whatever its rank."""
        buffer = self._memory.allocate(4 * self.length, "a vector")
        self.zero(buffer)
        return buffer

    def zero(self, x: cl.Buffer) -> None:
        """x = 0."""
        cl.enqueue_fill_buffer(self.device.queue, x, np.float32(0), 0, 4 * self.length)

    def copy(self, y: cl.Buffer, x: cl.Buffer) -> None:
        """y = x."""
        cl.enqueue_copy(self.device.queue, y, x, byte_count=4 * self.length)

    def combine(self, a: float, y: cl.Buffer, b: float, x: cl.Buffer) -> None:
        """y = a y + b x."""
        self._combine.bind(a=np.float32(a), y=y, b=np.float32(b), x=x).launch((self.length,), (64,))

    def dot(self, x: cl.Buffer, y: cl.Buffer) -> float:
        """x · y."""
        self._dot.bind(x=x, y=y, count=self.length, more=0, parts=self._parts).launch((_DOT_ITEMS,), (64,))
        return float(self.device.download(self._parts, (2, _DOT_ITEMS), np.float32)[0].sum(dtype=np.float64))

    def close(self) -> None:
        """Give all device memory back."""
        self._memory.close()


class GaussNewton(Parameters):
    """Levenberg-Marquardt on batches of views.

    Args:
        device, scene: as of :class:`Parameters`.
        derivatives: of the scene.
        limits: of the parameters. usual: size of a splat, world units. trust: how to go.
    """

    def __init__(
        self, device: Device, scene: Scene, derivatives: PictureDerivatives, limits: Limits, usual: float, trust: Trust
    ) -> None:
        rasterizer = derivatives.rasterizer
        super().__init__(device, scene, rasterizer.parameters, derivatives.columns)
        self._derivatives, self._rasterizer, self._trust = derivatives, rasterizer, trust
        count, stride = self.columns.count, self.buffers.stride
        self._vectors = Vectors(device, count, stride)
        self._tangents = PictureTangents(device, rasterizer)
        self._gradients = ConjugateGradients(self._vectors)
        self._residual, self._solution, self._diagonal, self._former, self._slope = (
            self._vectors.vector() for _ in range(5)
        )
        elements = _TRIANGLE + count - _BLOCK
        self._blocks, self._triangles = (self._memory.allocate(4 * elements * stride, "the blocks") for _ in range(2))
        cl.enqueue_fill_buffer(device.queue, self._blocks, np.float32(0), 0, self._blocks.size)
        names = ("add_products", "factorise", "solve", "add_diagonal", "move", "signs")
        self._kernels = {name: device.shared_kernel(_KERNELS, name) for name in names}
        longest = dataclasses.replace(_LONGEST, means=usual).of_columns(self.columns)
        bounds = np.zeros((count, 4), np.float32)
        bounds[:, 0], bounds[:, 1], bounds[:, 2] = longest, -1e30, 1e30
        bounds[self.columns.log_scales, 1:3] = limits.log_scales
        bounds[self.columns.opacity_logits, 1:3] = limits.opacity_logits
        self._bounds = self._memory.upload(bounds, "the bounds")
        # What a parameter's longest step may cost: so little that only what no view shows is held by it.
        floors = (1e-4 / longest**2).astype(np.float32)
        self._floors = self._memory.upload(floors, "the floors")
        self._samples, self._damping, self._seed = 0.0, trust.damping, 0
        self._picture: cl.Buffer | None = None
        self._sets: list[ViewSet] = []
        self.told = ""

    def step(self, cameras: Sequence[Camera], target: cl.Buffer, unit: float) -> None:
        """An outer step on a batch of views; ``target`` has their pictures."""
        self._prepare(cameras)
        error = self._linearise(target, unit)
        self._estimate()
        vectors = self._vectors
        part = 1 / (self._samples * self._weight())
        self._over_splats(
            "factorise", blocks=self._blocks, columns=self.columns.count, part=part, damping=self._damping,
            floors=self._floors, diagonal=self._diagonal, factors=self._triangles,
        )  # fmt: skip
        vectors.zero(self._solution)
        vectors.copy(self._slope, self._residual)
        done = self._gradients.descend(
            self, self._solution, self._residual, error, self._trust.steps, 1e-3, lambda _: None
        )
        promised = self._promised()
        vectors.copy(self._former, self.values)
        kernel = self._kernels["move"]
        kernel.bind(parameters=self.values, stride=self.buffers.stride, step=self._solution, limits=self._bounds)
        kernel.launch((self.buffers.stride, self.columns.count), (SPLAT_GROUP, 1))
        self.give()
        after = self._look(cameras, target, unit)
        ratio = (error - after) / promised if promised > 0 else 0.0
        if not after < error:
            vectors.copy(self.values, self._former)
            self.give()
        if ratio < 0.25:
            self._damping = min(self._damping * 4, 1e6)
        elif ratio > 0.7:
            self._damping = max(self._damping / 2.5, 1e-4)
        self.told = (
            f"{error:.4g} -> {after:.4g}, {ratio:.2f} of what was promised, {done} steps, damping {self._damping:.2g}"
        )

    def restart(self) -> None:
        """Forget all steps."""
        self.back()
        cl.enqueue_fill_buffer(self._device.queue, self._blocks, np.float32(0), 0, self._blocks.size)
        self._samples, self._damping, self._seed = 0.0, self._trust.damping, 0

    def precondition(self, residual: cl.Buffer, result: cl.Buffer) -> None:
        """See :class:`potr_cl.stages.refitting.conjugate_gradients.System`."""
        self._over_splats("solve", factors=self._triangles, columns=self.columns.count, x=residual, result=result)

    def product(self, direction: cl.Buffer, result: cl.Buffer) -> None:
        """result = (Jᵀ W J + D) direction."""
        assert self._picture is not None
        for views in self._sets:
            self._tangents.of(views, direction, self._picture)
            self._derivatives.add_prepared(views, self._picture, given=True)
        self._vectors.copy(result, self._derivatives.gradient)
        self._derivatives.forget()
        self._damp(result, direction)

    def _damp(self, result: cl.Buffer, direction: cl.Buffer) -> None:
        kernel = self._kernels["add_diagonal"].bind(y=result, diagonal=self._diagonal, x=direction)
        kernel.launch((self._vectors.length,), (64,))

    def _promised(self) -> float:
        """By how much |r + J x|² is less than |r|²: x · b + x · (b - H x), and x · D x of what H has besides Jᵀ W J."""
        vectors, product = self._vectors, self._gradients.product
        fallen = vectors.dot(self._solution, self._slope) + vectors.dot(self._solution, self._residual)
        vectors.zero(product)
        self._damp(product, self._solution)
        return fallen + vectors.dot(self._solution, product)

    def _prepare(self, cameras: Sequence[Camera]) -> None:
        self._release()
        at_a_time = 1 if self._device.family == "cpu" else 4
        for first in range(0, len(cameras), at_a_time):
            self._sets.append(self._rasterizer.prepare_set(cameras[first : first + at_a_time]))
        most = 12 * max(views.pixels for views in self._sets)
        if self._picture is None or self._picture.size < most:
            if self._picture is not None:
                self._memory.free(self._picture)
            self._picture = self._memory.allocate(most, "pictures' changes")

    def _linearise(self, target: cl.Buffer, unit: float) -> float:
        """The residual becomes -Jᵀ W r; returns r · W r."""
        first, error = 0, 0.0
        for views in self._sets:
            self._derivatives.add_prepared(views, target, first, unit=unit)
            error += self._weighted(views, unit)
            first += views.pixels
        self._vectors.zero(self._residual)
        self._vectors.combine(0.0, self._residual, -1.0, self._derivatives.gradient)
        self._derivatives.forget()
        return error

    def _look(self, cameras: Sequence[Camera], target: cl.Buffer, unit: float) -> float:
        """r · W r of the parameters as they are."""
        first, error = 0, 0.0
        self._prepare(cameras)
        for views in self._sets:
            self._derivatives.add_prepared(views, target, first, unit=unit)
            error += self._weighted(views, unit)
            first += views.pixels
        self._derivatives.forget()
        return error

    def _weight(self) -> float:
        """W: all views have one size here."""
        camera = self._sets[0].views[0].camera
        return REFERENCE_PIXELS / (camera.width * camera.height)

    def _weighted(self, views: ViewSet, unit: float) -> float:
        return self._derivatives.squared_error(views) * self._weight() / unit**2

    def _estimate(self) -> None:
        """Bring the blocks up to date with this batch's views, a set of views a sample."""
        assert self._picture is not None
        probes = self._trust.probes * (1 if self._samples else _FIRST_PROBES)
        for number in range(probes * len(self._sets)):
            views = self._sets[number % len(self._sets)]
            self._seed += 1
            signs = self._kernels["signs"].bind(seed=self._seed * 747796405 % 2**32, values=self._picture)
            signs.launch((3 * views.pixels,))
            self._derivatives.add_prepared(views, self._picture, given=True)
            keep = self._trust.memory if number == 0 else 1.0
            self._over_splats(
                "add_products", gradient=self._derivatives.gradient, columns=self.columns.count, keep=keep,
                blocks=self._blocks,
            )  # fmt: skip
            # A sample is of one set; all sets' sum is wanted.
            self._samples = self._samples * keep + 1 / len(self._sets)

    def _over_splats(self, name: str, **arguments: Any) -> None:
        kernel = self._kernels[name].bind(stride=self.buffers.stride, **arguments)
        kernel.launch((self.buffers.stride,), (SPLAT_GROUP if self._device.family == "gpu" else 64,))

    def _release(self) -> None:
        for views in self._sets:
            views.close()
        self._sets = []

    def close(self) -> None:
        """Give all device memory back."""
        self._release()
        self._vectors.close()
        self._tangents.close()
        super().close()


class Race:
    """One pruned scene, its views and targets: what both solvers start from."""

    def __init__(self, device: Device, scene: Scene, pruned: Scene, train: Sequence[Camera], test: Sequence[Camera]):
        self.device, self.scene, self.pruned, self.train, self.test = device, scene, pruned, list(train), list(test)
        with Rasterizer(device, scene) as rasterizer:
            looked_at = [*self.train[:: max(len(self.train) // 8, 1)], *self.test]
            self.wanted = [(camera, rasterizer.render(camera)[0]) for camera in looked_at]
        self.trained_on = len(self.wanted) - len(self.test)

    def quality(self, rasterizer: Rasterizer) -> tuple[float, float]:
        """PSNR on some training views, and on the test views."""
        errors = [float(np.mean((rasterizer.render(c)[0].astype(np.float64) - p) ** 2)) for c, p in self.wanted]
        train, test = errors[: self.trained_on], errors[self.trained_on :]
        return tuple(-10 * float(np.log10(np.mean(part))) for part in (train, test))  # type: ignore[return-value]

    def run(
        self,
        seconds: float,
        looks: Sequence[float],
        begin: Callable[[PictureDerivatives, TargetPictures], Generator[str, None, None]],
    ) -> list[tuple[float, int, float, float, str]]:
        """Seconds, steps, PSNR on training and on test views, and what a solver tells, at each look."""
        rows = []
        device = self.device
        with (
            Rasterizer(device, self.scene) as whole,
            PictureDerivatives(device, self.pruned) as derivatives,
            TargetPictures(device, self.train, RenderedTargets(whole, self.train), 4e9) as pictures,
        ):
            for number in range(len(self.train)):
                pictures.of([number])
            rows.append((0.0, 0, *self.quality(derivatives.rasterizer), ""))
            spent, steps, waiting = 0.0, 0, list(looks)
            solver = begin(derivatives, pictures)
            next(solver)  # builds kernels
            while spent < seconds and waiting:
                began = _now(device)
                told = next(solver)
                device.queue.finish()
                spent += _now(device) - began
                steps += 1
                if spent >= waiting[0]:
                    while waiting and spent >= waiting[0]:
                        waiting.pop(0)
                    rows.append((spent, steps, *self.quality(derivatives.rasterizer), told))
                    print(" ".join(map(str, rows[-1])), flush=True)
            solver.close()
        return rows


def _now(device: Device) -> float:
    """Seconds: of the clock on GPUs; on CPUs, which other work may share, of all processors together."""
    return time.process_time() if device.info.kind == "cpu" else time.perf_counter()


def usual_size(scene: Scene) -> float:
    """The median of the splats' middle standard deviations, world units."""
    return float(np.exp(np.median(np.sort(scene.log_scales.astype(np.float64), axis=1)[:, 1])))


def limits_of(scene: Scene) -> Limits:
    """As the stage has them."""
    return Limits(
        (float(scene.log_scales.min()), float(scene.log_scales.max())),
        (-5.5, max(16.0, float(scene.opacity_logits.max()))),
    )


def adam(
    race: Race, seconds: float, batch: int
) -> Callable[[PictureDerivatives, TargetPictures], Generator[str, None, None]]:
    """Adam, whose rates fall to a tenth within so many seconds."""

    def run(derivatives: PictureDerivatives, pictures: TargetPictures) -> Generator[str, None, None]:
        rates = dataclasses.replace(RATES, means=RATES.means * usual_size(race.pruned))
        rasterizer = derivatives.rasterizer
        with Adam(
            race.device, race.pruned, rasterizer.parameters, derivatives.columns, rates, limits_of(race.pruned)
        ) as it:
            order = batches(range(len(race.train)), batch, 0)
            numbers = next(order)
            derivatives.add([race.train[n] for n in numbers], pictures.of(numbers), unit=8.0)
            derivatives.forget()
            yield ""
            spent = 0.0
            while True:
                began = _now(race.device)
                numbers = next(order)
                derivatives.add([race.train[n] for n in numbers], pictures.of(numbers), unit=8.0)
                it.step(derivatives.gradient, 0.1 ** min(spent / seconds, 1.0))
                race.device.queue.finish()
                spent += _now(race.device) - began
                yield ""

    return run


def gauss_newton(
    race: Race, trust: Trust
) -> Callable[[PictureDerivatives, TargetPictures], Generator[str, None, None]]:
    """Levenberg-Marquardt."""

    def run(derivatives: PictureDerivatives, pictures: TargetPictures) -> Generator[str, None, None]:
        limits = limits_of(race.pruned)
        with GaussNewton(race.device, race.pruned, derivatives, limits, usual_size(race.pruned), trust) as it:
            order = batches(range(len(race.train)), trust.batch, 0)
            numbers = next(order)
            it.step([race.train[n] for n in numbers], pictures.of(numbers), 8.0)
            it.restart()
            yield it.told
            while True:
                numbers = next(order)
                it.step([race.train[n] for n in numbers], pictures.of(numbers), 8.0)
                yield it.told

    return run


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--keep", type=float, default=0.35, help="part of the splats (default %(default)s)")
    parser.add_argument("--iterations", type=int, default=12, help="of the pruning (default %(default)s)")
    parser.add_argument("--size", type=int, help="longer side of the views in pixels; as they are by default")
    parser.add_argument("--views", type=int, help="training views, spread evenly; all by default")
    parser.add_argument("--tests", type=int, default=20, help="test views, spread evenly (default %(default)s)")
    parser.add_argument("--seconds", type=float, default=60, help="that each solver may take (default %(default)s)")
    parser.add_argument("--batches", type=int, nargs="+", default=[16], help="views of an outer step")
    parser.add_argument("--cg", type=int, nargs="+", default=[8], help="steps of conjugate gradients in each")
    parser.add_argument("--device", help="as for potr-cl")
    parser.add_argument("--json", type=Path, help="also keep the results here")
    args = parser.parse_args()
    device = Device(args.device, variants=VARIANTS)
    scene, cameras = read(args.scene)
    train, test = (
        spread(views, n) for views, n in ((train_views(cameras), args.views), (test_views(cameras), args.tests))
    )
    if args.size:
        train, test = ([shrunk(camera, args.size) for camera in views] for views in (train, test))
    options = EncodeOptions.for_preset(
        "best", prune={"count": round(args.keep * len(scene)), "iterations": args.iterations},
        compact=False, refit=False, between={"views": 0},
    )  # fmt: skip
    pruned = reduced(scene, train, options, device)
    race = Race(device, scene, pruned, train, test)
    looks = [args.seconds * 2.0**-k for k in range(5, -1, -1)]
    table = Results(device.info, args.json).table(
        "solvers",
        f"{args.scene.name}, {len(pruned)} of {len(scene)} splats, {len(train)} views of {train[0].width} pixels: "
        "PSNR against seconds of fitting",
        Column("solver"), Column("seconds", "s", ".2f"), Column("steps", "", "d"),
        Column("training views", "dB", ".2f"), Column("test views", "dB", ".2f"), Column("of the last step"),
    )  # fmt: skip
    ways = {f"Adam, {batch} views a step": adam(race, args.seconds, batch) for batch in (4,)}
    for batch in args.batches:
        for steps in args.cg:
            trust = Trust(batch=min(batch, len(train)), steps=steps)
            ways[f"Levenberg-Marquardt, {batch} views, {steps} steps"] = gauss_newton(race, trust)
    for name, way in ways.items():
        for row in race.run(args.seconds, looks, way):
            table.add(name, *row)


def spread(views: list[Camera], count: int | None) -> list[Camera]:
    """So many of the views, evenly."""
    if count is None or count >= len(views):
        return views
    return [views[round(place)] for place in np.linspace(0, len(views) - 1, count)]


def shrunk(camera: Camera, longest: int) -> Camera:
    """The view at a lower resolution."""
    factor = longest / max(camera.width, camera.height)
    return resized(camera, round(camera.width * factor), round(camera.height * factor))


if __name__ == "__main__":
    main()
