"""The definitions that tools.stress.run judges by: a case's view in float64, every pixel with every splat.

:func:`stand_in` gives the case's numbers in float64, or what rounding them to float32 may make of them. The rest are
projection, compositing and removal effects by their definitions, on arrays (splats, pixels) that stay small.
"""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.raster.rules import RasterRules
from potr_cl.raster.view_set import TILE
from tests.reference import raster as reference
from tools.stress.cases import Case

F64 = NDArray[np.float64]

#: Half a unit in the last place of a float32, relatively.
ULP = 2.0**-24
#: Draws of rounding errors. Seed of all of them.
DRAWS, SEED = 3, 0


def rounded(values: F64, rng: np.random.Generator) -> F64:
    """Each value off by up to half a unit in the last place of a float32."""
    return values * (1 + ULP * rng.uniform(-1, 1, values.shape))


def stand_in(case: Case, rng: np.random.Generator | None = None) -> tuple[Scene, Camera]:
    """The case's scene and view in float64, or what rounding may make of them."""
    scene, view = case.scene, case.view
    quaternions = scene.quaternions.astype(np.float64)
    length = np.linalg.norm(quaternions, axis=1, keepdims=True)
    quaternions = np.where(length > 0, quaternions / np.where(length > 0, length, 1), (1.0, 0, 0, 0))
    means, log_scales = scene.means.astype(np.float64), scene.log_scales.astype(np.float64)
    # As the rasterizer takes them: nothing can be seen to differ, nothing overflows.
    log_scales = np.minimum(log_scales, np.log(1e12))
    logits, sh = scene.opacity_logits.astype(np.float64), scene.sh.astype(np.float64)
    if rng is not None:
        rotation = rounded(view.rotation, rng)
        means = view.centre + rounded(means - view.centre, rng)
        log_scales = log_scales + ULP * rng.uniform(-1, 1, log_scales.shape)
        quaternions = rounded(quaternions, rng)
        log2_opacities = rounded(-np.logaddexp(0, -logits) / np.log(2), rng)
        with np.errstate(over="ignore"):
            logits = -np.log(np.expm1(-np.minimum(log2_opacities * np.log(2), -1e-300)))
        view = dataclasses.replace(
            view,
            rotation=rotation,
            translation=-rotation @ view.centre,
            fx=float(rounded(np.array(view.fx), rng)),
            fy=float(rounded(np.array(view.fy), rng)),
        )
    count = len(means)

    class Precise(SimpleNamespace):
        def __len__(self) -> int:
            return count

    precise = Precise(
        means=means,
        log_scales=log_scales,
        quaternions=quaternions,
        opacity_logits=logits,
        sh=sh,
        sh_degree=scene.sh_degree,
        antialiased=scene.antialiased,
        low_pass=scene.low_pass,
    )
    return cast(Scene, precise), view


def projected(case: Case, rng: np.random.Generator | None = None) -> reference.Projected:
    """The definition of projection, of the case or of what rounding may make of it."""
    with np.errstate(all="ignore"):
        return reference.project(*stand_in(case, rng), case.rules)


@dataclasses.dataclass
class Pixels:
    """Centres of a view's pixels and the tiles that they lie in, (P,)."""

    x: F64
    y: F64
    tile: NDArray[np.int64]

    @staticmethod
    def of(view: Camera) -> Pixels:
        rows, columns = np.divmod(np.arange(view.width * view.height), view.width)
        return Pixels(columns + 0.5, rows + 0.5, rows // TILE * -(-view.width // TILE) + columns // TILE)


def alphas_of_covariances(p: reference.Projected, pixels: Pixels) -> F64:
    """(K, P) alpha before cap and threshold, by the definition."""
    s = p.covariance
    with np.errstate(all="ignore"):
        dx, dy = pixels.x - p.centre[:, :1], pixels.y - p.centre[:, 1:]
        # Cholesky's factor: the conic's three terms cancel for needles, even in float64.
        c = 1 / np.sqrt(s[:, 1, 1])
        # Lagrange's identity needs the axes; the determinant of the dilated covariance is at least 0.09.
        determinant = np.maximum(s[:, 0, 0] * s[:, 1, 1] - s[:, 0, 1] ** 2, 0.09)
        a = np.sqrt(s[:, 1, 1] / determinant)
        u = a[:, None] * (dx - (s[:, 0, 1] / s[:, 1, 1])[:, None] * dy)
        alpha = p.opacity[:, None] * np.exp(-0.5 * (u * u + (c[:, None] * dy) ** 2))
    return cast(F64, np.nan_to_num(alpha, nan=0.0))


def alphas_of_shapes(shapes: F64, pixels: Pixels) -> F64:
    """(K, P) alpha before cap and threshold, of ellipses as cl/include/splat.clh has them, (K, 8)."""
    x, y, a, b, c, log2_opacity = (shapes[:, i, None] for i in range(6))
    with np.errstate(all="ignore"):
        dx, dy = pixels.x - x, pixels.y - y
        alpha = np.exp2(log2_opacity - (a * dx + b * dy) ** 2 - (c * dy) ** 2)
    return cast(F64, np.nan_to_num(alpha, nan=0.0))


@dataclasses.dataclass
class Composited:
    """One view in float64.

    Attributes:
        image: (P, 3). transmittance: (P,).
        margin: (P,) how near, relatively, a pixel came to a threshold.
        alpha: (K, P) of the pairs that were composited, else 0.
    """

    image: F64
    transmittance: F64
    margin: F64
    alpha: F64


def composite(raw: F64, colours: F64, rules: RasterRules) -> Composited:
    """Front to back; ``raw`` (K, P) is 0 where a splat is in no list of the pixel's tile."""
    transmittance = np.ones(raw.shape[1])
    alive = np.ones(raw.shape[1], bool)
    margin = np.full(raw.shape[1], np.inf)
    image = np.zeros((raw.shape[1], 3))
    used = np.zeros_like(raw)
    for k in range(len(raw)):
        margin = np.where(alive & (raw[k] > 0), np.minimum(margin, np.abs(raw[k] * 255 - 1)), margin)
        alpha = np.where(raw[k] >= 1 / 255, np.minimum(raw[k], rules.alpha_cap), 0)
        after = transmittance * (1 - alpha)
        touched = alive & (alpha > 0)
        margin = np.where(touched, np.minimum(margin, np.abs(after / rules.transmittance_threshold - 1)), margin)
        alive &= ~(touched & (after < rules.transmittance_threshold))
        used[k] = np.where(touched & alive, alpha, 0)
        image += (transmittance * used[k])[:, None] * colours[k]
        transmittance = transmittance * (1 - used[k])
    return Composited(image, transmittance, margin, used)


def held_image(alpha: F64, colours: F64) -> F64:
    """(P, 3) of pairs that are composited whatever the transmittance, over black."""
    before = np.cumprod(1 - alpha, axis=0)
    weights = alpha.copy()
    weights[1:] *= before[:-1]
    return weights.T @ colours


def removal_effects(alpha: F64, colours: F64, wanted: F64, splats: NDArray[np.int64]) -> tuple[F64, F64, F64]:
    """ΔMSE of single removals with the pixels' ends held, the sum of the terms' magnitudes, and importances.

    By the definition: composited with and without each splat.
    """
    now = held_image(alpha, colours)
    before = np.cumprod(1 - alpha, axis=0)
    weights = alpha.copy()
    weights[1:] *= before[:-1]
    effects, magnitudes = np.zeros(len(splats)), np.zeros(len(splats))
    for i, k in enumerate(splats):
        touched = np.flatnonzero(alpha[k])  # no other pixel changes, and most splats are in few of them
        without = alpha[:, touched]
        without[k] = 0
        change, error = held_image(without, colours) - now[touched], (now - wanted)[touched]
        effects[i] = np.sum(change**2 + 2 * change * error)
        magnitudes[i] = np.sum(change**2 + 2 * np.abs(change) * np.abs(error))
    pixels = alpha.shape[1]
    return effects / (3 * pixels), magnitudes / (3 * pixels), weights[splats].sum(axis=1) / pixels
