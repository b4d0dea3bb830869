"""The splats' own blocks of the normal equations (:class:`SplatBlocks`): the preconditioner, what tells which
coefficients to give up, and what colours are rounded by (:class:`Rounding`).

A splat's block is the sum over views s and pixels of w_s (T alpha)^2 B Bᵀ, B the SH basis towards the splat, for a
channel of unit length in R, G, B; Y, Co and Cg have the squared lengths 3, 2 and 3 and do not mix.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.model.scene import FloatArray
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.outputs.output import ColourGrid
from potr_cl.raster.scene_buffers import SPLAT_GROUP
from potr_cl.stages.refitting.coefficients import Coefficients, Vector
from potr_cl.stages.refitting.sliced_arrays import CHANNELS, Ridge

_SOURCE = "refit/blocks.cl"
#: Splats of a work-group of kernels that have arrays in local memory, OWN_GROUP of theirs.
_OWN_GROUP = 32


def _group(device: Device) -> dict[str, int]:
    """The work-group of kernels that have them there on some GPUs only (cl/include/registers.clh)."""
    return {} if device.sub_group is None else {"group": _OWN_GROUP}


class SplatBlocks:
    """A symmetric block a splat, cl/refit/blocks.cl.

    Args:
        coefficients: whose vectors and flags they go with; they are given back with these.
        splats: whose integers are on the device at a time; None: all.

    Attributes:
        array: (M (M + 1) / 2, stride) float32, packed upper triangles.
        ranges: the splats whose blocks are added up together.

    Raises:
        PotrError: the host has no room for them.
        DeviceError: the device has none, or the kernels cannot be built.
    """

    def __init__(self, coefficients: Coefficients, splats: int | None = None) -> None:
        self._coefficients = coefficients
        device, layout = coefficients.device, coefficients.layout
        self._precondition, self._select_active, self._same_for_all, self._set_shares = (
            device.shared_kernel(_SOURCE, name, **layout.macros)
            for name in ("precondition", "select_active", "same_for_all", "set_shares")
        )
        self.array = coefficients.array(layout.triangle, "the splats' normal equations")
        self._shares = coefficients.array(1, "the splats' shares of pixels")
        some = layout.stride
        if splats is not None and not coefficients.whole:
            some = min(max(splats // SPLAT_GROUP, 1) * SPLAT_GROUP, some)
        self.ranges = [range(first, min(first + some, layout.stride)) for first in range(0, layout.stride, some)]

    def set_fixed(self, splats: range, sums: cl.Buffer, unit: float) -> None:
        """blocks = unit times integers, which become 0.

        Args:
            splats: whose blocks, one of :attr:`ranges`.
            sums: (M (M + 1) / 2, len(splats)) int64.
            unit: in single precision.
        """
        self._coefficients.set_sums(self.array, sums, unit, splats)

    def packed(self) -> FloatArray:
        """(M (M + 1) / 2, N) float32, the upper triangles row by row."""
        return self._coefficients.read(self.array)

    def diagonals(self) -> FloatArray:
        """(N, M) float32, what stands on the blocks' diagonals."""
        layout = self._coefficients.layout
        diagonals = np.empty((layout.splats, layout.sh_count), np.float32)
        for m in range(layout.sh_count):
            diagonals[:, m] = self._row(m * layout.sh_count - m * (m - 1) // 2)
        return diagonals

    def constants(self) -> FloatArray:
        """(N,) float32, what stands on the blocks' diagonals for the constant coefficient."""
        return self._row(0).copy()

    def _row(self, number: int) -> FloatArray:
        row: FloatArray = self._coefficients.read(self.array, range(number, number + 1))[0]
        return row

    def share(self, product: Callable[[Vector, Vector], None], direction: Vector, result: Vector) -> None:
        """Find each splat's share of its pixels, which :meth:`precondition` goes by from then on.

        A splat's own block says how far to go if no other moves. But where many faint ones lie behind each other, all
        see the same error, and together they go many times too far. How many that is, the product with a direction
        tells in which all splats change alike: over the block's own part, it is what the others would take away if
        each went as far as it wants to. To divide by it would be right for what all of a pixel's splats have in common,
        and far too little for the rest: its fourth root is between.

        Args:
            product: of a direction in which only constant coefficients change, result = H direction.
            direction, result: vectors, which are used up.
        """
        coefficients = self._coefficients
        active = coefficients.active
        for part in coefficients.slices((active,), (direction,)):
            self._same_for_all.bind(active=part[active], stride=part.stride, direction=part[direction])
            part.run(self._same_for_all)
        product(direction, result)
        for part in coefficients.slices((result, self.array), (self._shares,)):
            self._set_shares.bind(
                product=part[result], blocks=part[self.array], stride=part.stride, shares=part[self._shares]
            )
            part.run(self._set_shares)

    def precondition(self, residual: Vector, result: Vector, ridge: Ridge) -> None:
        """result = share (block + ridge)⁻¹ residual on each splat's active coefficients, 0 on the others."""
        active = self._coefficients.active
        for part in self._coefficients.slices((residual, active, self.array, self._shares), (result,)):
            self._precondition.bind(
                residual=part[residual],
                blocks=part[self.array],
                active=part[active],
                shares=part[self._shares],
                stride=part.stride,
                result=part[result],
                **ridge.scalars,
            )
            part.run(self._precondition, CHANNELS, **_group(self._coefficients.device))

    def give_up(self, x: Vector, prior: float, least: float) -> None:
        """Set AC coefficients that cost less than ``least`` to 0 and make them inactive.

        In each channel, the coefficient whose loss costs least goes first, and the others make up for it; then the next
        one, as long as one is cheap enough. The loss of x_m costs x_m² / P_mm, where P is the inverse of the block.

        Args:
            x: the coefficients.
            prior: added to the blocks' diagonals.
            least: weighted squared error.
        """
        active = self._coefficients.active
        for part in self._coefficients.slices((x, active, self.array), (x, active)):
            for channel in range(CHANNELS):
                self._select_active.bind(
                    coefficients=part[x],
                    blocks=part[self.array],
                    active=part[active],
                    stride=part.stride,
                    prior=np.float32(prior),
                    least=np.float32(least),
                    c=channel,
                )
                part.run(self._select_active, group=_OWN_GROUP)


_ROUNDING = "refit/rounding.cl"
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
ROUNDS = (Round(others=1, constant=1, steps=3), Round(others=3, constant=2, steps=1))


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
    """Colours rounded to the steps of a file in rounds, between which the others are solved for again.

    A coefficient that is rounded alone leaves an error in the pictures, and those of many splats add up. What is not
    rounded yet can take most of it back. So half of the splats come first: their AC coefficients one after another,
    each making up for those before it within the splat (cl/refit/rounding.cl; Babai: "On Lovász' lattice reduction and
    the nearest lattice point problem", 1986, the nearest-plane method), and then the constant ones. All that is still
    free takes some steps towards the pictures. Then come the AC coefficients of the other splats and half of their
    constant ones, and after some more steps the rest. Each lies among others that are rounded at another time.

    An AC coefficient becomes 0 instead of one step where the bits that this saves are worth more than the error that it
    adds: rate-distortion optimised quantisation (Karczewicz, Ye, Chong: "Rate distortion optimized quantization",
    VCEG-AH21, 2008), with an error that counts what the others of the splat make up for.

    Args:
        coefficients: whose vectors are rounded.
        steps: of the splats.
    """

    def __init__(self, coefficients: Coefficients, steps: Steps) -> None:
        self._coefficients = coefficients
        device, layout = coefficients.device, coefficients.layout
        self._round_ac, self._round_constant = (
            device.shared_kernel(_ROUNDING, name, **layout.macros) for name in ("round_ac", "round_constant")
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
                part.run(self._round_ac, **_group(self._coefficients.device))
            self._round_constant.bind(**own, steps=part[self._constant], turn=this.constant)
            part.run(self._round_constant)
