"""What lives on a worker of a Dask cluster: :class:`Seat`, an actor there."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import DeviceInfo, fitting_devices
from potr_cl.workers.pool import Part, Shared


class Seat:
    """Lives on a worker, and holds its parts and what they share.

    Args:
        place: the worker's number among those of its computer.
    """

    def __init__(self, place: int) -> None:
        self._place = place
        self._known: dict[int, Any] = {}
        self._parts: dict[int, Part] = {}

    def hello(self) -> tuple[str, str, str, str]:
        """The version here, the device, the family of its kernels, and its digits."""
        from potr_cl import __version__

        device = _device(self._place)
        return __version__, str(device.info), device.family, device.digits()

    def keep(self, number: int, thing: Any, others: Sequence[int]) -> None:
        """Keep a thing for parts, and of those that are known only the ones of these numbers."""
        self._known = {each: self._known[each] for each in others} | {number: thing}

    def make(self, number: int, kind: type[Part], memory: int | None, given: Sequence[Any]) -> None:
        """Make a part."""
        device = _device(self._place)
        things = [each.of(self._known[each.handle.number]) if isinstance(each, Shared) else each for each in given]
        # A failure may leave buffers behind that nobody owns any more.
        with device.all_or_nothing(), device.errors("failed while encoding"):
            self._parts[number] = kind(device, memory, *things)

    def run(self, number: int, command: str, args: Sequence[Any]) -> Any:
        """Give a part a command."""
        with _device(self._place).errors("failed while encoding"):
            return getattr(self._parts[number], command)(*args)

    def drop(self, number: int) -> None:
        """Give a part's memory back."""
        part = self._parts.pop(number, None)
        if part is not None:
            part.close()

    def __del__(self) -> None:
        # The master has left, perhaps without a word.
        for number in list(self.__dict__.get("_parts", ())):
            with suppress(Exception):
                self.drop(number)


@dataclass(frozen=True)
class Known:
    """Stands for something that the seat has been sent."""

    number: int


#: The devices that seats of this process have, by the seat's place.
opened: dict[int, Device] = {}


def _device(place: int) -> Device:
    """This worker's device: of the best ones, that of the worker's place among those of its computer."""
    if place not in opened:
        best, *others = fitting_devices()
        alike: list[DeviceInfo] = [best, *(info for info in others if _kind(info) == _kind(best))]
        opened[place] = Device(alike[place % len(alike)])
    return opened[place]


def _kind(info: DeviceInfo) -> tuple[str, str]:
    return info.kind, info.platform
