"""Frequencies of tokens: they add up, and none that occurs is lost; those that decoders know."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from potr_cl.codec.bundles import streams
from potr_cl.codec.bundles.description import known_model


@given(hnp.arrays(np.int64, st.integers(1, 252), elements=st.integers(0, 10**9)))
def test_frequencies_add_up(counts):
    counts[0] += 1
    frequencies = streams.normalise(counts)
    assert frequencies.sum() == streams.TOTAL
    assert ((frequencies > 0) == (counts > 0)).all()


@pytest.mark.parametrize("tokens", [8, 32, 128, 216])
def test_models_that_decoders_know(tokens):
    model = known_model(tokens)
    assert (model.frequencies.sum(axis=1) == streams.TOTAL).all()
    assert (model.frequencies > 0).all()
    assert model.classes.tolist() == [size // 8 for size in range(256)]
    # Larger ones are expected where larger ones were.
    means = (model.frequencies * np.arange(tokens)).sum(axis=1)
    assert (np.diff(means) >= 0).all()
