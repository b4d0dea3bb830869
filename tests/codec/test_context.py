"""Context coder: any integers come back; contexts pay; nothing in a section is trusted."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from potr_cl.codec.context import encoder
from potr_cl.codec.context.decoder import Reader
from potr_cl.codec.context.encoder import Batches, Streams
from potr_cl.codec.context.lanes import Lanes
from potr_cl.codec.context.model import Sizes
from potr_cl.errors import DataError


def read(stored, splats, streams, signed, predicted, history=None):
    return [s.values for s in Reader(memoryview(stored), splats, streams, signed, predicted, history, "test")]


def encode(streams, signed, predicted):
    (stored,) = encoder.encode([[Streams(streams, signed, predicted)]])
    return stored and stored[0]


def check(streams, signed, predicted):
    stored = encode(streams, signed, predicted)
    back = read(stored, len(streams[0]), len(streams), signed, predicted)
    for before, after in zip(streams, back, strict=True):
        assert (before == after).all()
    return stored


@settings(max_examples=30, deadline=None)
@given(st.data(), st.integers(1, 700), st.integers(1, 7), st.booleans(), st.booleans())
def test_any_integers(data, splats, count, signed, predicted):
    signed = signed or predicted
    top = data.draw(st.sampled_from([0, 1, 3, 127, 128, 130, 1000, 2**20, 2**34]))
    elements = st.integers(-top if signed else 0, top)
    check([data.draw(hnp.arrays(np.int64, splats, elements=elements)) for _ in range(count)], signed, predicted)


@pytest.mark.parametrize("splats", [1, 2, 255, 256, 257, 511, 1000, 2048])
def test_any_number_of_splats(splats):
    rng = np.random.default_rng(splats)
    check([rng.geometric(0.3, splats) for _ in range(3)], signed=False, predicted=False)


def test_lanes_hold_every_splat_once():
    for splats in (1, 5, 256, 300, 1023, 70000):
        lanes = Lanes(splats)
        values = np.arange(1, splats + 1)
        laid = lanes.split(values)
        assert laid.shape == (lanes.steps, lanes.number)
        assert ((laid > 0).sum(axis=1) == lanes.counts).all()
        # Those of a step are the first lanes.
        assert all((row[:count] > 0).all() for row, count in zip(laid, lanes.counts, strict=True))
        assert (lanes.join(laid) == values).all()


def test_what_is_too_large_is_refused():
    assert encode([np.array([2**38])], False, False) is None
    assert encode([np.array([2**37])], True, False) is None
    check([np.array([2**38 - 1])], False, False)


def entropy(values):
    counts = np.unique(values, return_counts=True)[1]
    return float((counts * np.log2(counts.sum() / counts)).sum() / 8)


def test_contexts_pay():
    """Streams whose magnitudes go together take fewer bytes than their entropies one by one."""
    rng = np.random.default_rng(0)
    activity = rng.choice([0.2, 10.0], 40000)
    streams = [np.round(rng.laplace(size=40000) * activity).astype(int) for _ in range(6)]
    # To know which of two it is, is worth a bit for each integer but the first few of a splat.
    saved = sum(map(entropy, streams)) - len(check(streams, signed=True, predicted=False))
    assert saved > 0.5 * 6 * 40000 / 8
    # And so do magnitudes that change slowly along the stream.
    slow = [np.round(rng.laplace(size=40000) * np.exp(2 * np.sin(np.arange(40000) / 500))).astype(int)]
    assert len(check(slow, signed=True, predicted=False)) < 0.93 * entropy(slow[0])


def test_without_anything_in_common_no_more_than_the_entropy():
    rng = np.random.default_rng(1)
    streams = [rng.geometric(0.2, 40000) for _ in range(3)]
    assert len(check(streams, signed=False, predicted=False)) < 1.02 * sum(map(entropy, streams))


def test_prediction_pays_where_values_change_slowly():
    values = np.cumsum(np.random.default_rng(2).integers(-2, 3, 20000))
    assert len(check([values], True, True)) < 0.7 * len(check([values], True, False))


def test_history_of_earlier_sections():
    rng = np.random.default_rng(3)
    activity = rng.exponential(size=30000)
    first, second = ([np.round(rng.laplace(size=30000) * activity).astype(int) for _ in range(3)] for _ in range(2))
    (stored,) = encoder.encode([[Streams(first, signed=True), Streams(second, signed=True)]])
    history = Sizes(Lanes(30000))
    for streams, data in zip((first, second), stored, strict=True):
        assert all((a == b).all() for a, b in zip(streams, read(data, 30000, 3, True, False, history), strict=True))
    assert len(stored[1]) < len(encode(second, True, False))


def test_sections_side_by_side_are_those_alone():
    """Whatever else is coded at the same time, in however many threads and however many lanes at once."""
    rng = np.random.default_rng(6)

    def some(count, splats, top=12):
        return Streams(
            [np.round(rng.laplace(size=splats) * rng.integers(1, top)).astype(int) for _ in range(count)], True
        )

    for splats in (1, 700, 3000):
        chains = [[some(9, splats), some(3, splats)], [some(1, splats)], [some(3, splats, 300)], []]
        alone = [encoder.encode([chain])[0] for chain in chains]
        assert encoder.encode(chains) == alone
        with ThreadPoolExecutor(3) as pool:
            assert encoder.encode(chains, pool.map) == alone
        # One that cannot be coded does not keep the others from it.
        broken = [[some(3, splats), Streams([np.full(splats, 2**40)], True)], *chains]
        assert encoder.encode(broken) == [None, *alone]


def test_many_lanes_are_coded_as_few_are():
    rng = np.random.default_rng(7)
    chains = [[Streams([rng.geometric(0.1 + 0.2 * k, 5000) for k in range(3)], False)] for _ in range(2)]
    one_by_one = Batches(sizes=64, working_bytes=0, many_lanes=1)
    assert encoder.encode(chains, batches=one_by_one) == encoder.encode(chains)


def test_same_bytes_every_time():
    streams = [np.random.default_rng(4).geometric(0.3, 3000) for _ in range(3)]
    assert check(streams, False, False) == check([s.astype(np.int16) for s in streams], False, False)


def test_damage_never_passes_for_something_else():
    """Every changed byte is found, or changes integers; nothing but DataError is raised."""
    rng = np.random.default_rng(5)
    streams = [rng.geometric(0.1, 200) * (rng.random(200) < 0.9) for _ in range(3)]
    streams[1][5] = 5000  # has bits beside its token
    stored = check(streams, False, False)
    for cut in (0, 4, 7, 20, len(stored) // 2, len(stored) - 1):
        with pytest.raises(DataError):
            read(stored[:cut], 200, 3, False, False)
    with pytest.raises(DataError):
        read(stored + b"\0", 200, 3, False, False)
    found = 0
    for at in range(len(stored)):
        changed = bytearray(stored)
        changed[at] ^= 1 << rng.integers(8)
        try:
            back = read(bytes(changed), 200, 3, False, False)
        except DataError:
            found += 1
        else:
            assert all(len(stream) == 200 for stream in back)
    assert found > 0.9 * len(stored)
