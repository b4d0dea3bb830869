"""Which of two files is the better one."""

from __future__ import annotations

import pytest

from potr_cl.stages.fitting.fitted import File, TwoFiles


def two(nbytes: float, decibels: float) -> TwoFiles:
    """A file of 100,000 bytes and 50 dB, and one with a fit: by how much its size and PSNR differ."""
    return TwoFiles(File(100_000, 1e-5), File(round(100_000 * nbytes), 1e-5 * 10 ** (-decibels / 10)))


@pytest.mark.parametrize(
    ("nbytes", "decibels", "pays"),
    [
        (0.85, 0.0, True),
        (1.0, 1.0, True),
        (0.9, -0.5, True),  # at 15 % a decibel, half of it would take back 7 %
        (0.9, -1.0, False),
        (1.04, 1.2, True),
        (1.04, 0.6, False),  # at 5 % a decibel it would be larger
        (1.0, 0.0, False),
        (0.995, 0.0, False),  # so little may be chance
        (1.0, 0.1, False),
        (1.002, -0.16, False),
    ],
)
def test_it_pays_however_much_a_decibel_takes(nbytes, decibels, pays):
    assert two(nbytes, decibels).pays is pays


def test_what_is_told_of_both():
    files = two(0.9, -0.5)
    assert files.facts["without"] == {"bytes": 100_000, "psnr": pytest.approx(50)}
    assert files.facts["with"] == {"bytes": 90_000, "psnr": pytest.approx(49.5)}
    assert "90,000 bytes and 49.50 dB with it, 100,000 bytes and 50.00 dB without" in str(files)
