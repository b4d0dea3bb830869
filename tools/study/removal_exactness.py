"""Predicted removal effects against rendering without each splat in float64: python -m tools.study.removal_exactness

For splats spread over the whole range of importance: their ΔMSE over some training views as one sweep predicts it, and
as brute force finds it: every tile that a splat can touch is composited in float64 with and without it, once with each
pixel ending where it ended before the removal ("pixel ends held"), and once where the same rule would end it then ("as
rendered"). The rule that ends a pixel before the splat that would bring its transmittance below 1e-4 is a jump: a pixel
that ends one splat later can gain a hundredth of its light, and no formula for single removals sees that. So the sweep
and the brute force are also made with smaller limits than the rules'; "by the rules" then compares what such a sweep
predicts with what the rasterizer's own rule renders.

The noise floor is a thousandth of the smallest ΔMSE_MAX that a quality sets. Times are of the processor where the
device is one, else of the clock. Prints Markdown.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from potr_cl.formats import load_cameras, load_scene
from potr_cl.model.camera import Camera, train_views
from potr_cl.opencl.device import Device
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import INRIA, RasterRules
from potr_cl.raster.view_set import TILE
from potr_cl.stages.pruning.removal import RemovalSweep, SweepOptions
from tests.oracles import raster as reference

#: A thousandth of ΔMSE_MAX at q = 1.
NOISE_FLOOR = 1e-3 * 10**-10.8
ABOVE = (0.0, NOISE_FLOOR, 100 * NOISE_FLOOR)
#: Transmittances at which pixels may end: the rules' first.
THRESHOLDS = (INRIA.transmittance_threshold, 1e-6, 1e-8)
REPEATS = 5
SCENES = Path(__file__).parents[3] / "shared" / "scenes"
F64 = NDArray[np.float64]


def _ends(alpha: F64, stops: Sequence[float]) -> list[NDArray[np.bool_]]:
    """(K, pixels) where a pixel has not ended, for each transmittance at which it may."""
    after = np.cumprod(1 - alpha, axis=0)
    return [after >= stop for stop in stops]


class BruteForce:
    """One view of a scene in float64, composited tile by tile with and without single splats."""

    def __init__(self, projected: reference.Projected, camera: Camera, rules: RasterRules) -> None:
        self.p, self.camera, self.rules = projected, camera, rules
        sigma = projected.covariance
        mid = 0.5 * (sigma[:, 0, 0] + sigma[:, 1, 1])
        gap = np.hypot(0.5 * (sigma[:, 0, 0] - sigma[:, 1, 1]), sigma[:, 0, 1])
        # Nothing reaches beyond the original's square nor, without it, beyond 3.34 sigma.
        self.radius = np.ceil(3.5 * np.sqrt(mid + gap)) + TILE
        self.square = np.ceil(3 * np.sqrt(mid + np.sqrt(np.maximum(0.1, mid * mid - np.linalg.det(sigma)))))
        self.rank_of = {int(k): rank for rank, k in enumerate(projected.index)}

    def tile(self, column: int, row: int) -> tuple[F64, NDArray[np.int64]]:
        """Alphas (K, pixels) of the splats that may touch a tile, and their ranks, front to back."""
        x0, y0 = column * TILE, row * TILE
        c = self.p.centre
        near = np.flatnonzero(
            (np.abs(c[:, 0] - x0 - TILE / 2) < self.radius) & (np.abs(c[:, 1] - y0 - TILE / 2) < self.radius)
        )
        xs = np.arange(x0, min(x0 + TILE, self.camera.width)) + 0.5
        ys = np.arange(y0, min(y0 + TILE, self.camera.height)) + 0.5
        gx, gy = (g.ravel() for g in np.meshgrid(xs, ys))
        dx, dy = gx - c[near, 0, None], gy - c[near, 1, None]
        s = self.p.covariance[near]
        determinant = s[:, 0, 0] * s[:, 1, 1] - s[:, 0, 1] ** 2
        power = s[:, 1, 1, None] * dx * dx - 2 * s[:, 0, 1, None] * dx * dy + s[:, 0, 0, None] * dy * dy
        alpha = np.minimum(
            self.p.opacity[near, None] * np.exp(-0.5 * power / determinant[:, None]), self.rules.alpha_cap
        )
        alpha[alpha < 1 / 255] = 0
        alpha[~self._square(near, column, row)] = 0
        seen = alpha.any(axis=1)
        return alpha[seen], near[seen]

    def _square(self, near: NDArray[np.int64], column: int, row: int) -> NDArray[np.bool_]:
        """Whether the original's square extent lets a splat into a tile."""
        place = np.array([column, row])
        low = np.floor((self.p.centre[near] - 0.5 - self.square[near, None]) / TILE)
        high = np.floor((self.p.centre[near] - 0.5 + self.square[near, None] + TILE - 1) / TILE)
        inside: NDArray[np.bool_] = ((low <= place) & (place < high)).all(axis=1)
        return inside

    def colour(self, alpha: F64, ranks: NDArray[np.int64], ends: Sequence[NDArray[np.bool_]]) -> list[F64]:
        """(pixels, 3) over black, once for each (K, pixels) that says where a pixel has not ended."""
        weight = alpha.copy()
        weight[1:] *= np.cumprod(1 - alpha, axis=0)[:-1]
        return [(weight * goes_on).T @ self.p.colour[ranks] for goes_on in ends]

    def effects(self, splats: NDArray[np.int64], stops: Sequence[float] | None = None) -> F64:
        """ΔSE of each splat over the view's pixels and channels, (2, stops, splats): with the pixels' ends held, and as
        rendered, for each transmittance at which pixels may end; by default the rules' alone."""
        stops = [self.rules.transmittance_threshold] if stops is None else stops
        found = np.zeros((2, len(stops), len(splats)))
        tiles: dict[tuple[int, int], list[int]] = {}
        columns, rows = -(-self.camera.width // TILE), -(-self.camera.height // TILE)
        for i, k in enumerate(splats):
            rank = self.rank_of.get(int(k))
            if rank is None:
                continue
            centre, radius = self.p.centre[rank], self.radius[rank]
            low = np.maximum(np.floor((centre - radius) / TILE), 0).astype(int)
            high = np.minimum(np.floor((centre + radius) / TILE), (columns - 1, rows - 1)).astype(int)
            for row in range(low[1], high[1] + 1):
                for column in range(low[0], high[0] + 1):
                    tiles.setdefault((column, row), []).append(i)
        for place, members in tiles.items():
            alpha, ranks = self.tile(*place)
            ends = _ends(alpha, stops)
            now = self.colour(alpha, ranks, ends)
            for i in members:
                at = np.flatnonzero(ranks == self.rank_of[int(splats[i])])
                if not len(at):
                    continue
                pixels = alpha[at[0]] > 0
                without = alpha[:, pixels]
                without[at] = 0
                held = [end[:, pixels] for end in ends]
                for truth, rule in zip(found, (held, _ends(without, stops)), strict=True):
                    for n, colour in enumerate(self.colour(without, ranks, rule)):
                        truth[n, i] += ((colour - now[n][pixels]) ** 2).sum()
        return found


def choose_splats(importance: F64, count: int) -> NDArray[np.int64]:
    """About ``count`` splats that the views see, evenly over the logarithm of importance."""
    seen = np.flatnonzero(importance > 0)
    by_importance = seen[np.argsort(importance[seen], kind="stable")]
    low, high = np.log(importance[by_importance[[len(seen) // 100, -1]]])
    at = np.searchsorted(np.log(importance[by_importance]), np.linspace(low, high, count))
    return np.unique(by_importance[at.clip(0, len(seen) - 1)])


def spent(device: Device) -> float:
    """Seconds: of the processor if it is the device, whatever else it does, else of the clock."""
    return time.process_time() if device.family == "cpu" else time.perf_counter()


def predicted(rasterizer: Rasterizer, cameras: Sequence[Camera], stop: float) -> tuple[F64, F64, float]:
    """ΔMSE, importance, and the seconds of a sweep, the best of some."""
    own = rasterizer.rules.transmittance_threshold
    removal = RemovalSweep(
        rasterizer, cameras, SweepOptions(transmittance_threshold=None if np.float32(stop) == np.float32(own) else stop)
    )
    effect, importance = removal.measure()
    seconds = []
    for _ in range(REPEATS):
        removal.sweep_everything()
        started = spent(rasterizer.device)
        removal.measure()
        seconds.append(spent(rasterizer.device) - started)
    removal.free()
    return effect, importance, min(seconds)


def measure(folder: Path, devices: Sequence[Device], views: int, splats: int) -> None:
    """Print a scene's rows."""
    scene = load_scene(folder / "point_cloud.ply")
    training = train_views(load_cameras(folder / "cameras.json"))
    cameras = training[:: max(1, len(training) // views)][:views]
    predictions = []
    for device in devices:
        rasterizer = Rasterizer(device, scene)
        predictions.append([predicted(rasterizer, cameras, stop) for stop in THRESHOLDS])
        rasterizer.free()
    chosen = choose_splats(predictions[0][0][1], splats)

    truth = np.zeros((2, len(THRESHOLDS), len(chosen)))
    for camera in cameras:
        view = BruteForce(reference.project(scene, camera, INRIA), camera, INRIA)
        truth += view.effects(chosen, THRESHOLDS) / (3 * camera.width * camera.height * len(cameras))
    for device, by_stop in zip(devices, predictions, strict=True):
        for n, (stop, (effect, _, seconds)) in enumerate(zip(THRESHOLDS, by_stop, strict=True)):
            truths = {"pixel ends held": truth[0, n], "as rendered": truth[1, n]}
            if n:
                truths["by the rules"] = truth[1, 0]
            for label, true in truths.items():
                relative = np.abs(effect[chosen] - true) / np.maximum(true, 1e-300)
                cells = [folder.name, device.family, f"{stop:.0e}", f"{seconds / by_stop[0][2]:.2f}", label]
                for limit in ABOVE:
                    error = relative[true > limit]
                    cells.append(f"{np.median(error):.1e} / {np.quantile(error, 0.99):.1e} ({len(error)})")
                print("| " + " | ".join(cells) + " |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device")
    parser.add_argument("--views", type=int, default=6)
    parser.add_argument("--splats", type=int, default=300)
    parser.add_argument("--families", nargs="+", choices=("cpu", "gpu"), help="of kernels; default: the device's own")
    parser.add_argument("--scenes", type=Path, default=SCENES, help="folder with lego and plush in it")
    args = parser.parse_args()
    families = args.families or [Device(args.device).family]
    devices = [Device(args.device, family=family) for family in families]
    print(f"{devices[0].info}; relative error of ΔMSE: median / 99th percentile (splats).\n")
    print("| scene | kernels | stop | time | truth | all | above the noise floor | above 100 times that |")
    print("|---|---|---|---|---|---|---|---|")
    for name in ("lego", "plush"):
        if (args.scenes / name).exists():
            measure(args.scenes / name, devices, args.views, args.splats)


if __name__ == "__main__":
    main()
