"""What is set before NumPy is loaded: workers of pytest-xdist share the processors out, each one's libraries do not.

Each worker would have OpenBLAS start a thread for every processor, and these wait for each other by spinning: with two
workers on two processors the tests of the model and of the stages took half as much processor time again. Without
xdist nothing is set, so plain runs try the threads of BLAS, too.
"""

from __future__ import annotations

import os

if "PYTEST_XDIST_WORKER" in os.environ:
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
# Dozens of tests start programs, each of which would compile the package anew; what they leave, git ignores.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
