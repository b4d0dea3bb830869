"""Coder BUNDLES: integers come back, by NumPy and by the native path alike, and damage is found."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from potr_cl.codec.bundles import encoder
from potr_cl.codec.bundles.decoder import Reader, Wanted
from potr_cl.codec.bundles.description import known_model
from potr_cl.codec.bundles.sections import MAIN, ORDER, ROTATION
from potr_cl.codec.bundles.streams import SIZES as TOKEN_SIZES
from potr_cl.codec.bundles.streams import TOTAL, normalise
from potr_cl.codec.decoder import open_file
from potr_cl.codec.encoder import code_scene
from potr_cl.codec.quantize import HyperParameters
from potr_cl.codec.sections import SH, Coder, Property
from potr_cl.codec.steps.rule import KNOTS, ColourSteps
from potr_cl.errors import DataError
from potr_cl.native.library import VARIABLE, VECTORS_VARIABLE, native

DEGREES = {prop: prop.streams for prop in SH[1:]}
#: Around where bundles and lanes begin and end.
SIZES = (1, 2, 255, 256, 257, 300, 7937, 8191, 8192, 8193, 8448, 16385)
NEEDS_LIBRARY = pytest.mark.skipif(native() is None, reason="the compiled library is not there")


@pytest.fixture
def paths(monkeypatch) -> Callable[[], Iterator[None]]:
    """Goes through the ways to decode, each chosen by the environment: NumPy, native with wide vectors and without."""

    def chosen() -> Iterator[None]:
        for way, vectors in (("0", "1"), *([("1", "1"), ("1", "0")] if native() else [])):
            with monkeypatch.context() as patch:
                patch.setenv(VARIABLE, way)
                patch.setenv(VECTORS_VARIABLE, vectors)
                yield

    return chosen


def integers(splats: int, seed: int = 1, density: float = 0.1, spread: int = 20) -> dict:
    """Integers of a file of all sections: neighbours alike, most AC coefficients 0."""
    rng = np.random.default_rng(seed)
    size = np.repeat(rng.integers(1, spread + 1, splats // 50 + 1), 50)[:splats]

    def some(signed=False):
        values = rng.geometric(1 / (1 + size)) - 1
        return values * rng.choice((-1, 1), splats) if signed else values

    values = {
        MAIN[0]: [some()],
        MAIN[1]: [some() for _ in range(3)],
        MAIN[2]: [some(True) for _ in range(3)],
        ROTATION: [some(True) for _ in range(3)],
    }
    for index, streams in DEGREES.items():
        values[index] = [some(True) * (rng.random(splats) < density) for _ in range(streams)]
    return values


def steps_of(splats: int) -> ColourSteps:
    groups = np.random.default_rng(5).integers(-3, 4, -(-splats // 16)).astype(np.int8)
    return ColourSteps(4, 1, 1, (8, 5), (20, -300), (188, -86, 55), tuple(range(-160, -160 + 20 * KNOTS, 20)), groups)


def classes_of(values: dict, steps: ColourSteps | None) -> np.ndarray:
    splats = len(values[MAIN[0]][0])
    nothing = [np.zeros(splats, np.int64)] * 3
    if steps is None:
        return np.zeros(splats, np.int8)
    return steps.classes(values.get(MAIN[1], nothing), values[MAIN[0]][0])[0]


def reader_of(stored: dict, splats: int, steps: ColourSteps | None = None) -> Reader:
    def opened(key):
        return (memoryview(stored[key]), key.title) if key in stored else None

    return Reader(splats, opened, lambda: steps)


def assert_same(values: dict, levels) -> None:
    splats = levels.stop - levels.start
    none = [np.zeros(splats, np.int64)] * 3
    assert np.array_equal(levels.opacities, values[MAIN[0]][0])
    for key, found in ((MAIN[1], levels.scales), (MAIN[2], levels.dc), (ROTATION, levels.rotations)):
        assert all(np.array_equal(a, b) for a, b in zip(values.get(key, none), found, strict=True))
    for index, streams in DEGREES.items():
        for k in range(streams):
            m, c = divmod(3 * index.degree**2 + k, 3)
            there = index in values
            wanted = values[index][k] if there else none[0]
            assert np.array_equal(levels.coefficient(m)[c], wanted)


def check_comes_back(paths, values: dict, steps: ColourSteps | None = None) -> dict:
    """By every path; returns what is stored, which is the same by all (test_table.py)."""
    splats = len(values[MAIN[0]][0])
    stored = encoder.encode(values, classes_of(values, steps))
    for _ in paths():
        reader = reader_of(stored, splats, steps)
        assert_same(values, reader.levels(0, reader.bundles.number))
    return stored


@pytest.mark.parametrize(("splats", "adapted"), [(splats, number % 2 == 0) for number, splats in enumerate(SIZES)])
def test_integers_come_back(paths, splats, adapted):
    """A section begins with the size of its description, which is nothing where it does not pay."""
    stored = check_comes_back(paths, integers(splats, splats), steps_of(splats) if adapted else None)
    assert splats > 300 or stored[MAIN[0]][:4] == bytes(4)
    assert splats > 1 or sum(map(len, stored.values())) < 160


@pytest.mark.parametrize("largest", [128, (1 << 29) - 1, 1 << 29, (1 << 37) - 1])
def test_large_integers_come_back(paths, largest):
    """Those that one path leaves to the other too."""
    values = integers(300)
    rng = np.random.default_rng(2)
    for key, streams in values.items():
        for stream in streams:
            where = rng.integers(0, 300, 9)
            stream[where] = rng.integers(largest // 2, largest + 1, 9)
            if key not in MAIN[:2]:
                stream[where[:4]] *= -1
    check_comes_back(paths, values)
    values[ROTATION][1][7] = -(1 << 37) - 1
    for _ in paths():
        assert encoder.encode(values, np.zeros(300, np.int8)) is None  # left to others


@pytest.mark.parametrize("left", [{0}, {0, 1}, {0, 6}, {0, 3}, {0, 2, 4}, {0, 1, 2, 3, 4, 6}])
def test_sections_may_be_absent(paths, left):
    values = integers(300)
    values = {key: values[key] for number, key in enumerate(ORDER) if number in left}
    assert check_comes_back(paths, values, steps_of(300)).keys() == values.keys()


@pytest.mark.parametrize("density", [0.0, 0.001, 1.0])
def test_channels_without_a_value_and_full_ones(paths, density):
    values = integers(300, density=density)
    values[Property.SH2][4][:] = 0
    values[Property.SH2][4][77] = 3
    check_comes_back(paths, values)


@NEEDS_LIBRARY
def test_streams_that_several_threads_ask_for_first(monkeypatch):
    """Each may get its own, as where blocks are coded side by side; the bytes are the same."""
    values = integers(400, spread=200)
    classes = classes_of(values, steps_of(400))
    expected = encoder.encode(values, classes)
    monkeypatch.setattr(encoder, "streams_of", encoder.streams_of.__wrapped__)
    assert encoder.encode(values, classes) == expected


def test_a_part_of_the_bundles_and_of_the_sections(paths):
    """Bundles need no other, and chains are read as far as one likes: what is behind is not opened."""
    splats = 2 * 8192 + 100
    values = integers(splats, spread=5)
    stored = encoder.encode(values, np.zeros(splats, np.int8))
    del stored[ROTATION], stored[MAIN[4]], stored[MAIN[5]]
    own = slice(8192, splats)
    for _ in paths():
        levels = reader_of(stored, splats).levels(1, 3, Wanted(4, False))
        assert np.array_equal(levels.opacities, values[MAIN[0]][0][own])
        assert np.array_equal(levels.dc[2], values[MAIN[2]][2][own])
        assert levels.rotations is None
        assert np.array_equal(levels.coefficient(2)[1], values[MAIN[3]][4][own])


def test_it_is_small():
    """Not far above the entropy of what it codes: 7.0 bits of a token of 128 equally likely values, and next to nothing
    for streams of zeros."""
    rng = np.random.default_rng(1)
    splats = 1 << 15
    values = integers(splats, density=0)
    values[MAIN[0]] = [rng.integers(0, 128, splats)]
    values[MAIN[1]] = [np.zeros(splats, np.int64), np.full(splats, 5), np.zeros(splats, np.int64)]
    stored = encoder.encode(values, np.zeros(splats, np.int8))
    assert len(stored[MAIN[0]]) < 1.03 * 7 / 8 * splats
    assert len(stored[MAIN[1]]) < 200
    assert sum(len(stored[index]) for index in DEGREES) < 600


# What decoders know ---------------------------------------------------------------------------------------------------


@given(hnp.arrays(np.int64, st.integers(1, 252), elements=st.integers(0, 10**9)))
def test_frequencies_add_up(counts):
    counts[0] += 1
    frequencies = normalise(counts)
    assert frequencies.sum() == TOTAL
    assert ((frequencies > 0) == (counts > 0)).all()


@pytest.mark.parametrize("tokens", [8, 32, 128, 216])
def test_models_that_decoders_know(tokens):
    model = known_model(tokens)
    assert (model.frequencies.sum(axis=1) == TOTAL).all()
    assert (model.frequencies > 0).all()
    assert model.classes.tolist() == [size // 8 for size in range(256)]
    # Larger ones are expected where larger ones were.
    means = (model.frequencies * np.arange(tokens)).sum(axis=1)
    assert (np.diff(means) >= 0).all()


def test_sizes_of_tokens_are_exact():
    """⌊16 log2(1 + m) + ½⌋ by whole numbers: (1 + m)³² lies between 2^(2k − 1) and 2^(2k + 1)."""
    for signed, sizes in TOKEN_SIZES.items():
        for token, size in enumerate(sizes.tolist()):
            least = token if token < 128 else (4 + token % 4) << (5 + (token - 128) // 4)
            power = (1 + ((least + 1) // 2 if signed else least)) ** 32
            assert 1 << max(2 * size - 1, 0) <= power < 1 << (2 * size + 1)


# Damage ---------------------------------------------------------------------------------------------------------------


def outcome(stored: dict, splats: int, steps: ColourSteps | None):
    """What a path makes of sections: their levels, or that they are damaged."""
    try:
        reader = reader_of(stored, splats, steps)
        levels = reader.levels(0, reader.bundles.number)
    except DataError:
        return None
    rows = [levels.opacities, *levels.scales, *levels.rotations, *levels.dc]
    rows += [channel for m in range(1, 16) for channel in levels.coefficient(m)]
    return np.array([row.astype(np.int64) for row in rows])


@pytest.fixture(scope="module")
def small():
    values = integers(400, spread=200)
    steps = steps_of(400)
    return encoder.encode(values, classes_of(values, steps)), steps


def with_parts(section: bytes, first: bool, change: Callable[[bytes, int, bytes], tuple[bytes, int, bytes]]) -> bytes:
    """A section of a file of one bundle whose states, count of words, and words are changed."""
    at = 4 + struct.unpack_from("<I", section)[0]
    end = at + (4 * 2 if first else 0)
    states, count, words = change(section[at:end], struct.unpack_from("<I", section, end)[0], section[end + 4 :])
    return section[:at] + states + struct.pack("<I", count) + words


DAMAGE = {
    "a word less": lambda states, count, words: (states, count - 1, words[:-2]),
    "a word more": lambda states, count, words: (states, count + 1, words + b"\0\0"),
    "a count less": lambda states, count, words: (states, count - 1, words),
    "a count more": lambda states, count, words: (states, count + 1, words),
    "a state too low": lambda states, count, words: (struct.pack("<I", 0xFFFF) + states[4:], count, words),
    "a start that ends elsewhere": lambda states, *rest: (states[:2] + bytes([states[2] ^ 0x10]) + states[3:], *rest),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_words_and_states_that_no_encoder_leaves_are_refused(paths, small, damage):
    stored, steps = small
    with_states = (MAIN[0], ROTATION)
    for key in with_states if "state" in damage or "start" in damage else (*with_states, MAIN[1], MAIN[2], MAIN[-1]):
        damaged = {**stored, key: with_parts(stored[key], key in with_states, DAMAGE[damage])}
        for _ in paths():
            assert outcome(damaged, 400, steps) is None


# Files ----------------------------------------------------------------------------------------------------------------


@NEEDS_LIBRARY
def test_levels_beyond_what_is_looked_up(monkeypatch, plush_excerpt):
    """Scales and opacities of so many steps that the native path leaves some values to NumPy."""
    parameters = HyperParameters.from_quality(0.5, "best", sf_scale=1e5, sf_opacity=1e4)
    file = open_file(b"".join(code_scene(plush_excerpt.subset(np.arange(300)), parameters).pieces))
    assert file.blocks[0].coder == Coder.BUNDLES
    scenes = []
    for way in "01":
        monkeypatch.setenv(VARIABLE, way)
        scenes.append(file.scene(1))
    for name in ("log_scales", "quaternions", "opacity_logits", "sh"):
        assert np.array_equal(getattr(scenes[0], name), getattr(scenes[1], name))
    assert np.exp(scenes[0].log_scales.max()) * file.blocks[0].sf_scale > 1 << 16
