"""The pruning benchmark's own parts: Pareto front, settings."""

from __future__ import annotations

from tools.bench.pruning import pareto, skip_settings


def test_pareto_front():
    points = {"a": (3, 50.0), "b": (1, 40.0), "c": (2, 39.0), "d": (2, 45.0), "e": (4, 50.0)}
    rows = [{"skipped": n, "seconds": s, "psnr_at_equal_count": p} for n, (s, p) in points.items()]
    assert [r["skipped"] for r in pareto(rows)] == ["b", "d", "a"]


def test_the_full_computation_comes_first_and_every_name_once():
    settings = skip_settings([1, 4, 48])
    assert settings[0].name == "nothing"
    assert settings[0].sweep.tolerance == 0
    names = [s.name for s in settings]
    assert len(set(names)) == len(names)
