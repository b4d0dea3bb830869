"""Where a re-fit's vectors lie: in the device's memory, or, where it has not enough, on the host (:func:`placed`).

A splat takes about 3,400 bytes in one piece at SH degree 3: seven vectors of 48 values, the sums over views, the blocks
of the normal equations and what they are added up in. With the blocks and all vectors but one on the host it takes
about 950: the direction that views are looked along, a place for the other vectors that they are looked at with, and
the sums. Further vectors stay on the device as far as there is room, those that are used most often first.
"""

from __future__ import annotations

from dataclasses import dataclass

from potr_cl.opencl.device import Device
from potr_cl.views.reached import Reach

#: Vectors of a solution: six of the solver and what it was before it was rounded.
_VECTORS = 7
#: Vectors that lie on the device in any case, and at most: beyond, the blocks are most of what travels.
_FEWEST, _MOST = 1, 6
#: With the sums they take no more than this part of a GPU's memory: to take one there again and again costs more than
#: to prepare views that it leaves no room for; and of the host's, where a CPU computes: there it is the other way.
_OF_VECTORS, _OF_HOST = 0.8, 0.5
#: What a sweep has besides for each splat: geometry, the splats of a view as they are projected, and its sums.
_SWEEP = 68 + 32 + 16 + 16 + 32 + 8 + 8
#: The vectors lie on the device if they take no more than this part of what is free, or of the memory that is given.
_OF_FREE, _OF_GIVEN = 0.75, 0.5
#: Of less nobody needs to be careful.
_ANYWAY = 256e6
#: Of the memory, what a slice may take, and the integers of blocks that are on the device at a time.
_SLICE, _BLOCKS = 1 / 32, 1 / 5
_LEAST_SLICE, _MOST_SLICE = 1 << 14, 1 << 18
#: For the blocks, all views are looked at so many times at most.
_MOST_RANGES = 8
#: Where views have splats of their own: what lies on the device of each splat; what those take of which a launch has as
#: many as a view at most; and, of the memory, what is left for views in any case.
_LYING, _LAUNCHED, _LEAST_VIEWS = 76, 160, 1 / 20
#: With the coefficients on the device too, which have this rank, no other place is needed to look at views with them.
_COEFFICIENTS = 3


@dataclass(frozen=True)
class Place:
    """How a re-fit does with the device's memory.

    Attributes:
        views: bytes that prepared views and targets may take; None: a part of what is free.
        slice: splats whose coefficients go through the device together; None: all, and vectors and blocks lie there.
        blocks: splats whose blocks are added up together.
        resident: with slices, vectors that lie on the device even so.
    """

    views: int | None
    slice: int | None = None
    blocks: int | None = None
    resident: int = 0


def placed(
    device: Device,
    splats: int,
    sh_count: int,
    memory: int | None,
    slices: int | None = None,
    reach: Reach | None = None,
) -> Place:
    """Where a re-fit's vectors lie.

    Args:
        device: to compute on.
        splats: N.
        sh_count: M, coefficients of a channel.
        memory: bytes of the device's memory that the user would have taken; None: as much as there is.
        slices: splats of a slice, if the vectors are to lie on the host in any case.
        reach: of the views, if each has splats of its own.
    """
    vector, triangle = 12 * sh_count, sh_count * (sh_count + 1) // 2
    one_piece = splats * (_VECTORS * vector + 2 * vector + 12 * triangle)
    free = max(device.info.memory - device.allocated, 0)
    fits = one_piece <= max(_OF_FREE * free if memory is None else min(_OF_GIVEN * memory, _OF_FREE * free), _ANYWAY)
    if slices is None and fits:
        return Place(memory if memory is None or one_piece <= _ANYWAY else max(memory - one_piece, 0))
    total = free if memory is None else min(memory, free)
    of_slice = 2 * vector + 4 * triangle + 8
    some = slices or min(max(int(_SLICE * total / of_slice), _LEAST_SLICE), _MOST_SLICE)
    # To look at views with splats of their own once more is cheap.
    of_blocks = _BLOCKS if reach is None else _BLOCKS / 2
    blocks = slices or max(int(of_blocks * total / (8 * triangle)), -(-splats // _MOST_RANGES))
    # A place for a vector that views are looked at with, the sums, and some vectors.
    of_host = device.info.kind == "cpu" or device.info.integrated
    if slices is None and reach is not None:
        own = splats * (2 * vector + _LYING) + _LAUNCHED * reach.most + reach.total
        left = total - own - some * of_slice - 8 * triangle * min(blocks, splats)
        share = _OF_HOST * total - own if of_host else left - _LEAST_VIEWS * total
        resident = min(int(max(share, 0) / max(splats * vector, 1)), _MOST)
        others = 0
        if resident <= _COEFFICIENTS:
            resident, others = max(resident - 1, _FEWEST), 1
        return Place(max(int(left - (resident + others) * splats * vector), 0), some, blocks, resident)
    room = int(((_OF_HOST if of_host else _OF_VECTORS) * total / max(splats, 1) - _SWEEP) / vector) - 3
    besides = splats * (3 * vector + _SWEEP) + some * of_slice + 8 * triangle * min(blocks, splats)
    # Of few splats a slice, which has so many at least, takes more than its share.
    room = min(room, int((total - besides) / max(splats * vector, 1)))
    resident = min(max(room, _FEWEST), _MOST) if slices is None else _FEWEST
    return Place(max(int(total - besides - splats * resident * vector), 0), some, blocks, resident)
