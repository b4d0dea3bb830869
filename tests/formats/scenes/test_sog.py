"""SOG files that are damaged; tests of all foreign formats look at good ones."""

from __future__ import annotations

import io
import json
import zipfile

import numpy as np
import pytest
from PIL import Image

from potr_cl.errors import DataError
from potr_cl.formats import load_scene
from potr_cl.formats.scenes import sog
from potr_cl.host.inputs import FREE_SPLATS
from tests.cases.memory import takes_at_most
from tests.cases.own_warnings import no_warnings


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
        (lambda m: m.update(count=10**9), "1000000000 splats in [0-9]+ bytes .*--trust"),
        (lambda m: m.update(count=1601), "pixels for 1601 splats"),
        (lambda m: m.update(count=True), "a count of"),
        (lambda m: m.update(version="\x1b[31m" * 9999), "version unknown, only 2"),
        (lambda m: m.update(count=10**400), "a count of an impossible number"),
        (lambda m: m["means"].update(mins=[0, float("nan"), 0]), "not 3 numbers"),
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


def webp(width, height, frames=1) -> bytes:
    file = io.BytesIO()
    images = [Image.new("RGBA", (width, height), (n, 0, 0, 255)) for n in range(frames)]
    images[0].save(file, "WEBP", lossless=True, method=0, save_all=frames > 1, append_images=images[1:])
    return file.getvalue()


def sog_of(target, count, width, height, method=zipfile.ZIP_DEFLATED, frames=1):
    """A SOG file of equal splats."""
    images = webp(width, height, frames)
    book = [0.0] * 256
    meta = {
        "version": 2,
        "count": count,
        "means": {"mins": [0, 0, 0], "maxs": [1, 1, 1], "files": ["a.webp", "a.webp"]},
        "quats": {"files": ["a.webp"]},
        "scales": {"files": ["a.webp"], "codebook": book},
        "sh0": {"files": ["a.webp"], "codebook": book},
    }
    with zipfile.ZipFile(target, "w", method) as archive:
        archive.writestr("meta.json", json.dumps(meta))
        archive.writestr("a.webp", images)
    return target


def test_a_small_file_of_countless_pixels(tmp_path):
    """Refused by its description alone; who trusts it gets its splats, without a word of Pillow's."""
    bomb = sog_of(tmp_path / "bomb.sog", 8_000_000, 3000, 3000)
    assert bomb.stat().st_size < 60_000
    with takes_at_most(4 << 20), pytest.raises(DataError, match=r"8000000 splats in \d+ bytes .*--trust"):
        load_scene(bomb)
    fair = sog_of(tmp_path / "fair.sog", FREE_SPLATS + 40_000, 400, 300)
    with pytest.raises(DataError, match="--trust"):
        load_scene(fair)
    with no_warnings():
        assert len(load_scene(fair, trust=True)) == FREE_SPLATS + 40_000


def test_many_pixels_for_few_splats_are_not_unpacked(tmp_path, monkeypatch):
    bomb = sog_of(tmp_path / "bomb.sog", 10, 5000, 5000)
    monkeypatch.setattr(Image, "open", lambda *args, **kwargs: pytest.fail("an image was opened"))
    with pytest.raises(DataError, match="5000 x 5000 pixels for 10 splats"):
        load_scene(bomb, trust=True)


@pytest.mark.parametrize("options", [{"lossless": True}, {}, {"lossless": True, "exif": b"Exif\0\0ab"}])
def test_sizes_of_webp_images(options):
    for mode in ("RGB", "RGBA"):
        file = io.BytesIO()
        Image.new(mode, (300, 77), 9).save(file, "WEBP", **options)
        assert sog.webp_size(file.getvalue()) == (300, 77)
    assert sog.webp_size(b"RIFF") is None
    assert sog.webp_size(file.getvalue()[:12] + b"ABCD" + file.getvalue()[16:]) is None


@pytest.mark.parametrize("method", [zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2])
def test_packings_that_no_sog_file_has(tmp_path, method):
    """LZMA takes as much memory as a file says."""
    with pytest.raises(DataError, match="packed in a way"):
        load_scene(sog_of(tmp_path / "a.sog", 9, 3, 3, method))


def test_animated_images_are_refused(tmp_path):
    with pytest.raises(DataError, match="animated"):
        load_scene(sog_of(tmp_path / "a.sog", 9, 3, 3, frames=2))


@pytest.mark.parametrize("name", ["degree_0.sog", "degree_3.sog"])
def test_values_are_those_that_another_reader_gives(data, name):
    reader = pytest.importorskip("gsply.sog_reader")
    expected = reader.sogread(data / "foreign" / name)
    scene = load_scene(data / "foreign" / name)
    assert np.abs(scene.means - expected.means).max() < 1e-6
    assert np.array_equal(scene.log_scales, expected.scales)
    assert np.abs(scene.quaternions - expected.quats).max() < 1e-6
    assert np.abs(scene.opacity_logits - expected.opacities).max() < 1e-5
    assert np.array_equal(scene.sh[:, 0], expected.sh0)
    assert np.array_equal(scene.sh[:, 1:], expected.shN)
