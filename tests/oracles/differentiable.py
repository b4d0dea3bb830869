"""A plain renderer of splats in PyTorch, float64, whose derivatives autograd finds: :func:`picture`.

It is written from the definition in the original paper (Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance
Field Rendering", 2023) with whole matrices of pixels by splats, and shares no formula with tests/reference. Needs the
extra "torch".
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.raster.rules import RasterRules


@dataclass
class Leaves:
    """A scene's N splats as float64 tensors that derivatives are found for.

    Attributes:
        means, log_scales: (N, 3). quaternions: (N, 4), of length 1. opacity_logits: (N,). sh: (N, M, 3).
    """

    means: Any
    log_scales: Any
    quaternions: Any
    opacity_logits: Any
    sh: Any

    @classmethod
    def of(cls, scene: Scene) -> Leaves:
        """The parameters of a scene."""
        unit = scene.quaternions / np.linalg.norm(scene.quaternions.astype(np.float64), axis=1, keepdims=True)
        arrays = (scene.means, scene.log_scales, unit, scene.opacity_logits, scene.sh)
        return cls(*(torch.tensor(a.astype(np.float64), requires_grad=True) for a in arrays))

    def derivatives(self) -> dict[str, np.ndarray]:
        """What ``backward`` has left, (N, columns) each."""
        return {name: leaf.grad.numpy().reshape(len(leaf), -1) for name, leaf in vars(self).items()}


def picture(
    leaves: Leaves,
    camera: Camera,
    rules: RasterRules,
    background: tuple[float, float, float],
    antialiased: bool = False,
    low_pass: float = 0.3,
) -> Any:
    """(H, W, 3) the picture as a function of the leaves."""
    turn, shift = torch.tensor(camera.rotation), torch.tensor(camera.translation)
    local = leaves.means @ turn.T + shift
    near = torch.nonzero(local[:, 2].detach() > rules.near).ravel()
    near = near[torch.argsort(local[near, 2].detach(), stable=True)]
    local = local[near]
    x, y, z = local.unbind(1)
    centre = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], 1)
    covariance, sharp = _covariances(leaves, near, local, camera, turn, low_pass)
    opacity = torch.sigmoid(leaves.opacity_logits[near])
    if antialiased:
        opacity = opacity * torch.sqrt(torch.clamp(torch.det(sharp) / torch.det(covariance), min=0.005**2))
    eye = torch.tensor(camera.centre)
    colour = torch.relu(_colour(leaves.means[near] - eye, leaves.sh[near]) + 0.5)

    rows, columns = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    pixels = torch.stack([columns.ravel() + 0.5, rows.ravel() + 0.5], 1).double()
    offset = pixels[:, None] - centre
    square = torch.einsum("pki,kij,pkj->pk", offset, torch.linalg.inv(covariance), offset)
    raw = opacity * torch.exp(-square / 2)
    drawn = raw.detach() >= 1 / 255
    if rules.square_extent:
        drawn = drawn & _in_square(centre.detach(), covariance.detach(), pixels, camera)
    alpha = torch.where(drawn, torch.clamp(raw, max=rules.alpha_cap), torch.zeros_like(raw))
    through = torch.cumprod(1 - alpha, 1)
    after = through.detach()
    goes_on = after > 1e-4 if rules.threshold_included else after >= 1e-4
    alpha = torch.where(goes_on, alpha, torch.zeros_like(alpha))
    through = torch.cumprod(1 - alpha, 1)
    before = torch.cat([torch.ones_like(through[:, :1]), through[:, :-1]], 1)
    image = (before * alpha) @ colour + through[:, -1:] * torch.tensor(background, dtype=torch.float64)
    return image.reshape(camera.height, camera.width, 3)


def _covariances(leaves: Leaves, near: Any, local: Any, camera: Camera, turn: Any, low_pass: float) -> tuple[Any, Any]:
    """(K, 2, 2) on screen, with the low-pass filter and without."""
    q = leaves.quaternions[near]
    w, i, j, k = (q / q.norm(dim=1, keepdim=True)).unbind(1)
    # Rows of the matrix by the Hamilton product q v q*.
    rotation = torch.stack(
        [
            torch.stack([w * w + i * i - j * j - k * k, 2 * (i * j - w * k), 2 * (i * k + w * j)], 1),
            torch.stack([2 * (i * j + w * k), w * w - i * i + j * j - k * k, 2 * (j * k - w * i)], 1),
            torch.stack([2 * (i * k - w * j), 2 * (j * k + w * i), w * w - i * i - j * j + k * k], 1),
        ],
        1,
    )
    world = rotation @ torch.diag_embed(torch.exp(2 * leaves.log_scales[near])) @ rotation.transpose(1, 2)
    x, y, z = local.unbind(1)
    bound_x, bound_y = 1.3 * camera.width / (2 * camera.fx), 1.3 * camera.height / (2 * camera.fy)
    zero = torch.zeros_like(z)
    slopes = torch.stack(
        [
            torch.stack([camera.fx / z, zero, -camera.fx * torch.clamp(x / z, -bound_x, bound_x) / z], 1),
            torch.stack([zero, camera.fy / z, -camera.fy * torch.clamp(y / z, -bound_y, bound_y) / z], 1),
        ],
        1,
    )
    way = slopes @ turn
    sharp = way @ world @ way.transpose(1, 2)
    return sharp + low_pass * torch.eye(2, dtype=torch.float64), sharp


def _in_square(centre: Any, covariance: Any, pixels: Any, camera: Camera) -> Any:
    """(P, K) which pixels lie in tiles that the original's square of three standard deviations touches."""
    middle = covariance.diagonal(dim1=1, dim2=2).sum(1) / 2
    largest = middle + torch.sqrt(torch.clamp(middle**2 - torch.det(covariance), min=0.1))
    radius = torch.ceil(3 * torch.sqrt(largest))[:, None]
    # The original's pixel centres have whole coordinates.
    first = torch.floor((centre - 0.5 - radius) / 16)
    end = torch.floor((centre - 0.5 + radius + 15) / 16)
    last = torch.tensor([math.ceil(camera.width / 16), math.ceil(camera.height / 16)])
    tile = torch.floor(pixels / 16)[:, None]
    return ((tile >= first) & (tile < torch.minimum(end, last))).all(2)


def _colour(away: Any, sh: Any) -> Any:
    """(K, 3) sums of spherical harmonics in the directions ``away``, without the constant 0.5."""
    x, y, z = (away / away.norm(dim=1, keepdim=True)).unbind(1)
    pi = math.pi
    # The real basis with the Condon-Shortley phase, from its closed forms.
    basis = [torch.full_like(x, math.sqrt(1 / (4 * pi)))]
    if sh.shape[1] > 1:
        one = math.sqrt(3 / (4 * pi))
        basis += [-one * y, one * z, -one * x]
    if sh.shape[1] > 4:
        two = math.sqrt(15 / (4 * pi))
        zonal = math.sqrt(5 / (16 * pi))
        basis += [two * x * y, -two * y * z, zonal * (3 * z**2 - 1), -two * x * z, two / 2 * (x**2 - y**2)]
    if sh.shape[1] > 9:
        a, b = math.sqrt(35 / (32 * pi)), math.sqrt(105 / (4 * pi))
        c, d = math.sqrt(21 / (32 * pi)), math.sqrt(7 / (16 * pi))
        basis += [
            -a * y * (3 * x**2 - y**2),
            b * x * y * z,
            -c * y * (5 * z**2 - 1),
            d * z * (5 * z**2 - 3),
            -c * x * (5 * z**2 - 1),
            b / 2 * z * (x**2 - y**2),
            -a * x * (x**2 - 3 * y**2),
        ]
    return torch.einsum("mk,kmc->kc", torch.stack(basis), sh)
