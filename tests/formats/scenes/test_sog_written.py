"""SOG files that are written: what is read again, by this package and by another one."""

from __future__ import annotations

import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest

from potr_cl import DataError, Scene, convert
from potr_cl.cli import main
from potr_cl.formats.scenes import sog
from potr_cl.formats.scenes.sog_images import members, write_folder
from potr_cl.formats.scenes.sog_values import distinct_rows, in_order, palette_of, quantised
from tests.cases.scenes import in_order_of, turned_by


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
    scene = replace(plush_excerpt, sh=plush_excerpt.sh[:, : (degree + 1) ** 2])
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
    sog.save(tmp_path / "a.sog", plush_excerpt)
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


def test_another_reader_sees_the_same(tmp_path, plush_excerpt):
    reader = pytest.importorskip("gsply")
    sog.save(tmp_path / "a.sog", plush_excerpt)
    ours, theirs = sog.load(tmp_path / "a.sog"), reader.sogread(tmp_path / "a.sog")
    assert np.allclose(theirs.means, ours.means, atol=1e-5)
    assert np.allclose(theirs.sh0, ours.sh[:, 0], atol=1e-6)
    assert np.allclose(theirs.shN, ours.sh[:, 1:], atol=1e-6)
    assert np.allclose(np.abs((theirs.quats * ours.quaternions).sum(axis=1)), 1, atol=1e-4)
