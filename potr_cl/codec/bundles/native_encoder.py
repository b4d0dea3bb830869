"""The encoder of coder BUNDLES by the native path: :func:`encode_natively` gives the same bytes as NumPy.

Threads share the bundles out three times: for what weights are fitted to, for what contexts are made of, and to code.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.bundles.description import Fitted
from potr_cl.codec.bundles.fitting import log_table, samples_of_bundle, solve
from potr_cl.codec.bundles.layout import Bundles
from potr_cl.codec.bundles.model import Model
from potr_cl.codec.bundles.rans import TOTAL
from potr_cl.codec.bundles.sections import MAIN, ORDER, ROTATION, stored_section
from potr_cl.codec.bundles.streams import Stream, streams_of
from potr_cl.codec.bundles.tokens import tokens_of
from potr_cl.codec.native.bundles import fits
from potr_cl.codec.native.bundles_encode import BundleEncoder
from potr_cl.codec.native.bundles_encode import Model as NativeModel
from potr_cl.codec.native.functions import Functions
from potr_cl.codec.sections import Property
from potr_cl.host.threads import Run

I32 = NDArray[np.int32]
I64 = NDArray[np.int64]

#: Names of the sections of an item a splat.
_DENSE = {"opacity": MAIN[0], "scales": MAIN[1], "dc": MAIN[2], "rotations": ROTATION}
#: Of a stream without an item.
_NOTHING = NativeModel(np.zeros(256, np.uint8), np.full((1, 1), TOTAL, np.uint16))


def encode_natively(
    functions: Functions,
    values: Mapping[Property, Sequence[NDArray[np.integer]]],
    classes: NDArray[np.int8],
    known: frozenset[Property],
    run: Run,
) -> Any:
    """:func:`potr_cl.codec.bundles.encoder.coded`, of integers that :func:`narrow` lets through."""
    if not isinstance(values, Narrow):
        return NotImplemented
    bundles = Bundles(len(values[MAIN[0]][0]))
    # Asked for once: threads that ask for the first time side by side get each their own.
    of_section = [streams_of(key) for key in ORDER]
    streams = [stream for own in of_section for stream in own]
    without = [
        Fitted.without(stream) if key in known else None
        for key, own in zip(ORDER, of_section, strict=True)
        for stream in own
    ]
    first_of_section = np.cumsum([0, *map(len, of_section)]).tolist()
    of_degrees = [(3 * key.degree**2, section) for key, section in values.items() if key.degree]
    encoder = functions.bundle_encoder(
        bundles.splats,
        {name: values[key] for name, key in _DENSE.items() if key in values},
        {index - 3 + k: stream for index, section in of_degrees for k, stream in enumerate(section)},
        [stream.sizes for stream in streams],
        [len(stream.terms) for stream in streams],
        [stream.coefficients for stream in streams],
        np.ascontiguousarray(classes),
    )
    at_least = samples_of_bundle(bundles.number)
    deque(run(lambda bundle: encoder.survey(bundle, at_least), range(bundles.number)), 0)
    numbers = [
        _solved(stream, gram) if own is None else own.numbers
        for stream, gram, own in zip(streams, encoder.grams(), without, strict=True)
    ]
    encoder.take_numbers([some.tolist() for some in numbers])
    deque(run(encoder.count, range(bundles.number)), 0)
    alphabets = tokens_of(encoder.largest().astype(np.int64)).astype(int) + 1
    jobs = enumerate(alphabets.tolist())
    found = run(lambda job: _fitted_model(encoder, *job), jobs)
    models = [
        model if own is None else NativeModel(own.classes, own.frequencies.astype(np.uint16))
        for model, own in zip(found, without, strict=True)
    ]
    encoder.take_models(models)
    coded = list(run(encoder.code, range(bundles.number)))
    fitted = [
        own or Fitted(stream, some, Model(model.classes, model.frequencies.astype(np.int64)))
        for stream, some, model, own in zip(streams, numbers, models, without, strict=True)
    ]
    states = {
        MAIN[0]: [bundle.states for bundle in coded],
        ROTATION: [bundle.rotation_states for bundle in coded],
    }

    def section(number: int) -> bytes:
        key = ORDER[number]
        own = fitted[first_of_section[number] : first_of_section[number + 1]]
        first = None
        if key in states:
            first = np.concatenate([part[:lanes] for part, lanes in zip(states[key], bundles.lanes, strict=True)])
        words = [bundle.words[number] for bundle in coded]
        return stored_section(own, first, np.array([len(part) for part in words]), np.concatenate(words))

    numbers_of = [number for number, key in enumerate(ORDER) if key in values]
    return dict(zip([ORDER[number] for number in numbers_of], run(section, numbers_of), strict=True))


class Narrow(dict[Property, list[I32]]):
    """Integers that the native path takes."""


def narrow(values: Mapping[Property, Sequence[NDArray[np.integer]]], run: Run = map) -> Narrow | None:
    """The integers as the native path takes them; None if one is too large for it."""

    def narrowed(stream: NDArray[np.integer]) -> I32 | None:
        # Mapped to unsigned an integer has another bit.
        if not fits(2 * max(int(stream.max()), -int(stream.min())) + 1):
            return None
        return np.ascontiguousarray(stream, np.int32)

    made = iter(list(run(narrowed, [stream for streams in values.values() for stream in streams])))
    found = {key: [next(made) for _ in streams] for key, streams in values.items()}
    arrays = Narrow({key: [stream for stream in streams if stream is not None] for key, streams in found.items()})
    return arrays if all(len(arrays[key]) == len(values[key]) for key in values) else None


def _solved(stream: Stream, gram: I64) -> I64:
    constant = len(stream.terms) + 1
    if not gram[constant, constant]:
        return np.zeros(stream.weights, np.int64)
    used = range(stream.weights + 1)
    return solve(gram[np.ix_(used, used)])


def _fitted_model(encoder: BundleEncoder, number: int, alphabet: int) -> NativeModel:
    counts = encoder.counts(number, alphabet)
    return encoder.contexts(counts, alphabet, log_table()) if counts.any() else _NOTHING
