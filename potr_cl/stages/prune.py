"""The stage "prune": remove the splats whose removal does no harm (paper section "Iterative pruning")."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import UsageError
from potr_cl.host.threads import in_background, thread_pool
from potr_cl.model.scene import FloatArray
from potr_cl.raster.resident import scene_on
from potr_cl.raster.scene_buffers import SceneBuffers
from potr_cl.stages.pruning.controller import prune_scene
from potr_cl.stages.pruning.helpers import importances_of, measurement
from potr_cl.stages.pruning.removal import RemovalSweep
from potr_cl.stages.pruning.schedule import Course, Pruned, PruningOptions
from potr_cl.stages.pruning.sweep import SweepOptions
from potr_cl.stages.stage import Flag, Interlude, Stage, State, Workbench, option
from potr_cl.stages.unseen import CHOICES, Unresolved, Unseen, as_of_whole, find_unseen, without_directions
from potr_cl.views.reached import surely_seen
from potr_cl.views.shares import ViewShares
from potr_cl.views.targets import PicturesInPassing
from potr_cl.views.visibility import MOST_SEEN, Visibility, groups_of_large, seen_part, visibility_of_large
from potr_cl.workers.pool import Pool

#: Of the time of all iterations, what the first measurement takes, which looks at all of every view; the others look at
#: less and less, so that what is left of the time is this power of what is left of the iterations. But not where more
#: than this part of the views is made again each time.
_FIRST, _FEWER, _MADE_AGAIN = 0.11, 1.4, 0.1
#: Splats that no given view sees are looked for in the views where they are no more than this part of all.
_FEW_HIDDEN = 1 / 8


@dataclass(frozen=True)
class Prune(Stage):
    """Remove splats in many iterations, judging by the training views.

    Between iterations it does what other stages want done then (:meth:`potr_cl.stages.stage.Stage.interludes`).

    Attributes:
        keep, count: part or number of the splats to keep, exactly, instead of ``delta_mse_max``.
        delta_mse_max: replaces q's ΔMSE_MAX: that of a scene that each view shows whole.
        iterations, decay, mapping_a: of the schedule (:class:`potr_cl.stages.pruning.schedule.PruningOptions`).
        unseen: "keep" or "drop": what becomes of splats that no training view's picture reaches
            (:func:`potr_cl.model.splat_groups.unseen_splats`). With ``keep`` or ``count`` they go first in any case.
            "protect", and "keep" where views were placed: what no view has resolved stays as it is
            (:mod:`potr_cl.placement.rays`).
        tolerance, turns, transmittance_threshold: of the measurements
            (:class:`potr_cl.stages.pruning.sweep.SweepOptions`).

    Raises:
        UsageError: a value is out of range.
    """

    name = "prune"
    title = "pruning"

    on: bool = option(True, Flag("--no-prune", "keep every splat"))
    keep: float | None = option(
        None,
        Flag("--keep", "keep exactly this fraction of the splats (overrides -q)", "FRACTION", float, group="how many"),
    )
    count: int | None = option(
        None, Flag("--count", "keep exactly N splats (overrides -q)", "N", int, group="how many")
    )
    delta_mse_max: float | None = option(
        None,
        Flag(
            "--delta-mse-max",
            "remove splats that raise the mean squared error by less than X (less if each view shows only a part of "
            "the scene)",
            "X",
            float,
            group="how many",
        ),
        parameter=True,
    )
    iterations: int = option(48, Flag("--iterations", "rounds of measuring and removing", "N", int))
    tolerance: float = option(
        SweepOptions.tolerance,
        Flag(
            "--tolerance",
            "measure a tile again once this part of it has been removed, of large splats up to four times as much; 0: "
            "after any removal",
            "X",
            float,
        ),
    )
    turns: int = option(
        SweepOptions.turns, Flag("--turns", "measure each view again only every N iterations", "N", int)
    )
    decay: float = option(
        PruningOptions.decay,
        Flag(
            "--damping",
            "decay of the exponential moving average that ranks the splats; 0: only the newest measurement counts, "
            "as in the paper",
            "X",
            float,
        ),
    )
    mapping_a: float = option(
        PruningOptions.a,
        Flag(
            "--mapping-a",
            "lower values keep splats whose removal would improve the match for longer (paper: 10)",
            "X",
            float,
        ),
    )
    unseen: str = option(
        "keep",
        Flag(
            "--unseen",
            "splats that no training view shows: keep them, coded coarsely, or drop them (--keep and --count always "
            "drop them first); protect: keep unchanged what no view shows from near enough; so does keep without any",
            choices=CHOICES,
        ),
    )
    transmittance_threshold: float | None = option(SweepOptions.transmittance_threshold)

    def __post_init__(self) -> None:
        if self.keep is not None and not 0 < self.keep <= 1:
            raise UsageError(f"--keep is {self.keep:g}, it must be above 0 and at most 1")
        if self.keep is not None and self.count is not None:
            raise UsageError("give either the part or the number of splats to keep")
        if self.unseen not in CHOICES:
            raise UsageError(f"--unseen is '{self.unseen}', it must be one of {', '.join(CHOICES)}")
        _ = self._sweep_options(None), self._schedule(0.0, 1)  # refuse what is out of range at once

    @property
    def removes_in(self) -> int:
        return self.iterations

    def _sweep_options(self, memory: int | None) -> SweepOptions:
        return SweepOptions(
            tolerance=self.tolerance,
            turns=self.turns,
            memory=memory,
            transmittance_threshold=self.transmittance_threshold,
        )

    def _schedule(self, delta_mse_max: float, splats: int) -> PruningOptions:
        count = self.count if self.keep is None else max(round(self.keep * splats), 1)
        return PruningOptions(delta_mse_max, self.iterations, a=self.mapping_a, count=count, decay=self.decay)

    def run(self, state: State, bench: Workbench) -> State:
        """Remove splats, and leave a :class:`potr_cl.stages.pruning.schedule.Pruned` in ``results``.

        And what no view sees; the price of a splat, where the number of splats is not given; what views show of each
        splat, where none had gone before; and the shares, where workers elsewhere get what their views see.
        """
        if state.results.unresolved is not None:
            return self._guarded(state, bench, state.results.unresolved)
        with thread_pool(bench.threads) as pool, scene_on(bench.opened, bench.scene_of(state)) as placed:
            quick = partial(surely_seen, placed) if isinstance(placed, SceneBuffers) else None
            part = in_background(seen_part, state.scene, state.views)  # while a device finds the unseen ones
            unseen = find_unseen(state, None, pool.map, quick) if quick else None
            likely = part.result() <= MOST_SEEN
            groups = groups_of_large(state.scene, pool.map) if likely or not unseen else None
            hidden, area = unseen or find_unseen(state, groups, pool.map)
            visibility = visibility_of_large(state.scene, state.views, groups, pool.map) if likely else None
            groups = None
            if visibility is not None and bench.all_here:
                visibility = visibility.lasting()
        splats = int(np.count_nonzero(hidden))
        kept = self.unseen == "keep" and self.keep is None and self.count is None
        told = state.with_results(unseen=Unseen(splats, len(state.scene), kept, area))
        told = self._told(told, bench, visibility)
        if not (kept and splats):
            return self._pruned(told, bench, visibility)
        # A copy of a large scene without them would take as much memory as the scene.
        if visibility is not None and bench.all_here and not bench.interludes:
            return self._pruned(told, bench, visibility, hidden=hidden)
        seen = np.flatnonzero(~hidden)
        if not len(seen):
            nothing = np.zeros(splats, np.float32)
            return _knowing(
                told, Pruned(splats, np.full(splats, -1, np.int32), 0, nothing, lambda: Course(np.zeros(splats)))
            )
        if visibility is not None:
            visibility = visibility_of_large(state.scene.uncoloured().subset(seen), state.views)
        return self._pruned(told, bench, visibility, seen, hidden)

    def _guarded(self, state: State, bench: Workbench, unresolved: Unresolved) -> State:
        """Prune, but for what no view has resolved.

        Raises:
            UsageError: fewer splats are asked for than that.
        """
        spared = int(np.count_nonzero(unresolved.among(state.survivors)))
        wanted = self._schedule(0.0, len(state.scene)).count
        if wanted is not None and wanted < spared:
            raise UsageError(
                f"{wanted:,} splats are fewer than the {spared:,} that no view shows from near enough: keep more, or "
                "give --unseen keep instead of protect"
            )
        with thread_pool(bench.threads) as pool:
            likely = seen_part(state.scene, state.views) <= MOST_SEEN
            groups = groups_of_large(state.scene, pool.map) if likely else None
            visibility = visibility_of_large(state.scene, state.views, groups, pool.map)
            if visibility is not None and bench.all_here:
                visibility = visibility.lasting()
        told = self._told(state, bench, visibility).with_results(unseen=unresolved)
        return self._pruned(told, bench, visibility)

    def _told(self, state: State, bench: Workbench, visibility: Visibility | None) -> State:
        """The state that knows what the views see, and what a splat may cost."""
        if state.scene is state.source:
            state = replace(state, visibility=visibility)
            if visibility is not None and bench.kept is not None and bench.kept.is_of(state.source):
                bench.kept.groups = visibility.groups  # for who judges by pictures later, and for coarser levels
        else:
            state = replace(state, visibility=bench.visibility_of_source(state, state.views))
        if self.keep is None and self.count is None:
            state = state.with_results(price=bench.parameters.delta_mse_max)
        return state

    def _pruned(
        self,
        state: State,
        bench: Workbench,
        visibility: Visibility | None = None,
        seen: NDArray[np.int64] | None = None,
        hidden: NDArray[np.bool_] | None = None,
    ) -> State:
        """The state after pruning.

        Args:
            visibility: what the views see of the splats that are pruned.
            seen: (n,) numbers of these, ascending; None: all of the state's scene, hidden ones too.
            hidden: (N,) which splats are kept in any case, without what of their colours depends on the direction.
        """
        dealt = None
        if visibility is not None and bench.pool is not None and not bench.all_here:
            dealt = _dealt(state, seen, bench.pool, visibility)
            if state.scene is state.source:  # else pictures of the source would lack what is gone already
                state = state.with_results(shares=dealt)
        unresolved = state.results.unresolved
        stays = hidden if seen is None else None
        if unresolved is not None:
            stays = unresolved.among(state.survivors)
        waiting = sorted(bench.interludes, key=lambda interlude: interlude.after)
        schedule = self._schedule(bench.parameters.delta_mse_max, len(state.scene) if seen is None else len(seen))
        pictures = _in_passing(state, bench, hidden if seen is not None else None)
        bench.progress("prepare views", 0.0)
        options = self._sweep_options(bench.memory)
        with measurement(state, bench, options, visibility, dealt, seen, pictures) as removal:
            course = _Course(state, removal, seen)
            ready = removal.ready_views >= (1 - _MADE_AGAIN) * len(state.views)

            def after_iteration(iteration: int) -> None:
                while waiting and iteration + 1 >= waiting[0].after:
                    course.visit(waiting.pop(0), np.flatnonzero(removal.alive), bench)
                    removal.replace_sh(course.measured_sh)

            bench.progress("prune", 0.0)
            pruned = prune_scene(
                removal,
                schedule,
                lambda done, _: bench.progress("prune", min(part_of_time(done / self.iterations, ready), 0.99)),
                after_iteration,
                stays,
            )
            bench.progress("prune", 1.0)
            for interlude in waiting:
                if interlude.always:
                    course.visit(interlude, pruned.survivors, bench)
            # While drivers give the measurement's memory back.
            left = in_background(self._left, course, pruned, seen, hidden)
        then = left.result()
        return then if pictures is None else then.with_results(pictures=pictures)

    def _left(
        self, course: _Course, pruned: Pruned, seen: NDArray[np.int64] | None, hidden: NDArray[np.bool_] | None
    ) -> State:
        """The state after pruning; ``seen`` and ``hidden`` as of :meth:`_pruned`."""
        survivors = pruned.survivors
        if hidden is None or seen is None:
            left = _knowing(course.left(survivors), pruned)
            return left if hidden is None else without_directions(left, hidden[survivors])
        of_whole = in_background(as_of_whole, seen, hidden, pruned)
        kept = hidden.copy()
        kept[seen[survivors]] = True
        numbers = np.flatnonzero(kept)
        # Nobody looked at the hidden ones from any direction.
        left = without_directions(course.having(numbers), hidden[numbers])
        return _knowing(left, of_whole.result())


def _in_passing(state: State, bench: Workbench, hidden: NDArray[np.bool_] | None) -> PicturesInPassing | None:
    """Takes the pictures of the source that later stages will ask for; None: nobody does, or it does not pay.

    Args:
        hidden: (N,) splats that are not there while views are looked at; None: all are.
    """
    if not bench.shown_again or bench.memory is not None or state.scene is not state.source:
        return None
    pictures = PicturesInPassing.wanted(bench.opened, state.views)
    if pictures is None or hidden is None:
        return pictures
    numbers = np.flatnonzero(hidden)
    if len(numbers) > _FEW_HIDDEN * len(hidden):
        return None
    # Those that no given view sees may be seen from between, and a tile's list may have them.
    pictures.leave_out(state.scene.uncoloured().subset(numbers))
    return pictures


def part_of_time(iterations: float, stays: bool) -> float:
    """Which part of pruning's time has gone, 0 to 1, as measured on CPUs within a factor of two of what is left.

    Args:
        iterations: the part of the iterations that are done, 0 to 1.
        stays: whether views stay prepared.
    """
    return _FIRST + (1 - _FIRST) * (1 - (1 - iterations) ** _FEWER) if stays else iterations


def _knowing(state: State, pruned: Pruned) -> State:
    """The state that knows what pruning did, and what it has measured, if that was the whole source."""
    whole = len(pruned.importance) == len(state.source)
    return state.with_results(pruned=pruned, importance=pruned.importance if whole else state.results.importance)


def _dealt(state: State, seen: NDArray[np.int64] | None, pool: Pool, visibility: Visibility) -> ViewShares:
    """The views for a pool's workers, and which of the splats each gets."""
    workers = pool.workers()
    source, numbers = (state.source, state.survivors) if state.is_cut else (state.scene, np.arange(len(state.scene)))
    names = [worker.name for worker in workers]
    splats = numbers if seen is None else numbers[seen]
    return ViewShares.of(state.views, visibility, [1.0] * len(workers), source, splats, names)


class _Course:
    """The scene while splats are being removed.

    Args:
        state: the state before the first iteration.
        removal: measures effects, and knows which splats are left.
        seen: (n,) numbers in the state's scene of the splats that the removal has; None: it has all.

    Attributes:
        sh: (N, M, 3) the colours that all splats of the state's scene have by now.
    """

    def __init__(self, state: State, removal: RemovalSweep, seen: NDArray[np.int64] | None = None) -> None:
        self._state, self._removal, self._seen = state, removal, seen
        self.sh = state.scene.sh

    @property
    def measured_sh(self) -> FloatArray:
        """(n, M, 3) the colours of the removal's splats."""
        return self.sh if self._seen is None else self.sh[self._seen]

    def left(self, splats: NDArray[np.int64], afresh: bool = False) -> State:
        """The state in which only these of the removal's splats are left.

        With the colours of the beginning or with those of now.
        """
        return self.having(self._numbers(splats), afresh)

    def having(self, numbers: NDArray[np.int64], afresh: bool = False) -> State:
        """The same for splats of the state's scene."""
        scene = self._state.scene if afresh else replace(self._state.scene, sh=self.sh)
        return replace(self._state, scene=scene).keeping(numbers)

    def _numbers(self, splats: NDArray[np.int64]) -> NDArray[np.int64]:
        return splats if self._seen is None else self._seen[splats]

    def visit(self, interlude: Interlude, splats: NDArray[np.int64], bench: Workbench) -> None:
        """Have another stage work on these of the removal's splats, and go on with the colours that it gives them."""
        given = replace(self.left(splats, interlude.afresh), importances=importances_of(self._removal, splats))
        then = interlude.stage.run(given, bench)
        if then is given:
            return
        if self.sh is self._state.scene.sh:  # the array of the state before, which must not change
            self.sh = self.sh.copy()
        self.sh[self._numbers(splats)] = then.scene.sh
        self._state = replace(self._state, results=then.results)
