"""A part of the views of a re-fit, on a worker: :class:`ColourPart`."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory
from potr_cl.opencl.narrow import Narrowed
from potr_cl.opencl.relay import Lent
from potr_cl.raster.carried import Excerpt
from potr_cl.raster.kept_scene import KeptScene, lying_on, whole_on_device
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import RasterRules
from potr_cl.raster.scene_buffers import stride_of
from potr_cl.stages.refitting.coefficients import Coefficients
from potr_cl.stages.refitting.coming_scene import AnyScene, arrived, colourless
from potr_cl.stages.refitting.exchange import Exchange, SentVector
from potr_cl.stages.refitting.layout import Layout
from potr_cl.stages.refitting.own_views import OwnViews
from potr_cl.stages.refitting.sweep import Sweep
from potr_cl.views.reached import reached_splats
from potr_cl.views.targets import PicturesAhead, Targets, targets_of
from potr_cl.views.visibility import Visibility
from potr_cl.workers.pool import Part


@dataclass(frozen=True)
class Gradient:
    """What the views of a part add to a gradient.

    Attributes:
        errors: the squared error by W of each view, by number.
        sums: (active coefficients,) int64.
        blocks: (M (M + 1) / 2, stride) int64, the sums of the splats' own blocks, where they are lent.
        drawn: (N / 8, rounded up) uint8, a bit for each splat that the views draw, the lowest first, if that is asked:
            whatever the others' colours are, the sums are the same, and theirs are 0.
    """

    errors: dict[int, float]
    sums: Narrowed | Lent
    blocks: Lent | None = None
    drawn: NDArray[np.uint8] | None = None

    @property
    def nbytes(self) -> int:
        """Bytes that travel."""
        return (
            16 * len(self.errors)
            + self.sums.nbytes
            + sum(each.nbytes for each in (self.blocks, self.drawn) if each is not None)
        )


class ColourPart(Part):
    """Some of the views; see :class:`potr_cl.stages.refitting.own_views.OwnViews`.

    Args:
        device: to compute on.
        memory: bytes of its memory that prepared views and targets may take; None: the default.
        scene: whose geometry and opacities are used, perhaps still to come; its colours are not looked at.
        sh_count: M, coefficients of a channel.
        rules, background: of the rasterizer.
        source: the scene whose pictures are the targets, perhaps kept on devices, with pictures of it there, or what
            these views see of it.
        cameras: all views.
        numbers: of the views of this part, ascending.
        sights: what all views may draw of the source, where no view sees much of it.

    Raises:
        DeviceError: the scenes or a view do not fit the device.
    """

    def __init__(
        self,
        device: Device,
        memory: int | None,
        scene: AnyScene,
        sh_count: int,
        rules: RasterRules,
        background: tuple[float, float, float],
        source: Scene | KeptScene | PicturesAhead | Excerpt,
        cameras: Sequence[Camera],
        numbers: Sequence[int],
        sights: Visibility | None = None,
    ) -> None:
        self._device = device
        with ExitStack() as owned:
            sweep = Sweep(device, rules)
            layout = Layout(len(scene), stride_of(len(scene)), sh_count, sweep.lanes)
            self._coefficients = owned.enter_context(Coefficients(device, layout))
            self._exchange = owned.enter_context(Exchange(self._coefficients))
            self._x, self._direction = self._coefficients.vector(), self._coefficients.vector()
            self._coefficients.zero(self._x)
            ahead, kept = (source, source.source) if isinstance(source, PicturesAhead) else (None, source)
            pictured = owned.enter_context(lying_on(device, kept))
            if sights is not None:
                pictured = owned.enter_context(whole_on_device(device, pictured))
            of_source = owned.enter_context(targets_of(device, pictured, cameras, background, sights))
            here = arrived(scene)
            rasterizer = owned.enter_context(Rasterizer(device, colourless(here), rules))
            self._reach = reach = reached_splats(rasterizer, cameras, numbers, memory)
            self._views = owned.enter_context(
                OwnViews(sweep, rasterizer, self._coefficients, cameras, background, memory, numbers, reach=reach)
            )
            self._targets: Targets = of_source
            if ahead is not None:
                self._targets = ahead.before(device, self._targets)
            self._views.prepare(self._targets)
            self._blocks = owned.enter_context(Memory(device))
            self._block_sums: cl.Buffer | None = None
            self._owned = owned.pop_all()

    def gradient(
        self,
        x: SentVector,
        flags: NDArray[np.uint32] | Lent,
        blocks: bool,
        constant: bool,
        tell_drawn: bool = False,
    ) -> Gradient:
        """What these views add to :meth:`~potr_cl.stages.refitting.colour_map.ColourMap.gradient`.

        Args:
            x: the coefficients. If they are lent, the sums are lent too, and the blocks with them.
            flags: (2, N) uint32, which of them are active.
            blocks: whether the splats' own blocks are wanted; see :meth:`block_rows`.
            constant: whether only the constant coefficients are active.
            tell_drawn: whether it is asked which splats the views draw.
        """
        self._forget_blocks()
        layout = self._coefficients.layout
        self._exchange.take_flags(flags)
        self._exchange.take_vector(self._x, x)
        if blocks:
            self._block_sums = self._blocks.allocate(
                8 * layout.triangle * layout.stride, "the splats' normal equations"
            )
            self._coefficients.zero(self._block_sums)
        drawn = None
        with Memory(self._device) as memory:
            marks = None
            if tell_drawn and self._reach is None:
                marks = memory.allocate(layout.stride, "the splats that views draw")
                self._device.fill(marks, np.uint8(0))
            self._views.gradient(self._x, self._targets, self._block_sums, constant, marks)
            if tell_drawn:
                drawn = self._drawn(marks)
        lent = None
        if self._block_sums is not None and self._exchange.lends:
            lent = Lent(self._device, self._block_sums, self._block_sums.size)
        sums = self._exchange.send_sums(self._views.sums)
        return Gradient(self._views.found_errors(), sums, lent, drawn)

    def leave_out(self, drawn: NDArray[np.uint8]) -> None:
        """Have no coefficient active of splats that these views do not draw.

        Args:
            drawn: (N / 8, rounded up) uint8, those that they draw, as of :attr:`Gradient.drawn`.
        """
        self._exchange.take_flags(self._exchange.flags() * unpacked(drawn, self._coefficients.layout.splats))

    def _drawn(self, marks: cl.Buffer | None) -> NDArray[np.uint8]:
        """A bit for each splat that is marked, or that any view reaches."""
        splats = self._coefficients.layout.splats
        found: NDArray[Any]
        if marks is not None:
            found = self._device.download(marks, (splats,), np.uint8)
        else:
            assert self._reach is not None
            found = self._reach.marks(splats)
        return np.packbits(found, bitorder="little")

    def block_rows(self, first: int, rows: int) -> Narrowed:
        """Some rows of the sums of the splats' own blocks after a gradient; valid until the next call.

        Returns:
            (rows, stride) int64, of packed upper triangles.
        """
        assert self._block_sums is not None, "the gradient was without blocks"
        return self._exchange.rows(self._block_sums, first, rows)

    def _forget_blocks(self) -> None:
        self._blocks.close()
        self._block_sums = None

    def normal(
        self, direction: FloatArray | Lent, unit: float, constant: bool, part: int | None = None
    ) -> Narrowed | Lent:
        """What these views add to :meth:`~potr_cl.stages.refitting.colour_map.ColourMap.normal`.

        Args:
            direction: (active coefficients,) float32. If it is lent, the sums are lent too.
            unit: it is multiplied by this.
            constant: whether only the constant coefficients are active.
            part: of the views; None: all of them.

        Returns:
            (active coefficients,) int64.
        """
        self._forget_blocks()
        self._exchange.take_floats(self._direction, direction)
        self._views.normal(self._direction, self._x, unit, constant, part)
        return self._exchange.send_sums(self._views.sums)

    def close(self) -> None:
        """Give all device memory back."""
        self._owned.close()


def unpacked(bits: NDArray[np.uint8], splats: int) -> NDArray[np.bool_]:
    """(N,), the splats whose bits are set, as of :attr:`Gradient.drawn`."""
    return np.unpackbits(bits, count=splats, bitorder="little").astype(bool)
