"""Rotated spherical harmonics against the basis that scenes are rendered with."""

import numpy as np
import pytest

from potr_cl.model.spherical_harmonics import rotated_sh
from tests.reference.raster import rotation_matrices, sh_basis
from tests.reference.scenes import random_scene


@pytest.mark.parametrize("degree", range(4))
def test_a_colour_turns_with_the_scene(degree):
    rng = np.random.default_rng(degree)
    quaternion = rng.normal(size=4)
    rotation = rotation_matrices(quaternion[None] / np.linalg.norm(quaternion))[0]
    sh = random_scene(70_000 if degree == 1 else 200, degree).sh
    turned = rotated_sh(sh, rotation)
    directions = rng.normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before = sh_basis(directions, degree) @ sh[-200:].astype(float)
    after = sh_basis(directions @ rotation.T, degree) @ turned[-200:].astype(float)
    np.testing.assert_allclose(after, before, atol=3e-6)
    np.testing.assert_array_equal(turned[:, 0], sh[:, 0])


def test_half_a_turn_about_z_changes_signs_alone():
    sh = random_scene(10, 3).sh
    turned = rotated_sh(sh, np.diag([-1.0, -1.0, 1.0]))
    np.testing.assert_allclose(np.abs(turned), np.abs(sh), atol=1e-6)
