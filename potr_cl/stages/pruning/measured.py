"""Removal effects and importances of a state's scene, for as long as a stage needs them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.raster.kept_scene import lying_on, whole_on_device
from potr_cl.raster.scene_buffers import SceneBuffers
from potr_cl.stages.pruning.removal import RemovalSweep, planned_sweep
from potr_cl.stages.pruning.shared_removal import OtherViews, RemovalPart
from potr_cl.stages.pruning.staleness import SweepOptions
from potr_cl.stages.stage import State, Workbench
from potr_cl.views.plan import none
from potr_cl.views.shares import ViewShares
from potr_cl.views.subsets import NoSplats
from potr_cl.views.visibility import Visibility
from potr_cl.workers.dealing import Shares, shares
from potr_cl.workers.parts import Parts


@contextmanager
def measurement(
    state: State,
    bench: Workbench,
    options: SweepOptions,
    sights: Visibility | None = None,
    spared: NDArray[np.bool_] | None = None,
    dealt: ViewShares | None = None,
    seen: NDArray[np.int64] | None = None,
) -> Iterator[RemovalSweep]:
    """A removal sweep over the views of a state, its splats numbered as in the state's scene.

    Args:
        state, bench, options: of the stage.
        sights: what the views see, where each had better be looked at with what it sees.
        spared: as of :class:`~potr_cl.stages.pruning.removal.RemovalSweep`; only with ``sights``.
        dealt: the views, for a pool whose workers get what these see and no more of the scene.
        seen: (n,) numbers of the splats that the sweep is to have, ascending, which it numbers from 0 on; None: all.

    Raises:
        DeviceError: the scene or a view does not fit the device.
    """

    def progress(done: int, count: int) -> None:
        bench.progress("prepare views", done / count)

    device, pool, views = bench.opened, bench.pool, state.views
    splats = len(state.scene) if seen is None else len(seen)
    share = None if pool is None else shares(pool, len(views))
    with ExitStack() as stack:
        if pool is None or share is None or not share.others:
            scene = None
            if sights is not None:
                scene = state.scene if seen is None else state.scene.subset(seen)
                drawable = stack.enter_context(whole_on_device(device, bench.drawable(scene)))
            else:
                drawable = stack.enter_context(lying_on(device, bench.placed(state, seen)))
            given_all = (device, drawable, views, options, bench.background, sights, None, progress, scene, spared)
            yield stack.enter_context(planned_sweep(*given_all))
            return
        given: list[tuple[Any, ...]] = []
        if dealt is not None:
            share = Shares([], [each.numbers for each in dealt.shares], dealt.names)
            for part in dealt.shares:
                excerpt = stack.enter_context(pool.shared(part.excerpt))
                given.append((excerpt, views, options, bench.background, part.numbers, part.sights))
        else:
            sent = stack.enter_context(bench.shared(pool, state, seen))
            sights = sights if pool.in_process else None
            given = [(sent, views, options, bench.background, numbers, sights) for numbers in share.others]
        parts = stack.enter_context(Parts(pool, RemovalPart, given, options.memory, share.names))
        numbers = None if dealt is None else [each.splats for each in dealt.shares]
        others = stack.enter_context(OtherViews(device, splats, parts, pool, numbers))
        if share.own:
            drawable = stack.enter_context(lying_on(device, bench.placed(state, seen)))
            # Only what lies on the device already is looked at in parts.
            own_sights = sights if isinstance(drawable, SceneBuffers) else None
            own = (device, drawable, views, options, bench.background, own_sights, share.own, progress)
            sweep = stack.enter_context(planned_sweep(*own, others=others))
        else:
            source = NoSplats(device, splats)
            sweep = stack.enter_context(RemovalSweep(source, views, options, plan=none(), others=others))
        parts.ready()
        yield sweep


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
