"""Device memory that the removal kernels of several sets of views share."""

from __future__ import annotations

from dataclasses import dataclass

import pyopencl as cl


@dataclass(frozen=True)
class SweepBuffers:
    """What the kernels of a set work on besides the set's own buffers.

    Attributes:
        alive: (N,) uint8, :class:`~potr_cl.stages.pruning.survivors.SplatState`.
        tiles: uint32, the list of tiles to sweep, numbered within their set.
        stale: float32, staleness of the tiles, each set's from its first tile on.
        listed: uint32, how many tiles of each set the device has listed itself.
        totals: (N, 2) int64, ΔMSE and I of each splat in the units of
            :class:`~potr_cl.stages.pruning.fixed_point.FixedPoint`.
        numbers: for GPU kernels, (n,) uint32, the numbers among those N splats of the n that the set's views were
            prepared with; None: they were prepared with all.
    """

    alive: cl.Buffer
    tiles: cl.Buffer
    stale: cl.Buffer
    listed: cl.Buffer
    totals: cl.Buffer
    numbers: cl.Buffer | None = None
