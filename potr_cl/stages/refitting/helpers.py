"""Products of a re-fit whose views are done by several: :class:`ColourPart` does some of them on a worker, and
:class:`ColourHelpers` adds what the others find.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.errors import DeviceMemoryError
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner
from potr_cl.opencl.narrow import Narrowed
from potr_cl.opencl.relay import Lent
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.resident import ResidentScene, SceneSubset, scene_on
from potr_cl.raster.scene_buffers import stride_of
from potr_cl.stages.refitting.coefficients import Coefficients
from potr_cl.stages.refitting.exchange import DrawnRows, Exchange, SentVector
from potr_cl.stages.refitting.own_views import Look, OwnViews
from potr_cl.stages.refitting.refit_options import AnyScene, arrived, colourless
from potr_cl.stages.refitting.sliced_arrays import Layout
from potr_cl.stages.refitting.view_kernels import RefitSweep
from potr_cl.views.reached import reached_splats
from potr_cl.views.shares import HelpFrom, ViewShares
from potr_cl.views.targets import PicturesAhead, Targets, targets_of
from potr_cl.views.visibility import Visibility
from potr_cl.workers.parts import Each, Parts, Pending
from potr_cl.workers.pool import Part, Pool, Shared, Shares, shares


@dataclass(frozen=True)
class Gradient:
    """What the views of a part add to a gradient.

    Attributes:
        errors: the squared error by W of each view, by number.
        sums: (active coefficients,) int64; None: they are not wanted.
        blocks: (M (M + 1) / 2, n) int64, the sums of the splats' own blocks, where they are lent.
        drawn: (N / 8, rounded up) uint8, a bit for each splat that the views draw, the lowest first, if that is asked:
            whatever the others' colours are, the sums are the same, and theirs are 0.
    """

    errors: dict[int, float]
    sums: Narrowed | Lent | None
    blocks: Lent | None = None
    drawn: NDArray[np.uint8] | None = None

    @property
    def nbytes(self) -> int:
        """Bytes that travel."""
        return 16 * len(self.errors) + sum(
            each.nbytes for each in (self.sums, self.blocks, self.drawn) if each is not None
        )


class ColourPart(Part):
    """Some of the views; see :class:`potr_cl.stages.refitting.own_views.OwnViews`.

    Args:
        device: to compute on.
        memory: bytes of its memory that prepared views and targets may take; None: the default.
        scene: whose geometry and opacities are used, perhaps still to come; its colours are not looked at.
        sh_count: M, coefficients of a channel.
        background: of the rasterizer.
        source: the scene whose pictures are the targets, perhaps kept on devices, with pictures of it there, or what
            these views see of it.
        cameras: all views.
        numbers: of the views of this part, ascending.
        visibility: what all views may draw of the source, where no view sees much of it.
    """

    def __init__(
        self,
        device: Device,
        memory: int | None,
        scene: AnyScene,
        sh_count: int,
        background: tuple[float, float, float],
        source: Scene | ResidentScene | PicturesAhead | SceneSubset,
        cameras: Sequence[Camera],
        numbers: Sequence[int],
        visibility: Visibility | None = None,
    ) -> None:
        self._device = device
        with ExitStack() as owned:
            sweep = RefitSweep(device)
            layout = Layout(len(scene), stride_of(len(scene)), sh_count, sweep.lanes)
            self._coefficients = owned.enter_context(Coefficients(device, layout))
            self._exchange = owned.enter_context(Exchange(self._coefficients))
            self._x, self._direction = self._coefficients.vector(), self._coefficients.vector()
            self._coefficients.zero(self._x)
            ahead, kept = (source, source.source) if isinstance(source, PicturesAhead) else (None, source)
            pictured = owned.enter_context(scene_on(device, kept))
            of_source = owned.enter_context(targets_of(device, pictured, cameras, background, visibility))
            here = arrived(scene)
            rasterizer = owned.enter_context(Rasterizer(device, colourless(here)))
            self._reach = reach = reached_splats(rasterizer, cameras, numbers, memory)
            self._views = owned.enter_context(
                OwnViews(
                    sweep, rasterizer, self._coefficients, cameras, background, memory, numbers, reach, shared=True
                )
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
        blocks: range | None,
        constant: bool,
        tell_drawn: bool = False,
        back: bool = True,
        every: int = 1,
    ) -> Gradient:
        """What these views add to :meth:`~potr_cl.stages.refitting.colour_map.ColourMap.gradient`.

        Args:
            x: the coefficients. If they are lent, the sums are lent too, and the blocks with them.
            flags: (2, N) uint32, which of them are active.
            blocks: the splats whose own blocks are wanted; see :meth:`block_rows`.
            constant: whether only the constant coefficients are active.
            tell_drawn: whether it is asked which splats the views draw.
            back: whether sums are wanted, and not only errors.
            every: of so many blocks of the views' pixels one is looked at.
        """
        layout = self._coefficients.layout
        self._exchange.take_flags(flags)
        self._exchange.take_vector(self._x, x)
        first_block = self._begin_blocks(blocks)
        drawn = None
        with Memory(self._device) as memory:
            marks = None
            if tell_drawn and self._reach is None:
                marks = memory.allocate(layout.stride, "the splats that views draw")
                self._device.fill(marks, np.uint8(0))
            look = Look(
                self._x,
                self._targets,
                constant=constant,
                every=every,
                blocks=self._block_sums,
                first_block=first_block,
                drawn=marks,
                back=back,
            )
            self._views.add_up(look)
            if tell_drawn:
                drawn = self._drawn(marks)
        lent = self._lent_blocks() if self._block_sums is not None and self._exchange.lends else None
        sums = self._exchange.send_sums(self._views.sums) if back else None
        return Gradient(self._views.found_errors(), sums, lent, drawn)

    def lend_blocks(self, splats: range) -> Lent:
        """(M (M + 1) / 2, n) int64, the sums of some splats' own blocks, for others of this process."""
        first_block = self._begin_blocks(splats)
        self._views.add_up(Look(blocks=self._block_sums, first_block=first_block))
        return self._lent_blocks()

    def _begin_blocks(self, splats: range | None) -> int:
        """Have zeros for some splats' blocks, and for no others; the number of the first of these splats."""
        self._forget_blocks()
        if splats is None:
            return 0
        nbytes = 8 * self._coefficients.layout.triangle * len(splats)
        self._block_sums = self._blocks.allocate(nbytes, "the splats' normal equations")
        self._coefficients.zero(self._block_sums)
        return splats.start

    def _lent_blocks(self) -> Lent:
        assert self._block_sums is not None
        return Lent(self._device, self._block_sums, self._block_sums.size)

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
        """Some rows of the sums of all splats' own blocks after a gradient; valid until the next call.

        Returns:
            (rows, stride) int64, of packed upper triangles.
        """
        assert self._block_sums is not None, "the gradient was without blocks"
        return self._exchange.rows(self._block_sums, first, rows)

    def _forget_blocks(self) -> None:
        self._blocks.close()
        self._block_sums = None

    def normal(self, direction: FloatArray | Lent, unit: float, constant: bool, every: int = 1) -> Narrowed | Lent:
        """What these views add to :meth:`~potr_cl.stages.refitting.colour_map.ColourMap.normal`.

        Args:
            direction: (active coefficients,) float32. If it is lent, the sums are lent too.
            unit: it is multiplied by this.
            constant: whether only the constant coefficients are active.
            every: of so many blocks of the views' pixels one is looked at.

        Returns:
            (active coefficients,) int64.
        """
        self._forget_blocks()
        self._exchange.take_floats(self._direction, direction)
        self._views.add_up(Look(self._direction, None, self._x, unit, constant, every))
        return self._exchange.send_sums(self._views.sums)


def unpacked(bits: NDArray[np.uint8], splats: int) -> NDArray[np.bool_]:
    """(N,), the splats whose bits are set, as of :attr:`Gradient.drawn`."""
    return np.unpackbits(bits, count=splats, bitorder="little").astype(bool)


#: Bytes of the splats' own blocks that are added at a time.
_AT_ONCE = 1 << 26
#: The master does so many times as many views as each of the others, which wait for what they need of a vector, and
#: for which it waits until it has their sums: 5 of 60 ms a product, at a million splats and 200 views on two H200.
_OWN_SPEED = 1.06


class ColourHelpers(Owner):
    """What others add to the products of a :class:`potr_cl.stages.refitting.colour_map.ColourMap`.

    Args:
        coefficients: the master's, whose vectors are sent.
        others: parts, each a :class:`ColourPart`.
        in_process: whether they are threads of this process, which read what lies on the master's device themselves.
    """

    def __init__(self, coefficients: Coefficients, others: Parts, in_process: bool) -> None:
        self._coefficients, self._others, self._in_process = coefficients, others, in_process
        self._x: Lent | None = None
        self._exchange = Exchange(coefficients, in_process)
        self._pending: Pending | None = None
        # Which splats the others' views draw, the first gradient tells; for one alone nothing is left out.
        self._ask_drawn = not in_process and len(others) > 1
        self._drawn: DrawnRows | None = None

    def begin_gradient(
        self, x: cl.Buffer, blocks: range | None, constant: bool, every: int = 1, back: bool = True
    ) -> None:
        """Have them begin with a gradient at x and the own blocks of some splats; or only with the error there.

        Args:
            every: as of :meth:`ColourPart.gradient`.
        """
        flags: Lent | Each | NDArray[np.uint32]
        flags = (
            self._exchange.send_flags() if self._drawn is None else Each(self._drawn.take_flags(self._exchange.flags()))
        )
        sent = self._exchange.send_vector(x)
        self._x = sent if isinstance(sent, Lent) else None
        given = (sent, flags, blocks, constant, self._ask_drawn, back, every)
        self._pending = self._others.begin("gradient", *given, anew=True)
        self._exchange.settle()

    def begin_normal(self, direction: cl.Buffer, at: cl.Buffer, unit: float, constant: bool, every: int) -> None:
        """Have them begin with a product of the normal matrix."""
        if self._x is not None:
            self._x.lend(at)  # a part that is made again asks for it; where it was before it may have changed
        packed: Lent | Each | FloatArray
        packed = self._exchange.send_floats(direction) if self._drawn is None else Each(self._drawn.floats(direction))
        self._pending = self._others.begin("normal", packed, unit, constant, every, logged=False)

    def begin_blocks(self, splats: range) -> None:
        """Have them begin with the own blocks of other splats than in the gradient before; only in this process."""
        self._pending = self._others.begin("lend_blocks", splats, logged=False)

    def add_blocks(self, blocks: cl.Buffer) -> None:
        """Add those blocks to sums on the master's device."""
        for found in self._found():
            self._exchange.add_lent(blocks, found)

    def _found(self) -> list[Any]:
        pending, self._pending = self._pending, None
        assert pending is not None, "nothing was begun"
        return pending.results()

    def add(self, sums: cl.Buffer, blocks: cl.Buffer | None) -> dict[int, float]:
        """Add what they found to sums on the master's device."""
        errors: dict[int, float] = {}
        results = self._found()
        for place, result in enumerate(results):
            errors |= result.errors if isinstance(result, Gradient) else {}
            found = result.sums if isinstance(result, Gradient) else result
            if found is None:
                continue
            if self._drawn is not None:
                assert isinstance(found, Narrowed)
                self._drawn.add_sums(sums, place, found)
            else:
                self._exchange.add_sums(sums, found)
        if self._ask_drawn:
            self._ask_drawn = False
            self._note_drawn(results)
        if blocks is not None and not self._in_process:
            self._add_blocks(blocks, None)
        elif blocks is not None:
            for place, found in enumerate(results):
                if found.blocks is not None and found.blocks.nbytes == blocks.size:
                    self._exchange.add_lent(blocks, found.blocks)
                else:
                    self._add_blocks(blocks, place)
        return errors

    def _note_drawn(self, results: Sequence[Gradient]) -> None:
        """Have the others' views get no more from now on than what they draw, if that is less."""
        drawn: dict[int, NDArray[np.bool_]] = {}
        for place, found in enumerate(results):
            assert found.drawn is not None
            drawn[place] = unpacked(found.drawn, self._coefficients.layout.splats)
        if DrawnRows.are_worth_it(drawn):
            with suppress(DeviceMemoryError):  # a device without room for that many rows goes on with one for all
                self._drawn = DrawnRows(self._coefficients, self._exchange, drawn)
        if self._drawn is not None:
            bits = [np.packbits(drawn[part], bitorder="little") for part in range(len(drawn))]
            self._others.tell("leave_out", Each(bits))

    def _add_blocks(self, blocks: cl.Buffer, place: int | None) -> None:
        """Add those of one part, or of all: some rows at a time, as all of them take more memory than anything else."""
        layout = self._coefficients.layout
        all_rows = layout.sh_count * (layout.sh_count + 1) // 2
        rows = max(_AT_ONCE // (8 * layout.stride), 1)
        for first in range(0, all_rows, rows):
            count = min(rows, all_rows - first)
            if place is None:
                found = self._others.begin("block_rows", first, count, logged=False).results()
            else:
                found = [self._others.ask(place, "block_rows", first, count)]
            for more in found:
                self._exchange.add_rows(blocks, first, more)

    def close(self) -> None:
        """Give the master's device memory back; the parts are the caller's."""
        if self._drawn is not None:
            self._drawn.close()
        self._exchange.close()


def colour_shares(pool: Pool, views: int) -> Shares:
    """Who does which of a re-fit's views; raises what :func:`potr_cl.workers.pool.shares` does."""
    return shares(pool, views, _OWN_SPEED)


@contextmanager
def colour_parts(
    pool: Pool,
    share: Shares,
    scene: AnyScene,
    background: tuple[float, float, float],
    help_from: HelpFrom,
    cameras: Sequence[Camera],
    memory: int | None,
) -> Iterator[Parts]:
    """The parts that do the others' views.

    Args:
        pool: of their workers.
        share: who does which views.
        scene: whose colours are re-fitted.
        background: of the rasterizer.
        help_from: with the scene whose pictures are the targets.
        cameras: all views.
        memory: bytes of a device's memory that prepared views and targets may take; None: the default.
    """
    source = help_from.source
    sh_count = scene.sh.shape[1]
    if not pool.in_process:  # nobody needs the other colours, and they would travel
        here = arrived(scene)
        scene = replace(here, sh=np.ascontiguousarray(here.sh[:, :1]))
    with ExitStack() as stack:
        shape = stack.enter_context(pool.shared(scene))
        pictured: list[tuple[Shared, Visibility | None]]
        if isinstance(source, ViewShares):
            pictured = [(stack.enter_context(pool.shared(each.subset)), each.visibility) for each in source.shares]
        else:
            pictured = [(stack.enter_context(pool.shared(source)), help_from.visibility)] * len(share.others)
        given = [
            (shape, sh_count, background, own, cameras, numbers, visibility)
            for (own, visibility), numbers in zip(pictured, share.others, strict=True)
        ]
        with Parts(pool, ColourPart, given, memory, share.names) as parts:
            yield parts
