"""The removal sweep's interface for a controller on the device: it marks splats and reads totals without the host."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.opencl.device import Device


class Steered(Protocol):
    """What :mod:`potr_cl.stages.pruning.on_device` needs.

    Attributes:
        device: where the totals and the marks are.
        totals: (N, 2) int64 in the device's memory.
        marks: (N,) uint8 in the device's memory, :class:`~potr_cl.stages.pruning.survivors.SplatState`. The controller
            marks splats as JUST_REMOVED and calls :meth:`remove_marked`; when it marks the next ones, it changes the
            earlier marks to REMOVED.
        units: ΔMSE and I of 1 in the totals.
        splats: N.
    """

    device: Device
    totals: cl.Buffer
    marks: cl.Buffer
    units: tuple[float, float]
    splats: int

    @property
    def alive(self) -> NDArray[np.bool_]:
        """(N,) which splats are left."""
        ...

    def measure_on_device(self) -> None:
        """Bring the totals up to date."""

    def remove_marked(self) -> None:
        """Take the splats out that are marked JUST_REMOVED."""
