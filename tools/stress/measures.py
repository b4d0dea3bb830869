"""What the stress of all kernels measures, the worst so far, and the search for worse: a part of tools.stress.run."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from hypothesis import HealthCheck, Phase, find, given, settings, target
from hypothesis import strategies as st
from hypothesis.errors import NoSuchExample

#: What a check finds: error, and the part of it that rounding the input explains.
Measure = tuple[float, float]
Measures = dict[str, Measure]

#: Times what rounding the input explains, beyond which an error is the kernel's own.
LIMIT = 100.0

WHAT = {
    "project: alpha": "largest error of a splat's alpha in a pixel",
    "project: colour": "of a colour, relative to the sum of its terms' magnitudes",
    "project: depth": "of a depth, relative to the distance",
    "tile lists": "255 alpha - 1 of the brightest (pixel, splat) pair that a list lacks",
    "sort": "intersections out of order",
    "composite": "of a pixel, relative to the brightest colour",
    "render": "of a pixel of the whole rasterizer, the same",
    "removal: importance": "of a splat's importance, relative",
    "removal: effect": "of a splat's ΔMSE, relative to the sum of its terms' magnitudes",
    "fit: finite": "a derivative of a picture that is not finite",
    "fit: gradient": "of the pictures' derivatives by a kind of parameters, relative to their length",
    "fit: steps": "what steps of the fit add to the held-out error, relative; or a parameter that is not finite",
    "fit: settling": "a value that is not finite after coefficients were chosen, geometry rounded and the rest fitted",
    "ridge": "weighted colour error above the optimum, relative to the largest coefficient or 1",
    "re-fit: optimum": "colour error in the pictures above the optimum, or above where the solver had to stop",
    "re-fit: loss": "how much more squared error than the start has, relative",
}
#: Measures whose expectation is a promise, not the effect of rounding.
PROMISES = ("ridge", "re-fit: optimum", "re-fit: loss")
#: Measures of what must not be found at all.
NONE_OF_IT = ("fit: steps", "fit: settling")


@dataclasses.dataclass
class Worst:
    """The largest of one measure so far, by error and by the part that nothing explains."""

    error: float = -1.0
    expected: float = 0.0
    at: str = ""
    ratio: float = -1.0
    ratio_at: str = ""
    checked: int = 0

    def add(self, error: float, expected: float, name: str) -> None:
        self.checked += 1
        if not error <= self.error:
            self.error, self.expected, self.at = error, expected, name
        if not error / expected <= self.ratio:
            self.ratio, self.ratio_at = error / expected, name


def _settings(examples: int, *phases: Phase) -> settings:
    return settings(
        max_examples=examples,
        database=None,
        deadline=None,
        derandomize=True,
        suppress_health_check=list(HealthCheck),
        phases=phases,
    )


def search(
    measure: str, cases: st.SearchStrategy[Any], run: Callable[[Any], Measures], worst: dict[str, Worst], examples: int
) -> None:
    """Have hypothesis raise one measure's error, and that error over what rounding explains."""

    def attempt(case: Any) -> None:
        found = run(case)
        note(worst, found, case.name)
        error, expected = found.get(measure, (0.0, 1.0))
        target(float(np.log10(max(min(error, 1e30), 1e-12))), label=f"{measure}: error")
        target(float(np.log10(max(min(error / expected, 1e30), 1e-12))), label=f"{measure}: ratio")

    given(cases)(_settings(examples, Phase.generate, Phase.target)(attempt))()


def limit(measure: str) -> float:
    """Times its expectation beyond which a measure is a fault."""
    if measure in NONE_OF_IT:
        return 0.0
    return 1.0 if measure in PROMISES else LIMIT


def smallest_failure(
    measure: str, cases: st.SearchStrategy[Any], run: Callable[[Any], Measures], examples: int
) -> str | None:
    """The smallest input in which a measure is beyond the limit, if hypothesis comes upon one."""

    def fails(case: Any) -> bool:
        error, expected = run(case).get(measure, (0.0, 1.0))
        return not error <= limit(measure) * expected

    try:
        return str(find(cases, fails, settings=_settings(examples, Phase.generate, Phase.target, Phase.shrink)).name)
    except NoSuchExample:
        return None


def note(worst: dict[str, Worst], found: Measures, name: str) -> None:
    """Keep what is worse than before."""
    for measure, (error, expected) in found.items():
        worst.setdefault(measure, Worst()).add(error, expected, name)
