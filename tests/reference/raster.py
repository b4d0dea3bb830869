"""Float64 definitions of projection, spherical harmonics and compositing, in plain numpy.

Every result of the OpenCL rasterizer is judged against these. They follow the original 3DGS rasterizer
(Kerbl et al. 2023) splat by splat and pixel by pixel, with no tile lists and no early end beyond the per-pixel one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.raster.rules import LEAST_COMPENSATION, RasterRules

Array = NDArray[np.float64]
TILE = 16

# The constants of the original's real SH basis, by degree.
_C0 = 0.28209479177387814
_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
_C3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)


def sh_basis(directions: Array, degree: int) -> Array:
    """(N, M) real SH basis values in unit ``directions`` (N, 3)."""
    x, y, z = directions.T
    columns = [np.full_like(x, _C0)]
    if degree >= 1:
        columns += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree >= 2:
        columns += [
            _C2[0] * x * y,
            _C2[1] * y * z,
            _C2[2] * (2 * z * z - x * x - y * y),
            _C2[3] * x * z,
            _C2[4] * (x * x - y * y),
        ]
    if degree >= 3:
        columns += [
            _C3[0] * y * (3 * x * x - y * y),
            _C3[1] * x * y * z,
            _C3[2] * y * (4 * z * z - x * x - y * y),
            _C3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y),
            _C3[4] * x * (4 * z * z - x * x - y * y),
            _C3[5] * z * (x * x - y * y),
            _C3[6] * x * (x * x - 3 * y * y),
        ]
    return np.stack(columns, axis=1)


def rotation_matrices(quaternions: Array) -> Array:
    """(N, 3, 3) rotations of quaternions (w, x, y, z) of any length."""
    w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


@dataclass
class Projected:
    """The splats of one view that are in front of the near plane, front to back.

    Attributes:
        index: (K,) splat numbers; order of depth, ties by number.
        centre: (K, 2) pixel position. covariance: (K, 2, 2) pixels squared, dilated.
        depth: (K,). opacity: (K,), in an antialiased scene less what the dilation has added to the splat's area.
        colour: (K, 3), not below 0.
    """

    index: NDArray[np.int64]
    centre: Array
    covariance: Array
    depth: Array
    opacity: Array
    colour: Array


def project(scene: Scene, camera: Camera, rules: RasterRules) -> Projected:
    """Project every splat of ``scene`` in float64."""
    means = scene.means.astype(np.float64)
    t = means @ camera.rotation.T + camera.translation
    index = np.flatnonzero(t[:, 2] > rules.near)
    # The depth order is part of the picture: the rasterizer sorts float32 depths.
    order = np.lexsort((index, t[index, 2].astype(np.float32)))
    index = index[order]
    t = t[index]

    limit = 1.3 * np.array([camera.width / (2 * camera.fx), camera.height / (2 * camera.fy)])
    ratio = np.clip(t[:, :2] / t[:, 2:], -limit, limit)
    jacobian = np.zeros((len(index), 2, 3))
    jacobian[:, 0, 0] = camera.fx / t[:, 2]
    jacobian[:, 1, 1] = camera.fy / t[:, 2]
    jacobian[:, 0, 2] = -camera.fx * ratio[:, 0] / t[:, 2]
    jacobian[:, 1, 2] = -camera.fy * ratio[:, 1] / t[:, 2]
    axes = rotation_matrices(scene.quaternions[index].astype(np.float64))
    axes = axes * np.exp(scene.log_scales[index].astype(np.float64))[:, None, :]
    m = jacobian @ camera.rotation @ axes
    sharp = m @ np.swapaxes(m, 1, 2)
    covariance = sharp + scene.low_pass * np.eye(2)

    centre = np.stack([camera.fx * t[:, 0] / t[:, 2] + camera.cx, camera.fy * t[:, 1] / t[:, 2] + camera.cy], axis=1)
    direction = means[index] - camera.centre
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    basis = sh_basis(direction, scene.sh_degree)
    colour = np.einsum("nm,nmc->nc", basis, scene.sh[index].astype(np.float64)) + 0.5
    opacity = 1 / (1 + np.exp(-scene.opacity_logits[index].astype(np.float64)))
    if scene.antialiased:
        # Not below 0, which rounding could make of a splat that is seen edge-on.
        ratio = np.linalg.det(sharp) / np.linalg.det(covariance)
        opacity *= np.sqrt(np.maximum(ratio, LEAST_COMPENSATION**2))
    return Projected(index, centre, covariance, t[:, 2], opacity, np.maximum(colour, 0))


def footprint(centre: Array, covariance: Array, rules: RasterRules, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """(H, W) pixels that one splat may touch at all, before the test of alpha."""
    height, width = shape
    inside = np.ones(shape, dtype=bool)
    if not rules.square_extent:
        return inside
    mid = 0.5 * (covariance[0, 0] + covariance[1, 1])
    radius = np.ceil(3 * np.sqrt(mid + np.sqrt(max(0.1, mid * mid - np.linalg.det(covariance)))))
    # The original numbers pixel centres from 0, half a pixel less than here, and takes whole tiles.
    low = np.floor((centre - 0.5 - radius) / TILE)
    high = np.floor((centre - 0.5 + radius + TILE - 1) / TILE)
    columns = np.arange(width) // TILE
    rows = np.arange(height) // TILE
    inside &= ((columns >= low[0]) & (columns < high[0]))[None, :]
    inside &= ((rows >= low[1]) & (rows < high[1]))[:, None]
    return inside


@dataclass
class Composite:
    """What compositing one view gives.

    Attributes:
        image: (H, W, 3). transmittance: (H, W).
        margin: (H, W) how near, relatively, the pixel came to a threshold (1/255 or the end of a pixel):
            the smallest |value / threshold - 1| over its splats.
        pairs: (pixel, splat) pairs with alpha at or above 1/255 that were composited.
    """

    image: Array
    transmittance: Array
    margin: Array
    pairs: int


def composite(
    projected: Projected, shape: tuple[int, int], rules: RasterRules, background: tuple[float, ...] = (0, 0, 0)
) -> Composite:
    """Composite front to back, every splat over every pixel; colours may have any number of channels."""
    height, width = shape
    y, x = np.mgrid[:height, :width] + 0.5
    image = np.zeros((height, width, projected.colour.shape[1]))
    transmittance = np.ones(shape)
    margin = np.full(shape, np.inf)
    alive = np.ones(shape, dtype=bool)
    pairs = 0
    for k in range(len(projected.index)):
        if projected.opacity[k] < 1 / 255:
            continue
        inverse = np.linalg.inv(projected.covariance[k])
        dx = x - projected.centre[k, 0]
        dy = y - projected.centre[k, 1]
        q = inverse[0, 0] * dx * dx + 2 * inverse[0, 1] * dx * dy + inverse[1, 1] * dy * dy
        raw = projected.opacity[k] * np.exp(-0.5 * q)
        inside = footprint(projected.centre[k], projected.covariance[k], rules, shape)
        margin = np.where(alive & inside, np.minimum(margin, np.abs(raw * 255 - 1)), margin)
        alpha = np.where(inside & (raw >= 1 / 255), np.minimum(raw, rules.alpha_cap), 0)
        following = transmittance * (1 - alpha)
        ends = following <= 1e-4 if rules.threshold_included else following < 1e-4
        touched = alive & (alpha > 0)
        margin = np.where(touched, np.minimum(margin, np.abs(following * 1e4 - 1)), margin)
        alive &= ~(touched & ends)
        touched &= alive
        pairs += int(touched.sum())
        image += np.where(touched, transmittance * alpha, 0)[..., None] * projected.colour[k]
        transmittance = np.where(touched, following, transmittance)
    image += transmittance[..., None] * np.asarray(background, dtype=np.float64)
    return Composite(image, transmittance, margin, pairs)


@dataclass
class Pixel:
    """One pixel of a scene of any size, see :class:`Composite`.

    Attributes:
        colour: (3,). transmittance, margin: as there.
        gap: smallest difference in depth, relatively, between two splats that follow each other in the pixel: below
            float32's resolution their order, and with it the colour, is anyone's.
    """

    colour: Array
    transmittance: float
    margin: float
    gap: float


def composite_pixel(projected: Projected, column: int, row: int, rules: RasterRules) -> Pixel:
    """One pixel over black, for scenes too large for :func:`composite`; rules without the square extent only."""
    assert not rules.square_extent
    a, b, c = projected.covariance[:, 0, 0], projected.covariance[:, 0, 1], projected.covariance[:, 1, 1]
    dx = column + 0.5 - projected.centre[:, 0]
    dy = row + 0.5 - projected.centre[:, 1]
    raw = projected.opacity * np.exp(-0.5 * (c * dx * dx - 2 * b * dx * dy + a * dy * dy) / (a * c - b * b))
    colour, transmittance, margin, gap, depth = np.zeros(3), 1.0, np.inf, np.inf, 0.0
    for k in np.flatnonzero(raw >= 0.99 / 255):
        margin = min(margin, abs(raw[k] * 255 - 1))
        if raw[k] < 1 / 255:
            continue
        alpha = min(raw[k], rules.alpha_cap)
        following = transmittance * (1 - alpha)
        margin = min(margin, abs(following * 1e4 - 1))
        if following <= 1e-4 if rules.threshold_included else following < 1e-4:
            break
        gap = min(gap, abs(projected.depth[k] / depth - 1) if depth else np.inf)
        depth = projected.depth[k]
        colour += transmittance * alpha * projected.colour[k]
        transmittance = following
    return Pixel(colour, transmittance, margin, gap)


def render(
    scene: Scene, camera: Camera, rules: RasterRules, background: tuple[float, float, float] = (0, 0, 0)
) -> Composite:
    """Project and composite."""
    return composite(project(scene, camera, rules), (camera.height, camera.width), rules, background)
