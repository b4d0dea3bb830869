"""What others do in the same process at the same time fails no test, and hides no fault of what is tested."""

from __future__ import annotations

import logging
import threading
import time
import warnings
from concurrent.futures import ThreadPoolExecutor

import pytest
from hypothesis import settings

from potr_cl.host.threads import in_background
from tests.cases.own_warnings import FOREIGN, no_warnings, warnings_are_errors


def warn_elsewhere(kind: type[Warning]) -> None:
    """From another thread, as who builds a program does."""
    with ThreadPoolExecutor(1) as thread:
        thread.submit(warnings.warn, "not ours", kind).result()


def test_foreign_warnings_are_none_of_ours():
    with no_warnings():
        for kind in FOREIGN:
            warn_elsewhere(kind)


@pytest.mark.parametrize("kind", [RuntimeWarning, UserWarning, DeprecationWarning])
def test_all_others_are_errors(kind):
    filters = list(warnings.filters)
    with pytest.raises(kind, match="ours"), no_warnings():
        warnings.warn("ours", kind, stacklevel=1)
    assert list(warnings.filters) == filters


@warnings_are_errors
def test_a_marked_test_passes_foreign_warnings_over():
    for kind in FOREIGN:
        warn_elsewhere(kind)
    with pytest.raises(RuntimeWarning):
        warnings.warn("ours", RuntimeWarning, stacklevel=1)


@warnings_are_errors
def test_what_others_forget_is_none_of_ours():
    """As a library's coroutine that nobody awaits, which Python collects when it likes; or a thread that ends so."""

    async def forgotten():
        pass

    _ = forgotten()
    del _
    thread = threading.Thread(target=warnings.warn, args=("not ours", RuntimeWarning))
    thread.start()
    thread.join()


def test_the_log_is_this_packages(caplog):
    logging.getLogger("somebody.else").warning("not ours")
    assert not caplog.records
    logging.getLogger("potr_cl").warning("ours")
    logging.getLogger("potr_cl.part").warning("ours too")
    assert [record.getMessage() for record in caplog.records] == ["ours", "ours too"]


def test_hypothesis_measures_no_time_and_leaves_nothing_to_chance():
    assert settings.default is not None
    assert settings.default.deadline is None
    assert settings.get_profile("potr_cl").derandomize


@pytest.fixture(scope="module")
def done():
    """What has been done; looked at once when the tests of this module that use it are over."""
    done = []
    yield done
    assert done == ["in the background"]


def test_what_goes_on_in_the_background_ends_with_the_test(done):
    end = threading.Event()

    def work():
        end.wait(60)
        time.sleep(0.3)
        done.append("in the background")

    in_background(work)
    end.set()
