"""The study of the fit: what a course says, and that each part of its ladder is another encode."""

from __future__ import annotations

import dataclasses

import pytest

from potr_cl.pipeline.options import EncodeOptions
from potr_cl.stages.fitting.fit import RATES
from tools.study.fit import Course, ladder


def test_a_course_is_read():
    course = Course.of("q0.3/500,encode/1000+last=0.2+cycles=1+groups=means:dc@0.3@0.5")
    assert course.parts == ((0.3, 500), (None, 1000))
    assert course.qualities == (0.3, 0.5)
    assert course.fit["rates"] == dataclasses.replace(RATES, log_scales=0, quaternions=0, opacity_logits=0, ac=0)
    assert (course.fit["last"], course.fit["cycles"]) == (0.2, 1)
    assert EncodeOptions().changed(fit=course.fit).fit.cycles == 1
    with pytest.raises(ValueError, match="the fit has no hue"):
        Course.of("encode/10+groups=hue")


def test_each_part_of_the_ladder_is_an_encode_of_its_own():
    courses = ladder([0.3, 0.5])
    fits = [EncodeOptions(q=0.3).changed(fit={"steps": course.parts[0][1], **course.fit}).fit for course in courses]
    assert fits[0] == EncodeOptions().changed(fit={"steps": fits[0].steps}).fit, "the first has everything"
    assert len(set(fits)) == len(fits) > 8
    for group in (each.name for each in dataclasses.fields(RATES)):
        assert any(getattr(fit.rates, group) == 0 for fit in fits), f"{group} always move"
    assert all(course.qualities == (0.3, 0.5) for course in courses)
