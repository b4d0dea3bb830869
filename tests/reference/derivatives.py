"""Float64 definition of a picture's derivatives with respect to the splats' parameters, in plain numpy.

:func:`gradient` is the transposed product Jᵀ v: J has a row for each pixel and channel of
:func:`tests.reference.raster.render`, a column for each parameter, and v is a number for each pixel and channel. If v
is the derivative of some loss by the pixels, Jᵀ v is that of the loss by the parameters.

Whatever the rasterizer decides by comparing numbers is taken as constant: the depth order, which alphas are skipped or
capped, where a pixel ends, which colours are cut at 0, where the Jacobian's x/z and y/z are clamped.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.raster.rules import LEAST_COMPENSATION, RasterRules
from tests.reference.raster import Array, Projected, footprint, project, rotation_matrices, sh_basis

#: Of a central difference of the SH basis by the direction: exact to 1e-10, as the basis is a cubic polynomial.
_STEP = 1e-5


@dataclass
class Gradient:
    """A number for each parameter of a scene's N splats.

    Attributes:
        means, log_scales: (N, 3). opacity_logits: (N,). sh: (N, M, 3).
        quaternions: (N, 4), with respect to the unit quaternion, without the part along it, which changes nothing.
    """

    means: Array
    log_scales: Array
    quaternions: Array
    opacity_logits: Array
    sh: Array


def gradient(
    scene: Scene, camera: Camera, rules: RasterRules, values: Array, background: tuple[float, float, float] = (0, 0, 0)
) -> Gradient:
    """Jᵀ v of one view.

    Args:
        scene: its arrays may be float64.
        values: (H, W, 3), v.
    """
    projected = project(scene, camera, rules)
    on_screen = _on_screen(projected, values, rules, background)
    return _of_parameters(scene, camera, projected, on_screen)


@dataclass
class _OnScreen:
    """Derivatives with respect to what the projection gives: shapes as in ``Projected``."""

    centre: Array
    covariance: Array
    opacity: Array
    colour: Array


def _on_screen(
    projected: Projected, values: Array, rules: RasterRules, background: tuple[float, float, float]
) -> _OnScreen:
    """The way back from the pixels, splat by splat from the last to the first."""
    height, width, _ = values.shape
    y, x = np.mgrid[:height, :width] + 0.5
    count = len(projected.index)
    result = _OnScreen(np.zeros((count, 2)), np.zeros((count, 2, 2)), np.zeros(count), np.zeros((count, 3)))
    transmittance, alive = np.ones((height, width)), np.ones((height, width), dtype=bool)
    drawn = []
    for k in range(count):
        if projected.opacity[k] < 1 / 255:
            continue
        inverse = np.linalg.inv(projected.covariance[k])
        offset = np.stack([x - projected.centre[k, 0], y - projected.centre[k, 1]], axis=-1)
        falloff = np.exp(-0.5 * np.einsum("hwi,ij,hwj->hw", offset, inverse, offset))
        raw = projected.opacity[k] * falloff
        inside = footprint(projected.centre[k], projected.covariance[k], rules, (height, width))
        alpha = np.where(inside & (raw >= 1 / 255), np.minimum(raw, rules.alpha_cap), 0)
        following = transmittance * (1 - alpha)
        ends = following <= 1e-4 if rules.threshold_included else following < 1e-4
        alive &= ~((alpha > 0) & ends)
        alpha = np.where(alive, alpha, 0)
        drawn.append((k, inverse, offset, falloff, alpha, transmittance, raw < rules.alpha_cap))
        transmittance = transmittance * (1 - alpha)
    behind = np.broadcast_to(np.asarray(background, dtype=np.float64), values.shape)
    for k, inverse, offset, falloff, alpha, before, free in reversed(drawn):
        result.colour[k] = np.einsum("hw,hwc->c", before * alpha, values)
        # The picture is before * (alpha * colour + (1 - alpha) * behind) + what is in front.
        by_alpha = before * ((projected.colour[k] - behind) * values).sum(axis=-1)
        by_raw = np.where(free & (alpha > 0), by_alpha, 0)
        by_exponent = by_raw * projected.opacity[k] * falloff
        result.opacity[k] = (by_raw * falloff).sum()
        towards = offset @ inverse
        result.centre[k] = np.einsum("hw,hwi->i", by_exponent, towards)
        result.covariance[k] = 0.5 * np.einsum("hw,hwi,hwj->ij", by_exponent, towards, towards)
        behind = alpha[..., None] * projected.colour[k] + (1 - alpha[..., None]) * behind
    return result


def _of_parameters(scene: Scene, camera: Camera, projected: Projected, by: _OnScreen) -> Gradient:
    """From the splats on screen to their parameters, the projection's steps in the opposite order."""
    index = projected.index
    means = scene.means[index].astype(np.float64)
    t = means @ camera.rotation.T + camera.translation
    quaternions = scene.quaternions[index].astype(np.float64)
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    scales = np.exp(scene.log_scales[index].astype(np.float64))
    focal = np.array([camera.fx, camera.fy])
    z = t[:, 2:]
    limit = 1.3 * np.array([camera.width, camera.height]) / (2 * focal)
    ratio = np.clip(t[:, :2] / z, -limit, limit)
    unclamped = np.abs(t[:, :2] / z) < limit
    jacobian = np.zeros((len(index), 2, 3))
    jacobian[:, [0, 1], [0, 1]] = focal / z
    jacobian[:, :, 2] = -focal * ratio / z
    turned = camera.rotation @ rotation_matrices(quaternions)
    m = jacobian @ turned * scales[:, None, :]

    # Opacity, and with antialiasing the factor that the covariance has on it.
    opacity = 1 / (1 + np.exp(-scene.opacity_logits[index].astype(np.float64)))
    by_sharp = by.covariance.copy()
    by_opacity = by.opacity
    if scene.antialiased:
        sharp = m @ np.swapaxes(m, 1, 2)
        of_sharp, of_both = np.linalg.det(sharp), np.linalg.det(projected.covariance)
        kept = np.maximum(of_sharp / of_both, LEAST_COMPENSATION**2)
        free = of_sharp / of_both > LEAST_COMPENSATION**2
        by_kept = np.where(free, by.opacity * opacity * 0.5 / np.sqrt(kept), 0)
        by_sharp += (by_kept / of_both)[:, None, None] * _adjugate(sharp)
        by_sharp -= (by_kept * of_sharp / of_both**2)[:, None, None] * _adjugate(projected.covariance)
        by_opacity = by.opacity * np.sqrt(kept)

    by_m = 2 * by_sharp @ m
    by_log_scales = (by_m * m).sum(axis=1)
    by_turned = np.swapaxes(jacobian, 1, 2) @ by_m * scales[:, None, :]
    by_jacobian = by_m * scales[:, None, :] @ np.swapaxes(turned, 1, 2)
    by_rotation = camera.rotation.T @ by_turned
    by_quaternions = np.einsum("nij,qnij->nq", by_rotation, _rotation_derivatives(quaternions))
    by_quaternions -= (by_quaternions * quaternions).sum(axis=1, keepdims=True) * quaternions

    by_ratio = by_jacobian[:, :, 2] * (-focal / z)
    by_t = np.zeros_like(t)
    by_t[:, :2] = by.centre * focal / z + np.where(unclamped, by_ratio / z, 0)
    by_t[:, 2] = -(by.centre * focal * t[:, :2] / z**2).sum(axis=1)
    by_t[:, 2] -= (np.where(unclamped, by_ratio, 0) * t[:, :2] / z**2).sum(axis=1)
    by_t[:, 2] -= (by_jacobian * jacobian).sum(axis=(1, 2)) / z[:, 0]
    by_means = by_t @ camera.rotation

    away = means - camera.centre
    distance = np.linalg.norm(away, axis=1, keepdims=True)
    direction = away / distance
    sh = scene.sh[index].astype(np.float64)
    degree = scene.sh_degree
    basis = sh_basis(direction, degree)
    uncut = np.einsum("nm,nmc->nc", basis, sh) + 0.5 > 0
    by_colour = np.where(uncut, by.colour, 0)
    by_basis = np.einsum("nmc,nc->nm", sh, by_colour)
    by_direction = np.empty_like(means)
    for axis, step in enumerate(_STEP * np.eye(3)):
        slope = (sh_basis(direction + step, degree) - sh_basis(direction - step, degree)) / (2 * _STEP)
        by_direction[:, axis] = (by_basis * slope).sum(axis=1)
    by_direction -= (by_direction * direction).sum(axis=1, keepdims=True) * direction
    by_means += by_direction / distance

    def of_all(values: Array) -> Array:
        everything = np.zeros((len(scene.means), *values.shape[1:]))
        everything[index] = values
        return everything

    return Gradient(
        of_all(by_means),
        of_all(by_log_scales),
        of_all(by_quaternions),
        of_all(by_opacity * opacity * (1 - opacity)),
        of_all(basis[:, :, None] * by_colour[:, None, :]),
    )


def _adjugate(matrices: Array) -> Array:
    """(N, 2, 2) derivatives of the determinants of symmetric (N, 2, 2)."""
    result = -matrices.copy()
    result[:, 0, 0], result[:, 1, 1] = matrices[:, 1, 1], matrices[:, 0, 0]
    return result


def _rotation_derivatives(quaternions: Array) -> Array:
    """(4, N, 3, 3) derivatives of the matrices 1 + 2 w [v] + 2 [v]², [v] x = v × x, with respect to w and v."""
    w, v = quaternions[:, 0], quaternions[:, 1:]

    def cross(vectors: Array) -> Array:
        result = np.zeros((len(vectors), 3, 3))
        for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            result[:, c, b], result[:, b, c] = vectors[:, a], -vectors[:, a]
        return result

    of_v = cross(v)
    derivatives = [2 * of_v]
    for axis in np.eye(3):
        unit = cross(np.broadcast_to(axis, v.shape))
        derivatives.append(2 * w[:, None, None] * unit + 2 * (unit @ of_v + of_v @ unit))
    return np.stack(derivatives)
