"""Where growing functions meet their aims, figures of a typical scene, and other steps of the quantiser."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from potr_cl.codec.quantize import PRESETS
from potr_cl.pipeline.growth import FinenessAxis, Typical, meet, with_colour_steps, with_steps
from potr_cl.pipeline.options import EncodeOptions

PAPER = EncodeOptions.for_preset("paper")


@settings(deadline=None)
@given(st.floats(0.3, 3), st.floats(-50, 50), st.floats(-5, 5))
def test_lines_are_met_with_two_points(rate, root, first):
    points = {first: rate * (first - root)}
    for _ in range(2):
        place = meet(points, 0.0, 1.0)
        points[place] = rate * (place - root)
    assert min(abs(place - root) for place in points) < 1e-6


@settings(deadline=None)
@given(st.floats(-3, 3), st.floats(0.4, 2.5), st.floats(-0.2, 0.2), st.floats(-3, 3))
def test_growing_functions_are_met(root, rate, bend, first):
    """As size and PSNR grow: at about the typical rate, not along a line."""

    def value(x):
        return rate * (x - root) + bend * rate * (x - root) * abs(x - root) / 6

    points, place = {first: value(first)}, first
    while abs(value(place)) >= 0.01:
        assert len(points) <= 6
        place = meet(points, 0.0, 1.0)
        lower = [x for x in points if points[x] < 0]
        upper = [x for x in points if points[x] >= 0]
        if lower and upper:
            assert max(lower) < place < min(upper)
        points[place] = value(place)


@pytest.mark.parametrize(
    ("points", "side"),
    [
        ({1.0: 5.0, 2.0: 5.0, 3.0: 4.0}, -1),  # nowhere little enough: ever further down
        ({1.0: -4.0, 2.0: -5.0, 3.0: -5.0}, 1),
    ],
)
def test_where_values_do_not_grow_one_goes_on(points, side):
    place = meet(points, 0.0, 1.0)
    assert place < min(points) if side < 0 else place > max(points)


SCALES = [
    *(
        (each.value, each.quality)
        for preset in PRESETS
        for each in (Typical.sizes(preset, 1000), Typical.psnrs(preset))
    ),
    *((each.fineness, each.quality) for each in map(FinenessAxis, (PAPER, PAPER.changed(code={"sf_sh": 7.0})))),
]


@pytest.mark.parametrize(("value", "quality"), SCALES)
def test_typical_values_and_fineness_grow_and_tell_the_quality(value, quality):
    values = [value(q) for q in np.linspace(0, 1, 50)]
    assert np.all(np.diff(values) > 0)
    for q in (0, 0.00123, 0.013, 0.3, 0.77, 1):
        assert quality(value(q)) == pytest.approx(q, abs=1e-5)
    assert quality(values[0] - 1) == 0
    assert quality(values[-1] + 1) == 1


def test_steps_of_another_quality():
    some = PAPER.changed(q=0.5, code={"sf_scale": 9.0})
    mixed, finer = with_steps(some, 0.7).parameters, some.changed(q=0.7).parameters
    for field in dataclasses.fields(mixed):
        source = finer if field.name.startswith("sf_") or field.name in ("beta", "gamma") else some.parameters
        assert getattr(mixed, field.name) == getattr(source, field.name), field.name


def test_steps_of_colours():
    plain = PAPER.changed(q=0.5, code={"sf_dc": 9.0})
    finer = with_colour_steps(plain, plain, 0.1)
    assert finer == plain.changed(code={"sf_sh": plain.parameters.sf_sh * math.exp(0.1)})
    both = plain.changed(code={"sf_sh": 7.0})
    assert with_colour_steps(both, both, 0.1) == both
