"""A part of the views of a removal measurement, on a worker: :class:`RemovalPart`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Scratch, Staging
from potr_cl.opencl.narrow import Narrowing
from potr_cl.opencl.relay import Lent
from potr_cl.raster.carried import Excerpt
from potr_cl.raster.kept_scene import KeptScene, PartOfKept, lying_on, whole_on_device
from potr_cl.stages.pruning.alive_packing import AlivePacking
from potr_cl.stages.pruning.changed_totals import (
    ChangedTotals,
    Changes,
    ChangesOfHost,
    changes_on_host,
    numbers_or_bits,
)
from potr_cl.stages.pruning.planned import planned_sweep
from potr_cl.stages.pruning.survivors import Bits
from potr_cl.stages.pruning.sweep_options import SweepOptions
from potr_cl.views.visibility import Visibility
from potr_cl.workers.pool import Part

Indices = NDArray[np.int64]


class RemovalPart(Part):
    """Some of the views; see :class:`potr_cl.stages.pruning.removal.RemovalSweep`.

    Args:
        device: to compute on.
        memory: bytes of its memory that the views may take; None: the default.
        scene: the uncompressed scene, perhaps kept on devices; or of it what these views may draw
            (:mod:`potr_cl.views.shares`).
        cameras: all views.
        options: speed/accuracy trade-offs.
        background: R, G, B behind the scene.
        numbers: of the views of this part, ascending.
        sights: what all views see of it, where each had better be looked at with what it sees; None: with all splats.

    Raises:
        DeviceError: the scene or a view does not fit the device.
    """

    def __init__(
        self,
        device: Device,
        memory: int | None,
        scene: Scene | KeptScene | PartOfKept | Excerpt,
        cameras: Sequence[Camera],
        options: SweepOptions,
        background: tuple[float, float, float],
        numbers: Sequence[int],
        sights: Visibility | None = None,
    ) -> None:
        options = SweepOptions(**{**vars(options), "memory": memory})
        with ExitStack() as owned:
            drawable = owned.enter_context(lying_on(device, scene))
            if sights is not None:
                drawable = owned.enter_context(whole_on_device(device, drawable))
            sweep = planned_sweep(device, drawable, cameras, options, background, sights, numbers)
            self._sweep = owned.enter_context(sweep)
            steering = self._sweep.steering
            self._alive = (
                None
                if steering is None
                else owned.enter_context(AlivePacking(device, self._sweep.splats, steering.marks))
            )
            self._changed: ChangedTotals | None = None
            self._narrowing: Narrowing | None = None
            self._staging = owned.enter_context(Staging(device))
            self._totals = owned.enter_context(Scratch(device, "the removal effects"))
            self._owned = owned.pop_all()
        self._device = device
        self._sent: NDArray[np.int64] | None = None
        self._told: tuple[int, Iterator[tuple[int, Indices, NDArray[np.float64]]]] | None = None

    @property
    def steers(self) -> bool:
        """Whether the device can list stale tiles itself."""
        return self._sweep.steering is not None

    def can_steer(self) -> bool:
        """:attr:`steers`, as a command."""
        return self.steers

    def measure(self) -> NDArray[np.int64]:
        """(N, 2) int64, the totals of these views in units of the fixed point of all; valid until the next call."""
        steering = self._sweep.steering
        if steering is None:
            return self._sweep.measure_totals()
        steering.measure_on_device()
        totals: NDArray[np.int64] = self._staging.download(steering.totals, (self._sweep.splats, 2), np.int64)
        return totals

    def measure_changes(self) -> ChangesOfHost:
        """What has changed in the totals of the splats that are left since the last call; all, at the first.

        Valid until the next call.
        """
        totals = self.measure().copy()
        sent = self._before()
        # Column by column, and whole rows taken: five times as fast as "any" and indexing.
        other = (totals[:, 0] != sent[:, 0]) | (totals[:, 1] != sent[:, 1])
        other &= self._sweep.alive
        changed = np.flatnonzero(other)
        changes = totals.take(changed, axis=0) - sent.take(changed, axis=0)
        self._sent = totals
        if self._narrowing is None:
            self._narrowing = self._owned.enter_context(Narrowing(self._device))
        # The effects and the importances by themselves: those beside each other are about as long.
        narrowed = self._narrowing.narrowed(np.ascontiguousarray(changes.T))
        return numbers_or_bits(changed, other), narrowed

    def changes(self) -> Changes:
        """The same as bits and a row (:mod:`potr_cl.stages.pruning.changed_totals`), for a master whose device adds up.

        Valid until the next call. Of :meth:`measure_changes` and this, a master asks for one and the same all the time.
        """
        steering = self._sweep.steering
        if steering is None:  # some views do not fit this device
            totals = self.measure().copy()
            found = changes_on_host(totals, self._before(), self._sweep.alive)
            self._sent = totals
            return found
        if self._changed is None:
            self._changed = self._owned.enter_context(ChangedTotals(self._device, self._sweep.splats, steering.marks))
        steering.measure_on_device()
        return self._changed.take(steering.totals)

    def _before(self) -> NDArray[np.int64]:
        """(N, 2) the totals that the master has."""
        return np.zeros((self._sweep.splats, 2), np.int64) if self._sent is None else self._sent

    def lend_totals(self) -> Lent:
        """The totals of :meth:`measure`, for others of this process to read from the device until the next command.

        Those of all splats, or of those that are left, as :class:`AlivePacking` has them.
        """
        steering, nbytes = self._sweep.steering, 16 * self._sweep.splats
        if steering is None:  # some views do not fit this device
            self._totals.reserve(nbytes)
            totals = self._sweep.measure_totals()
            cl.enqueue_copy(self._device.queue, self._totals.buffer, totals, is_blocking=True)
            return Lent(self._device, self._totals.buffer, nbytes)
        steering.measure_on_device()
        assert self._alive is not None
        return self._alive.lend(steering.totals)

    def remove(self, splats: Indices) -> None:
        """Take splats out for good."""
        self._sweep.remove(splats)

    def remove_marked(self, splats: Bits) -> None:
        """Take splats out for good, as a device has marked them (:meth:`Survivors.just_marked`)."""
        steering = self._sweep.steering
        if steering is None:
            marked = np.unpackbits(splats, count=self._sweep.splats, bitorder="little")
            self._sweep.remove(np.flatnonzero(marked))
        else:
            steering.mark(splats)
            steering.remove_marked()
            assert self._alive is not None
            self._alive.note()

    def replace_sh(self, sh: FloatArray) -> None:
        """Go on with other colours."""
        self._sweep.replace_sh(sh)

    def sweep_everything(self) -> None:
        """Have the next measurement sweep every tile."""
        self._sweep.sweep_everything()

    def sweep_changed(self) -> None:
        """Measure whatever anything was removed from since it was last measured."""
        self._told = None
        self._sweep.sweep_changed()

    def importances(self, place: int) -> tuple[int, NDArray[np.uint32], NDArray[np.float64]] | None:
        """What is known of one view after :meth:`sweep_changed`.

        Args:
            place: of the view in this part; fastest one after the other.

        Returns:
            The view's number among all, the splats that it sees, ascending, and the mean of T α of each over its
            pixels; None behind the last view.
        """
        if self._told is None or self._told[0] != place:
            known = self._sweep.known_importances()
            for _ in range(place):
                next(known, None)
        else:
            known = self._told[1]
        found = next(known, None)
        self._told = (place + 1, known)
        return None if found is None else (found[0], found[1].astype(np.uint32), found[2])

    def close(self) -> None:
        """Give all device memory back."""
        self._owned.close()
