"""The joint re-fit of the colours in float64: the linear map written out, the objective, the least-squares solution.

The map follows the picture of :mod:`tests.reference.raster`: a pixel is the sum over the splats of T alpha times the
splat's colour, a colour is 0.5 + the SH basis times the coefficients, R = Y + Co - Cg, G = Y + Cg, B = Y - Co - Cg.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.raster.rules import INRIA
from potr_cl.stages.compaction.view_weights import REFERENCE_PIXELS
from tests.reference import raster as reference

Array = NDArray[np.float64]

#: R, G, B of Y, Co, Cg.
TO_RGB = np.array([[1.0, 1, -1], [1, 0, 1], [1, -1, -1]])


def to_ycocg(sh: NDArray[np.floating[Any]]) -> Array:
    """(N, M, 3) R, G, B as Y, Co, Cg."""
    x: Array = sh.astype(np.float64) @ np.linalg.inv(TO_RGB).T
    return x


def to_rgb(x: Array) -> Array:
    """The inverse of :func:`to_ycocg`."""
    rgb: Array = x @ TO_RGB.T
    return rgb


@dataclass
class LinearView:
    """One view: what a pixel counts, T alpha (P, N), the SH basis (N, M), and the light that comes through (P,)."""

    weight: float
    blend: Array
    basis: Array
    through: Array

    def colours(self, x: Array) -> Array:
        """(N, 3) R, G, B of the splats, not cut."""
        rgb: Array = 0.5 + np.einsum("nm,nmc->nc", self.basis, to_rgb(x))
        return rgb


def linear_view(scene: Scene, camera: Camera) -> LinearView:
    """The map of one view.

    Raises:
        ValueError: a pixel is so near a threshold that float32 may decide otherwise.
    """
    shape = (camera.height, camera.width)
    projected = reference.project(scene, camera, INRIA)
    # With unit colours the picture is the weights.
    unit = dataclasses.replace(projected, colour=np.eye(len(projected.index)))
    composite = reference.composite(unit, shape, INRIA, (0.0,))
    if composite.margin.min() <= 3e-6:
        raise ValueError("a pixel is too near a threshold to compare float32 with float64: choose another scene")
    blend = np.zeros((camera.width * camera.height, len(scene)))
    blend[:, projected.index] = composite.image.reshape(len(blend), -1) if len(projected.index) else 0
    directions = scene.means.astype(np.float64) - camera.centre
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    basis = reference.sh_basis(directions, scene.sh_degree)
    return LinearView(REFERENCE_PIXELS / len(blend), blend, basis, composite.transmittance.ravel())


class Reference:
    """The least-squares problem of one scene.

    Args:
        scene: its geometry, opacities and degree count, and its coefficients are the start.
        cameras: the views.
        targets: (H, W, 3) a view.
        lam, chroma_factor, prior: as RefitOptions has them.
        active: (N, M, 3) in Y, Co, Cg; the others are 0 unless ``hold``.
    """

    def __init__(
        self,
        scene: Scene,
        cameras: Sequence[Camera],
        targets: Sequence[NDArray[np.floating[Any]]],
        lam: float = 0.0,
        prior: float = 0.1,
        chroma_factor: float = 3.0,
        active: NDArray[np.bool_] | None = None,
        hold: bool = False,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        self.views = [linear_view(scene, camera) for camera in cameras]
        self.targets = [np.asarray(t, np.float64).reshape(-1, 3) for t in targets]
        self.background = np.asarray(background, np.float64)
        self.active = np.ones(scene.sh.shape, bool) if active is None else active
        # The solver keeps its start in float32.
        self.start: Array = to_ycocg(scene.sh).astype(np.float32).astype(np.float64) * (self.active | hold)
        self.free = [view.colours(self.start) > 0 for view in self.views]
        self.pull = np.zeros(scene.sh.shape)
        self.pull[:, 1:] = lam * np.array([1, chroma_factor, chroma_factor])
        self.prior = prior

    # ------------------------------------------------------------------------------------------ the map

    def forward(self, direction: Array) -> list[Array]:
        """A times a change of the coefficients: (P, 3) a view."""
        return [
            view.blend @ (free * np.einsum("nm,nmc->nc", view.basis, to_rgb(direction)))
            for view, free in zip(self.views, self.free, strict=True)
        ]

    def transposed(self, images: Sequence[Array]) -> Array:
        """A transposed times W times pictures."""
        total = np.zeros(self.start.shape)
        for view, free, image in zip(self.views, self.free, images, strict=True):
            colours = view.weight * free * (view.blend.T @ image)
            total += view.basis[:, :, None] * (colours @ TO_RGB)[:, None, :]
        return total

    def gram(self) -> Array:
        """(N, M, M) the splats' own blocks for a channel of unit length, cuts left out of account."""
        return sum(
            (
                np.einsum("n,ni,nj->nij", view.weight * (view.blend**2).sum(axis=0), view.basis, view.basis)
                for view in self.views
            ),
            start=np.zeros((len(self.start), self.start.shape[1], self.start.shape[1])),
        )

    def pictures(self, x: Array) -> list[Array]:
        """(P, 3) a view, colours cut at 0."""
        return [
            view.blend @ np.maximum(view.colours(x), 0) + view.through[:, None] * self.background for view in self.views
        ]

    # ------------------------------------------------------------------------------------------ the problem

    def error(self, x: Array) -> float:
        """Mean squared error over views, pixels and channels."""
        pairs = zip(self.pictures(x), self.targets, strict=True)
        return float(np.mean([np.mean((picture - target) ** 2) for picture, target in pairs]))

    def objective(self, x: Array) -> float:
        """What is minimised."""
        squared = 3 * REFERENCE_PIXELS * len(self.views) * self.error(x)
        ridge = np.where(self.active, self.pull, 0) * x**2
        return squared + float(ridge.sum() + self.prior * ((x - self.start) ** 2).sum())

    def residuals(self) -> list[Array]:
        """Targets less pictures at the start."""
        return [t - p for t, p in zip(self.targets, self.pictures(self.start), strict=True)]

    def solution(self) -> Array:
        """(N, M, 3) the least-squares solution, colours that are cut at the start staying so (LSMR).

        Raises:
            ImportError: scipy is not installed.
        """
        from scipy.sparse.linalg import LinearOperator, lsmr

        shape, active = self.start.shape, self.active
        columns = int(active.sum())
        roots = [np.sqrt(view.weight) for view in self.views]
        ridge, prior = np.sqrt(self.pull[active]), np.sqrt(self.prior)

        def apply(change: Array) -> Array:
            direction = np.zeros(shape)
            direction[active] = change
            images = [root * image for root, image in zip(roots, self.forward(direction), strict=True)]
            return np.concatenate([*(i.ravel() for i in images), ridge * change, prior * change])

        def apply_transposed(values: Array) -> Array:
            images, at = [], 0
            for root, view in zip(roots, self.views, strict=True):
                size = 3 * len(view.blend)
                images.append(values[at : at + size].reshape(-1, 3) / root)
                at += size
            first = self.transposed(images)[active]
            change: Array = first + ridge * values[at : at + columns] + prior * values[at + columns :]
            return change

        rows = sum(3 * len(view.blend) for view in self.views) + 2 * columns
        operator = LinearOperator((rows, columns), matvec=apply, rmatvec=apply_transposed, dtype=np.float64)
        data = [(root * r).ravel() for root, r in zip(roots, self.residuals(), strict=True)]
        wanted = np.concatenate([*data, -ridge * self.start[active], np.zeros(columns)])
        change: Array = lsmr(operator, wanted, atol=1e-9, btol=1e-9, conlim=0, maxiter=20000)[0]
        x: Array = self.start.copy()
        x[active] += change
        return x


#: Squared lengths of Y, Co and Cg in R, G, B.
LENGTHS = (3.0, 2.0, 3.0)


def selection(
    block: Array, x: Array, active: NDArray[np.bool_], length: float, prior: float, least: float, decay: float = 1e-4
) -> tuple[NDArray[np.bool_], Array, float]:
    """Which coefficients of one channel of one splat are kept: the definition, with an inverse at every step.

    Args:
        block: (M, M) the splat's own block of the normal equations. x: (M,). active: (M,).
        least: a coefficient that costs less is given up, the cheapest first.

    Returns:
        What is kept; the coefficients then; and how near, relatively, a decision was.
    """
    matrix = length * block + prior * np.eye(len(x))
    scale = np.sqrt(np.diag(matrix))
    unit = matrix / np.outer(scale, scale) + decay * np.eye(len(x))
    kept, x, margin = active.copy(), np.where(active, x * scale, 0), np.inf
    while True:
        index = np.flatnonzero(kept)
        inverse = np.linalg.inv(unit[np.ix_(index, index)])
        costs = x[index] ** 2 / np.diag(inverse)
        costs[index == 0] = np.inf
        if len(index) < 2:
            break
        cheapest, second = np.sort(costs)[:2]
        margin = min(margin, abs(cheapest / least - 1))
        if cheapest >= least:
            break
        margin = min(margin, second / max(cheapest, 1e-300) - 1)
        worst = int(np.argmin(costs))
        x[index] -= inverse[:, worst] * x[index[worst]] / inverse[worst, worst]
        x[index[worst]] = 0
        kept[index[worst]] = False
    return kept, x / scale, margin
