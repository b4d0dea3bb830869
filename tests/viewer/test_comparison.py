"""Two pictures in one."""

import dataclasses

import numpy as np
import pytest

from potr_cl.formats.images import to_8_bits
from potr_cl.quality.compare import difference_map
from potr_cl.viewer.comparison import MODES, compared, under_photograph

A = np.random.default_rng(1).random((20, 40, 3), np.float32)
B = np.clip(A + np.random.default_rng(2).normal(0, 0.05, A.shape), -0.1, 1.2).astype(np.float32)


@pytest.mark.parametrize(("at", "column"), [(0, 0), (0.25, 10), (0.5, 20), (1, 40), (7, 40), (-1, 0)])
def test_the_divider(at, column):
    picture, factor = compared("divider", A, B, at)
    assert np.array_equal(picture[:, :column], to_8_bits(A)[:, :column])
    assert np.array_equal(picture[:, column:], to_8_bits(B)[:, column:])
    assert factor == 1


def test_one_alone_and_both():
    assert np.array_equal(compared("A", A, B)[0], to_8_bits(A))
    assert np.array_equal(compared("B", A, B)[0], to_8_bits(B))
    assert np.array_equal(compared("side by side", A, B)[0], np.concatenate([to_8_bits(A), to_8_bits(B)], axis=1))


@pytest.mark.parametrize("factor", [1, 5, 50])
def test_differences(factor):
    clamped = abs(np.clip(A, 0, 1) - np.clip(B, 0, 1))
    picture, told = compared("difference", A, B, factor=factor)
    assert told == factor
    assert np.array_equal(picture, to_8_bits(factor * clamped))
    heat, _ = compared("heat map", A, B, factor=factor)
    largest = clamped.max(axis=-1)
    assert (heat[factor * largest >= 1] == 255).all()
    assert (heat[..., 0] >= heat[..., 1]).all()
    assert (heat[..., 1] >= heat[..., 2]).all()


def test_automatic_differences_are_those_of_compare():
    heat, factor = difference_map(A, B)
    picture, told = compared("heat map", A, B)
    assert told == factor
    assert np.array_equal(picture, to_8_bits(heat))
    assert compared("difference", A, B)[1] == factor
    assert {compared(mode, A, A)[0].dtype for mode in MODES} == {np.dtype(np.uint8)}, "identical pictures have some too"


def test_a_photograph_fades_over_the_picture(plush_excerpt_cameras):
    camera = plush_excerpt_cameras[0]
    size = (camera.height, camera.width, 3)
    picture, photograph = np.full(size, 40, np.uint8), np.full(size, 200, np.uint8)
    for part, value in [(0, 40), (0.5, 120), (1, 200), (3, 200)]:
        assert np.array_equal(under_photograph(picture, camera, photograph, camera, part), np.full(size, value))
    assert (picture == 40).all(), "it is not changed in place"


def test_a_photograph_lies_where_the_view_sees_it(plush_excerpt_cameras):
    """The picture shows more than the view: a photograph of all white fills just the view's part."""
    camera = dataclasses.replace(plush_excerpt_cameras[0], cx=120.0, cy=90.0)
    wide = dataclasses.replace(camera, width=480, height=180, cx=240.0)
    picture = np.zeros((180, 480, 3), np.uint8)
    result = under_photograph(picture, wide, np.full((180, 240, 3), 255, np.uint8), camera, 1.0)
    assert (result[:, 120:360] == 255).all()
    assert (result[:, :120] == 0).all()
    assert (result[:, 360:] == 0).all()
