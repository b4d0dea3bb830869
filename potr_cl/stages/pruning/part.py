"""A part of the views of a removal measurement, on a worker: :class:`RemovalPart`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.relay import Lent
from potr_cl.raster.carried import Excerpt
from potr_cl.raster.kept_scene import KeptScene, PartOfKept, lying_on, whole_on_device
from potr_cl.stages.pruning.alive_packing import AlivePacking
from potr_cl.stages.pruning.changed_totals import ChangedTotals, Changes
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
            self._alive = owned.enter_context(AlivePacking(device, self._sweep.splats, self._sweep.marks))
            self._changed: ChangedTotals | None = None
            self._owned = owned.pop_all()
        self._device = device
        self._told: tuple[int, Iterator[tuple[int, Indices, NDArray[np.float64]]]] | None = None

    def can_steer(self) -> bool:
        """Whether the device can list stale tiles itself."""
        return self._sweep.steering is not None

    def changes(self) -> Changes:
        """By how much the totals of the splats that are left have changed since the last call; all, at the first.

        See :mod:`potr_cl.stages.pruning.changed_totals`; valid until the next call.
        """
        sweep = self._sweep
        if self._changed is None:
            self._changed = self._owned.enter_context(ChangedTotals(self._device, sweep.splats, sweep.marks))
        sweep.measure_on_device()
        return self._changed.take(sweep.totals)

    def lend_totals(self) -> Lent:
        """The totals, for others of this process to read from the device until the next command.

        Those of all splats, or of those that are left, as :class:`AlivePacking` has them.
        """
        self._sweep.measure_on_device()
        return self._alive.lend(self._sweep.totals)

    def remove_marked(self, splats: Bits) -> None:
        """Take splats out for good, a bit each (:meth:`Survivors.just_marked`)."""
        if self._sweep.steering is None:
            marked = np.unpackbits(splats, count=self._sweep.splats, bitorder="little")
            self._sweep.remove(np.flatnonzero(marked))
        else:
            self._sweep.mark(splats)
            self._sweep.remove_marked()
        self._alive.note()

    def replace_sh(self, sh: FloatArray) -> None:
        """Go on with other colours."""
        self._sweep.replace_sh(sh)

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
