"""One scene on one device, and what pruned versions of it are worth (:class:`Bench`), for tools.bench.pruning."""

import math
import statistics
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.formats import load_cameras, load_scene
from potr_cl.formats.images import read_ground_truth
from potr_cl.model.camera import Camera, test_views, train_views
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner
from potr_cl.quality.compare import find_ground_truth
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.pruning.on_device import prune_scene
from potr_cl.stages.pruning.removal import RemovalSweep
from potr_cl.stages.pruning.schedule import Pruned, PruningOptions, prune
from potr_cl.stages.pruning.sweep_options import SweepOptions
from tools.study.pruning_baselines import mesongs_power, removal_order, scores, transmittance_sums
from tools.workloads import scaled

F64 = NDArray[np.float64]
Indices = NDArray[np.int64]
Image = NDArray[np.float32]
Row = dict[str, Any]


class Bench(Owner):
    """One scene on one device: reference renders, and what pruned versions of it are worth.

    Attributes:
        train, test: the views to prune by and to judge by.
    """

    def __init__(self, folder: Path, device: Device, quick: bool, truth: bool) -> None:
        self.name = folder.name
        self.device = device
        self.scene = load_scene(folder / "point_cloud.ply")
        cameras = load_cameras(folder / "cameras.json")
        every = 4 if quick else 1
        self.train, self.test = train_views(cameras)[::every], test_views(cameras)[::every]
        self.rasterizer = Rasterizer(device, self.scene)
        self._test_renders = self._renders(self.test)
        self._train_renders: list[Image] | None = None
        self._ground_truth: list[Image] | None = None
        if truth:
            files = find_ground_truth(folder / "images", self.test)
            self._ground_truth = [read_ground_truth(files[c.name], self.rasterizer.background) for c in self.test]
            pairs = zip(self._test_renders, self._ground_truth, strict=True)
            self._uncompressed = [decibels(squared_error(render, photograph)) for render, photograph in pairs]
        self._orders: dict[str, Indices] = {}
        self._baselines: dict[str, Indices] = {}
        # Builds every kernel, so that no measurement pays for it.
        self.pruned(self.train[:1], PruningOptions(0, 1, count=len(self.scene) // 2), SweepOptions())

    def _renders(self, cameras: Sequence[Camera]) -> list[Image]:
        return [np.clip(self.rasterizer.render(camera)[0], 0, 1) for camera in cameras]

    def quality(self, survivors: Indices) -> Row:
        """PSNR of what the survivors render against the uncompressed scene, and the loss against the photographs."""
        with Rasterizer(self.device, self.scene.subset(survivors)) as rasterizer:
            renders, losses = [], []
            for number, camera in enumerate(self.test):
                image = rasterizer.render(camera)[0]
                renders.append(decibels(squared_error(image, self._test_renders[number])))
                if self._ground_truth is not None:
                    error = squared_error(image, self._ground_truth[number])
                    losses.append(self._uncompressed[number] - decibels(error))
        row: Row = {"kept": len(survivors), "psnr": statistics.mean(renders)}
        if losses:
            row["loss"] = statistics.mean(losses)
        return row

    def train_psnr(self, survivors: Indices) -> float:
        """PSNR of the mean squared error over all training views: what pruning tries to keep."""
        if self._train_renders is None:
            self._train_renders = self._renders(self.train)
        with Rasterizer(self.device, self.scene.subset(survivors)) as rasterizer:
            errors = [
                squared_error(rasterizer.render(camera)[0], reference)
                for camera, reference in zip(self.train, self._train_renders, strict=True)
            ]
        return decibels(statistics.mean(errors))

    def pruned(
        self, cameras: Sequence[Camera], options: PruningOptions, sweep: SweepOptions, half: int = 0
    ) -> tuple[Pruned, Row]:
        """Run a schedule, so many of its measurements of half-size views; its result and its cost in seconds and full
        sweeps."""
        started = time.perf_counter()
        with ExitStack() as owned:
            removal = owned.enter_context(RemovalSweep(self.rasterizer, cameras, sweep))
            small: RemovalSweep | None = None
            if half:
                small = owned.enter_context(RemovalSweep(self.rasterizer, [scaled(c, 0.5) for c in cameras], sweep))
            prepared = time.perf_counter()
            if small:
                result = prune(HalfSizeFirst(removal, small, half), len(self.scene), options)
            else:
                result = prune_scene(removal, options)
            self.device.queue.finish()
            ended = time.perf_counter()
            sweeps = removal.sweeps
            if small:
                sweeps += small.sweeps / 4
        return result, {
            "prepare_seconds": prepared - started,
            "prune_seconds": ended - prepared,
            "seconds": ended - started,
            "sweeps": sweeps,
            "rounds": result.iterations,
        }

    def ours(self, kept: int, iterations: int) -> tuple[Pruned, Row]:
        """Our schedule to an exact count, at the default skips."""
        return self.pruned(self.train, PruningOptions(0, iterations, count=kept), SweepOptions())

    def one_order(self, kept: int, iterations: int) -> Indices:
        """The order of one schedule down to ``kept`` survivors, made once."""
        key = f"{kept} {iterations}"
        if key not in self._orders:
            self._orders[key] = self.ours(kept, iterations)[0].order
        return self._orders[key]

    def baselines(self) -> dict[str, Indices]:
        """The other pruners' orders."""
        if not self._baselines:
            with RemovalSweep(self.rasterizer, self.train, SweepOptions(transmittance_threshold=None)) as sweep:
                importance = sweep.measure()[1]
            transmittance = transmittance_sums(self.rasterizer, self.train)
            found = scores(self.scene, importance, transmittance, mesongs_power(self.name))
            self._baselines = {name: removal_order(score) for name, score in found.items()}
        return self._baselines

    def close(self) -> None:
        """Give the device's memory back."""
        self.rasterizer.close()


class HalfSizeFirst:
    """Removal effects of which all measurements but the first and those after some number are of half-size views."""

    def __init__(self, full: RemovalSweep, half: RemovalSweep, number: int) -> None:
        self._full, self._half, self._left = full, half, number + 1
        self._first = True

    def measure(self) -> tuple[F64, F64]:
        """As :meth:`RemovalSweep.measure`."""
        self._left -= 1
        if self._left < 0:
            return self._full.measure()
        effects = self._half.measure()
        if self._first:
            effects = self._full.measure()
            self._first = False
        return effects

    def remove(self, splats: Indices) -> None:
        """As :meth:`RemovalSweep.remove`."""
        self._full.remove(splats)
        self._half.remove(splats)


def log(text: str) -> None:
    """Progress, to standard error."""
    print(f"[{time.strftime('%H:%M:%S')}] {text}", file=sys.stderr, flush=True)


def squared_error(image: Image, reference: Image) -> float:
    """Mean over pixels and channels; the reference is clamped already."""
    difference = (np.clip(image, 0, 1) - reference).ravel()
    return float(difference @ difference) / difference.size


def decibels(error: float) -> float:
    """PSNR of a mean squared error."""
    return -10 * math.log10(error) if error > 0 else math.inf
