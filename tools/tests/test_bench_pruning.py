"""The pruning benchmark's own parts: measurements of half-size views, Pareto front, settings."""

from __future__ import annotations

import numpy as np

from tools.bench.pruned_scene import HalfSizeFirst
from tools.bench.pruning import skip_settings
from tools.bench.pruning_report import pareto


class Recorder:
    """Effects that say who measured them, and when."""

    def __init__(self, name, calls):
        self.name, self.calls = name, calls

    def measure(self):
        self.calls.append(self.name)
        return self.name, None

    def remove(self, splats):
        self.calls.append(f"{self.name} loses {len(splats)}")


def test_half_size_views_first():
    calls = []
    effects = HalfSizeFirst(Recorder("full", calls), Recorder("half", calls), 2)
    measured = []
    for _ in range(4):
        measured.append(effects.measure()[0])
        effects.remove(np.arange(3))
    # The first measurement renders the targets of both.
    assert measured == ["full", "half", "half", "full"]
    assert calls.count("full") == 2
    assert calls.count("half") == 3
    assert calls.count("full loses 3") == calls.count("half loses 3") == 4


def test_pareto_front():
    rows = [{"seconds": s, "psnr_at_equal_count": p} for s, p in [(3, 50), (1, 40), (2, 39), (4, 49), (3, 51)]]
    assert [(r["seconds"], r["psnr_at_equal_count"]) for r in pareto(rows)] == [(1, 40), (3, 51)]


def test_the_full_computation_comes_first_and_every_name_once():
    settings = skip_settings([1, 4, 48])
    assert settings[0].name == "nothing"
    assert settings[0].sweep.tolerance == 0
    names = [s.name for s in settings]
    assert len(set(names)) == len(names)
