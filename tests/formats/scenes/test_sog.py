"""SOG files that are damaged or hostile; tests of all foreign formats look at good ones, others at descriptions."""

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
    image = {"files": ["a.webp"]}
    indexed = image | {"codebook": [0.0] * 256}
    means = {"mins": [0, 0, 0], "maxs": [1, 1, 1], "files": ["a.webp", "a.webp"]}
    meta = {"version": 2, "count": count, "means": means, "quats": image, "scales": indexed, "sh0": indexed}
    with zipfile.ZipFile(target, "w", method) as archive:
        archive.writestr("meta.json", json.dumps(meta))
        archive.writestr("a.webp", webp(width, height, frames))
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
    bomb = sog_of(tmp_path / "bomb.sog", 10, 1000, 1000)
    monkeypatch.setattr(Image, "open", lambda *args, **kwargs: pytest.fail("an image was opened"))
    with pytest.raises(DataError, match="1000 x 1000 pixels for 10 splats"):
        load_scene(bomb, trust=True)


@pytest.mark.parametrize("options", [{"lossless": True}, {}, {"lossless": True, "exif": b"Exif\0\0ab"}])
def test_sizes_of_webp_images(options):
    for mode in ("RGB", "RGBA"):
        file = io.BytesIO()
        Image.new(mode, (300, 77), 9).save(file, "WEBP", **options)
        assert sog.webp_size(file.getvalue()) == (300, 77)
    assert sog.webp_size(b"RIFF") is None
    assert sog.webp_size(file.getvalue()[:12] + b"ABCD" + file.getvalue()[16:]) is None


@pytest.mark.parametrize(
    ("choices", "message"),
    [
        # LZMA takes as much memory as a file says.
        ({"method": zipfile.ZIP_LZMA}, "packed in a way"),
        ({"method": zipfile.ZIP_BZIP2}, "packed in a way"),
        ({"frames": 2}, "animated"),
    ],
)
def test_packings_and_images_that_no_sog_file_has(tmp_path, choices, message):
    with pytest.raises(DataError, match=message):
        load_scene(sog_of(tmp_path / "a.sog", 9, 3, 3, **choices))


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
