"""Removal effects and importances of a state's scene, for as long as a stage needs them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.pruning.removal import RemovalSweep
from potr_cl.stages.pruning.sweep_options import SweepOptions
from potr_cl.stages.stage import State, Workbench


@contextmanager
def measurement(state: State, bench: Workbench, options: SweepOptions) -> Iterator[RemovalSweep]:
    """A removal sweep over the views of a state, its splats numbered as in the state's scene.

    Raises:
        DeviceError: the scene or a view does not fit the device.
    """
    with (
        Rasterizer(bench.opened, bench.drawable(state.scene), background=bench.background) as rasterizer,
        RemovalSweep(
            rasterizer, state.views, options, lambda done, count: bench.progress("prepare views", done / count)
        ) as removal,
    ):
        yield removal


class Measured:
    """What a sweep measured of the splats that are left.

    Args:
        removal: the sweep, which has measured.
        left: (n,) the sweep's numbers of the splats that are left, ascending.
    """

    def __init__(self, removal: RemovalSweep, left: NDArray[np.int64]) -> None:
        self._removal = removal
        self._places = np.full(removal.splats, -1, np.int64)
        self._places[left] = np.arange(len(left))

    def view_importances(self) -> Iterator[tuple[int, NDArray[np.int64], NDArray[np.float64]]]:
        """I_k(s) of the splats that are left, view by view.

        Yields:
            The number of the view, the numbers among those left of the splats that it sees, ascending, and the mean of
            T α of each over the view's pixels.
        """
        for view, seen, importances in self._removal.view_importances():
            yield view, self._places[seen], importances
