"""The encoder of sections: :func:`encode`, from streams of integers to a section's stored bytes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec import rans
from potr_cl.codec.context.fitting import cells_of, fit_model, fit_weights, recent_sizes
from potr_cl.codec.context.lanes import Lanes, to_residuals
from potr_cl.codec.context.model import CHANNELS, HEAD, LARGEST_SIZE, write_description
from potr_cl.codec.context.tokens import SIZES, Bits, tokenise
from potr_cl.codec.native.library import native
from potr_cl.host.threads import Run

I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]

#: Splats to which weights are fitted.
_FITTED = 1 << 16
#: Memory that fitting a coefficient takes a splat, bytes.
_COEFFICIENT_BYTES = 48


@dataclass(frozen=True)
class Streams:
    """What one section holds.

    Attributes:
        values: (n,) integers each, n >= 1; not negative if not ``signed``.
        signed: whether they may be negative.
        predicted: store differences from the mean of the splats before.
    """

    values: Sequence[NDArray[np.integer]]
    signed: bool
    predicted: bool = False


@dataclass(frozen=True)
class Batches:
    """How much an encoder works on at a time: it decides time and memory, not the bytes.

    Attributes:
        sizes: of tokens, at a time: few enough for temporaries to stay in a cache.
        working_bytes: memory for coefficients whose weights are fitted at the same time.
        many_lanes: from this many lanes on sections are range coded one by one.
    """

    sizes: int = 1 << 15
    working_bytes: int = 1 << 27
    many_lanes: int = 1 << 11


BATCHES = Batches()


def encode(
    chains: Sequence[Sequence[Streams]],
    run: Run = map,
    progress: Callable[[float], None] | None = None,
    batches: Batches = BATCHES,
) -> list[list[bytes] | None]:
    """Code some sections of a scene.

    Args:
        chains: sections one after another; the sizes of those before tell those of the next. All hold as many splats.
        run: in place of :func:`map`, to work with several threads.
        progress: told which part is done.
        batches: how much is worked on at a time; the bytes do not depend on it.

    Returns:
        The stored bytes of each chain's sections; None for a chain that holds an integer too large.
    """
    report = progress or (lambda done: None)
    drafts = [[_Draft(section) for section in chain] for chain in chains]
    streams = [(draft, s) for chain in drafts for draft in chain for s in range(len(draft.section.values))]
    if not streams:
        return [[] for _ in chains]
    layout = _Layout.of(len(streams[0][0].section.values[0]))
    made = run(lambda job: _tokens_of(job[0].section, job[1], layout), streams)
    for (draft, _), tokens in zip(streams, made, strict=True):
        if tokens is None:
            draft.too_large = True
        else:
            draft.tokens.append(tokens[0])
            draft.beside.append(tokens[1])
            draft.alphabet = max(draft.alphabet, int(tokens[0].max()) + 1)
    coded = [chain for chain in drafts if not any(draft.too_large for draft in chain)]
    report(0.2)
    for draft, weights, cells in _fit_coefficients(coded, layout, run, batches):
        draft.weights.append(weights)
        draft.cells.extend(cells)
    report(0.5)
    sections = [draft for chain in coded for draft in chain]
    finished = list(run(lambda draft: _finish(draft, layout), sections))
    # With few lanes a step's calls of NumPy take longer than its work; with many, what they work on must fit a cache.
    few = layout.lanes.number < batches.many_lanes and native() is None
    parts = [finished] if few and finished else [[each] for each in finished]
    words = [pair for part in run(rans.encode, [[tokens for tokens, _ in part] for part in parts]) for pair in part]
    for draft, (_, head), (states, rest) in zip(sections, finished, words, strict=True):
        draft.stored = b"".join([head, states.astype("<u4").tobytes(), rest])
    report(1.0)
    return [[draft.stored for draft in chain] if chain in coded else None for chain in drafts]


@dataclass(frozen=True)
class _Layout:
    """Where splats are among steps and lanes.

    Attributes:
        idle: flat indices of the lanes in the steps in which they have no splat.
        fitted: of the splats to which weights are fitted.
    """

    lanes: Lanes
    idle: I64
    fitted: I64

    @staticmethod
    def of(splats: int) -> _Layout:
        lanes = Lanes(splats)
        active = (np.arange(lanes.number) < lanes.counts[:, None]).ravel()
        return _Layout(lanes, np.flatnonzero(~active), np.flatnonzero(active)[:: max(1, splats // _FITTED)])


@dataclass(eq=False)
class _Draft:
    """A section on its way to bytes.

    Attributes:
        tokens: of each stream, (steps, lanes), as long as they are needed.
        beside: the bits beside them.
        too_large: whether there is an integer that no token stands for.
        alphabet: one more than the largest token.
        weights: of each coefficient, (channels, terms).
        cells: of each stream, (steps, lanes): expected size · alphabet + token.
    """

    section: Streams
    tokens: list[U8 | None] = field(default_factory=list)
    beside: list[Bits] = field(default_factory=list)
    too_large: bool = False
    alphabet: int = 1
    weights: list[NDArray[np.int16]] = field(default_factory=list)
    cells: list[U16] = field(default_factory=list)
    stored: bytes = b""


def _tokens_of(section: Streams, stream: int, layout: _Layout) -> tuple[U8, Bits] | None:
    values = layout.lanes.split(section.values[stream])
    if section.predicted:
        values = to_residuals(values)
        values.ravel()[layout.idle] = 0
    return tokenise(values, section.signed)


def _fit_coefficients(
    chains: list[list[_Draft]], layout: _Layout, run: Run, batches: Batches
) -> Iterator[tuple[_Draft, NDArray[np.int16], list[U16]]]:
    """Weights and cells of every coefficient (up to three streams of a section) of some chains, in order."""
    jobs = [(chain, draft, s) for chain in chains for draft in chain for s in range(0, len(draft.tokens), CHANNELS)]
    shape = (layout.lanes.steps, layout.lanes.number)
    sums = {id(chain): [np.zeros(shape, np.int32)] * CHANNELS for chain in chains}

    def measure(part: list[tuple[list[_Draft], _Draft, int]]) -> tuple[list[list[U8]], I32, I32]:
        """Sizes and recent ones of some coefficients; of several at once, as it takes a call a step."""
        tokens = []
        for _, draft, s in part:
            tokens.append([token for token in draft.tokens[s : s + CHANNELS] if token is not None])
            draft.tokens[s : s + CHANNELS] = [None] * len(tokens[-1])
        sizes = np.empty((sum(map(len, tokens)), *shape), np.int32)
        of_all = [(token, draft) for (_, draft, _), own in zip(part, tokens, strict=True) for token in own]
        for size, (token, draft) in zip(sizes, of_all, strict=True):
            SIZES[draft.section.signed].take(token, out=size, mode="clip")
        return tokens, sizes, recent_sizes(sizes)

    def weigh(job: tuple[_Draft, list[I32], list[U8], I32, I32]) -> tuple[_Draft, NDArray[np.int16], list[U16]]:
        draft, before, tokens, sizes, recent = job
        weights = fit_weights(before, sizes, recent, layout.fitted)
        cells = [
            cells_of([*before, *sizes[:c], recent[c]], weights[c], token, draft.alphabet, batches.sizes)
            for c, token in enumerate(tokens)
        ]
        return draft, weights, cells

    at_once = max(batches.sizes // (CHANNELS * shape[1]), 1)
    at_a_time = max(batches.working_bytes // (_COEFFICIENT_BYTES * layout.lanes.splats * at_once), 2) * at_once
    for start in range(0, len(jobs), at_a_time):
        window = jobs[start : start + at_a_time]
        parts = [window[k : k + at_once] for k in range(0, len(window), at_once)]
        work = []
        for part, (tokens, all_sizes, all_recent) in zip(parts, run(measure, parts), strict=True):
            at = 0
            for (chain, draft, _), own in zip(part, tokens, strict=True):
                sizes, recent = (array[at : at + len(own)] for array in (all_sizes, all_recent))
                at += len(own)
                before = sums[id(chain)]
                work.append((draft, before, own, sizes, recent))
                if len(own) == CHANNELS:
                    sums[id(chain)] = [total + size for total, size in zip(before, sizes, strict=True)]
        yield from run(weigh, work)


def _finish(draft: _Draft, layout: _Layout) -> tuple[rans.Tokens, bytes]:
    """What the range coder takes of a section, and the stored bytes before its own."""
    channels = range(min(CHANNELS, len(draft.cells)))
    models = [fit_model(draft.cells[c::CHANNELS], layout.idle, draft.alphabet) for c in channels]
    for cells in draft.cells:
        cells.ravel()[layout.idle] = (LARGEST_SIZE + 1) * draft.alphabet
    description = write_description(np.concatenate(draft.weights), models)
    beside = np.packbits(np.concatenate(draft.beside), bitorder="little").tobytes()
    tokens = rans.Tokens(
        draft.cells,
        [s % CHANNELS for s in range(len(draft.cells))],
        [model.frequencies for model in models],
        [model.classes for model in models],
    )
    return tokens, b"".join([HEAD.pack(len(description), len(beside)), description, beside])
