"""Camera files of every kind: their kind is found, they agree with each other, and bad ones say what is wrong."""

from __future__ import annotations

import shutil

import pytest

from potr_cl import UsageError
from potr_cl.formats import load_cameras
from potr_cl.formats.cameras import view_files
from potr_cl.model.camera import test_views as views_for_judging
from potr_cl.model.camera import train_views
from tests.cases.cameras import assert_same_views, nerfstudio, refused, view, write_image, write_json

# The same views in different formats ---------------------------------------------------------------------------------


def test_the_excerpts_views_as_cameras_json_and_as_transforms(data, tmp_path):
    shutil.copytree(data / "plush_transforms", tmp_path, dirs_exist_ok=True)
    expected = load_cameras(data / "plush_excerpt_cameras.json")
    for camera in expected:
        write_image(tmp_path / "images" / f"{camera.name}.png", 240, 180)
    loaded = load_cameras(tmp_path)
    assert_same_views(loaded, expected)
    assert len(train_views(loaded)) == 9
    assert len(views_for_judging(loaded)) == 3
    assert loaded[0].image_path == tmp_path / "images" / f"{loaded[0].name}.png"
    assert [c.name for c in load_cameras(tmp_path / "transforms_test.json")] == [c.name for c in loaded[9:]]


@pytest.mark.parametrize("model", ["plush_sparse_binary", "plush_sparse_text"])
def test_plush_excerpt_as_cameras_json_and_as_colmap_model(model, data):
    expected = load_cameras(data / "plush_cameras.json")
    assert_same_views(load_cameras(data / model), expected, 1e-9)
    assert [c.split for c in load_cameras(data / model)].count("test") == 3
    for file in sorted((data / model).iterdir()):  # each stands for the whole model
        assert_same_views(load_cameras(file), expected, 1e-9)


# Finding the kind ----------------------------------------------------------------------------------------------------


def test_folders_and_any_file_name(data, tmp_path):
    refused(tmp_path, "has no cameras, expected a COLMAP model .*, a cameras.json or a transforms.json", UsageError)
    shutil.copytree(data / "plush_sparse_binary", tmp_path / "another" / "sparse" / "0")
    assert len(load_cameras(tmp_path / "another" / "sparse")) == 17
    shutil.copy(data / "plush_cameras.json", tmp_path / "views of mine.JSON")
    assert len(load_cameras(tmp_path / "views of mine.JSON")) == 17
    write_json(tmp_path / "poses.json", nerfstudio(["a.png"]))
    assert len(load_cameras(tmp_path / "poses.json")) == 1


def test_views_that_are_too_wide_for_a_pinhole_are_told(data, tmp_path, caplog):
    """As of focal lengths in millimetres."""
    load_cameras(data / "plush_cameras.json")
    assert caplog.text == ""
    focals = enumerate((35.0, 800.0, 28.0))
    wide = [view(img_name=f"{k}.png", width=990, height=742, fx=focal, fy=focal) for k, focal in focals]
    load_cameras(write_json(tmp_path / "cameras.json", wide))
    assert (
        "2 of 3 views are very wide, up to 174 degrees: are their focal lengths in pixels of 990 x 742?" in caplog.text
    )
    load_cameras(write_json(tmp_path / "tall.json", [view(width=90, height=990, fx=28.0, fy=28.0)]))
    assert "up to 174 degrees: are their focal lengths in pixels of 90 x 990?" in caplog.text


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is not valid JSON"),
        (b"{", "is not valid JSON"),
        (b"\xff\xfe\x00", "is not valid JSON"),
        (b"[" * 200_000, "is nested too deeply"),
        (b"[" + b"9" * 5000 + b"]", "is not valid JSON|not a list of views"),
        (b"3", "is neither a cameras.json"),
        (b'{"a": 1}', "is neither a cameras.json"),
        (b"[]", "has no views"),
        (b"[1]", "not a list of views"),
        (b"[{}]", "view 0: 'img_name' is missing"),
        (b'[{"img_name": "a"}]', "view 'a': 'width' is missing"),
        (b'[{"img_name": "\\ud800"}]', "not the name of an image"),
    ],
)
def test_json_of_no_known_kind(content, message, tmp_path):
    (tmp_path / "a.json").write_bytes(content)
    refused(tmp_path / "a.json", message)


def test_paths_of_no_known_kind(tmp_path, monkeypatch):
    refused(tmp_path / "missing.json", "cannot read '.*missing.json': No such file", UsageError)
    refused(tmp_path / "missing", "there is no file or folder", UsageError)
    (tmp_path / "notes.txt").write_bytes(b"")
    refused(tmp_path / "notes.txt", "unknown kind of cameras", UsageError)
    (tmp_path / "a.json").mkdir()
    refused(tmp_path / "a.json", "has no cameras", UsageError)
    monkeypatch.setattr(view_files, "MAX_JSON_BYTES", 10)
    refused(write_json(tmp_path / "b.json", [view()]), "too large for a camera file")
