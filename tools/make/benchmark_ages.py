"""How old the tables of docs/benchmarks are: python -m tools.make.benchmark_pages --ages

For each result the commit that was measured and how many commits have changed the package (the folder potr_cl) since,
the most outdated first. A result of several commits is as old as the oldest of them; one that names none counts from
the last commit of its day. What is old need not be wrong: whoever changes something looks here for what may show it.
"""

from __future__ import annotations

import re
import subprocess
from dataclasses import dataclass
from functools import cache

from tools.make.benchmark_results import ROOT, Result

_PACKAGE = "potr_cl"
_COMMIT = re.compile(r"\b[0-9a-f]{7,40}\b")


@dataclass(frozen=True)
class Age:
    """Of one result.

    Attributes:
        name: of the result.
        date: as the result says it.
        commits: that were measured; none if the result does not say.
        changes: commits that have changed the package since the oldest of them; None where that is unknown, as for a
            commit that is not in this repository, or without a repository.
    """

    name: str
    date: str
    commits: tuple[str, ...]
    changes: int | None


def ages(results: dict[str, Result]) -> list[Age]:
    """Of all results that are not history: unknown ages first, then the most changes since."""
    found = [_age(name, result) for name, result in results.items() if result.state != "history"]
    return sorted(found, key=lambda age: (age.changes is not None, -(age.changes or 0), age.name))


def _age(name: str, result: Result) -> Age:
    commits = tuple(dict.fromkeys(_COMMIT.findall(result.commit)))
    starts = commits or tuple(filter(None, map(_last_of_day, re.findall(r"\d{4}-\d\d-\d\d", result.date))))
    counts = [_changes_since(start) for start in starts]
    known = [count for count in counts if count is not None]
    return Age(name, result.date, commits, max(known) if known and len(known) == len(counts) else None)


@cache
def _changes_since(commit: str) -> int | None:
    """Commits that change the package and are not in that one's history."""
    counted = _git("rev-list", "--count", "--no-merges", f"{commit}..HEAD", "--", _PACKAGE)
    return int(counted) if counted else None


@cache
def _last_of_day(day: str) -> str:
    return _git("rev-list", "-1", f"--before={day} 23:59:59 +0000", "HEAD")


def _git(*arguments: str) -> str:
    """What git says, or nothing."""
    try:
        done = subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return ""
    return done.stdout.strip()
