"""Levels that are made at the same time: :func:`slots` are what each thread makes them with, :func:`side_by_side` runs
the threads.

A level leaves the GPU idle while the host works, and the host's processors while the GPU does; of the next finer level
it has to know only which splats that keeps. Several GPUs make levels of their own, without a word to each other.
"""

from __future__ import annotations

import itertools
import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import copy_context
from dataclasses import dataclass, replace

from potr_cl.errors import DeviceError
from potr_cl.opencl.device import Device
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.stages.stage import Progress
from potr_cl.workers.pool import Pool

_log = logging.getLogger("potr_cl")

#: Slots of one GPU, if its memory is so many times the scene in each.
_ON_ONE, _ROOM = 2, 24


@dataclass(frozen=True)
class Slot:
    """What a thread makes levels with.

    Attributes:
        device: None: nothing looks at views, or whoever does opens one.
        pool: workers that help it.
        memory: bytes of the device that it has for itself once others begin; None: all.
    """

    device: Device | None
    pool: Pool | None = None
    memory: int | None = None

    def share(self) -> None:
        """Leave the others their part of the device's memory."""
        if self.device is not None and self.memory is not None:
            self.device.info = replace(self.device.info, memory=self.memory)


def slots_on(device: Device, nbytes: int, memory: int | None) -> int:
    """How many levels a device makes at the same time.

    Args:
        nbytes: of the scene.
        memory: as of :class:`potr_cl.pipeline.options.EncodeOptions`.
    """
    if memory is not None or device.info.shares_host_memory:
        return 1
    return _ON_ONE if _ON_ONE * _ROOM * nbytes <= device.info.memory else 1


@contextmanager
def slots(device: Device | None, pool: Pool | None, nbytes: int, options: EncodeOptions) -> Iterator[list[Slot]]:
    """The slots that there are on a device, or on all of this computer's that share the work.

    A file is the same however many there are; but on a GPU that they share, views of a scene that is large for it are
    kept in the part of its memory that is a slot's.

    Args:
        device: the first one. pool: others that help it.
        nbytes: of the scene. options: of the encode.
    """
    if device is None or not (pool is None or pool.in_process):
        yield [Slot(device, pool)]
        return
    devices = [device, *(() if pool is None else pool.devices)]
    number = slots_on(device, nbytes, options.memory)
    infos = [each.info for each in devices]
    try:
        devices += [Device(info) for _ in range(number - 1) for info in infos]
    except DeviceError as error:  # some drivers open a device once
        _log.debug("levels are made one after the other: %s", error)
        number = 1
    share = None if number == 1 else device.info.memory // number
    found = [Slot(each, None, share) for each in devices]
    try:
        for slot in found[1:]:
            slot.share()
        yield found
    finally:
        for each, info in zip(devices, infos, strict=False):
            each.info = info


class _StopError(Exception):
    """Another thread has failed, or was interrupted."""


def side_by_side(work: Callable[[int, Slot, Progress], bool], slots: Sequence[Slot], progress: Progress | None) -> None:
    """Have each slot do one work after another, from number 0 on, until there are no more.

    This thread does the first one, and tells of those that it does. If one fails, the others end as soon as they report
    how far they are.

    Args:
        work: called with a number, the slot, and what to report to; false: there is none of this number.

    Raises:
        What a work raises.
    """
    numbers, stopped = itertools.count(), threading.Event()

    def report(what: str, done: float) -> None:
        if stopped.is_set():
            raise _StopError

    def tell(what: str, done: float) -> None:
        report(what, done)
        if progress is not None:
            progress(what, done)

    def go_on(slot: Slot, first: int, report: Progress) -> None:
        try:
            while work(first, slot, report):
                first = next(numbers)
        except BaseException:
            stopped.set()
            raise

    first = next(numbers)
    with ThreadPoolExecutor(max(len(slots) - 1, 1), thread_name_prefix="potr_cl slot") as threads:
        others: list[Future[None]] = [
            threads.submit(copy_context().run, lambda slot=slot: go_on(slot, next(numbers), report))
            for slot in slots[1:]
        ]
        try:
            go_on(slots[0], first, tell)
            for other in others:
                other.result()
        except BaseException as error:
            stopped.set()
            if isinstance(error, KeyboardInterrupt):
                raise
            for other in others:
                failed = other.exception()
                if failed is not None and not isinstance(failed, _StopError):
                    raise failed from None
            raise
