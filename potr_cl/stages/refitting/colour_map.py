"""The linear map A from a scene's SH coefficients to its pictures in all views, and its transpose.

For given geometry and opacities the pictures are linear in the coefficients, pictures = A x + a constant, as long as no
colour is cut at 0. Colours that are cut at some x count as constant: :meth:`ColourMap.gradient` settles at its x which
are, and :meth:`ColourMap.normal` goes by that.

A product with Aᵀ W A is a sum over views (own_views.py). The sums are integers. So it makes no difference to any bit if
other devices do some of the views (helpers.py): here all are added up.
"""

from __future__ import annotations

import math

import pyopencl as cl

from potr_cl.opencl.memory import Memory
from potr_cl.stages.compaction.view_weights import REFERENCE_PIXELS
from potr_cl.stages.refitting.blocks import SplatBlocks
from potr_cl.stages.refitting.coefficients import Coefficients, Vector
from potr_cl.stages.refitting.helpers import ColourHelpers
from potr_cl.stages.refitting.own_views import Look, OwnViews
from potr_cl.stages.refitting.sliced_arrays import Ridge
from potr_cl.views.targets import Targets

#: Views from which on some of their pixels can stand for all: with few, each splat is seen in few pixels as it is.
ENOUGH = 100


class ColourMap:
    """A of one scene and some views, with pixels weighed by W.

    Args:
        coefficients: whose vectors the map takes and gives.
        own: the views that are done here.
        helpers: do the others.

    Attributes:
        own: as given.
        total_weight: the sum over all pixels and channels of their weights: a squared error over it is a mean one.
    """

    def __init__(self, coefficients: Coefficients, own: OwnViews, helpers: ColourHelpers | None = None) -> None:
        self._coefficients, self.own, self._helpers = coefficients, own, helpers
        self.total_weight = 3 * REFERENCE_PIXELS * own.count

    def gradient(
        self,
        x: Vector,
        targets: Targets,
        result: Vector,
        blocks: SplatBlocks | None = None,
        constant: bool = False,
        every: int = 1,
    ) -> float:
        """result += Aᵀ W (pictures(x) - targets), half the gradient of the squared error at x.

        Colours that are cut at 0 at x are settled: they have no part in it.

        Args:
            x: the coefficients.
            targets: what the pictures should show.
            result: a vector.
            blocks: become the splats' own blocks of Aᵀ W A; cuts are left out of account there.
            constant: leave the result's AC coefficients alone. Not together with blocks.
            every: of so many blocks of pixels one stands for all, on CPUs and where views are many; not together with
                blocks.

        Returns:
            The squared error |pictures(x) - targets|² by W.
        """
        own, coefficients, unit, every = self.own, self._coefficients, 1 / self.own.one, self._sampled(every)
        ranges = [] if blocks is None else blocks.ranges
        with Memory(coefficients.device) as memory:
            sums = self._block_sums(memory, ranges[0]) if ranges else None
            on_device = coefficients.on_device(x)
            if self._helpers is not None:
                own.prepare(targets)  # it waits for this device, from which the others then read x
                self._helpers.begin_gradient(on_device, ranges[0] if ranges else None, constant, every)
            own.add_up(Look(on_device, targets, constant=constant, every=every, blocks=sums))
            errors = {} if self._helpers is None else self._helpers.add(own.sums, sums)
            errors |= own.found_errors()
            coefficients.add_sums(result, own.sums, every * unit, constant)
            if blocks is not None:
                blocks.set_fixed(ranges[0], sums, unit)
                coefficients.device.finish()  # before their memory is given back
        for splats in ranges[1:]:
            with Memory(coefficients.device) as memory:
                sums = self._block_sums(memory, splats)
                if self._helpers is not None:
                    self._helpers.begin_blocks(splats)
                own.add_up(Look(blocks=sums, first_block=splats.start))
                if self._helpers is not None:
                    self._helpers.add_blocks(sums)
                assert blocks is not None
                blocks.set_fixed(splats, sums, unit)
                coefficients.device.finish()
        return every * math.fsum(errors[number] for number in sorted(errors))

    def _sampled(self, every: int) -> int:
        """Of how many blocks of pixels a gradient looks at one: on GPUs the errors of others would count too."""
        return every if self.own.count >= ENOUGH and self._coefficients.device.family == "cpu" else 1

    def error(self, x: Vector, targets: Targets) -> float:
        """The squared error by W at x, as :meth:`gradient` returns it, which takes nearly twice as long.

        Colours that are cut at 0 at x are settled here too.

        Args:
            x, targets: as of :meth:`gradient`.
        """
        own, on_device = self.own, self._coefficients.on_device(x)
        if self._helpers is not None:
            own.prepare(targets)
            self._helpers.begin_gradient(on_device, None, False, back=False)
        own.add_up(Look(on_device, targets, back=False))
        errors = {} if self._helpers is None else self._helpers.add(own.sums, None)
        errors |= own.found_errors()
        return math.fsum(errors[number] for number in sorted(errors))

    def normal(
        self,
        direction: Vector,
        result: Vector,
        at: Vector,
        ridge: Ridge,
        constant: bool = False,
        every: int = 1,
    ) -> None:
        """result = (Aᵀ W A + ridge) direction, but 0 for the pictures' part if the direction is 0 or not finite.

        Args:
            direction: a vector. It may be of any length: it is scaled so that the fixed point of the sums fits.
            result: another vector.
            at: the vector that :meth:`gradient` was given last, with the same content.
            ridge: of the coefficients that may change; the result's others become 0.
            constant: the direction's AC coefficients are all 0, and the pictures' part of the result's is left out.
            every: of so many blocks of pixels one stands for all (cl/refit/samples.clh): 1, 2 or 4. Where views are
                few, all are looked at.
        """
        own, coefficients = self.own, self._coefficients
        every = every if own.count >= ENOUGH else 1
        coefficients.zero(result)
        largest = coefficients.largest(direction)
        if 0 < largest < math.inf:
            unit = 1 / largest
            on_device = coefficients.on_device(direction)
            if self._helpers is not None:
                self._helpers.begin_normal(on_device, coefficients.on_device(at, 1), unit, constant, every)
            own.add_up(Look(on_device, None, at, unit, constant, every))
            if self._helpers is not None:
                self._helpers.add(own.sums, None)
            coefficients.add_sums(result, own.sums, every / (own.one * unit), constant)
        coefficients.add_ridge(result, direction, ridge)

    def _block_sums(self, memory: Memory, splats: range) -> cl.Buffer:
        """Integers for the blocks of some splats, 0."""
        layout = self._coefficients.layout
        sums = memory.allocate(8 * layout.triangle * len(splats), "the splats' normal equations")
        self._coefficients.zero(sums)
        return sums
