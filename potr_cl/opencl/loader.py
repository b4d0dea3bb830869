"""The OpenCL loader: making it see a runtime that pip installed, and calling it without stopping other threads."""

from __future__ import annotations

import atexit
import ctypes
import hashlib
import importlib.metadata
import logging
import os
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import pyopencl as cl

from potr_cl.errors import PotrError
from potr_cl.host.atomic_write import replacing
from potr_cl.host.leftovers import temporary_folder
from potr_cl.opencl.cache_folder import cache_folder

logger = logging.getLogger("potr_cl")

_ICD_VARIABLE = "OCL_ICD_VENDORS"
_WINDOWS_ICD_VARIABLE = "OCL_ICD_FILENAMES"
_INTEL_PACKAGE = "intel-opencl-rt"
_INTEL_LIBRARY = "libintelocl.so"
_INTEL_WINDOWS_LIBRARY = "intelocl64.dll"


def register_runtimes() -> None:
    """Make the loader see Intel's CPU runtime where pip installed it. Must run before the first platform query."""
    if hasattr(os, "getuid"):
        _register_intel_runtime()
    else:
        _register_intel_runtime_on_windows()


def loader_function(name: str) -> Any:
    """A function of the OpenCL loader that pyopencl has loaded; None where it cannot be had.

    pyopencl would call it too, but keep all other threads waiting meanwhile; a driver takes a tenth of a second to load
    and another to make a context.
    """
    # First what the whole process sees: a library may stand before the loader, as Oclgrind's does.
    for library in (None, cl._cl.__file__):
        with suppress(OSError, AttributeError, TypeError):
            return getattr(ctypes.CDLL(library), name)
    return None


def load_drivers() -> None:
    """Have the loader load every driver; other threads go on meanwhile."""
    list_platforms, list_handles = loader_function("clGetPlatformIDs"), loader_function("clGetDeviceIDs")
    if list_platforms is None or list_handles is None:
        return
    every_type = ctypes.c_uint64(0xFFFFFFFF)
    count = ctypes.c_uint()
    list_platforms(0, None, ctypes.byref(count))
    platforms = (ctypes.c_void_p * count.value)()
    list_platforms(count, platforms, None)
    for platform in platforms:
        list_handles(ctypes.c_void_p(platform), every_type, 0, None, ctypes.byref(count))


def new_context(handle: cl.Device) -> cl.Context:
    """A context of one device; other threads go on meanwhile."""
    create = loader_function("clCreateContext")
    if create is not None:
        create.restype = ctypes.c_void_p
        error = ctypes.c_int()
        devices = (ctypes.c_void_p * 1)(handle.int_ptr)
        context = create(None, 1, devices, None, None, ctypes.byref(error))
        if context:
            return cl.Context.from_int_ptr(context, retain=False)
    return cl.Context([handle])  # which says what is wrong


def _installed_by_pip(library: str) -> Path | None:
    """Where pip put this library of Intel's CPU runtime; None if it did not."""
    try:
        paths = importlib.metadata.files(_INTEL_PACKAGE) or []
    except importlib.metadata.PackageNotFoundError:
        return None
    path = next((Path(str(p.locate())).resolve() for p in paths if p.name == library), None)
    return path if path is not None and path.exists() else None


def _register_intel_runtime_on_windows() -> None:
    """As :func:`_register_intel_runtime`, for Windows' loader: it reads a list of libraries beside the registry."""
    library = _installed_by_pip(_INTEL_WINDOWS_LIBRARY)
    known = os.environ.get(_WINDOWS_ICD_VARIABLE, "")
    if library is not None and _INTEL_WINDOWS_LIBRARY not in known:
        os.environ[_WINDOWS_ICD_VARIABLE] = f"{known}{os.pathsep}{library}" if known else str(library)


def _register_intel_runtime() -> None:
    """Make the loader see Intel's CPU runtime where pip installed it.

    Its wheel brings an ``.icd`` file that holds a placeholder path, so a folder is made with an ``.icd`` of the real
    path beside copies of all those that the loader would have read. Must run before the first platform query.
    """
    library = _installed_by_pip(_INTEL_LIBRARY)
    if library is None:
        return
    known = os.environ.get(_ICD_VARIABLE) or os.environ.get("OPENCL_VENDOR_PATH") or "/etc/OpenCL/vendors"
    vendors = Path(known)
    if not vendors.is_dir():
        if vendors.exists() or _ICD_VARIABLE in os.environ:
            return  # the user points the loader to one library: that is an order
        others: list[Path] = []
    else:
        others = sorted(vendors.glob("*.icd"))
    if any(_INTEL_LIBRARY in icd.read_text(errors="replace") for icd in others):
        return
    contents = {icd.name: icd.read_text(errors="replace") for icd in others}
    contents["potr_cl_intel_cpu.icd"] = f"{library}\n"
    digest = hashlib.sha256(repr(sorted(contents.items())).encode()).hexdigest()[:16]
    # What is listed in a folder is loaded: one that others cannot have made.
    for lasting in (True, False):
        try:
            folder = cache_folder(f"runtimes-{digest}") if lasting else _folder_of_this_process()
            if folder is not None:
                _keep(folder, contents)
                os.environ[_ICD_VARIABLE] = str(folder)
                return
        except (OSError, PotrError) as error:  # a full disk
            logger.debug("no list of OpenCL runtimes: %s", error)
    logger.warning("cannot register Intel's CPU runtime: neither cache nor temporary folder can be written to")


def _keep(folder: Path, contents: Mapping[str, str]) -> None:
    for name, text in contents.items():
        path = folder / name
        if not path.exists() or path.read_text(errors="replace") != text:
            with replacing(path) as file:
                file.write(text.encode(errors="surrogateescape"))


def _folder_of_this_process() -> Path:
    stack = ExitStack()
    atexit.register(stack.close)
    return Path(stack.enter_context(temporary_folder()))
