"""What colours remember of where they were trained from: :class:`Memory`.

Training moves the coefficients of a splat along the basis functions of its views' directions, so the squared deviation
of its colour, averaged over many splats, follows the density of the views (``energy`` in
:mod:`potr_cl.model.spherical_harmonics`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.sampling import F64
from potr_cl.model.spherical_harmonics import unit_coefficients
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory as DeviceMemory
from potr_cl.placement.space import Space

F32 = NDArray[np.float32]

_SOURCE, _GROUP = "placement/energies.cl", 64
#: Splats with coefficients to speak of, below which colours tell nothing; and coefficients, with the constant one: a
#: function of the first degree varies as much away from a view as towards it.
_INFORMATIVE, _COEFFICIENTS = 100, 9
#: What counts as the best of some places: this quantile.
_BEST = 0.95


@dataclass(frozen=True)
class Memory:
    """The colours of some points, and places to compare with.

    Attributes:
        points: (K, 3) world units.
        colours: (K, M - 1, 3) AC coefficients of unit norm, 0 where there are none to speak of.
        best: (R, K) the energies towards the places that others are compared with.
    """

    device: Device
    space: Space
    points: F64
    colours: F32
    best: F32

    @staticmethod
    def of(device: Device, space: Space, points: F64, sh: F32, places: F64) -> Memory | None:
        """What there is to remember; None: nothing.

        Args:
            device: computes.
            space: where the points are.
            points: (K, 3) world units.
            sh: (K, M, 3) the coefficients there.
            places: (R, 3) to compare with.
        """
        if sh.shape[1] < _COEFFICIENTS:
            return None
        colours = unit_coefficients(sh[:, 1:]).astype(np.float32)
        if np.count_nonzero(colours.any(axis=(1, 2))) < _INFORMATIVE:
            return None
        memory = Memory(device, space, points, colours, np.empty((0, len(points)), np.float32))
        return Memory(device, space, points, colours, memory._energies(places))

    def of_places(self, places: F64, shown: F32) -> F64:
        """How well places are remembered, (P,): as a part of how well the same points remember the best ones.

        Args:
            places: (P, 3).
            shown: (P, K) how well each shows each point, 0 to 1.
        """
        weights = shown * self.colours.any(axis=(1, 2))
        total = np.maximum(weights.sum(axis=1), 1e-6)
        own = np.einsum("pk,pk->p", weights, self._energies(places)) / total
        best = np.quantile(weights @ self.best.T / total[:, None], _BEST, axis=1)
        # Of a place that shows none of them nothing is known.
        found: F64 = np.where(weights.any(axis=1), own / np.maximum(best, 1e-12), 1.0)
        return found

    def _energies(self, places: F64) -> F32:
        """(P, K) towards places."""
        kernel = self.device.shared_kernel(_SOURCE, "energies", SH_COUNT=self.colours.shape[1] + 1)
        count = len(self.points)
        with DeviceMemory(self.device) as memory:
            found = memory.allocate(4 * count * len(places), "what colours remember")
            kernel.bind(
                places=memory.upload(self.space.in_cells(places, np.zeros(len(places))), "the places"),
                targets=memory.upload(self.space.in_cells(self.points, np.zeros(count)), "the points"),
                colours=memory.upload(np.ascontiguousarray(self.colours.reshape(count, -1).T), "the colours"),
                count=count,
                found=found,
            )
            kernel.launch((-(-count // _GROUP) * _GROUP, len(places)), (_GROUP, 1))
            return self.device.download(found, (len(places), count), np.float32)
