"""Interleaved range coder: what goes in comes out, at the length that theory gives; damage is found."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from potr_cl import rans
from potr_cl.errors import DataError


def coded(tokens, contexts, frequencies):
    """(steps, lanes) tokens to states and words."""
    encoder = rans.Encoder(tokens.shape[1])
    starts = np.cumsum(frequencies, axis=1) - frequencies
    for t in range(len(tokens) - 1, -1, -1):
        encoder.step(frequencies[contexts[t], tokens[t]], starts[contexts[t], tokens[t]])
    return encoder.states, encoder.words()


def decoded(states, words, contexts, frequencies):
    decoder = rans.Decoder(states.copy(), words, "test")
    table = rans.decoding_table(frequencies)
    out = np.zeros(contexts.shape, np.uint8)
    for t in range(len(out)):
        decoder.step(table, contexts[t] * rans.TOTAL, out[t])
    decoder.finish()
    return out


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
