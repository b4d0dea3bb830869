"""Points on a device, each of which is compared with the centres of some cells: :class:`Points`.

Vectors are rows of floats in which a weighted distance is a product of two rows. A point x has a weight w_g for each
group g of coordinates (an SH coefficient: its R, G and B). Its distance to a centre, the sum over groups of
w_g |x_g − c_g|², is a constant of the point plus the product of [w, −2 w x] and [|c|², c].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.host.threads import thread_pool
from potr_cl.model.scene import FloatArray
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner

#: Floats in a row are a multiple of this.
QUARTER = 4
#: Points that a thread works on at a time.
_TOGETHER = 1 << 14


def width_of(groups: int, coordinates: int) -> int:
    """Floats in a row of vectors of so many groups of so many coordinates."""
    return -(-groups * (1 + coordinates) // QUARTER) * QUARTER


def rows_of_points(points: FloatArray, weights: FloatArray) -> FloatArray:
    """(N, width) float32, C order.

    Args:
        points: (N, G, C).
        weights: (N, G).
    """
    n, groups, coordinates = points.shape
    rows = np.zeros((n, width_of(groups, coordinates)), np.float32)

    def fill(start: int) -> None:
        some = slice(start, start + _TOGETHER)
        rows[some, :groups] = weights[some]
        weighted = points[some] * (weights[some, :, None] * np.float32(-2))
        rows[some, groups : groups * (1 + coordinates)] = weighted.reshape(len(weighted), -1)

    with thread_pool() as pool:
        list(pool.map(fill, range(0, n, _TOGETHER)))
    return rows


def rows_of_centres(centres: FloatArray) -> FloatArray:
    """(K, width) float32, C order.

    Args:
        centres: (K, G, C).
    """
    count, groups, coordinates = centres.shape
    rows = np.zeros((count, width_of(groups, coordinates)), np.float32)
    rows[:, :groups] = np.einsum("kgc,kgc->kg", centres, centres, dtype=np.float64)
    rows[:, groups : groups * (1 + coordinates)] = centres.reshape(count, -1)
    return rows


def centres_of_sums(sums: FloatArray, centres: FloatArray) -> FloatArray:
    """(K, G, C), the weighted means of clusters; where nothing has any weight, a centre stays.

    Args:
        sums: (K, width), of the rows of each cluster's points.
        centres: (K, G, C), those before.
    """
    count, groups, coordinates = centres.shape
    mass = sums[:, :groups, None].astype(np.float64)
    weighted = sums[:, groups : groups * (1 + coordinates)].reshape(count, groups, coordinates)
    return np.where(mass > 0, -0.5 * weighted / np.where(mass > 0, mass, 1), centres).astype(np.float32)


def errors_at_zero(points: FloatArray, weights: FloatArray) -> NDArray[np.float64]:
    """(N,) the constant of each point: its distance to zero."""
    errors = np.empty(len(points))

    def add(start: int) -> None:
        some = slice(start, start + _TOGETHER)
        np.einsum(
            "ngc,ngc,ng->n", points[some], points[some], weights[some], dtype=np.float64, optimize=False,
            out=errors[some],
        )  # fmt: skip

    with thread_pool() as pool:
        list(pool.map(add, range(0, len(points), _TOGETHER)))
    return errors


#: Work-items of a GPU's work-group, a point each; and points that are compared with the same centres.
_GROUP = 128


U32 = NDArray[np.uint32]

_NO_POINT = np.uint32(0xFFFFFFFF)


@dataclass(frozen=True)
class Lists:
    """Which centres the points of each cell are compared with.

    Attributes:
        runs: (R, 2) uint32, first and number of centres in sequence.
        runs_of: (C + 1,) uint32, where the runs of each cell begin, and the end.
    """

    runs: U32
    runs_of: U32

    @staticmethod
    def of_all(centres: int) -> Lists:
        """One cell, whose points are compared with all centres."""
        return Lists(np.array([[0, centres]], np.uint32), np.array([0, 1], np.uint32))


class Points(Owner):
    """Points on a device.

    Args:
        device: to compute on.
        rows: (N, width) float32, of :func:`rows_of_points`.
    """

    def __init__(self, device: Device, rows: FloatArray) -> None:
        self._device = device
        self._count, self._width = rows.shape
        gpu = device.family == "gpu"
        # Points that are compared with the same centres, and the work-items of their work-group.
        self._block, self._group = (_GROUP, _GROUP) if gpu else (device.vector_width, 1)
        macros = {"GROUP": _GROUP} if gpu else {"LANES": self._block}
        source = f"clustering/nearest_{device.family}.cl"
        self._nearest = device.shared_kernel(source, "nearest", WIDTH=self._width, **macros)
        self._sums = device.shared_kernel("clustering/sums.cl", "sums", WIDTH=self._width)
        self._memory = Memory(device)
        with device.all_or_nothing():
            self._rows = self._memory.upload(rows, "vectors to be clustered")
            self._labels = self._memory.allocate(4 * self._count, "the clusters of vectors")
            self._scores = self._memory.allocate(4 * self._count, "the distances of vectors")

    def nearest(
        self,
        centres: FloatArray,
        biases: FloatArray | None = None,
        cells: U32 | None = None,
        lists: Lists | None = None,
    ) -> tuple[U32, FloatArray]:
        """The best centre of each point, and its distance less the point's distance to zero, plus the centre's bias.

        Args:
            centres: (K, G, C).
            biases: (K,) float32, added to the distances; None: 0.
            cells: (N,) the cell of each point; None: there is one.
            lists: which centres the points of a cell are compared with; None: one cell's points with all.
        """
        lists = lists or Lists.of_all(len(centres))
        order, block_cells = _blocks(self._count, cells, len(lists.runs_of) - 1, self._block)
        with Memory(self._device) as memory:
            self._nearest.bind(
                points=self._rows,
                order=memory.upload(order, "the order of vectors"),
                cells=memory.upload(block_cells, "the cells of vectors"),
                runs_of=memory.upload(lists.runs_of, "the centres of each cell"),
                runs=memory.upload(lists.runs, "the centres of each cell"),
                centres=memory.upload(rows_of_centres(centres), "the centres"),
                biases=memory.upload(np.zeros(len(centres), np.float32) if biases is None else biases, "their biases"),
                labels=self._labels,
                scores=self._scores,
            ).launch((len(block_cells) * self._group,), (self._group,))
            labels: U32 = self._device.download(self._labels, (self._count,), np.uint32)
        return labels, self._device.download(self._scores, (self._count,), np.float32)

    def sums(self, labels: U32, count: int) -> FloatArray:
        """(count, width) float32, the sum of the rows of each label's points."""
        order = sorted_by_label(labels, count).astype(np.uint32)
        starts = np.concatenate([[0], np.cumsum(np.bincount(labels, minlength=count))]).astype(np.uint32)
        with Memory(self._device) as memory:
            result = memory.allocate(4 * count * self._width, "the sums of clusters")
            self._sums.bind(
                points=self._rows,
                order=memory.upload(order, "the order of clusters"),
                starts=memory.upload(starts, "the first of each cluster"),
                result=result,
            ).launch((count * self._width // QUARTER,))
            sums: FloatArray = self._device.download(result, (count, self._width), np.float32)
        return sums


def _blocks(count: int, cell_of: U32 | None, cells: int, size: int) -> tuple[U32, U32]:
    """Points in blocks of ``size``, each of one cell: their numbers (blocks * size,), and the cell of each block."""
    if cell_of is None:
        order = np.full(-(-count // size) * size, _NO_POINT, np.uint32)
        order[:count] = np.arange(count)
        return order, np.zeros(len(order) // size, np.uint32)
    counts = np.bincount(cell_of, minlength=cells)
    blocks = -(-counts // size)
    firsts = (np.cumsum(blocks) - blocks) * size
    by_cell = sorted_by_label(cell_of, cells)
    sorted_cells = cell_of[by_cell]
    ranks = np.arange(count) - (np.cumsum(counts) - counts)[sorted_cells]
    order = np.full(int(blocks.sum()) * size, _NO_POINT, np.uint32)
    order[firsts[sorted_cells] + ranks] = by_cell
    return order, np.repeat(np.arange(cells, dtype=np.uint32), blocks)


def sorted_by_label(labels: U32, count: int) -> NDArray[np.intp]:
    """Numbers of points by their labels, below ``count``; those of one label keep their order."""
    # NumPy sorts 16 bits by their digits, ten times as quickly as it compares longer ones.
    return np.argsort(labels.astype(np.uint16) if count <= 1 << 16 else labels, kind="stable")
