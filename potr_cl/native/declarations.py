"""The C functions with the types of their arguments (:func:`declared`), as potr_native.h has them, and arrays as C
takes them: where their numbers are (:func:`address`).
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

_SIZE, _NUMBER, _POINTER, _WORD = ctypes.c_size_t, ctypes.c_int, ctypes.c_void_p, ctypes.c_uint64
_REAL = ctypes.c_float

#: Argument types and result of each function, in the order of the C declarations.
_DECLARATIONS: dict[str, tuple[Any, list[Any]]] = {
    "potr_octree_levels": (_NUMBER, [_POINTER, _SIZE, _POINTER, _SIZE, _NUMBER, _NUMBER, _POINTER, _POINTER, _POINTER]),
    "potr_octree_cut": (_SIZE, []),
    "potr_octree_cuts": (
        _SIZE,
        [_POINTER, _SIZE, _POINTER, _NUMBER, _POINTER, _WORD, _WORD, _POINTER, _WORD, _SIZE, _POINTER],
    ),
    "potr_octree_leaves": (None, [_POINTER, _POINTER, _NUMBER, *[_POINTER] * 6]),
    "potr_octree_padding": (_NUMBER, [_POINTER, _POINTER]),
    "potr_octree_centres": (None, [_POINTER] * 9),
    "potr_octree_bounds": (None, [_POINTER, _SIZE, _POINTER, _SIZE, _POINTER, _POINTER]),
    "potr_octree_words": (
        None,
        [_POINTER, _SIZE, _POINTER, ctypes.c_double, ctypes.c_double, _NUMBER, _SIZE, _SIZE, _POINTER],
    ),
    "potr_octree_wanted": (None, [_POINTER, _SIZE, ctypes.c_double, _NUMBER, _POINTER]),
    "potr_octree_sorting": (_SIZE, []),
    "potr_octree_sort": (_NUMBER, [_SIZE, *[_POINTER] * 5]),
    "potr_octree_sizes": (_SIZE, []),
    "potr_octree_survey": (None, [_POINTER, _SIZE, _SIZE, _NUMBER, *[_POINTER] * 3]),
    "potr_octree_streams": (None, [_POINTER, _SIZE, _SIZE, _NUMBER, *[_POINTER] * 8]),
    "potr_octree_decoded": (None, [_POINTER, _SIZE, _SIZE, _NUMBER, *[_POINTER] * 4, _SIZE, _SIZE, _POINTER]),
    "potr_bundles_table": (_NUMBER, [_POINTER, _SIZE, _SIZE, *[_POINTER] * 3]),
    "potr_bundles_vectors": (_NUMBER, []),
    "potr_bundles_work": (_SIZE, []),
    "potr_steps_classes": (None, [_POINTER, _POINTER, _POINTER, _SIZE, _POINTER, _POINTER]),
    "potr_bundles_begin": (None, [_POINTER]),
    "potr_bundles_levels": (_NUMBER, [_POINTER, _WORD, _NUMBER, _NUMBER, *[_POINTER] * 3]),
    "potr_bundles_values": (_NUMBER, [_POINTER, _WORD, _NUMBER, _NUMBER, *[_POINTER] * 3]),
    "potr_bundles_share": (_NUMBER, [_POINTER, _POINTER, _WORD]),
    "potr_bundles_wait": (ctypes.c_int32, [_POINTER, _WORD]),
    "potr_bundles_encoding": (_SIZE, []),
    "potr_bundles_survey": (None, [_POINTER, _WORD, _POINTER, _POINTER, _WORD, _POINTER, _POINTER]),
    "potr_bundles_count": (None, [_POINTER, _WORD, _POINTER, _POINTER, _SIZE, _POINTER]),
    "potr_bundles_code": (_SIZE, [_POINTER, _WORD, *[_POINTER] * 3, _SIZE, *[_POINTER] * 3]),
    "potr_bundles_grouping": (_SIZE, []),
    "potr_bundles_contexts": (_SIZE, [_POINTER, _SIZE, *[_POINTER] * 4]),
    "potr_nearest": (None, [_POINTER, _SIZE, _POINTER, _SIZE, _POINTER]),
    "potr_canonical": (None, [_POINTER, _POINTER, _POINTER, _SIZE, _POINTER, _POINTER, _POINTER, _POINTER]),
    "potr_splat_levels": (
        _NUMBER,
        [
            *[_POINTER] * 4,
            _SIZE,
            _POINTER,
            _POINTER,
            ctypes.c_double,
            _REAL,
            *[ctypes.c_double] * 3,
            _SIZE,
            _POINTER,
            _POINTER,
        ],
    ),
    "potr_unit_quaternions": (None, [_POINTER, _SIZE, _POINTER]),
    "potr_colour_levels": (
        _NUMBER,
        [_POINTER, *[_SIZE] * 4, _POINTER, _SIZE, _POINTER, _POINTER, _SIZE, _SIZE, _POINTER],
    ),
    "potr_predicted": (None, [_POINTER, _SIZE, _SIZE, _SIZE, *[_POINTER] * 4]),
    "potr_nonzero_levels": (_NUMBER, [_POINTER, _SIZE, _SIZE, ctypes.c_double, ctypes.c_double, _POINTER]),
    "potr_horizons": (ctypes.c_double, [_POINTER, _POINTER, _SIZE, _POINTER, _REAL, ctypes.c_int32, _POINTER]),
    "potr_shown": (None, [_POINTER, _SIZE, _POINTER, ctypes.c_int32, _POINTER, _POINTER]),
    "potr_energies": (None, [_POINTER, _SIZE, _POINTER, _SIZE, _POINTER]),
    "potr_unit_factors": (None, [_POINTER, _SIZE, _SIZE, _SIZE, _SIZE, _REAL, _POINTER]),
}
#: Those that take some microseconds, however large a file is. They keep the interpreter: to get it back among threads
#: that all want it takes longer than they do.
_SHORT = {
    "potr_bundles_table",
    "potr_bundles_work",
    "potr_bundles_vectors",
    "potr_octree_cut",
    "potr_octree_padding",
    "potr_octree_sorting",
    "potr_octree_sizes",
}


#: The functions of the library by name. They may be called from several threads at a time.
CFunctions: TypeAlias = "Mapping[str, Any]"


def declared(path: str) -> CFunctions:
    """The functions of a library by name, told what they take.

    Raises:
        OSError: there is none that can be loaded.
        AttributeError: one is missing.
    """
    library, keeping = ctypes.CDLL(path), ctypes.PyDLL(path)
    functions: dict[str, Any] = {}
    for name, (result, arguments) in _DECLARATIONS.items():
        functions[name] = (keeping if name in _SHORT else library)[name]
        functions[name].restype, functions[name].argtypes = result, arguments
    return functions


#: Integers of splats are below this in magnitude, so that sums of three fit.
LARGEST = 1 << 29


def fits(largest: int) -> bool:
    """Whether C can take integers of at most some magnitude."""
    return largest < LARGEST


def address(array: NDArray[Any], dtype: type[np.generic], number: int, writable: bool = False) -> int:
    """Where an array's numbers are, once it is sure that they are as many, of that type, and one after another.

    Raises:
        TypeError: they are not, or cannot be written to.
    """
    if array.dtype != dtype or array.size != number or not array.flags.c_contiguous or not array.flags.aligned:
        raise TypeError(f"the native path takes {number} of {np.dtype(dtype)}, not {array.size} of {array.dtype}")
    if writable and not array.flags.writeable:
        raise TypeError("the native path cannot write to a read-only array")
    where: int = array.__array_interface__["data"][0]  # what array.ctypes.data says, in a fraction of its time
    return where
