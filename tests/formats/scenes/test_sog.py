"""SOG, in files, folders and levels: hostile and damaged ones, what is read again, by this package and another one."""

from __future__ import annotations

import io
import json
import shutil
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from potr_cl import DataError, Scene, UsageError, convert
from potr_cl.cli import main
from potr_cl.formats import load_scene
from potr_cl.formats.scenes import sog, sog_levels
from potr_cl.formats.scenes.sog_images import members, write_folder
from potr_cl.formats.scenes.sog_values import distinct_rows, in_order, palette_of, quantised
from potr_cl.host.inputs import FREE_SPLATS
from tests.cases.memory import takes_at_most
from tests.cases.own_warnings import no_warnings
from tests.cases.scenes import in_order_of, turned_by

# Hostile files -------------------------------------------------------------------------------------------------------


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


def test_small_files_that_unpack_to_far_more(tmp_path):
    """Refused by its description alone; who trusts it gets its splats, without a word of Pillow's."""
    with zipfile.ZipFile(tmp_path / "meta.sog", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("meta.json", b" " * (1 << 24))
    with pytest.raises(DataError, match="far more than its size"):
        load_scene(tmp_path / "meta.sog")
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


def test_another_reader_sees_the_same(data, plush_excerpt, tmp_path):
    reader = pytest.importorskip("gsply.sog_reader")
    sog.save(tmp_path / "a.sog", plush_excerpt[::3])
    for path in (data / "foreign" / "degree_0.sog", data / "foreign" / "degree_3.sog", tmp_path / "a.sog"):
        scene, expected = load_scene(path), reader.sogread(path)
        assert np.abs(scene.means - expected.means).max() < 1e-6
        assert np.array_equal(scene.log_scales, expected.scales)
        assert np.abs(scene.quaternions - expected.quats).max() < 1e-6
        usual = np.abs(expected.opacities) < 10  # for the logits of 0 and 1 each reader has numbers of its own
        assert np.abs(scene.opacity_logits - expected.opacities)[usual].max() < 1e-5
        assert np.array_equal(scene.sh[:, 0], expected.sh0)
        assert np.array_equal(scene.sh[:, 1:], expected.shN)


# Folders and levels --------------------------------------------------------------------------------------------------


@pytest.fixture
def folder(data, tmp_path):
    """A SOG folder."""
    return Path(shutil.copytree(data / "other_tools" / "splat-transform_sog", tmp_path / "sog"))


@pytest.fixture
def levels(data, tmp_path):
    """A streamed SOG folder."""
    return Path(shutil.copytree(data / "other_tools" / "splat-transform_lod", tmp_path / "lod"))


#: What stands for a value that is missing.
GONE = object()


def rewritten(path: Path, **changes: Any) -> None:
    """The description with other values; ``a_b`` is b within a."""
    meta = json.loads(path.read_bytes())
    for place, value in changes.items():
        *outer, name = place.split("_")
        part = meta[outer[0]] if outer else meta
        part[name] = value
        if value is GONE:
            del part[name]
    path.write_text(json.dumps(meta))


@pytest.mark.parametrize(
    ("place", "values", "message"),
    [
        ("version", [1, 3, GONE], "version [13], only 2"),
        ("version", ["\x1b[31m" * 9999], "version unknown, only 2"),
        ("count", [-5, True, 10**400], "a count of"),
        ("count", [10**7], "10000000 splats in [0-9]+ bytes .*--trust"),
        ("count", [1000], "pixels for 1000 splats"),
        ("means_mins", [[0, float("nan"), 0], [1, 2]], "not 3 numbers"),
        ("quats", [GONE], "quats"),
        ("scales_codebook", [[0.0] * 255], "codebook"),
        ("shN_codebook", [["x"] * 256], "codebook"),
        ("shN_bands", [7], "7 bands"),
        ("shN_bands", [2], "palette"),
        ("shN_count", [60000], "palette"),
        ("sh0_files", [[], [3], "sh0.webp"], "damaged"),
        ("sh0_files", [["../sog/sh0.webp"], ["\x1b[2J.webp"], ["a\nb"]], "it names a file"),
    ],
)
def test_bad_descriptions(place, values, message, folder):
    for value in values:
        rewritten(folder / "meta.json", **{place: value})
        with pytest.raises(DataError, match=message):
            load_scene(folder)


def test_what_a_folder_lacks(folder):
    (folder / "quats.webp").unlink()
    with pytest.raises(UsageError, match=r"cannot open '.*quats.webp'"):
        load_scene(folder)
    (folder / "quats.webp").write_bytes(b"not a picture")
    with pytest.raises(DataError, match="no WebP image"):
        load_scene(folder / "meta.json")
    rewritten(folder / "meta.json", version=GONE, means=GONE)
    with pytest.raises(DataError, match="no description of a SOG scene"):
        load_scene(folder)
    (folder / "meta.json").write_bytes(b" " * (5 << 20))
    with pytest.raises(DataError, match="no description of a SOG scene: it has 5242880 bytes"):
        load_scene(folder)


def test_levels_that_there_are_not_and_further_ones(levels, caplog):
    load_scene(f"{levels}#0")
    assert not caplog.records
    load_scene(levels)
    assert "has 2 levels of detail: the finest is read" in caplog.text
    for level in (2, 999_999):
        with pytest.raises(UsageError, match=f"has the levels 0 to 1, and no level {level}"):
            load_scene(f"{levels}#{level}")
    rewritten(levels / "lod-meta.json", lodLevels=1)
    with pytest.raises(UsageError, match="has only level 0, and no level 1"):
        load_scene(f"{levels}/lod-meta.json#1")


def test_a_level_in_parts(levels):
    """Leaves of a tree that have some splats of two files each."""
    whole = load_scene(f"{levels}#0")
    shutil.copytree(levels / "0_0", levels / "other")

    leaves = [
        {"lods": {"0": {"file": number, "offset": offset, "count": count}}}
        for number, offset, count in ((2, 100, 50), (0, 20, 10), (0, 0, 20))
    ]
    names = json.loads((levels / "lod-meta.json").read_text())["filenames"]
    tree = {"children": [{"children": leaves[:2]}, leaves[2], {}]}
    rewritten(levels / "lod-meta.json", filenames=[*names, "other/meta.json"], environment=GONE, tree=tree)
    scene = load_scene(f"{levels}#0")
    np.testing.assert_array_equal(scene.means, whole.means[[*range(30), *range(100, 150)]])
    with pytest.raises(DataError, match="level 1 has no splats"):
        load_scene(f"{levels}#1")
    rewritten(levels / "lod-meta.json", tree={})
    with pytest.raises(DataError, match="level 0 has no splats"):
        load_scene(f"{levels}#0")


def node(**changes: Any) -> dict[str, Any]:
    return {"lods": {"0": {"file": 0, "offset": 0, "count": 150} | changes}}


@pytest.mark.parametrize(
    ("place", "values", "message"),
    [
        ("tree", [GONE], "it has no tree"),
        ("version", [2], "version 2, only 1"),
        ("lodLevels", [0, True], "impossible number of levels: (0|True)"),
        ("filenames", [None], "names no files"),
        ("filenames", [["../a/meta.json"]], "it names a file '../a/meta.json'"),
        ("filenames", [["0_0/meta.json"] * 2], "names a file twice"),
        ("environment", ["/etc/passwd"], "it names a file"),
        ("tree", [{"children": 3}, {"children": [3]}, {"lods": []}], "its tree is invalid"),
        ("tree", [node(file=2), node(file=-1)], "impossible number of files: (2|-1)"),
        ("tree", [node(offset=-1)], "impossible number of offset"),
        ("tree", [node(count=1.5)], "impossible number of count"),
        ("tree", [node(count=151), node(offset=1)], "has 150 splats"),
        ("tree", [{"children": [node(), node(count=1)]}], "parts overlap"),
        ("tree", [{"lods": {"0": {}}}], "damaged"),
    ],
)
def test_bad_trees(place, values, message, levels):
    for value in values:
        rewritten(levels / "lod-meta.json", **{place: value})
        with pytest.raises(DataError, match=message):
            load_scene(f"{levels}#0")


def test_missing_chunks_and_deep_trees(levels):
    (levels / "0_0" / "meta.json").unlink()
    with pytest.raises(UsageError, match=r"cannot open '.*0_0.meta.json'"):
        load_scene(levels)
    assert len(load_scene(f"{levels}#1")) == 200
    (levels / "lod-meta.json").write_text('{"tree": ' * 50_000)
    with pytest.raises(DataError):
        sog_levels.load(levels)


def test_many_chunks_that_claim_much(levels):
    """Each might hold FREE_SPLATS by itself."""
    chunk = {"version": 2, "count": FREE_SPLATS, "means": {}}
    names = [f"c{k}.json" for k in range(40)]
    for name in names:
        (levels / name).write_text(json.dumps(chunk))
    tree = {"children": [node(file=k, count=FREE_SPLATS) for k in range(40)]}
    rewritten(levels / "lod-meta.json", filenames=names, tree=tree)
    with pytest.raises(DataError, match=r"splats in \d+ bytes .*--trust"):
        load_scene(levels)


# Writing -------------------------------------------------------------------------------------------------------------


def scene_of(count, degree=3, seed=1):
    """A scene with values as trained ones have them."""
    generator = np.random.default_rng(seed)
    coefficients = (degree + 1) ** 2
    return Scene(
        generator.normal(size=(count, 3)).astype(np.float32),
        generator.normal(-4, 1, (count, 3)).astype(np.float32),
        generator.normal(size=(count, 4)).astype(np.float32),
        generator.normal(0, 3, count).astype(np.float32),
        generator.normal(0, 0.3, (count, coefficients, 3)).astype(np.float32),
    )


@pytest.mark.parametrize("degree", [0, 3])
def test_values_are_read_again_within_the_steps_of_the_format(tmp_path, plush_excerpt, degree):
    scene = replace(plush_excerpt, sh=plush_excerpt.sh[:, : (degree + 1) ** 2])[::2]
    sog.save(tmp_path / "a.sog", scene)
    back = in_order_of(scene, sog.load(tmp_path / "a.sog"))
    logarithms, again = (np.copysign(np.log1p(np.abs(s.means)), s.means) for s in (scene, back))
    assert np.abs(logarithms - again).max() <= 0.51 * np.ptp(logarithms, axis=0).max() / 65535 + 1e-6
    angles, differences = turned_by(scene, back)
    elongated = np.diff(np.sort(scene.log_scales, axis=1), axis=1).min(axis=1) > 0.5
    assert angles[elongated].max() < 0.02
    assert np.abs(differences[elongated]).mean() < 0.02
    assert np.abs(scene.opacities - back.opacities).max() < 0.502 / 255
    assert back.sh.shape == scene.sh.shape
    assert np.abs(back.sh[:, 0] - scene.sh[:, 0]).mean() < 0.01
    if degree:
        assert np.abs(back.sh[:, 1:] - scene.sh[:, 1:]).mean() < 0.002


def test_a_second_time_nothing_is_lost_of_colours(tmp_path, plush_excerpt):
    sog.save(tmp_path / "a.sog", plush_excerpt[::3])
    once = sog.load(tmp_path / "a.sog")
    sog.save(tmp_path / "b.sog", once)
    twice = in_order_of(once, sog.load(tmp_path / "b.sog"))
    assert np.array_equal(once.sh, twice.sh)
    assert np.array_equal(once.opacity_logits, twice.opacity_logits)
    assert np.abs(once.means - twice.means).max() < 1e-5


def test_a_folder_and_what_is_written_again_hold_the_same(tmp_path, data, plush_excerpt, capsys):
    convert(data / "plush_excerpt.ply", tmp_path / "a.sog")
    sog.save(tmp_path / "b.sog", plush_excerpt)
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()
    path = tmp_path / "folder" / "meta.json"
    path.parent.mkdir()
    assert main(["convert", str(data / "plush_excerpt.ply"), str(path)]) == 0
    told = capsys.readouterr()
    assert f"{sum(each.stat().st_size for each in path.parent.iterdir()):,} bytes" in told.out + told.err
    assert sog.load(tmp_path / "a.sog") == sog.load(path.parent)


def test_what_the_files_say_of_themselves_and_cannot_say(tmp_path, plush_excerpt, caplog):
    sog.save(tmp_path / "a.sog", replace(plush_excerpt.rendered(True), low_pass=0.1))
    assert caplog.text.count("low-pass filter of 0.1") == 1
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        meta = json.loads(archive.read("meta.json"))
        names = {entry.filename for entry in archive.infolist()}
        assert {e.compress_type for e in archive.infolist() if e.filename != "meta.json"} == {zipfile.ZIP_STORED}
    assert meta["version"] == 2
    assert meta["count"] == 1500
    assert meta["model"] == "antialiased"
    assert {name for part in meta.values() if isinstance(part, dict) for name in part.get("files", [])} < names
    assert all(len(meta[part]["codebook"]) == 256 for part in ("scales", "sh0", "shN"))
    assert sog.load(tmp_path / "a.sog").antialiased


def test_more_sets_of_coefficients_than_a_palette_holds(tmp_path):
    scene = scene_of(70_000, degree=1)
    scene.sh[::7, 1:] = 0
    palette = palette_of(scene)
    assert len(palette.entries) <= 65536
    kept = palette.book[palette.entries][palette.labels]
    assert not kept[::7].any()
    errors = np.square(kept - scene.sh[:, 1:]).sum(axis=(1, 2))
    assert np.sqrt(errors.mean()) < 0.1  # coefficients are 0.3 sqrt(9) long
    few = palette_of(scene, most=300)
    assert len(few.entries) <= 300
    assert np.square(few.book[few.entries][few.labels] - scene.sh[:, 1:]).sum(axis=(1, 2)).mean() > errors.mean()


def test_equal_rows_are_found_and_rows_that_only_seem_equal_told_apart():
    rows = np.random.default_rng(1).integers(0, 3, (500, 4)).astype(np.float32)
    rows[3] = -0.0
    sets, labels = distinct_rows(rows, 500)
    assert np.array_equal(sets[labels], rows)
    assert len(sets) == len(np.unique(rows, axis=0))
    assert distinct_rows(rows, 10) is None


def test_hardly_any_splats(tmp_path):
    for count in (1, 2, 3, 17):
        scene = scene_of(count)
        sog.save(tmp_path / "a.sog", scene)
        back = in_order_of(scene, sog.load(tmp_path / "a.sog"))
        assert np.abs(back.means - scene.means).max() < 1e-3
        assert np.abs(back.sh - scene.sh).max() < 1e-2


def test_large_values_and_splats_in_one_place(tmp_path):
    scene = scene_of(50)
    scene.means[:] = 1e30
    scene.means[0] = -1e-30
    scene.log_scales[3] = 60
    scene.sh[7] = 1e6
    sog.save(tmp_path / "a.sog", scene)
    back = sog.load(tmp_path / "a.sog")
    assert len(back) == 50
    assert np.sort(back.means[:, 0])[1:] == pytest.approx(1e30, rel=1e-3)


def test_more_splats_than_images_have_pixels(tmp_path, plush_excerpt):
    images = quantised(in_order(plush_excerpt), None)

    class Long(type(images)):
        def __len__(self):
            return 16380 * 16383 + 1

    with pytest.raises(DataError, match="cannot hold 268353541 splats"):
        next(members(Long(**vars(images))))


def test_a_folder_is_whole_or_stays_as_it_was(tmp_path, plush_excerpt):
    (tmp_path / "meta.json").write_text("before")
    images = quantised(in_order(plush_excerpt), None)
    broken = replace(images, colours=images.colours[:0])
    with pytest.raises(IndexError):
        write_folder(tmp_path / "meta.json", broken)
    assert [path.name for path in tmp_path.iterdir()] == ["meta.json"]
    assert (tmp_path / "meta.json").read_text() == "before"
