"""Numbers in order (potr_cl/model/order.py)."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from potr_cl.model.order import ascending, least


@given(st.lists(st.sampled_from([-1.0, 0.0, 0.5, 2.0]), min_size=1, max_size=30), st.data())
def test_the_least_are_those_that_an_ascending_order_begins_with(scores, data):
    score = np.array(scores)
    count = data.draw(st.integers(0, len(score)))
    assert np.array_equal(np.flatnonzero(least(score, count)), np.sort(ascending(score)[:count]))
