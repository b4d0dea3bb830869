"""A kernel whose arguments are bound by the names that its own declaration gives them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pyopencl as cl

from potr_cl.opencl.pieces import Pieces
from potr_cl.opencl.source import kernel_source
from potr_cl.opencl.structs import struct_dtype

_NUMBERS: dict[str, Any] = {
    "float": np.float32,
    "int": np.int32,
    "uint": np.uint32,
    "long": np.int64,
    "ulong": np.uint64,
}


class Kernel:
    """A kernel of one device.

    Made by :meth:`potr_cl.opencl.device.Device.kernel`. Arguments that are bound stay bound until they are bound
    anew, so that a loop binds once and then :meth:`set` what changes.

    Args:
        device: that it was built for.
        handle: pyopencl's kernel.
        source: the file below potr_cl/cl that declares it.
        variants: see :func:`potr_cl.opencl.source.kernel_source`.

    Attributes:
        name: of the function. parameters: its arguments, in the order of the declaration.

    Raises:
        TypeError: the declaration has an argument of a kind that is not known here.
    """

    def __init__(
        self, device: Launches, handle: cl.Kernel, source: str, variants: Mapping[str, Path] | None = None
    ) -> None:
        self.handle = handle
        self.name: str = handle.function_name
        self.parameters = declared_parameters(source, self.name, variants)
        self._device = device
        self._declared_in = source, self.name, tuple((variants or {}).items())
        self._places = {parameter.name: place for place, parameter in enumerate(self.parameters)}
        if handle.num_args != len(self.parameters):
            raise TypeError(
                f"{self}: the driver counts {handle.num_args} arguments, its declaration {len(self.parameters)}"
            )
        # Told the types, pyopencl sets all arguments twenty times as fast.
        handle.set_scalar_arg_dtypes([parameter.dtype for parameter in self.parameters])

    def bind(self, **arguments: Any) -> Kernel:
        """Give every argument a value, by name: device memory for pointers, numbers and structs for the rest.

        Returns:
            The kernel itself, for ``kernel.bind(…).launch(…)``.

        Raises:
            TypeError: a name is missing or not declared, or a value is of another kind than declared, or too large for
                it.
        """
        if arguments.keys() != self._places.keys():
            missing, unknown = self._places.keys() - arguments.keys(), arguments.keys() - self._places.keys()
            parts = [
                f"{what} {', '.join(sorted(names))}"
                for what, names in (("lacks", missing), ("does not know", unknown))
                if names
            ]
            raise TypeError(f"{self} {' and '.join(parts)}: it takes {', '.join(self._places)}")
        self.handle.set_args(*[self._accepted(p, arguments[p.name]) for p in self.parameters])
        return self

    def set(self, **arguments: Any) -> None:
        """Give some arguments another value.

        Raises:
            TypeError: as :meth:`bind`.
        """
        for name, value in arguments.items():
            if name not in self._places:
                raise TypeError(f"{self} does not know {name}: it takes {', '.join(self._places)}")
            place = self._places[name]
            parameter = self.parameters[place]
            accepted = self._accepted(parameter, value)
            self.handle.set_arg(place, accepted if parameter.dtype is None else parameter.dtype.type(accepted))

    def launch(
        self, items: tuple[int, ...], group: tuple[int, ...] | None = None, queue: cl.CommandQueue | None = None
    ) -> None:
        """Enqueue the kernel with the arguments it has.

        Args:
            items: work-items, and group: of a work-group, in up to three dimensions.
            queue: another than the device's own.

        Raises:
            DeviceError: the device refused it.
        """
        device, queue = self._device, queue or self._device.queue

        def enqueue(some: tuple[int, ...], offset: tuple[int, ...] | None = None) -> None:
            event = cl.enqueue_nd_range_kernel(queue, self.handle, some, group, offset)
            if device.profiling:
                device.timings.append((self.name, event))

        try:
            if device.pieces is None:
                enqueue(items)
            else:
                device.pieces.launch(enqueue, queue, self._declared_in, items, group)
        except (cl.Error, MemoryError):
            with device.errors(f"failed to run {self.name}"):
                raise

    def _accepted(self, parameter: Parameter, value: Any) -> Any:
        """The value, if it is of the declared kind."""
        if parameter.dtype is None:
            fits = isinstance(value, (cl.MemoryObjectHolder, cl.LocalMemory))
        elif parameter.dtype.names:
            fits = getattr(value, "dtype", None) == parameter.dtype
        elif parameter.range is None:
            fits = isinstance(value, (int, float, np.number, np.bool_))
        else:
            fits = isinstance(value, (int, np.integer, np.bool_))
            if fits and not parameter.range[0] <= value <= parameter.range[1]:
                raise TypeError(f"{self}: {parameter.name} is {parameter.declaration}, which does not hold {value}")
        if not fits:
            raise TypeError(f"{self}: {parameter.name} is {parameter.declaration}, not a {type(value).__name__}")
        return value

    def __str__(self) -> str:
        return f"kernel {self.name}"


class Launches(Protocol):
    """What a kernel needs of the device that it was built for, :class:`potr_cl.opencl.device.Device`."""

    queue: cl.CommandQueue
    profiling: bool
    pieces: Pieces | None
    timings: list[tuple[str, cl.Event]]

    def errors(self, what: str) -> AbstractContextManager[None]:
        """Turn pyopencl's errors into a DeviceError that says ``what`` about this device."""


@dataclass(frozen=True)
class Parameter:
    """One argument of a kernel as it is declared.

    Attributes:
        name: of the argument.
        declaration: its type as the source has it.
        dtype: of a number or a struct; None for a pointer.
        range: least and greatest value of an integer; None for anything else.
    """

    name: str
    declaration: str
    dtype: np.dtype[Any] | None
    range: tuple[int, int] | None = None


_declared: dict[tuple[Any, ...], tuple[Parameter, ...]] = {}


def declared_parameters(source: str, name: str, variants: Mapping[str, Path] | None = None) -> tuple[Parameter, ...]:
    """The arguments of a kernel, read from its declaration.

    Args:
        source: the file below potr_cl/cl that declares it, or includes what does.
        name: of the kernel.
        variants: see :func:`potr_cl.opencl.source.kernel_source`.

    Raises:
        TypeError: it is not declared there, or has an argument of a kind that is not known here.
    """
    key = source, name, *sorted((variants or {}).items())
    if key not in _declared:
        text = re.sub(r"/\*.*?\*/|//[^\n]*", " ", kernel_source(source, variants), flags=re.DOTALL)
        found = re.search(r"\bkernel\b[^;{}]*?\bvoid\s+" + re.escape(name) + r"\s*\(([^{]*)\)\s*\{", text)
        if found is None:
            raise TypeError(f"potr_cl/cl/{source} declares no kernel '{name}'")
        parts = [" ".join(part.split()) for part in found[1].split(",")]
        _declared[key] = tuple(_parameter(source, name, part, variants) for part in parts)
    return _declared[key]


def _parameter(source: str, kernel: str, text: str, variants: Mapping[str, Path] | None) -> Parameter:
    found = re.fullmatch(r"(.*?[\s*])(\w+)", text)
    if found is None:
        raise TypeError(f"potr_cl/cl/{source}: kernel {kernel} has an argument that cannot be read: '{text}'")
    declaration, name = found[1].strip(), found[2]
    if "*" in declaration:
        return Parameter(name, declaration, None)
    kind = declaration.removeprefix("const ").strip()
    if kind not in _NUMBERS:
        return Parameter(name, declaration, struct_dtype(source, kind, variants))
    dtype = np.dtype(_NUMBERS[kind])
    if dtype.kind == "f":
        return Parameter(name, declaration, dtype)
    limits = np.iinfo(dtype)
    return Parameter(name, declaration, dtype, (int(limits.min), int(limits.max)))
