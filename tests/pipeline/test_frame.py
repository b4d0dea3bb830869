"""The check of the cameras beside other work."""

from __future__ import annotations

import time

import pytest

from potr_cl import DataError, UsageError
from potr_cl.pipeline import frame
from potr_cl.pipeline.frame import FrameCheck


@pytest.fixture
def wrong(monkeypatch):
    """A check that finds the cameras to be wrong after a moment."""

    def refuse(scene, cameras, anyway):
        time.sleep(0.05)
        raise UsageError("cameras of another scene")

    monkeypatch.setattr(frame, "check_frame", refuse)
    return FrameCheck(None, None, False)


def test_a_wrong_frame_ends_work_when_it_reports(wrong):
    told = []

    def work():
        with wrong.beside(lambda *what: told.append(what)) as progress:
            while True:
                progress("work", 0.5)

    with pytest.raises(UsageError, match="another scene"):
        work()
    assert told


def test_a_wrong_frame_is_told_at_the_end_of_work_that_never_reports(wrong):
    with pytest.raises(UsageError, match="another scene"), wrong.beside(None):
        pass


def test_a_wrong_frame_is_told_before_what_else_fails(wrong):
    with pytest.raises(UsageError, match="another scene"), wrong.beside(None):
        raise DataError("nothing is seen")
    with pytest.raises(UsageError, match="another scene"), wrong.before_errors():
        raise DataError("nothing is seen")


def test_right_cameras_hide_no_error():
    told = []
    check = FrameCheck(None, None, False)
    with check.beside(lambda *what: told.append(what)) as progress:
        progress("work", 0.5)
    assert told == [("work", 0.5)]
    with pytest.raises(DataError, match="nothing is seen"), check.beside(None):
        raise DataError("nothing is seen")
