"""Changed SOG folders and streamed SOG: descriptions that name other files, trees of levels."""

from __future__ import annotations

import json
from random import Random
from typing import Any

from tools.stress.hostile.changes import TEXTS, damaged, damaged_json, damaged_value, json_bytes
from tools.stress.hostile.sog_files import parts

#: Files that belong together, by their names; the first is what is read.
Files = dict[str, bytes]

_NAMES = (*TEXTS, "../meta.json", "/dev/zero", "meta.json", "a/../../b", ".", "..")


def originals() -> list[Files]:
    """Good folders of every SH degree."""
    return [parts(5, bands) for bands in range(4)]


def changed(rng: Random) -> Files:
    """A small folder, changed."""
    files = dict(parts(rng.choice((1, 4, 30)), rng.choice((0, 0, 1, 3))))
    kind = rng.randrange(6)
    images = [name for name in files if name != "meta.json"]
    if kind == 0:
        files[rng.choice(images)] = damaged(files[images[0]], rng)
    elif kind == 1:
        del files[rng.choice(images)]
    elif kind == 2:
        meta = json.loads(files["meta.json"])
        meta[rng.choice(("means", "scales", "quats", "sh0"))]["files"] = rng.choices(_NAMES, k=2)
        files["meta.json"] = json_bytes(meta)
    elif kind < 5:
        files["meta.json"] = damaged_json(files["meta.json"], rng)
    return files


def level_originals() -> list[Files]:
    """A good streamed SOG folder."""
    return [streamed(_tree(), {"0": (5, 1), "1": (4, 0), "env": (3, 0)})]


def changed_levels(rng: Random) -> Files:
    """A small streamed SOG folder, changed."""
    meta = _tree()
    kind = rng.randrange(8)
    if kind == 0:
        meta[rng.choice(("filenames", "environment"))] = rng.choice(
            (["0/meta.json"] * 2, rng.choices(_NAMES, k=2), "x")
        )
    elif kind == 1:
        leaf = rng.choice(meta["tree"]["children"])["lods"]["0"]
        leaf[rng.choice(("file", "offset", "count"))] = rng.choice((0, 1, 2, 3, -1, 10**9, 2**40, 1.5, True, None, "0"))
    elif kind == 2:
        meta["lodLevels"] = rng.choice((0, 1, 3, 10**9, -1, None, 1.0))
    elif kind < 6:
        meta = damaged_value(meta, rng)
    files = streamed(meta, {"0": (5, rng.choice((0, 1))), "1": (4, 0), "env": (3, 0)})
    if rng.random() < 0.2:
        name = rng.choice(list(files))
        files[name] = damaged(files[name], rng)
    return files


def streamed(meta: Any, folders: dict[str, tuple[int, int]]) -> Files:
    """A streamed SOG folder: its description, and SOG folders of some splats and bands each."""
    files = {"lod-meta.json": json_bytes(meta)}
    for folder, (splats, bands) in folders.items():
        files |= {f"{folder}/{name}": content for name, content in parts(splats, bands).items()}
    return files


def _tree() -> dict[str, Any]:
    leaves = [
        {"lods": {"0": {"file": 0, "offset": 0, "count": 2}, "1": {"file": 1, "offset": 0, "count": 4}}},
        {"lods": {"0": {"file": 0, "offset": 2, "count": 3}}},
    ]
    return {
        "version": 1,
        "count": 9,
        "counts": [5, 4],
        "lodLevels": 2,
        "filenames": ["0/meta.json", "1/meta.json"],
        "environment": "env/meta.json",
        "tree": {"bound": {"min": [0, 0, 0], "max": [1, 1, 1]}, "children": leaves},
    }
