"""Changes of few totals among many, packed to travel: :func:`pack_changes`, :func:`unpack_changes`.

Most changes need far fewer than 64 bits, so their bytes are laid out plane by plane, and planes of zeros are left out.
"""

from __future__ import annotations

import struct

import numpy as np
import zstandard
from numpy.typing import NDArray

from potr_cl.codec.byte_planes import pack_integers, unpack_integers

#: More effort takes longer than a fast network saves.
_LEVEL = 1
#: The number of splats, and of each of the three streams its planes.
_HEAD = struct.Struct("<Q3B")


def pack_changes(splats: NDArray[np.int64], changes: NDArray[np.int64]) -> bytes:
    """Bytes that :func:`unpack_changes` takes.

    Args:
        splats: (n,) numbers, ascending.
        changes: (n, 2) int64.
    """
    gaps = np.diff(splats, prepend=0)
    packed = [pack_integers(gaps, False), *(pack_integers(changes[:, k], True) for k in range(2))]
    data = b"".join(planes for planes, _ in packed)
    return _HEAD.pack(len(splats), *(count for _, count in packed)) + zstandard.ZstdCompressor(_LEVEL).compress(data)


def unpack_changes(data: bytes) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The splats and their changes, as :func:`pack_changes` was given them.

    Raises:
        ValueError: the data are not of this kind.
    """
    try:
        count, *planes = _HEAD.unpack_from(data)
        size = count * sum(planes)
        if max(planes) > 8 or size > 1 << 40:
            raise ValueError
        # One byte more than there should be: more than that is not made.
        raw = zstandard.ZstdDecompressor().decompress(data[_HEAD.size :], max_output_size=size + 1)
    except (struct.error, zstandard.ZstdError, ValueError):
        raise ValueError("changes of totals are damaged") from None
    if len(raw) != size:
        raise ValueError("changes of totals are damaged")
    ends = np.cumsum([count * each for each in planes])
    parts = np.split(np.frombuffer(raw, np.uint8), ends[:-1])
    gaps, *columns = (
        unpack_integers(part, each, signed, 0, count).astype(np.int64)
        for part, each, signed in zip(parts, planes, (False, True, True), strict=True)
    )
    return np.cumsum(gaps), np.stack(columns, axis=1)
