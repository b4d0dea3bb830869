"""Changes of totals, packed and unpacked."""

from __future__ import annotations

import numpy as np
import pytest

from potr_cl.stages.pruning.changes import pack_changes, unpack_changes


def test_changes_come_back_as_they_went():
    rng = np.random.default_rng(1)
    splats = np.flatnonzero(rng.random(100_000) < 0.3)
    changes = rng.integers(-(1 << 40), 1 << 40, (len(splats), 2))
    changes[:5] = [[0, 0], [-1, 1], [np.iinfo(np.int64).min, np.iinfo(np.int64).max], [1 << 62, -(1 << 62)], [0, -5]]
    back, same = unpack_changes(pack_changes(splats, changes))
    assert np.array_equal(back, splats)
    assert np.array_equal(same, changes)
    nothing, _ = unpack_changes(pack_changes(splats[:0], changes[:0]))
    assert len(nothing) == 0


def test_damaged_changes_are_refused():
    data = pack_changes(np.arange(100), np.ones((100, 2), np.int64))
    huge = (1 << 60).to_bytes(8, "little") + data[8:]
    for damaged in (b"", data[:5], data[:-3], huge, data[:8] + b"\xff\xff\xff" + data[11:]):
        with pytest.raises(ValueError, match="damaged"):
            unpack_changes(damaged)
