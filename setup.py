"""Adds the compiled library to what pyproject.toml says.

It is optional: without a compiler the package is installed all the same, and NumPy does its work, more slowly. It
stands here and not in pyproject.toml because compilers take different options.
"""

import sys
from pathlib import Path

from setuptools import Extension, setup

NATIVE = Path("potr_cl", "native")
# Vectors; and each operation on floats rounded by itself, so that every machine decodes the same numbers.
OPTIONS = ["-std=c11", "-O3", "-ffp-contract=off", "-fno-math-errno", "-fvisibility=hidden"]
OPTIONS_OF_MSVC = ["/std:c11", "/O2", "/fp:precise"]

setup(
    ext_modules=[
        Extension(
            "potr_cl.native._library",
            sources=sorted(str(source) for source in NATIVE.glob("*.c")),
            depends=sorted(str(header) for header in NATIVE.glob("*.h")),
            extra_compile_args=OPTIONS_OF_MSVC if sys.platform == "win32" else OPTIONS,
            py_limited_api=True,
            optional=True,
        )
    ],
    # One wheel for all versions of Python.
    options={"bdist_wheel": {"py_limited_api": "cp310"}},
)
