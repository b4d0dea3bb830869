"""Who decides which splats go (:func:`prune_scene`): the host, or a GPU itself, which also lists the tiles to measure.

To fetch the effects of all splats and to send back a decision would take longer than to measure them. The rules are
those of :mod:`potr_cl.stages.pruning.schedule`, in float32, with one difference: splats of the same score go together.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from potr_cl.host.threads import in_background
from potr_cl.model.order import ascending
from potr_cl.opencl.kernel import Kernel
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.opencl.structs import bytes_before, struct_dtype
from potr_cl.raster.sweep import totals_limits
from potr_cl.stages.pruning.removal import RemovalSweep
from potr_cl.stages.pruning.schedule import BEYOND, Course, Iteration, Pruned, PruningOptions, prune

_SOURCE = "prune/choose_gpu.cl"
#: A score has so many digits, each of so many values; a work-group has a work-item for each value.
_DIGIT, _DIGITS = 256, 4

_REMOVED, _STATE = struct_dtype(_SOURCE, "Removed"), struct_dtype(_SOURCE, "State")


def prune_scene(
    removal: RemovalSweep,
    options: PruningOptions,
    progress: Callable[[int, int], None] | None = None,
    after_iteration: Callable[[int], None] | None = None,
    spared: NDArray[np.bool_] | None = None,
) -> Pruned:
    """As :func:`potr_cl.stages.pruning.schedule.prune`, on the device if it can decide for itself, else on the host."""
    if not removal.can_steer or options.count is not None or not np.isfinite(options.delta_mse_max):
        return prune(removal, removal.splats, options, progress, after_iteration, spared)
    with _Controller(removal, options, spared) as controller:
        return controller.run(progress, after_iteration)


class _Controller(Owner):
    """The schedule with its state in the device's memory."""

    def __init__(self, removal: RemovalSweep, options: PruningOptions, spared: NDArray[np.bool_] | None) -> None:
        self._removal, self._options = removal, options
        self._device = device = removal.device
        self._splats = removal.splats
        self._memory = memory = Memory(device)
        with device.all_or_nothing():
            self._smoothed = memory.allocate(4 * self._splats, "the smoothed effects")
            self._keys = memory.allocate(4 * self._splats, "the splats' scores")
            self._removed = memory.allocate(_REMOVED.itemsize * self._splats, "the removed splats")
            device.fill(self._removed, np.uint32(0))
            if spared is None:
                self._spared = memory.allocate(self._splats, "the splats that stay")
                device.fill(self._spared, np.uint8(0))
            else:
                self._spared = memory.upload(spared.view(np.uint8), "the splats that stay")
            self._state = memory.allocate(_STATE.itemsize, "the pruning's state")
            macros = totals_limits(device)
            self._rank, self._refine, self._mark = (
                device.kernel(_SOURCE, name, **macros) for name in ("rank", "refine", "mark")
            )

    def run(self, progress: Callable[[int, int], None] | None, after_iteration: Callable[[int], None] | None) -> Pruned:
        removal, options = self._removal, self._options
        left, done, weight = self._splats, 0, 0.0
        for iteration in range(options.iterations):
            if iteration == 0:
                importance = (removal.measure_totals()[:, 1] * removal.fixed_point.units[1]).astype(np.float32)
            else:
                removal.measure_on_device()
            weight = options.decay * weight + 1
            gone = self._choose(iteration, weight)
            done = iteration + 1
            if gone == 0:
                break  # no candidate is left, and measuring again would find the same
            removal.remove_marked()
            left -= gone
            if progress is not None:
                progress(done, max(left, 1))
            if after_iteration is not None:
                after_iteration(iteration)
        return self._pruned(done, importance)

    def _choose(self, iteration: int, weight: float) -> int:
        """Mark the splats that go in an iteration, and return their number."""
        removal, options = self._removal, self._options
        remaining = options.iterations - iteration
        effect_unit, importance_unit = removal.fixed_point.units
        everywhere = {"splats": self._splats, "totals": removal.totals, "keys": self._keys, "state": self._state}
        self._device.fill(self._state, np.uint32(0), _STATE.itemsize)
        self._rank.bind(
            **everywhere,
            alive=removal.marks,
            spared=self._spared,
            effect_unit=effect_unit,
            weight=weight,
            limit=options.delta_mse_max,
            a=options.a,
            smoothed=self._smoothed,
        )
        self._launch(self._rank)
        if remaining > 1:
            for digit in range(1, _DIGITS):
                self._refine.bind(**everywhere, digit=digit, remaining=remaining)
                self._launch(self._refine)
        self._mark.bind(
            **everywhere,
            alive=removal.marks,
            effect_unit=effect_unit,
            importance_unit=importance_unit,
            iteration=iteration,
            remaining=remaining,
            removed=self._removed,
        )
        self._launch(self._mark)
        gone = np.empty(1, np.uint32)
        self._device.copy(gone, self._state, of=bytes_before(_STATE, "gone"))
        return int(gone[0])

    def _launch(self, kernel: Kernel) -> None:
        groups = -(-self._splats // _DIGIT)
        kernel.launch((groups * _DIGIT,), (_DIGIT,))

    def _pruned(self, done: int, importance: NDArray[np.float32]) -> Pruned:
        device, n = self._device, self._splats
        alive = self._removal.alive.copy()
        smoothed = device.download(self._smoothed, (n,), np.float32)
        smoothed[device.download(self._spared, (n,), np.bool_)] = BEYOND
        removed = device.download(self._removed, (n,), _REMOVED)
        iteration = removed["iteration"].astype(np.int32)
        iteration[alive] = -1
        if not alive.any():  # an empty scene is no scene
            final = np.flatnonzero(iteration == iteration.max())
            last = final[ascending(removed["key"][final])][-1]
            alive[last], iteration[last] = True, -1
        # Others go on with what is left meanwhile.
        course = in_background(_course, iteration, removed, smoothed)
        return Pruned(int(np.count_nonzero(alive)), iteration, done, importance, course.result)


def _course(iteration: NDArray[np.int32], removed: np.ndarray, smoothed: NDArray[np.float32]) -> Course:
    """What the device has told: (N,) in which iteration each splat went, else -1, and what it was worth then."""
    score = np.where(iteration < 0, smoothed, removed["key"])
    gone = np.flatnonzero(iteration >= 0)
    own, effects = iteration[gone], removed["effect"][gone]
    counts = np.bincount(own)
    importance, effect = (np.bincount(own, values) for values in (removed["importance"][gone], effects))
    largest = np.full(len(counts), -np.inf)
    np.maximum.at(largest, own, effects)
    some = np.flatnonzero(counts)
    left = len(iteration) - np.cumsum(counts)
    columns = (each[some].tolist() for each in (left, importance, effect, largest))
    return Course(score, tuple(Iteration(*each) for each in zip(*columns, strict=True)))
