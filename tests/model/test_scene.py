"""Scene: shapes that belong together, activation without overflow, cleaning that counts, colours that turn with it."""

from __future__ import annotations

import dataclasses
import tracemalloc

import numpy as np
import pytest

from potr_cl.errors import DataError
from potr_cl.model import scene as scene_module
from potr_cl.model.spherical_harmonics import rotated_sh
from tests.reference.raster import rotation_matrices, sh_basis
from tests.reference.scenes import random_scene


def test_degrees_and_sizes():
    for degree, coefficients in enumerate((1, 4, 9, 16)):
        scene = random_scene(7, degree)
        assert (len(scene), scene.sh_degree) == (7, degree)
        assert scene.nbytes == 7 * 4 * (11 + 3 * coefficients)


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("log_scales", (7, 2)),
        ("quaternions", (6, 4)),
        ("opacity_logits", (7, 1)),
        ("sh", (7, 5, 3)),
        ("sh", (7, 16, 4)),
    ],
)
def test_arrays_that_do_not_belong_together(name, shape):
    with pytest.raises(DataError, match=name if shape != (7, 5, 3) else "coefficients"):
        dataclasses.replace(random_scene(7), **{name: np.zeros(shape, np.float32)})


def test_activation():
    scene = dataclasses.replace(random_scene(3, 0), opacity_logits=np.array([-200, 0, 200], np.float32))
    with np.errstate(all="raise", under="ignore"):
        assert np.allclose(scene.opacities, [0, 0.5, 1])
    assert np.allclose(scene.scales, np.exp(scene.log_scales))


@pytest.mark.parametrize(("splats", "value"), [(1, np.nan), (40000, np.inf), (5, -np.inf)])
def test_non_finite_splats_are_dropped_and_counted(splats, value):
    rng = np.random.default_rng(splats)
    scene = random_scene(splats + 5, 2)
    bad = rng.choice(splats + 5, 5, replace=False)
    scene.means[bad[0], 1] = value
    scene.log_scales[bad[1], 2] = value
    scene.quaternions[bad[2], 3] = value
    scene.opacity_logits[bad[3]] = np.nan
    scene.sh[bad[4], 8, 2] = value
    for strided in (scene, dataclasses.replace(scene, sh=np.asfortranarray(scene.sh))):
        clean, report = strided.cleaned()
        assert (len(clean), report.non_finite, report.zero_quaternions) == (splats, 5, 0)
        assert clean == scene[np.setdiff1d(np.arange(splats + 5), bad)]


def test_infinite_opacity_logits_become_finite_and_zero_quaternions_the_identity():
    scene = random_scene(6)
    assert scene.cleaned()[0] is scene  # not even copied
    scene.opacity_logits[:3] = np.inf, -np.inf, 1
    scene.means[3] = np.nan
    scene.quaternions[4] = 0
    scene.quaternions[5] = 1e-20
    before = scene.quaternions.copy()
    clean, report = scene.cleaned()
    assert (len(clean), report.non_finite, report.infinite_opacities, report.zero_quaternions) == (5, 1, 2, 2)
    assert np.isfinite(clean.opacity_logits).all()
    assert clean.opacities[0] == 1
    assert 0 <= clean.opacities[1] < 1e-8
    assert clean.opacity_logits[2] == 1
    assert clean.quaternions[3:].tolist() == [[1, 0, 0, 0]] * 2
    assert np.isinf(scene.opacity_logits[:2]).all()
    assert np.array_equal(scene.quaternions, before)


def test_nothing_left_is_an_error():
    scene = random_scene(2)
    scene.means[:] = np.nan
    for nothing in (scene, scene[:0]):
        with pytest.raises(DataError, match="no splat"):
            nothing.cleaned()


def test_many_splats_are_taken_by_threads_as_few_are(monkeypatch):
    scene = random_scene(1000, 3)
    numbers = np.random.default_rng(3).integers(0, 1000, 700)
    few = scene.subset(numbers)
    monkeypatch.setattr(scene_module, "_LARGE", 64)
    many = scene.subset(numbers)
    assert many == few
    assert all(array.flags.c_contiguous for array in many.arrays)
    assert len(scene.subset(np.arange(-700, 0))) == 700  # as NumPy counts
    with pytest.raises(IndexError):
        scene.subset(np.arange(301, 1001))


@pytest.mark.parametrize("planar", [False, True])
def test_scenes_are_joined_in_an_order(monkeypatch, planar):
    """Piece by piece: of each splat all values, from the scene that has it, however they lie in memory."""
    monkeypatch.setattr(scene_module, "_LARGE", 80)
    some, others = random_scene(40, 2, seed=1), random_scene(17, 2, seed=2)
    if planar:
        some = dataclasses.replace(some, sh=np.ascontiguousarray(some.sh.transpose(1, 2, 0)).transpose(2, 0, 1))
    order = np.random.default_rng(3).permutation(57)
    joined = some.joined(others, order)
    for found, *both in zip(joined.arrays, some.arrays, others.arrays, strict=True):
        assert np.array_equal(found, np.concatenate(both)[order])


def test_without_colours_a_part_of_a_scene_takes_no_memory_for_them():
    scene = random_scene(100_000, 3)
    some = np.arange(0, len(scene), 2)
    tracemalloc.start()
    part = scene.uncoloured().subset(some)
    taken = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert all(map(np.array_equal, part.arrays[:4], scene[some].arrays[:4]))
    assert part.sh.shape == (len(some), 1, 3)
    assert not part.sh.any()
    assert taken < scene.nbytes / 6  # the half of all but the colours, and little else


def test_splats_are_selected_and_scenes_compared(plush_excerpt):
    opaque = plush_excerpt.opacities > 0.5
    numbers = np.flatnonzero(opaque)
    assert plush_excerpt[opaque] == plush_excerpt[numbers] == plush_excerpt[numbers.tolist()]
    assert plush_excerpt[opaque] == plush_excerpt.subset(opaque) != plush_excerpt
    assert plush_excerpt[:7] == plush_excerpt.subset(np.arange(7))
    assert plush_excerpt[-1] == plush_excerpt.subset(np.array([len(plush_excerpt) - 1]))
    assert len(plush_excerpt[[]]) == 0
    assert plush_excerpt != dataclasses.replace(plush_excerpt, antialiased=True)
    assert plush_excerpt != "a scene"
    with pytest.raises(IndexError):
        plush_excerpt[opaque[:-1]]
    with pytest.raises(TypeError, match="no sequence of splats"):
        list(plush_excerpt)


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
