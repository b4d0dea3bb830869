"""Colours rounded to the steps of a file in rounds, between which the others are solved for again: :class:`Rounding`.

A coefficient that is rounded alone leaves an error in the pictures, and those of many splats add up. What is not
rounded yet can take most of it back. So half of the splats come first: their AC coefficients one after another, each
making up for those before it within the splat (cl/refit/rounding.cl; Babai: "On Lovász' lattice reduction and the
nearest lattice point problem", 1986, the nearest-plane method), and then the constant ones. All that is still free
takes some steps towards the pictures. Then come the AC coefficients of the other splats and half of their constant
ones, and after some more steps the rest. Each lies among others that are rounded at another time.

An AC coefficient becomes 0 instead of one step where the bits that this saves are worth more than the error that it
adds: rate-distortion optimised quantisation (Karczewicz, Ye, Chong: "Rate distortion optimized quantization",
VCEG-AH21, 2008), with an error that counts what the others of the splat make up for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.opencl.memory import Memory, Owner
from potr_cl.outputs.output import ColourGrid
from potr_cl.stages.refitting.blocks import SplatBlocks
from potr_cl.stages.refitting.coefficients import Coefficients, Vector
from potr_cl.stages.refitting.layout import CHANNELS

_SOURCE = "refit/rounding.cl"
#: Splats are due in so many turns: every fourth one in the order of the file in turn 0, the next ones in turn 1, …
TURNS = 4
_NEVER = np.iinfo(np.int32).max


@dataclass(frozen=True)
class Round:
    """What is rounded together.

    Attributes:
        others: the AC coefficients of splats that are due in this turn and before.
        constant: the constant coefficients of splats that are due in this turn and before; -1: none.
        steps: that what is free then takes towards the pictures.
    """

    others: int
    constant: int
    steps: int


#: The constant coefficients of the last turn stay as they are: they are rounded as the file is made.
ROUNDS = (Round(others=1, constant=1, steps=3), Round(others=3, constant=2, steps=2))


@dataclass(frozen=True)
class Steps:
    """When each splat is rounded, and to what.

    Attributes:
        turns: (stride,) int32, the turn in which a splat is due.
        constant, others: (stride,) float32, as of :class:`potr_cl.outputs.output.ColourGrid`.
    """

    turns: NDArray[np.int32]
    constant: NDArray[np.float32]
    others: NDArray[np.float32]

    @staticmethod
    def of(grid: ColourGrid, stride: int) -> Steps:
        """Those of a grid, padded."""
        turns = np.full(stride, _NEVER, np.int32)
        turns[grid.order] = np.arange(len(grid.order)) % TURNS
        constant, others = np.ones((2, stride), np.float32)
        constant[: len(grid.constant)], others[: len(grid.others)] = grid.constant, grid.others
        return Steps(turns, constant, others)


class Rounding(Owner):
    """The steps of one scene's colours.

    Args:
        coefficients: whose vectors are rounded.
        steps: of the splats.

    Raises:
        DeviceError: the device has no room, or the kernels cannot be built.
    """

    def __init__(self, coefficients: Coefficients, steps: Steps) -> None:
        self._coefficients = coefficients
        device, layout = coefficients.device, coefficients.layout
        self._round_ac, self._round_constant = (
            device.shared_kernel(_SOURCE, name, **layout.macros) for name in ("round_ac", "round_constant")
        )
        self._memory = Memory(device)
        with device.all_or_nothing():
            self._turns, self._constant, self._others = (
                coefficients.holding(self._memory, each, "the steps of colours")
                for each in (steps.turns, steps.constant, steps.others)
            )

    def round(self, x: Vector, blocks: SplatBlocks, this: Round, worth: float) -> None:
        """Round some of the active coefficients, and make them inactive.

        Args:
            x: the coefficients.
            blocks: the splats' own blocks of the normal equations.
            this: which ones.
            worth: weighted squared error that it is worth to save an AC coefficient.
        """
        active, turns = self._coefficients.active, self._turns
        read = (x, active, blocks.array, turns, self._constant, self._others)
        for part in self._coefficients.slices(read, (x, active)):
            own = {"coefficients": part[x], "active": part[active], "turns": part[turns], "stride": part.stride}
            for channel in range(CHANNELS):
                self._round_ac.bind(
                    **own,
                    blocks=part[blocks.array],
                    steps=part[self._others],
                    turn=this.others,
                    to_zero=np.float32(worth),
                    c=channel,
                )
                part.run(self._round_ac)
            self._round_constant.bind(**own, steps=part[self._constant], turn=this.constant)
            part.run(self._round_constant)

    def close(self) -> None:
        """Give the device's memory back."""
        self._memory.close()
