"""Predicted removal effects against rendering without each splat in float64: python -m tools.removal_exactness

For splats spread over the whole range of importance: their ΔMSE over some training views as one sweep predicts it, and
as brute force finds it: every tile that a splat can touch is composited in float64 with and without it, once with each
pixel ending where it ended before the removal, and once where the rasterizer would end it then. The rule that ends a
pixel before the splat that would bring its transmittance below 1e-4 is a jump: a pixel that ends one splat later can
gain a hundredth of its light. No formula for single removals sees that; the difference of the two is its noise floor.
Prints Markdown.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from potr_cl.cameras import Camera, train_views
from potr_cl.device import Device
from potr_cl.formats import load_cameras, load_scene
from potr_cl.rasterizer import INRIA, TILE, Rasterizer, RasterRules
from potr_cl.removal import RemovalSweep
from tests import reference

SCENES = Path(__file__).parents[2] / "shared" / "scenes"
F64 = NDArray[np.float64]


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

    def goes_on(self, alpha: F64) -> NDArray[np.bool_]:
        """(K, pixels) where a pixel has not ended."""
        return np.logical_and.accumulate(np.cumprod(1 - alpha, axis=0) >= self.rules.stop, axis=0)

    def colour(self, alpha: F64, ranks: NDArray[np.int64], goes_on: NDArray[np.bool_]) -> F64:
        """(pixels, 3) over black."""
        after = np.cumprod(1 - alpha, axis=0)
        weight = alpha
        weight[1:] *= after[:-1]
        weight *= goes_on
        return weight.T @ self.p.colour[ranks]

    def effects(self, splats: NDArray[np.int64]) -> tuple[F64, F64]:
        """ΔSE of each splat over the view's pixels and channels: with the pixels' ends held, and as rendered."""
        held, rendered = np.zeros(len(splats)), np.zeros(len(splats))
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
            goes_on = self.goes_on(alpha)
            now = self.colour(alpha.copy(), ranks, goes_on)
            for i in members:
                at = np.flatnonzero(ranks == self.rank_of[int(splats[i])])
                if len(at):
                    without = alpha.copy()
                    without[at] = 0
                    rendered[i] += ((self.colour(without.copy(), ranks, self.goes_on(without)) - now) ** 2).sum()
                    held[i] += ((self.colour(without, ranks, goes_on) - now) ** 2).sum()
        return held, rendered


def measure(name: str, device: Device, views: int, splats: int) -> None:
    folder = SCENES / name
    scene = load_scene(folder / "point_cloud.ply")
    training = train_views(load_cameras(folder / "cameras.json"))
    cameras = training[:: max(1, len(training) // views)][:views]
    rasterizer = Rasterizer(device, scene)
    removal = RemovalSweep(rasterizer, cameras)
    started = time.perf_counter()
    effect, importance = removal.measure()
    seconds = time.perf_counter() - started
    removal.free()
    rasterizer.free()

    # Evenly over the logarithm of importance, all that any view sees.
    seen = np.flatnonzero(importance > 0)
    by_importance = seen[np.argsort(importance[seen], kind="stable")]
    low, high = np.log(importance[by_importance[[len(seen) // 100, -1]]])
    at = np.searchsorted(np.log(importance[by_importance]), np.linspace(low, high, splats))
    chosen = np.unique(by_importance[at.clip(0, len(seen) - 1)])

    truth = np.zeros((2, len(chosen)))
    for camera in cameras:
        view = BruteForce(reference.project(scene, camera, INRIA), camera, INRIA)
        truth += np.stack(view.effects(chosen)) / (3 * camera.width * camera.height * len(cameras))
    predicted = effect[chosen]
    floor = float(np.median(np.abs(truth[1] - truth[0])))
    for label, true in zip(("pixel ends held", "as rendered"), truth, strict=True):
        relative = np.abs(predicted - true) / np.maximum(true, 1e-300)
        print(f"| {name} | {label} | {len(cameras)} | {len(chosen)} | {seconds:.2f} s | {floor:.1e} ", end="")
        for limit in (0.0, 10 * floor, 100 * floor, 1000 * floor):
            above = true > limit
            print(
                f"| {np.median(relative[above]):.1e} / {np.quantile(relative[above], 0.99):.1e} ({above.sum()}) ",
                end="",
            )
        print("|")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device")
    parser.add_argument("--views", type=int, default=6)
    parser.add_argument("--splats", type=int, default=300)
    parser.add_argument("--family", choices=("cpu", "gpu"))
    args = parser.parse_args()
    device = Device(args.device, family=args.family)
    print(f"{device.info}, family {device.family}. Noise floor: median difference of the two truths.")
    print("Relative error: median / 99th percentile (splats), above multiples of the noise floor.\n")
    print("| scene | truth | views | splats | sweep | noise floor | all | 10 x | 100 x | 1000 x |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for name in ("lego", "plush"):
        if (SCENES / name).exists():
            measure(name, device, args.views, args.splats)


if __name__ == "__main__":
    main()
