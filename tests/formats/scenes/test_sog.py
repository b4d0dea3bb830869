"""SOG files that are damaged; tests of all foreign formats look at good ones."""

from __future__ import annotations

import json
import zipfile

import pytest

from potr_cl.errors import DataError
from potr_cl.formats import load_scene
from potr_cl.formats.scenes import sog

pytest.importorskip("gsply", reason="the extra convert is not installed")


def rewritten_sog(source, target, change):
    """A copy of a SOG file with another description."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for entry in old.infolist():
            content = old.read(entry)
            if entry.filename == "meta.json":
                meta = json.loads(content)
                change(meta)
                content = json.dumps(meta).encode()
            new.writestr(entry.filename, content)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.update(version=1), "version 1"),
        (lambda m: m.pop("version"), "version 1"),
        (lambda m: m.update(count=-5), "a count of"),
        (lambda m: m.update(count=10**9), "pixels for 1000000000 splats"),
        (lambda m: m.pop("quats"), "quats"),
        (lambda m: m["scales"]["codebook"].pop(), "codebook"),
        (lambda m: m["shN"]["codebook"].__setitem__(0, "x"), "codebook"),
        (lambda m: m["shN"].update(bands=7), "7 bands"),
        (lambda m: m["shN"].update(bands=2), "palette"),
        (lambda m: m["shN"].update(count=60000), "palette"),
        (lambda m: m["means"].update(files=["../../etc/passwd", "x"]), "etc/passwd"),
        (lambda m: m["means"].update(mins=[1, 2]), "damaged"),
    ],
)
def test_bad_sog_files(tmp_path, data, change, message):
    rewritten_sog(data / "foreign" / "degree_3.sog", tmp_path / "bad.sog", change)
    with pytest.raises(DataError, match=message):
        sog.load(tmp_path / "bad.sog")


def test_a_sog_file_that_unpacks_to_far_more(tmp_path):
    with zipfile.ZipFile(tmp_path / "bomb.sog", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("meta.json", b" " * (1 << 24))
    with pytest.raises(DataError, match="far more than its size"):
        load_scene(tmp_path / "bomb.sog")
