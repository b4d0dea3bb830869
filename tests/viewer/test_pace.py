"""As many pixels as keep the pictures coming."""

import pytest

from potr_cl.viewer.pace import Pace

FULL = (640, 480)


def run(fixed: float, a_megapixel: float, pictures: int = 30, pace: Pace | None = None) -> tuple[Pace, list[float]]:
    """What pictures take on a device, one after the other."""
    pace = pace or Pace(0.1)
    took = []
    for _ in range(pictures):
        width, height = pace.size(*FULL)
        seconds = fixed + a_megapixel * width * height / 1e6
        took.append(seconds)
        pace.took(seconds)
    return pace, took


def test_a_fast_device_gets_full_pictures():
    pace, _ = run(0.001, 0.01)
    assert pace.is_full
    assert pace.size(*FULL) == FULL


def test_a_slow_device_gets_small_ones_at_once():
    pace, took = run(0.01, 2.0)
    assert not pace.is_full
    assert max(took[2:]) <= 0.1


def test_it_settles():
    pace, _ = run(0.02, 0.5, 40)
    sizes = {pace.size(*FULL) for _ in range(20) if run(0.02, 0.5, 1, pace)}
    assert len(sizes) <= 2


def test_a_device_that_gets_faster_gets_more_pixels():
    pace, _ = run(0.01, 2.0)
    slow = pace.size(*FULL)[0]
    run(0.001, 0.01, 30, pace)
    assert pace.size(*FULL)[0] > slow


@pytest.mark.parametrize("full", [(1, 1), (3000, 20), (2048, 1152)])
def test_there_is_always_a_picture(full):
    pace = Pace(0.1)
    for _ in range(20):
        pace.took(100.0)
    width, height = pace.size(*full)
    assert 1 <= width <= full[0]
    assert 1 <= height <= full[1]
    assert width / height == pytest.approx(full[0] / full[1], rel=0.05)
