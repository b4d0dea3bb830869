"""Float64 definition of a splat's removal effect: a view composited tile by tile with and without the splat."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.camera import Camera
from potr_cl.raster.rules import RasterRules
from potr_cl.raster.view_set import TILE
from tests.reference.raster import Projected

F64 = NDArray[np.float64]


def _ends(alpha: F64, thresholds: Sequence[float]) -> list[NDArray[np.bool_]]:
    """(K, pixels) where a pixel has not ended, for each transmittance at which it may."""
    after = np.cumprod(1 - alpha, axis=0)
    return [after >= threshold for threshold in thresholds]


class BruteForce:
    """One view of a scene in float64, composited tile by tile with and without single splats."""

    def __init__(self, projected: Projected, camera: Camera, rules: RasterRules) -> None:
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

    def effects(self, splats: NDArray[np.int64], thresholds: Sequence[float] | None = None) -> F64:
        """ΔSE of each splat over the view's pixels and channels, (2, thresholds, splats): with the pixels' ends held,
        and as rendered, for each transmittance at which pixels may end; by default the rules' alone."""
        thresholds = [self.rules.transmittance_threshold] if thresholds is None else thresholds
        found = np.zeros((2, len(thresholds), len(splats)))
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
            ends = _ends(alpha, thresholds)
            now = self.colour(alpha, ranks, ends)
            for i in members:
                at = np.flatnonzero(ranks == self.rank_of[int(splats[i])])
                if not len(at):
                    continue
                pixels = alpha[at[0]] > 0
                without = alpha[:, pixels]
                without[at] = 0
                held = [end[:, pixels] for end in ends]
                for truth, rule in zip(found, (held, _ends(without, thresholds)), strict=True):
                    for n, colour in enumerate(self.colour(without, ranks, rule)):
                        truth[n, i] += ((colour - now[n][pixels]) ** 2).sum()
        return found
