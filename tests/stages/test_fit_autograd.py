"""The float64 derivatives that kernels are compared with, against PyTorch's autograd (the extra "torch")."""

from __future__ import annotations

import numpy as np
import pytest

from potr_cl.raster.rules import GSPLAT, INRIA
from tests.cases.derivatives import case_of_derivatives
from tests.reference.derivatives import gradient
from tests.reference.raster import render

torch = pytest.importorskip("torch", reason="the extra torch is not installed")

from tests.oracles.differentiable import Leaves, picture  # noqa: E402 (needs torch)

BACKGROUND = (0.3, 0.6, 0.1)


@pytest.mark.parametrize(
    ("degree", "antialiased", "rules"),
    [(0, False, INRIA), (1, True, INRIA), (2, False, GSPLAT), (3, False, INRIA), (3, True, GSPLAT)],
)
def test_the_float64_definition(degree, antialiased, rules):
    """Pictures too."""
    scene, cameras, values = case_of_derivatives(degree, antialiased)
    leaves, loss, sums = Leaves.of(scene), 0, {}
    for camera, v in zip(cameras, values, strict=True):
        image = picture(leaves, camera, rules, BACKGROUND, antialiased, scene.low_pass)
        loss = loss + (image * torch.tensor(v)).sum()
        for name, array in vars(gradient(scene, camera, rules, v, BACKGROUND)).items():
            sums[name] = sums.get(name, 0.0) + array.reshape(len(scene), -1)
        defined = render(scene, camera, rules, BACKGROUND).image
        assert np.abs(image.detach().numpy() - defined).max() < 1e-9
    loss.backward()
    for name, exact in leaves.derivatives().items():
        assert np.linalg.norm(sums[name] - exact) < 1e-7 * np.linalg.norm(exact), name
