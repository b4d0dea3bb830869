"""Target pictures on a device, of which as many as a budget allows are kept: :class:`KeptPictures`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import pyopencl as cl

from potr_cl.model.camera import Camera
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner, Scratch
from potr_cl.stages.refitting.targets import Targets
from potr_cl.views.budget import target_bytes

#: Pictures that are asked for together, and their bytes at the most: a GPU prepares several views in one go.
_TOGETHER, _MOST_BYTES = 16, 1 << 28


class Budget(Protocol):
    """Bytes of device memory that several share."""

    #: What is left.
    room: float


@dataclass
class Room:
    """A budget of one's own."""

    room: float


class KeptPictures(Owner):
    """Pictures that are asked for again and again, those of some views together. They are kept after their first use.

    Args:
        device: whose memory it is.
        cameras: the views.
        budget: that the pictures which are kept are taken from.
        sets: of views that will be asked for: there is room for the largest in any case.

    Raises:
        DeviceMemoryError: the device has no room for these.
    """

    def __init__(
        self,
        device: Device,
        cameras: Sequence[Camera],
        budget: Budget,
        sets: Iterable[Sequence[int]] = (),
    ) -> None:
        self._device, self._cameras, self._budget = device, list(cameras), budget
        self._memory = Memory(device)
        self._others = Scratch(device, "the target images")
        self._kept: dict[tuple[int, ...], cl.Buffer] = {}
        self._kept_of: Targets | None = None
        self._others.reserve(max(map(self.nbytes, sets), default=0))

    def nbytes(self, numbers: Sequence[int]) -> int:
        """Bytes of some views' pictures."""
        return sum(target_bytes(self._cameras[number]) for number in numbers)

    def fill(self, targets: Targets, sets: Iterable[Sequence[int]], together: bool = False) -> None:
        """Have those pictures of these targets that are kept.

        Args:
            targets: give them.
            sets: of views whose pictures will be asked for.
            together: ask for those of several sets at a time.
        """
        self._keep_only(targets)
        waiting: list[tuple[int, ...]] = []
        for numbers in map(tuple, sets):
            if numbers in self._kept or self.nbytes([*sum(waiting, ()), *numbers]) > self._budget.room:
                continue
            if waiting and (
                not together or len(waiting) == _TOGETHER or self.nbytes([*sum(waiting, ()), *numbers]) > _MOST_BYTES
            ):
                self._take(targets, waiting)
                waiting = []
            waiting.append(numbers)
        self._take(targets, waiting)
        if together:
            self._others.close()

    def of(self, targets: Targets, numbers: Sequence[int]) -> cl.Buffer:
        """(pixels, 3) float32, what some views should show, one behind the other.

        They are valid until the next call. Other targets than at the last call take the place of what was kept.
        """
        self._keep_only(targets)
        key = tuple(numbers)
        if key not in self._kept and self.nbytes(key) > self._budget.room:
            self._into(targets, key, self._reserved(key))
            return self._others.buffer
        if key not in self._kept:
            self._take(targets, [key])
        return self._kept[key]

    def _take(self, targets: Targets, sets: Sequence[tuple[int, ...]]) -> None:
        """Keep pictures, for which there is room."""
        if len(sets) == 1:
            buffer = self._keep(sets[0])
            try:
                self._into(targets, sets[0], buffer)
            except BaseException:
                self._drop(sets[0])
                raise
        elif sets:
            every = sum(sets, ())
            self._into(targets, every, self._reserved(every))
            start = 0
            for numbers in sets:
                size = self.nbytes(numbers)
                cl.enqueue_copy(
                    self._device.queue, self._keep(numbers), self._others.buffer, byte_count=size, src_offset=start
                )
                start += size

    def _into(self, targets: Targets, numbers: Sequence[int], buffer: cl.Buffer) -> None:
        targets.into(numbers, buffer)

    def _reserved(self, numbers: Sequence[int]) -> cl.Buffer:
        self._others.reserve(self.nbytes(numbers))
        return self._others.buffer

    def _keep(self, numbers: tuple[int, ...]) -> cl.Buffer:
        buffer = self._memory.allocate(self.nbytes(numbers), "the target images")
        self._budget.room -= buffer.size
        self._kept[numbers] = buffer
        return buffer

    def _keep_only(self, targets: Targets) -> None:
        if targets is not self._kept_of:
            self._forget()
            self._kept_of = targets

    def _drop(self, numbers: tuple[int, ...]) -> None:
        buffer = self._kept.pop(numbers)
        self._budget.room += buffer.size
        self._memory.free(buffer)

    def _forget(self) -> None:
        for numbers in list(self._kept):
            self._drop(numbers)

    def close(self) -> None:
        """Give all device memory back."""
        self._forget()
        self._others.close()
        self._memory.close()
