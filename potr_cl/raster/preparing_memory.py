"""Memory in which views are prepared (:class:`PreparingMemory`), who sorts long lists there (:class:`LongLists`)."""

from __future__ import annotations

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.errors import DeviceMemoryError
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner, Scratch
from potr_cl.opencl.structs import struct_dtype
from potr_cl.raster.view_set import ViewSet

_SOURCE = "raster/sort_long_gpu.cl"
_PIECE = struct_dtype(_SOURCE, "Piece")
#: Longer lists are sorted by many work-groups; keys of a piece, which is one's share; work-items of one.
LONGEST, PIECE, _GROUP = 1 << 13, 1 << 11, 256


class LongLists(Owner):
    """Sorts the long lists of prepared views (cl/raster/sort_long_gpu.cl), one set of views after another.

    Args:
        device: to sort on.
    """

    def __init__(self, device: Device) -> None:
        self._device = device
        self._pieces = Scratch(device, "the pieces of long tile lists")
        self._others = Scratch(device, "the long tile lists' sort keys")
        self._longest = self._count = 0

    def find(self, views: ViewSet) -> bool:
        """Look for long lists in views whose offsets are known to the host, and make ready to sort them.

        Returns:
            Whether there are any, and room to sort them here. Without room they are sorted as others are, only slower.
        """
        keys: list[NDArray[np.int64]] = []
        lengths: list[NDArray[np.int64]] = []
        for start, offsets in zip(views.intersection_starts, views.found_offsets, strict=False):
            length: NDArray[np.int64] = (offsets[1:] - offsets[:-1]).astype(np.int64)
            tiles = np.flatnonzero(length > LONGEST)
            keys.append(offsets[tiles].astype(np.int64) + start)
            lengths.append(length[tiles])
        of_keys, of_length = np.concatenate(keys), np.concatenate(lengths)
        if not len(of_length):
            return False
        of_pieces = -(-of_length // PIECE)
        pieces = np.zeros(int(of_pieces.sum()), _PIECE)
        pieces["keys"] = np.repeat(of_keys, of_pieces)
        pieces["others"] = np.repeat(np.cumsum(of_length) - of_length, of_pieces)
        pieces["length"] = np.repeat(of_length, of_pieces)
        pieces["start"] = PIECE * (np.arange(len(pieces)) - np.repeat(np.cumsum(of_pieces) - of_pieces, of_pieces))
        try:
            self._others.reserve(8 * int(of_length.sum()))
            self._pieces.reserve(pieces.nbytes)
        except DeviceMemoryError:
            self.close()
            return False
        self._longest, self._count = int(of_length.max()), len(pieces)
        with self._device.errors("cannot hold the pieces of long tile lists"):
            cl.enqueue_copy(self._device.queue, self._pieces.buffer, pieces, is_blocking=True)
        return True

    def enqueue(self, keys: cl.Buffer, intersections: cl.Buffer) -> None:
        """Enqueue that the lists which were found last are sorted.

        Args:
            keys: of all lists, as they were filled.
            intersections: takes the numbers of the splats.
        """
        pieces, others = self._pieces.buffer, self._others.buffer
        shape = (self._count * _GROUP,), (_GROUP,)
        kernel = {
            name: self._device.shared_kernel(_SOURCE, name, PIECE=PIECE)
            for name in ("sort_pieces", "merge_pieces", "take_pieces")
        }
        kernel["sort_pieces"].bind(pieces=pieces, keys=keys).launch(*shape)
        size, from_keys = PIECE, True
        while size < self._longest:
            merge = kernel["merge_pieces"]
            merge.bind(pieces=pieces, keys=keys, others=others, size=size, from_keys=int(from_keys)).launch(*shape)
            size, from_keys = 2 * size, not from_keys
        take = kernel["take_pieces"]
        take.bind(pieces=pieces, keys=keys, others=others, from_keys=int(from_keys), intersections=intersections)
        take.launch(*shape)

    def close(self) -> None:
        """Give all device memory back; it is taken again when it is needed."""
        self._pieces.close()
        self._others.close()


class PreparingMemory(Owner):
    """What preparing views takes besides what is left of them: rasterizers that take turns may share it.

    Args:
        device: whose memory it is.

    Attributes:
        bounds, counts, keys: the tiles that splats touch, the tiles' counters, and the lists while they are sorted.
        long_lists: sorts those that one work-group would be long with.
        image, transmittance: of pictures.
    """

    def __init__(self, device: Device) -> None:
        self._device = device
        self.bounds = Scratch(device, "the projected splats' bounds")
        self.counts = Scratch(device, "the tile counts")
        self.keys = Scratch(device, "the tile lists' sort keys")
        self.long_lists = LongLists(device)
        self.image = Scratch(device, "the image")
        self.transmittance = Scratch(device, "the transmittance")

    def zeroed_counts(self, nbytes: int) -> cl.Buffer:
        """Counters for all tiles. They are zero, and the kernels that use them leave them zero."""
        if self.counts.reserve(nbytes):
            self._device.fill(self.counts.buffer, np.uint32(0), self.counts.nbytes)
        return self.counts.buffer

    def rest(self) -> None:
        """Give all back but the pictures."""
        for owner in (self.bounds, self.counts, self.keys, self.long_lists):
            owner.close()

    def close(self) -> None:
        self.rest()
        for scratch in (self.image, self.transmittance):
            scratch.close()
