"""Curves of size against quality of several runs of tools.study.rate_distortion: one set of points, and who made them.

A run that is cut short leaves a file with some points; another, of a later commit, goes on elsewhere. Here such files
become one, as ``report`` takes it.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from potr_cl.errors import UsageError


def merged(paths: Sequence[Path], chosen: Sequence[str] = ()) -> dict[str, Any]:
    """What ``measure`` left in some files, as if one run had measured it.

    Where two files have the same scene, series and quality, the later file's point stays.

    Args:
        paths: files of ``measure``, one or more.
        chosen: take these series alone, in this order; empty: all of them. A scene may lack some of them.

    Returns:
        The same structure. "commit" names every commit and, if there are several, the series that each has measured;
        "machine" and "command" are those of the files that a point is taken of, each once.

    Raises:
        UsageError: none of the files has a series of that name.
    """
    files = [json.loads(path.read_text()) for path in paths]
    together: dict[str, Any] = {**files[0], "scenes": {}}
    for number, file in enumerate(files):
        about = {"commit": file.get("commit", "unknown"), "file": number}
        for name, entry in file["scenes"].items():
            kept = together["scenes"].setdefault(name, {**entry, "series": {}})
            for series, curve in entry["series"].items():
                points = {p["q"]: p for p in kept["series"].get(series, {"encodes": []})["encodes"]}
                points |= {p["q"]: {**about, **p} for p in curve["encodes"]}
                kept["series"][series] = {**curve, "encodes": [points[q] for q in sorted(points)]}
    for entry in together["scenes"].values():
        order = chosen or list(entry["series"])
        entry["series"] = {name: entry["series"][name] for name in order if name in entry["series"]}
    for name in chosen:
        if not any(name in entry["series"] for entry in together["scenes"].values()):
            raise UsageError(f"{', '.join(map(str, paths))}: there is no series '{name}'")
    used = {
        point.pop("file")
        for entry in together["scenes"].values()
        for curve in entry["series"].values()
        for point in curve["encodes"]
    }
    together["commit"] = _commits(together["scenes"])
    sources = [file for number, file in enumerate(files) if number in used]
    for key, between in (("machine", "; "), ("date", ", ")):
        together[key] = between.join(dict.fromkeys(file[key] for file in sources if key in file))
    together["command"] = list(dict.fromkeys(command for file in sources for command in file.get("command", [])))
    return together


def _commits(scenes: dict[str, Any]) -> str:
    """The commits of all points: one, or each with the series (and, where they differ, the scenes) that it measured."""
    of_commit: dict[str, dict[str, list[str]]] = {}
    for scene, entry in scenes.items():
        for series, curve in entry["series"].items():
            for commit in dict.fromkeys(point["commit"] for point in curve["encodes"]):
                of_commit.setdefault(commit, {}).setdefault(series, []).append(scene)
    if len(of_commit) <= 1:
        return "".join(of_commit)
    parts = []
    for commit, parted in of_commit.items():
        texts = [
            series if len(measured) == len(scenes) else f"{series} of {' and '.join(measured)}"
            for series, measured in parted.items()
        ]
        parts.append(f"{commit} ({', '.join(texts)})")
    return "; ".join(parts)
