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
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.opencl.memory import Memory, Owner
from potr_cl.outputs.colour_grid import ColourGrid
from potr_cl.stages.refitting.blocks import SplatBlocks
from potr_cl.stages.refitting.coefficients import Coefficients
from potr_cl.stages.refitting.sliced_blocks import SlicedBlocks
from potr_cl.stages.refitting.sliced_coefficients import AnyVector, SlicedCoefficients

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
        constant, others: (stride,) float32, as of :class:`potr_cl.outputs.colour_grid.ColourGrid`.
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

    def part(self, splats: range, stride: int) -> Steps:
        """Those of some splats, padded."""

        def padded(values: NDArray[Any], by: float) -> NDArray[Any]:
            some = np.full(stride, by, values.dtype)
            some[: len(splats)] = values[splats.start : splats.stop]
            return some

        return Steps(padded(self.turns, _NEVER), padded(self.constant, 1), padded(self.others, 1))


class Rounding(Owner):
    """The steps of one scene's colours, on the device.

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
        try:
            self._turns = self._memory.upload(steps.turns, "the turns of splats")
            self._constant, self._others = (
                self._memory.upload(each, "the steps of colours") for each in (steps.constant, steps.others)
            )
        except BaseException:
            self.close()
            raise

    def round(self, x: cl.Buffer, blocks: SplatBlocks, this: Round, worth: float) -> None:
        """Round some of the active coefficients, and make them inactive.

        Args:
            x: the coefficients.
            blocks: the splats' own blocks of the normal equations.
            this: which ones.
            worth: weighted squared error that it is worth to save an AC coefficient.
        """
        layout = self._coefficients.layout
        active, stride = self._coefficients.active, layout.stride
        self._round_ac.bind(
            coefficients=x,
            blocks=blocks.buffer,
            active=active,
            turns=self._turns,
            steps=self._others,
            stride=stride,
            turn=this.others,
            to_zero=np.float32(worth),
        )
        layout.over_splats(self._round_ac)
        self._round_constant.bind(
            coefficients=x, active=active, turns=self._turns, steps=self._constant, stride=stride, turn=this.constant
        )
        layout.over_splats(self._round_constant)

    def close(self) -> None:
        """Give the device's memory back."""
        self._memory.close()


class SlicedRounding:
    """What :class:`Rounding` is, where vectors lie on the host.

    Args:
        coefficients: whose vectors are rounded.
        steps: of the splats.
    """

    def __init__(self, coefficients: SlicedCoefficients, steps: Steps) -> None:
        self._coefficients, self._steps = coefficients, steps

    def round(self, x: AnyVector, blocks: SlicedBlocks, this: Round, worth: float) -> None:
        """See :meth:`Rounding.round`."""
        own = self._coefficients.own

        def one(part: range, some: cl.Buffer) -> None:
            with Rounding(own, self._steps.part(part, own.layout.stride)) as rounding:
                rounding.round(some, blocks.give(part), this, worth)
                own.device.queue.finish()  # before the steps' memory is given back

        self._coefficients.each(x, one)
