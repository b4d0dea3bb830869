"""Parts that help with a work which the master could do alone: :class:`Helping`."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import ExitStack
from types import TracebackType
from typing import Any, TypeVar

from potr_cl.errors import DeviceError
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner
from potr_cl.workers.parts import Parts, Pending

_log = logging.getLogger("potr_cl")

T = TypeVar("T")


class Helping(Owner):
    """The parts, as long as there are any.

    Args:
        verb: what they help to do, for a message.

    Attributes:
        parts: None: nobody helps, not yet or not any more.
    """

    def __init__(self, device: Device, verb: str) -> None:
        self._device, self._verb = device, verb
        self.parts: Parts | None = None
        self._left = ExitStack()

    def open(self, opened: Callable[[ExitStack], Parts | None]) -> Parts | None:
        """Have parts help.

        Args:
            opened: makes them, if there is any use for them, and leaves what has to be closed with them on a stack.

        Returns:
            They; None: there is no use for them, or no worker can, and somebody is told so.
        """
        try:
            self.parts = opened(self._left)
        except DeviceError as error:
            self._lose(error)
        except BaseException as error:
            self.__exit__(type(error), error, None)
            raise
        return self.parts

    def asked(self, call: Callable[[Parts], T]) -> T | None:
        """What the parts answer; None: there are none, or they are lost just now, and somebody is told so."""
        if self.parts is None:
            return None
        try:
            return call(self.parts)
        except DeviceError as error:
            self._lose(error)
            return None

    def begin(self, command: str, *args: Any, logged: bool = True, anew: bool = False) -> Pending | None:
        """See :meth:`potr_cl.workers.parts.Parts.begin`; None as of :meth:`asked`."""
        return self.asked(lambda parts: parts.begin(command, *args, logged=logged, anew=anew))

    def results(self, pending: Pending | None) -> list[Any] | None:
        """What was begun; None: nothing was, or as of :meth:`asked`."""
        return None if pending is None else self.asked(lambda _: pending.results())

    def _lose(self, error: DeviceError) -> None:
        # What else the line says is how to mend it, which nobody has to.
        why = str(error).split(": ")[0]
        _log.warning("no worker can %s (%s); using %s instead", self._verb, why, self._device.info)
        abandoned = _Abandoned()
        self.__exit__(type(abandoned), abandoned, None)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.parts = None
        self._left.__exit__(kind, error, trace)  # after Ctrl-C nobody is waited for

    def close(self) -> None:
        """Have the workers forget the parts."""
        self.__exit__(None, None, None)


class _Abandoned(BaseException):
    """Has parts left without waiting for workers that may stand still."""
