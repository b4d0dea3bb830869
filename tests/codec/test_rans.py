"""Interleaved range coder: what goes in comes out, at the length that theory gives; damage is found."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from potr_cl.codec import rans
from potr_cl.errors import DataError


def as_tokens(tokens, contexts, frequencies):
    """Of one stream, (steps, lanes)."""
    cells = (contexts * frequencies.shape[1] + tokens).astype(np.uint16)
    return rans.Tokens([cells], [0], [frequencies], [np.arange(len(frequencies))])


def coded(tokens, contexts, frequencies):
    """(steps, lanes) tokens to states and words."""
    return rans.encode([as_tokens(tokens, contexts, frequencies)])[0]


def decoded(states, words, contexts, frequencies):
    decoder = rans.Decoder(states, words, "test")
    table = rans.Table.of(frequencies, np.zeros(256, np.int64))
    known = (contexts << rans.CONTEXT_SHIFT).__getitem__
    lanes = np.full(len(contexts), contexts.shape[1])
    tokens = decoder.stream(table, np.arange(len(frequencies)) * rans.TOTAL, known, 0, 0, lanes)
    decoder.finish()
    return tokens


def sample(steps, lanes, alphabet, contexts, seed):
    rng = np.random.default_rng(seed)
    chances = rng.dirichlet(np.full(alphabet, 0.3), contexts)
    context = rng.integers(0, contexts, (steps, lanes))
    tokens = np.stack([[rng.choice(alphabet, p=chances[c]) for c in row] for row in context])
    counts = np.zeros((contexts, alphabet), np.int64)
    np.add.at(counts, (context.ravel(), tokens.ravel()), 1)
    counts[counts.sum(axis=1) == 0, 0] = 1
    return tokens, context, np.array([rans.normalise(c) for c in counts])


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 30), st.integers(1, 20), st.integers(1, 40), st.integers(1, 5), st.integers(0, 1000))
def test_roundtrip(steps, lanes, alphabet, contexts, seed):
    tokens, context, frequencies = sample(steps, lanes, alphabet, contexts, seed)
    states, words = coded(tokens, context, frequencies)
    assert (decoded(states, words, context, frequencies) == tokens).all()


def test_length_is_that_of_the_entropy():
    tokens, context, frequencies = sample(2000, 16, 20, 3, seed=1)
    _, words = coded(tokens, context, frequencies)
    ideal = -np.log2(frequencies[context, tokens] / rans.TOTAL).sum() / 8
    assert abs(len(words) - ideal) < 2 * 16 + 0.002 * ideal


@given(st.lists(st.integers(0, 10**9), min_size=1, max_size=256).filter(any))
def test_frequencies_add_up_and_keep_every_token(counts):
    counts = np.array(counts, np.int64)
    frequencies = rans.normalise(counts)
    assert frequencies.sum() == rans.TOTAL
    assert ((frequencies > 0) == (counts > 0)).all()


def one_by_one(streams):
    """The textbook's coder, integer by integer: (tokens, contexts, frequencies) of each stream."""
    states, words = [rans.LOWEST] * streams[0][0].shape[1], []
    for tokens, contexts, frequencies in reversed(streams):
        starts = np.cumsum(frequencies, axis=1) - frequencies
        for step in reversed(range(len(tokens))):
            for lane in reversed(range(len(states))):
                cell = contexts[step, lane], tokens[step, lane]
                f, state = int(frequencies[cell]), states[lane]
                if state >= f << 20:
                    words.append(state & 0xFFFF)
                    state >>= 16
                states[lane] = state // f * rans.TOTAL + state % f + int(starts[cell])
    return states, np.array(words[::-1], "<u2").tobytes()


@pytest.mark.parametrize("lanes", [1, 3, 20])
def test_as_the_textbook_does(lanes):
    """Bit for bit, several sections of several streams at once, with frequencies from 1 to all."""
    sections = []
    for seed, count in ((1, 3), (2, 1), (3, 2)):
        streams = [sample(25, lanes, 12, 3, seed=10 * seed + k) for k in range(count)]
        sections.append(streams)
    certain = np.array([[rans.TOTAL, 0]]), np.zeros((25, lanes), int)
    sections.append([(certain[1], certain[1], certain[0])])
    rare = np.array([[1, rans.TOTAL - 1]])
    sections.append([((np.arange(25 * lanes).reshape(25, lanes) % 7 > 2).astype(int), certain[1], rare)])
    joined = [
        rans.Tokens(
            [as_tokens(*stream).cells[0] for stream in streams],
            list(range(len(streams))),
            [frequencies for _, _, frequencies in streams],
            [np.arange(len(frequencies)) for _, _, frequencies in streams],
        )
        for streams in sections
    ]
    for streams, (states, words) in zip(sections, rans.encode(joined), strict=True):
        wanted, wanted_words = one_by_one(streams)
        assert states.tolist() == wanted
        assert words == wanted_words


def test_lanes_without_a_token_rest():
    tokens, contexts, frequencies = sample(30, 4, 9, 2, seed=5)
    idle = as_tokens(tokens, contexts, frequencies)
    idle.cells[0][:, 2] = frequencies.size
    states, words = rans.encode([idle])[0]
    left = [0, 1, 3]
    wanted, wanted_words = coded(tokens[:, left], contexts[:, left], frequencies)
    assert states[left].tolist() == wanted.tolist()
    assert states[2] == rans.LOWEST
    assert words == wanted_words


def test_damage_is_found():
    tokens, context, frequencies = sample(50, 8, 20, 2, seed=2)
    states, words = coded(tokens, context, frequencies)
    with pytest.raises(DataError, match="too early"):
        decoded(states, words[:-2], context, frequencies)
    with pytest.raises(DataError, match="does not end"):
        decoded(states, words + b"\0\0", context, frequencies)
    changed = states.copy()
    changed[3] ^= 1
    with pytest.raises(DataError):
        decoded(changed, words, context, frequencies)
