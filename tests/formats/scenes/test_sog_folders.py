"""SOG folders and streamed SOG: whatever a folder lacks or names, levels in several parts."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from potr_cl import DataError, UsageError
from potr_cl.formats import load_scene
from potr_cl.formats.scenes import sog_levels
from potr_cl.host.inputs import FREE_SPLATS


@pytest.fixture
def folder(data: Path, tmp_path: Path) -> Path:
    """A SOG folder."""
    return Path(shutil.copytree(data / "other_tools" / "splat-transform_sog", tmp_path / "sog"))


@pytest.fixture
def levels(data: Path, tmp_path: Path) -> Path:
    """A streamed SOG folder."""
    return Path(shutil.copytree(data / "other_tools" / "splat-transform_lod", tmp_path / "lod"))


def rewritten(path: Path, change: Any) -> None:
    meta = json.loads(path.read_bytes())
    change(meta)
    path.write_text(json.dumps(meta))


@pytest.mark.parametrize(
    "name", ["../sh0.webp", "/etc/passwd", "a/../../x", "..\\x", "c:x", "", ".", "\x1b[2J.webp", "a\nb"]
)
def test_images_outside_of_the_folder_are_not_opened(name: str, folder: Path) -> None:
    (folder.parent / "sh0.webp").write_bytes((folder / "sh0.webp").read_bytes())
    rewritten(folder / "meta.json", lambda meta: meta["sh0"].update(files=[name]))
    with pytest.raises((DataError, UsageError), match=r"names a file|not a regular file"):
        load_scene(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.update(version=1), "version 1"),
        (lambda m: m.update(version=3), "version 3"),
        (lambda m: m.pop("version"), "version 1"),
        (lambda m: m.update(version="\x1b[31m" * 9999), "version unknown, only 2"),
        (lambda m: m.update(count=-5), "a count of"),
        (lambda m: m.update(count=True), "a count of"),
        (lambda m: m.update(count=10**400), "a count of an impossible number"),
        (lambda m: m.update(count=10**7), "10000000 splats in [0-9]+ bytes .*--trust"),
        (lambda m: m.update(count=1000), "pixels for 1000 splats"),
        (lambda m: m["means"].update(mins=[0, float("nan"), 0]), "not 3 numbers"),
        (lambda m: m["means"].update(mins=[1, 2]), "damaged"),
        (lambda m: m.pop("quats"), "quats"),
        (lambda m: m["scales"]["codebook"].pop(), "codebook"),
        (lambda m: m["shN"]["codebook"].__setitem__(0, "x"), "codebook"),
        (lambda m: m["shN"].update(bands=7), "7 bands"),
        (lambda m: m["shN"].update(bands=2), "palette"),
        (lambda m: m["shN"].update(count=60000), "palette"),
        (lambda m: m["sh0"].update(files=[]), "damaged"),
        (lambda m: m["sh0"].update(files=[3]), "damaged"),
        (lambda m: m["sh0"].update(files="sh0.webp"), "damaged"),
        (lambda m: (m.pop("version"), m.pop("means")), "no description of a SOG scene"),
    ],
)
def test_bad_descriptions(change: Any, message: str, folder: Path) -> None:
    rewritten(folder / "meta.json", change)
    with pytest.raises(DataError, match=message):
        load_scene(folder)


def test_what_a_folder_lacks(folder: Path) -> None:
    (folder / "quats.webp").unlink()
    with pytest.raises(UsageError, match=r"cannot open '.*quats.webp'"):
        load_scene(folder)
    (folder / "quats.webp").write_bytes(b"not a picture")
    with pytest.raises(DataError, match="no WebP image"):
        load_scene(folder / "meta.json")
    (folder / "meta.json").write_bytes(b" " * (5 << 20))
    with pytest.raises(DataError, match="no description of a SOG scene: it has 5242880 bytes"):
        load_scene(folder)


def test_levels_that_there_are_not_and_further_ones(levels: Path, caplog: pytest.LogCaptureFixture) -> None:
    load_scene(f"{levels}#0")
    assert not caplog.records
    load_scene(levels)
    assert "has 2 levels of detail: the finest is read" in caplog.text
    for level in (2, 999_999):
        with pytest.raises(UsageError, match=f"has the levels 0 to 1, and no level {level}"):
            load_scene(f"{levels}#{level}")
    rewritten(levels / "lod-meta.json", lambda meta: meta.update(lodLevels=1))
    with pytest.raises(UsageError, match="has only level 0, and no level 1"):
        load_scene(f"{levels}/lod-meta.json#1")


def test_a_level_in_parts(levels: Path) -> None:
    """Leaves of a tree that have some splats of two files each."""
    whole = load_scene(f"{levels}#0")
    shutil.copytree(levels / "0_0", levels / "other")

    def split(meta: dict[str, Any]) -> None:
        meta["filenames"].append("other/meta.json")
        del meta["environment"]
        leaves = [
            {"lods": {"0": {"file": number, "offset": offset, "count": count}}}
            for number, offset, count in ((2, 100, 50), (0, 20, 10), (0, 0, 20))
        ]
        meta["tree"] = {"children": [{"children": leaves[:2]}, leaves[2], {}]}

    rewritten(levels / "lod-meta.json", split)
    scene = load_scene(f"{levels}#0")
    np.testing.assert_array_equal(scene.means, whole.means[[*range(30), *range(100, 150)]])
    with pytest.raises(DataError, match="level 1 has no splats"):
        load_scene(f"{levels}#1")


def node(**changes: Any) -> dict[str, Any]:
    return {"lods": {"0": {"file": 0, "offset": 0, "count": 150} | changes}}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.pop("tree"), "it has no tree"),
        (lambda m: m.update(version=2), "version 2, only 1"),
        (lambda m: m.update(lodLevels=0), "impossible number of levels: 0"),
        (lambda m: m.update(lodLevels=True), "impossible number of levels: True"),
        (lambda m: m.update(filenames=None), "names no files"),
        (lambda m: m.update(filenames=["../a/meta.json"]), "it names a file '../a/meta.json'"),
        (lambda m: m.update(filenames=["0_0/meta.json"] * 2), "names a file twice"),
        (lambda m: m.update(environment="/etc/passwd"), "it names a file"),
        (lambda m: m.update(tree={"children": 3}), "its tree is invalid"),
        (lambda m: m.update(tree={"children": [3]}), "its tree is invalid"),
        (lambda m: m.update(tree={"lods": []}), "its tree is invalid"),
        (lambda m: m.update(tree=node(file=2)), "impossible number of files: 2"),
        (lambda m: m.update(tree=node(file=-1)), "impossible number of files: -1"),
        (lambda m: m.update(tree=node(offset=-1)), "impossible number of offset"),
        (lambda m: m.update(tree=node(count=1.5)), "impossible number of count"),
        (lambda m: m.update(tree=node(count=151)), "has 150 splats"),
        (lambda m: m.update(tree=node(offset=1)), "has 150 splats"),
        (lambda m: m.update(tree={"children": [node(), node(count=1)]}), "parts overlap"),
        (lambda m: m.update(tree={"lods": {"0": {}}}), "damaged"),
        (lambda m: m.update(tree={}) or m.pop("environment"), "level 0 has no splats"),
    ],
)
def test_bad_trees(change: Any, message: str, levels: Path) -> None:
    rewritten(levels / "lod-meta.json", change)
    with pytest.raises(DataError, match=message):
        load_scene(f"{levels}#0")


def test_missing_chunks_and_deep_trees(levels: Path) -> None:
    (levels / "0_0" / "meta.json").unlink()
    with pytest.raises(UsageError, match=r"cannot open '.*0_0.meta.json'"):
        load_scene(levels)
    assert len(load_scene(f"{levels}#1")) == 200
    (levels / "lod-meta.json").write_text('{"tree": ' * 50_000)
    with pytest.raises(DataError):
        sog_levels.load(levels)


def test_many_chunks_that_claim_much(levels: Path) -> None:
    """Each might hold FREE_SPLATS by itself."""
    chunk = {"version": 2, "count": FREE_SPLATS, "means": {}}
    names = [f"c{k}.json" for k in range(40)]
    for name in names:
        (levels / name).write_text(json.dumps(chunk))
    tree = {"children": [node(file=k, count=FREE_SPLATS) for k in range(40)]}
    rewritten(levels / "lod-meta.json", lambda meta: meta.update(filenames=names, tree=tree))
    with pytest.raises(DataError, match=r"splats in \d+ bytes .*--trust"):
        load_scene(levels)
