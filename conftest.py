"""How tests run beside each other, in one process after the other and in several at a time; for tests and tools.

Workers of pytest-xdist share the processors out, each one's libraries do not: each worker would have OpenBLAS start a
thread for every processor, and these wait for each other by spinning: with two workers on two processors the tests of
the model and of the stages took half as much processor time again. Without xdist nothing is set, so plain runs try the
threads of BLAS, too. This is set before NumPy is loaded.

What a test has begun in the background ends with it, or it would meet what the next test does to the process: filters
of warnings, replaced functions, environment, counts of threads and of memory.
"""

from __future__ import annotations

import gc
import logging
import os
import threading
from collections.abc import Iterator

if "PYTEST_XDIST_WORKER" in os.environ:
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
# Dozens of tests start programs, each of which would compile the package anew; what they leave, git ignores.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

import pytest
from hypothesis import HealthCheck, settings

from potr_cl.host.threads import BACKGROUND

#: Seconds that anything is waited for that should come at once: a bound for what hangs, however busy a machine is.
PATIENCE = 300

# The same examples in every run: whether a change is taken must not depend on chance, nor on what else the machine does
# (Hypothesis has limits for the time of an example, and for the time to think of one). `--hypothesis-profile=explore`
# looks for others.
settings.register_profile("potr_cl", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("explore", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("potr_cl")


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config: pytest.Config) -> None:
    """With ``-n`` each worker takes tests that stand together, so what a module has made once is rarely made twice."""
    if getattr(config.option, "numprocesses", None) and config.option.dist == "no":
        config.option.dist = "worksteal"


def pytest_collection_finish() -> None:
    """What is there now stays: the garbage collection, which each device that is opened asks for, need not look at it.

    With all tests collected it takes a tenth of a second each time.
    """
    gc.freeze()


@pytest.fixture(autouse=True)
def nothing_goes_on() -> Iterator[None]:
    """A test ends when what it has begun in the background is done."""
    yield
    for thread in threading.enumerate():
        if thread.name.startswith(BACKGROUND):
            thread.join(PATIENCE)


@pytest.fixture
def caplog(caplog: pytest.LogCaptureFixture) -> Iterator[pytest.LogCaptureFixture]:
    """What this package logs: threads of libraries that other tests have left may speak at any time."""

    def is_ours(record: logging.LogRecord) -> bool:
        return record.name.partition(".")[0] == "potr_cl"

    caplog.handler.addFilter(is_ours)
    yield caplog
    caplog.handler.removeFilter(is_ours)
