"""The values of a block, bundle by bundle: :class:`BlockValues`.

Threads share the bundles out. By the native path integers of a bundle become values while they are in a cache.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec import container, dequantizer, quantize
from potr_cl.codec.bundles.decoder import Reader, Wanted, check_said
from potr_cl.codec.bundles.layout import BUNDLE
from potr_cl.codec.bundles.sections import MAIN
from potr_cl.codec.bundles.streams import largest_integer
from potr_cl.codec.container import Block
from potr_cl.codec.native.bundles import BEYOND_TABLE
from potr_cl.codec.native.values import BundleShare, Tables, ValueArrays
from potr_cl.codec.sections import Property
from potr_cl.codec.steps import prediction
from potr_cl.codec.steps.rule import CLASSES, ColourSteps, factors
from potr_cl.errors import DataError
from potr_cl.native.declarations import CFunctions
from potr_cl.native.table import definition

if TYPE_CHECKING:
    from potr_cl.codec.dequantizer import Activation, BundleTaker

#: Bundles that NumPy decodes side by side.
_SIDE_BY_SIDE = 32
#: Bundles for each thread, so that one more pays.
_BUNDLES_A_THREAD = 2
#: Bundles that may wait to be taken, beside those that threads are packing.
_ROOMS_BESIDE = 8
#: Bytes of a file whose checksums take long enough for several threads.
_LARGE = 1 << 20
#: Levels whose values are looked up.
_TABLE = 1 << 16


@dataclass(frozen=True)
class BlockValues:
    """A block's splats but for their centres.

    Attributes:
        block: verified.
        data: its bytes, of those sections at least that are asked for.
        open_steps: gives the steps of its colours.
        activation: what is stored instead of logarithms of scales and logits of opacities; None: these.
        checked: whether sections are compared with their checksums when they are opened.
    """

    block: Block
    data: bytes | memoryview
    open_steps: Callable[[], ColourSteps | None]
    activation: Activation | None = None
    checked: bool = True

    @cached_property
    def reader(self) -> Reader:
        """Of the integers."""
        return Reader(self.block.splats, self._stored, self.open_steps)

    def _stored(self, key: Property) -> tuple[memoryview, str] | None:
        section = self.block.find(key)
        open_bytes = container.stored_bytes if self.checked else container.unchecked_bytes
        return None if section is None else (open_bytes(self.data, section), section.title)

    def fill(self, arrays: ValueArrays, threads: int = 1, beside: Callable[[], None] | None = None) -> None:
        """Fill some arrays; sections of others are not looked at.

        Args:
            arrays: what to decode.
            threads: to work with, this one included.
            beside: what else is to be done, by any thread.

        Raises:
            DataError: damaged; and what ``beside`` raises.
        """
        wanted = self._wanted(arrays)
        number = -(-self.block.splats // BUNDLE)
        helpers = min(threads, max(number // _BUNDLES_A_THREAD, 2)) - 1

        def work(scene: BlockValues, helpers: _Helpers) -> None:
            file, share = scene.reader.bundled_file(wanted), helpers.share
            if file is None or share is None:
                scene._side_by_side(lambda bundles: scene._by_numpy(bundles, wanted, arrays))
            else:
                share.open(file, wanted.sections, wanted.rotations, arrays, scene.tables)
                share.do()
                for bundle in range(number):
                    if scene._went_beyond(share.wait(bundle)):
                        scene._by_numpy(range(bundle, bundle + 1), wanted, arrays)
            helpers.finish()

        self._helped(bundle_share(number), helpers, wanted, beside, work)

    def pack(
        self, destination: BundleTaker, sh_count: int, threads: int, means: Callable[[], NDArray[np.float32]]
    ) -> None:
        """Hand the values of all bundles to a destination, packed and in their order, and the centres.

        This thread hands them on; others decode.

        Args:
            destination: takes them.
            sh_count: SH coefficients of a channel that are wanted.
            threads: to decode with.
            means: finds the centres; called by one of them.

        Raises:
            DataError: damaged; what ``means`` and the destination raise.
        """
        wanted = self._wanted_of(sh_count, True)
        number = -(-self.block.splats // BUNDLE)
        threads = max(1, min(threads, -(-number // _BUNDLES_A_THREAD)))
        destination.expect_bundles()

        def work(scene: BlockValues, helpers: _Helpers) -> None:
            file, share = scene.reader.bundled_file(wanted), helpers.share
            taken = False
            if file is None or share is None:
                scene._side_by_side(lambda bundles: scene._pack_by_numpy(destination, sh_count, wanted, bundles))
            else:
                share.open(file, wanted.sections, wanted.rotations, rooms, scene.tables)
                for bundle in range(number):
                    room = bundle % len(rooms)
                    if scene._went_beyond(share.wait(bundle, helpers.look_after)):
                        scene._pack_by_numpy(destination, sh_count, wanted, range(bundle, bundle + 1))
                    else:
                        destination.take_bundle(bundle * BUNDLE, rooms[room], share.items(room))
                    share.allow(bundle + 1 + len(rooms))
                    if not taken and helpers.beside.done():
                        destination.take_means(helpers.finish())
                        taken = True
            if not taken:
                destination.take_means(helpers.finish())

        share = bundle_share(number)
        with destination.rooms(0 if share is None else min(number, threads + _ROOMS_BESIDE)) as rooms:
            self._helped(share, threads, wanted, means, work)

    def _helped(
        self,
        share: BundleShare | None,
        threads: int,
        wanted: Wanted,
        beside: Callable[[], Any] | None,
        work: Callable[[BlockValues, _Helpers], None],
    ) -> None:
        """Do a work with the help of threads, of which some look after the checksums of large files meanwhile."""
        if threads < 2 or len(self.data) < _LARGE or share is None:
            with _Helpers(share, threads, beside) as helpers:
                work(self, helpers)
            return
        found = [section for key in wanted.keys if (section := self.block.find(key)) is not None]
        checks = [partial(container.is_sound, self.data, section) for section in found]
        try:
            with _Helpers(share, threads, beside, checks) as helpers:
                work(replace(self, checked=False), helpers)
                sound = helpers.all_true()
        except DataError:
            # What is wrong with sections comes first, in their order, and with their checksums before all else.
            self.reader.bundled_file(wanted)
            raise
        if not sound:
            self.reader.bundled_file(wanted)

    def _side_by_side(self, do: Callable[[range], None]) -> None:
        number = self.reader.bundles.number
        for first in range(0, number, _SIDE_BY_SIDE):
            do(range(first, min(first + _SIDE_BY_SIDE, number)))

    @cached_property
    def tables(self) -> Tables:
        """What makes values of levels."""
        block, activation = self.block, self.activation
        levels = np.arange(self._largest_level(MAIN[1]) + 1)
        classes = np.arange(-CLASSES, CLASSES).astype(np.int8)
        scales = quantize.dequantize_scales(levels, block.sf_scale)
        opacities = block.rules.dequantize_opacities(np.arange(self._largest_level(MAIN[0]) + 1), block.sf_opacity)
        return Tables(
            scales if activation is None else activation.scales(scales),
            opacities if activation is None else activation.opacities(opacities),
            factors(block.sf_dc, classes),
            factors(block.sf_ac, classes),
            *prediction.tables(),
            block.sf_rotation,
            activation is not None,
        )

    def _largest_level(self, key: Property) -> int:
        """Of a section, or the largest that is looked up."""
        section = self.reader.section(key)
        alphabets = [fitted.alphabet for fitted in section.streams] if section is not None else [1]
        return min(largest_integer(max(alphabets) - 1), _TABLE - 1)

    def _went_beyond(self, said: tuple[int, int]) -> bool:
        """Whether the native path says of a bundle that its levels are beyond its tables.

        Raises:
            DataError: it says that the bundle is damaged.
        """
        if said[0] == BEYOND_TABLE:
            return True
        check_said(self.reader, *said)
        return False

    def _pack_by_numpy(self, destination: BundleTaker, sh_count: int, wanted: Wanted, bundles: range) -> None:
        dequantizer.pack(
            destination, self.block, sh_count, bundles, lambda arrays: self._by_numpy(bundles, wanted, arrays)
        )

    def _by_numpy(self, bundles: range, wanted: Wanted, arrays: ValueArrays) -> None:
        """Fill arrays with the values of some bundles, which are decoded side by side. Raises DataError if damaged."""
        levels = self.reader.levels(bundles.start, bundles.stop, wanted)
        dequantizer.fill(arrays, self.block, levels, self.reader.steps, self.activation)

    def _wanted(self, arrays: ValueArrays) -> Wanted:
        rotations = arrays.quaternions is not None
        if arrays.sh is not None:
            return self._wanted_of(len(arrays.sh), rotations)
        return Wanted(2 if rotations or arrays.log_scales is not None else 1, rotations)

    def _wanted_of(self, sh_count: int, rotations: bool) -> Wanted:
        degree = round(sh_count**0.5) - 1
        # To the end of the chain where all is asked for: so its end is checked.
        return Wanted(len(MAIN) if degree == self.block.sh_degree else 3 + degree, rotations)


@definition
def bundle_share(bundles: int) -> BundleShare | None:
    """So many bundles for threads to share out while they leave the interpreter free; None: one thread does all."""
    return None


def _bundle_share_of_c(c: CFunctions, bundles: int) -> BundleShare:
    return BundleShare(c, bundles)


class _Helpers:
    """Threads that take part in decoding, and in what is to be done beside it.

    They begin at once, and wait in C until the bundles can be decoded: so they do not keep this thread from the
    interpreter while it opens the file. By NumPy there are none: they would wait for the interpreter all the time, and
    take memory meanwhile.

    Args:
        share: the bundles; None where NumPy is to be taken.
        threads: so many.
        beside: what else is to be done, by one of them, or by this one where there are none.
        checks: what others ask before they decode.

    Attributes:
        share: the bundles; None where NumPy is to be taken.
        beside: what came of what is done beside.
    """

    def __init__(
        self,
        share: BundleShare | None,
        threads: int,
        beside: Callable[[], Any] | None,
        checks: Sequence[Callable[[], bool]] = (),
    ) -> None:
        self.share = share
        self._number = 0 if self.share is None else threads
        self._do_beside = beside or (lambda: None)
        self._checks = checks
        self._answers: list[bool] = []
        self._pool = ThreadPoolExecutor(max(self._number, 1))
        self._futures: list[Future[None]] = []
        self.beside: Future[Any] = Future()

    def __enter__(self) -> _Helpers:
        try:
            for number in range(self._number):
                self._futures.append(self._pool.submit(self._do, number))
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *error: object) -> None:
        if self.share is not None:
            self.share.give_up()
        self._pool.shutdown(cancel_futures=True)

    def _do(self, number: int) -> None:
        if number == 0:
            self._set_beside()
        else:
            self._answers.extend(check() for check in self._checks[number - 1 :: self._number - 1])
        if self.share is not None:
            self.share.do()

    def _set_beside(self) -> None:
        try:
            self.beside.set_result(self._do_beside())
        except BaseException as error:  # the one who asks for the result is told
            self.beside.set_exception(error)

    def all_true(self) -> bool:
        """Whether all checks were made, once threads are done, and all of them said so."""
        wait(self._futures)
        return len(self._answers) == len(self._checks) and all(self._answers)

    def look_after(self) -> None:
        """Raise what has ended the threads, if none is left."""
        if all(future.done() for future in self._futures):
            for future in self._futures:
                future.result()

    def finish(self) -> Any:
        """See to it that what was to be done beside is, and give what came of it.

        Raises:
            What it raises.
        """
        if not self._number:
            self._set_beside()
        return self.beside.result()
