"""The encoder of coder BUNDLES: :func:`encode`, from a file's integers to the stored bytes of its sections.

By the native path threads share the bundles out three times: for what weights are fitted to, for what contexts are made
of, and to code.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.bundles.description import Fitted, Model
from potr_cl.codec.bundles.fitting import (
    expected_sizes,
    fit_model,
    log_table,
    products,
    recent_sizes,
    samples,
    samples_of_bundle,
    solve,
)
from potr_cl.codec.bundles.layout import LANES, Bundles, Layout
from potr_cl.codec.bundles.ranges import Tokens, encode_section
from potr_cl.codec.bundles.sections import MAIN, ORDER, ROTATION, stored_section
from potr_cl.codec.bundles.streams import (
    LOWEST,
    MOST_BITS,
    TOTAL,
    Stream,
    band,
    differences,
    step_terms,
    streams_of,
    tokens_of,
)
from potr_cl.codec.native.bundles_encode import BundleEncoder
from potr_cl.codec.sections import Property
from potr_cl.host.threads import Run
from potr_cl.native.declarations import CFunctions, fits
from potr_cl.native.table import definition

I64 = NDArray[np.int64]
Values = Sequence[NDArray[np.integer]]

#: Of fewer splats, models may weigh more than they save.
_FEW = 1 << 15


def encode(
    values: Mapping[Property, Values], classes: NDArray[np.int8], run: Run = map
) -> dict[Property, bytes] | None:
    """Code all integers of splats that a file holds.

    Args:
        values: of each section its integers, (n,) each; the opacity's at least. Sections whose integers are all 0 may
            be left out. Of DC what its prediction has left.
        classes: (n,) of the steps of DC.
        run: in place of :func:`map`, to work with several threads.

    Returns:
        The stored bytes of each section; None if an integer is too large.
    """
    narrowed = narrow(values, run)
    arrays = narrowed or values
    fitted = coded(arrays, classes, frozenset(), run)
    if fitted is None or narrowed is None or len(classes) >= _FEW:
        return fitted
    # What is fitted to few splats may weigh more than it saves.
    without = coded(arrays, classes, frozenset(values), run)
    assert without is not None
    return coded(arrays, classes, frozenset(key for key in values if len(without[key]) < len(fitted[key])), run)


@definition
def coded(
    values: Mapping[Property, Values], classes: NDArray[np.int8], known: frozenset[Property], run: Run
) -> dict[Property, bytes] | None:
    """:func:`encode` with some sections by models that decoders know."""
    drafts = _Drafts(Bundles(len(classes)), classes, known)
    keys = [key for key in ORDER if key in values]
    sections: dict[Property, list[Tokens]] = {}
    for key in keys:
        made = drafts.section(key, values[key])
        if made is None:
            return None
        sections[key] = made
    stored: dict[Property, bytes] = {}
    lanes = (np.arange(LANES) < drafts.bundles.lanes[:, None]).ravel()
    for chain in (MAIN, (ROTATION,)):
        states = np.full(LANES * drafts.bundles.number, LOWEST, np.int64)
        for key in reversed([key for key in chain if key in sections]):
            counts, words = encode_section(sections[key], states)
            first = states[lanes] if key == chain[0] else None
            stored[key] = stored_section([tokens.fitted for tokens in sections[key]], first, counts, words)
    return stored


class _Drafts:
    """Sections on their way to bytes: what was coded before tells the contexts of the next.

    Args:
        bundles: of the file.
        classes: (n,) of the steps of DC.
        known: sections whose models decoders know.
    """

    def __init__(self, bundles: Bundles, classes: NDArray[np.int8], known: frozenset[Property]) -> None:
        self.bundles, self._known, self._without = bundles, known, False
        self._terms: dict[str, I64] = {"step": step_terms(classes)}

    def section(self, key: Property, values: Values) -> list[Tokens] | None:
        """A section's streams; None if an integer is too large."""
        streams, self._without = streams_of(key), key in self._known
        if (key.degree or 0) > 0:
            return self._band(streams, key, values)
        if key is Property.ROTATION:
            scales = [self._term(f"scale {axis}") for axis in range(3)]
            self._terms.update({f"difference {k}": each for k, each in enumerate(differences(scales))})
        layout = self.bundles.dense
        made = []
        for stream, integers in zip(streams, values, strict=True):
            wide = integers.astype(np.int64)
            tokens = self._stream(stream, layout, _mapped(wide) if key.signed else wide, self._terms)
            if tokens is None:
                return None
            made.append(tokens)
        return made

    def _term(self, name: str) -> I64:
        """(n,) a term of a stream of an item a splat: 0 where its section is left out."""
        return self._terms.setdefault(name, np.zeros(self.bundles.splats, np.int64))

    def _band(self, streams: Sequence[Stream], key: Property, values: Values) -> list[Tokens] | None:
        """The streams of the AC coefficients of a degree."""
        first, end = band(key)
        channels = np.array(values).reshape(end - first, 3, -1)
        there = channels.any(axis=1)
        mask, pattern, *of_channels = streams
        masks = (there << np.arange(end - first)[:, None]).sum(axis=0)
        made = [self._stream(mask, self.bundles.dense, masks, self._terms)]
        splat, which = np.nonzero(there.T)
        items = channels[which, :, splat].T.astype(np.int64)
        at_items = {name: self._term(name)[splat] for name in (*(f"sum {c}" for c in range(3)), "mask", "step")}
        patterns = ((items != 0) << np.arange(3)[:, None]).sum(axis=0)
        made.append(self._stream(pattern, self.bundles.items(splat), patterns, at_items, which))
        sizes = [np.zeros(len(splat), np.int64) for _ in range(3)]
        for c, stream in enumerate(of_channels):
            (has,) = np.nonzero(items[c])
            at_values = {name: term[has] for name, term in at_items.items()}
            at_values.update({f"value {b}": sizes[b][has] for b in range(c)})
            mapped = _mapped(items[c, has]) - 1
            made.append(self._stream(stream, self.bundles.items(splat[has]), mapped, at_values, which[has]))
            if made[-1] is not None:
                sizes[c][has] = at_values[stream.name]
        for c in range(3):
            added = np.bincount(splat, weights=sizes[c], minlength=self.bundles.splats)
            self._terms[f"sum {c}"] = self._term(f"sum {c}") + added.astype(np.int64)
        whole = [tokens for tokens in made if tokens is not None]
        return whole if len(whole) == len(made) else None

    def _stream(
        self, stream: Stream, layout: Layout, mapped: I64, terms: dict[str, I64], which: I64 | None = None
    ) -> Tokens | None:
        """A stream of integers, mapped to unsigned; the sizes of its tokens become a term."""
        if int(mapped.max(initial=0)) >> MOST_BITS or int(mapped.min(initial=0)) < 0:
            return None
        tokens = tokens_of(mapped)
        sizes = stream.sizes.take(tokens).astype(np.int64)
        missing = [name for name in stream.terms if name not in terms]
        terms.update({name: np.zeros(len(tokens), np.int64) for name in missing})
        columns = [*(terms[name] for name in stream.terms), recent_sizes(layout, sizes)]
        terms[stream.name] = sizes
        if self._without:
            fitted = Fitted.without(stream)
            known = expected_sizes(columns, which, fitted.numbers) * fitted.alphabet + tokens
            return Tokens(layout, known.astype(np.uint16), mapped, fitted)
        alphabet = int(tokens.max(initial=0)) + 1
        if not len(tokens):
            tokens, columns, which = np.zeros(1, np.uint8), [np.zeros(1, np.int64) for _ in columns], None
            numbers = np.zeros(stream.weights, np.int64)
        else:
            some = samples(layout.counts)
            chosen = None if which is None else which[some]
            numbers = solve(products([c[some] for c in columns], chosen, stream.coefficients, sizes[some]))
        cells = (expected_sizes(columns, which, numbers) * alphabet + tokens).astype(np.uint16)
        fitted = Fitted(stream, numbers, fit_model(cells, alphabet))
        return Tokens(layout, cells[: len(mapped)], mapped, fitted)


def _mapped(values: I64) -> I64:
    """0, −1, 1, −2, … to 0, 1, 2, 3, …"""
    return (values << 1) ^ (values >> 63)


I32 = NDArray[np.int32]

#: Of a stream without an item.
_NOTHING = Model(np.zeros(256, np.uint8), np.full((1, 1), TOTAL))


def encode_natively(
    c: CFunctions,
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
    encoder = BundleEncoder(c, values, streams, np.ascontiguousarray(classes))
    at_least = samples_of_bundle(bundles.number)
    deque(run(lambda bundle: encoder.survey(bundle, at_least), range(bundles.number)), 0)
    numbers = [
        _solved(stream, gram) if own is None else own.numbers
        for stream, gram, own in zip(streams, encoder.grams(), without, strict=True)
    ]
    encoder.take_numbers([some.tolist() for some in numbers])
    deque(run(encoder.count, range(bundles.number)), 0)
    # Each takes so little that threads would wait for each other.
    found = [encoder.model(*job, log_table()) or _NOTHING for job in enumerate(encoder.alphabets)]
    models = [model if own is None else own.model for model, own in zip(found, without, strict=True)]
    encoder.take_models(models)
    coded = list(run(encoder.code, range(bundles.number)))
    fitted = [
        own or Fitted(stream, some, model)
        for stream, some, model, own in zip(streams, numbers, models, without, strict=True)
    ]
    states = {MAIN[0]: [bundle.states for bundle in coded], ROTATION: [bundle.rotation_states for bundle in coded]}

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
        # Mapped to unsigned an integer has another bit. Those of two bytes all fit.
        if stream.dtype.itemsize > 2 and not fits(2 * max(int(stream.max()), -int(stream.min())) + 1):
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
