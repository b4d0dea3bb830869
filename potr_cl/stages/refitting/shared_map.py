"""Products of a re-fit whose views are done by several: :class:`SharedViews` adds what the others find."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.errors import DeviceMemoryError
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.memory import Owner
from potr_cl.opencl.narrow import Narrowed
from potr_cl.opencl.relay import Lent
from potr_cl.raster.kept_scene import KeptScene
from potr_cl.raster.rules import RasterRules
from potr_cl.stages.refitting.coefficients import Coefficients
from potr_cl.stages.refitting.coming_scene import AnyScene, arrived
from potr_cl.stages.refitting.drawn_rows import DrawnRows
from potr_cl.stages.refitting.exchange import Exchange
from potr_cl.stages.refitting.own_views import parts_of
from potr_cl.stages.refitting.part import ColourPart, Gradient, unpacked
from potr_cl.views.shares import ViewShares
from potr_cl.views.targets import PicturesAhead
from potr_cl.views.visibility import Visibility
from potr_cl.workers.dealing import Shares, shares
from potr_cl.workers.parts import Each, Parts, Pending
from potr_cl.workers.pool import Pool, Shared

#: Bytes of the splats' own blocks that are added at a time.
_AT_ONCE = 1 << 26
#: The master does so many times as many views as each of the others, which wait for what they need of a vector, and
#: for which it waits until it has their sums: 5 of 60 ms a product, at a million splats and 200 views on two H200.
_OWN_SPEED = 1.06


class SharedViews(Owner):
    """A :class:`potr_cl.stages.refitting.colour_map.Helpers`.

    Args:
        coefficients: the master's, whose vectors are sent.
        others: parts, each a :class:`potr_cl.stages.refitting.part.ColourPart`.
        in_process: whether they are threads of this process, which read what lies on the master's device themselves.

    Raises:
        DeviceError: the kernels cannot be built.
    """

    def __init__(self, coefficients: Coefficients, others: Parts, in_process: bool) -> None:
        self._coefficients, self._others, self._in_process = coefficients, others, in_process
        self._x: Lent | None = None
        self._exchange = Exchange(coefficients, in_process)
        self._pending: Pending | None = None
        # Which splats the others' views draw, the first gradient tells; for one alone nothing is left out.
        self._ask_drawn = not in_process and len(others) > 1
        self._drawn: DrawnRows | None = None

    def begin_gradient(self, x: cl.Buffer, blocks: bool, constant: bool) -> None:
        """Have them begin with a gradient at x."""
        flags: Lent | Each | NDArray[np.uint32]
        flags = (
            self._exchange.send_flags() if self._drawn is None else Each(self._drawn.take_flags(self._exchange.flags()))
        )
        sent = self._exchange.send_vector(x)
        self._x = sent if isinstance(sent, Lent) else None
        self._pending = self._others.begin("gradient", sent, flags, blocks, constant, self._ask_drawn, anew=True)
        self._exchange.settle()

    def begin_normal(self, direction: cl.Buffer, at: cl.Buffer, unit: float, constant: bool, part: int | None) -> None:
        """Have them begin with a product of the normal matrix."""
        if self._x is not None:
            self._x.lend(at)  # a part that is made again asks for it; where it was before it may have changed
        packed: Lent | Each | FloatArray
        packed = self._exchange.send_floats(direction) if self._drawn is None else Each(self._drawn.floats(direction))
        self._pending = self._others.begin("normal", packed, unit, constant, part, logged=False)

    def add(self, sums: cl.Buffer, blocks: cl.Buffer | None) -> dict[int, float]:
        """Add what they found to sums on the master's device."""
        pending, self._pending = self._pending, None
        assert pending is not None, "nothing was begun"
        errors: dict[int, float] = {}
        results: list[Any] = pending.results()
        for place, result in enumerate(results):
            errors |= result.errors if isinstance(result, Gradient) else {}
            found = result.sums if isinstance(result, Gradient) else result
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
    """Who does which of a re-fit's views; raises what :func:`potr_cl.workers.dealing.shares` does."""
    return shares(pool, views, parts_of(views), _OWN_SPEED)


@contextmanager
def colour_parts(
    pool: Pool,
    share: Shares,
    scene: AnyScene,
    rules: RasterRules,
    background: tuple[float, float, float],
    source: Scene | KeptScene | PicturesAhead | ViewShares,
    cameras: Sequence[Camera],
    memory: int | None,
) -> Iterator[Parts]:
    """The parts that do the others' views.

    Args:
        pool: of their workers.
        share: who does which views.
        scene: whose colours are re-fitted.
        rules, background: of the rasterizer.
        source: the scene whose pictures are the targets, perhaps kept on devices, with pictures of it there, or what
            the views see of it.
        cameras: all views.
        memory: bytes of a device's memory that prepared views and targets may take; None: the default.
    """
    sh_count = scene.sh.shape[1]
    if not pool.in_process:  # nobody needs the other colours, and they would travel
        here = arrived(scene)
        scene = replace(here, sh=np.ascontiguousarray(here.sh[:, :1]))
    with ExitStack() as stack:
        shape = stack.enter_context(pool.shared(scene))
        pictured: list[tuple[Shared, Visibility | None]]
        if isinstance(source, ViewShares):
            pictured = [(stack.enter_context(pool.shared(each.excerpt)), each.sights) for each in source.shares]
        else:
            pictured = [(stack.enter_context(pool.shared(source)), None)] * len(share.others)
        given = [
            (shape, sh_count, rules, background, own, cameras, numbers, sights)
            for (own, sights), numbers in zip(pictured, share.others, strict=True)
        ]
        with Parts(pool, ColourPart, given, memory, share.names) as parts:
            yield parts
