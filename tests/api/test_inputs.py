"""What programs give to the functions: arrays, numbers and cameras as notebooks have them, and what is refused."""

from __future__ import annotations

import dataclasses
import json
import re

import numpy as np
import pytest

import potr_cl
from potr_cl import Camera, DataError, Scene, UsageError
from potr_cl.api.choices import encode_options
from potr_cl.api.inputs import cameras_of
from potr_cl.views import pictures, visibility

QUICK = {"preset": "fast", "iterations": 1, "refit": False, "compact": False}


def with_a_nan(scene: Scene) -> Scene:
    means = scene.means.copy()
    means[3] = np.nan
    return dataclasses.replace(scene, means=means)


CALLS = {
    "encode": lambda scene, cameras, folder: potr_cl.encode(scene, cameras, **QUICK),
    "encode without cameras": lambda scene, cameras, folder: potr_cl.encode(scene, **QUICK),
    "prune": lambda scene, cameras, folder: potr_cl.prune(scene, cameras, iterations=1),
    "render": lambda scene, cameras, folder: potr_cl.render(scene, cameras[0]),
    "compare": lambda scene, cameras, folder: potr_cl.compare(scene, scene, cameras),
    "save": lambda scene, cameras, folder: potr_cl.save(scene, folder / "scene.spz"),
}


@pytest.mark.parametrize("call", CALLS)
def test_a_scene_in_memory_that_nobody_has_cleaned(call, plush_excerpt, plush_excerpt_cameras, tmp_path):
    with pytest.raises(DataError, match=r"holds a splat with non-finite values: give scene.cleaned\(\)\[0\]"):
        CALLS[call](with_a_nan(plush_excerpt), plush_excerpt_cameras, tmp_path)
    with pytest.raises(DataError, match="the scene has no splats"):
        CALLS[call](plush_excerpt.subset(np.zeros(0, int)), plush_excerpt_cameras, tmp_path)


def test_what_can_be_mended_without_leaving_splats_out_is(plush_excerpt):
    quaternions = plush_excerpt.quaternions.copy()
    quaternions[:2] = 0
    mended = potr_cl.encode(dataclasses.replace(plush_excerpt, quaternions=quaternions), prune=False, **{**QUICK})
    assert len(mended.order) == len(plush_excerpt)
    assert np.isfinite(potr_cl.decode(mended).quaternions).all()


def test_info_tells_of_a_scene_what_is_wrong_with_it(plush_excerpt):
    assert any("NaN or infinite" in line for line in potr_cl.info(with_a_nan(plush_excerpt)).suspicious)


@pytest.mark.parametrize("name", ["means", "sh", "opacity_logits"])
def test_a_scene_of_what_is_no_array(name, plush_excerpt):
    for cast in (np.ndarray.tolist, lambda array: array.astype(float)):
        assert dataclasses.replace(plush_excerpt, **{name: cast(getattr(plush_excerpt, name))}) == plush_excerpt
    for wrong in ("red", [[1, 2], [3]], None, np.array([1j])):
        with pytest.raises(DataError, match=rf"scene: {name} is \w+, of which no array of float32 can be made: "):
            dataclasses.replace(plush_excerpt, **{name: wrong})


def test_a_camera_of_lists_and_of_other_numbers(plush_excerpt_cameras):
    camera = plush_excerpt_cameras[0]
    size = {"width": np.float32(camera.width), "height": float(camera.height), "fx": np.float64(camera.fx)}
    pose = {"rotation": camera.rotation.tolist(), "translation": tuple(camera.translation)}
    same = dataclasses.replace(camera, **size, **pose)
    assert (type(same.width), type(same.height), type(same.fx)) == (int, int, float)
    assert (same.width, same.height, same.fx) == (camera.width, camera.height, camera.fx)
    assert (same.rotation == camera.rotation).all()
    assert (same.translation == camera.translation).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 10.5}, "width is float, not a whole number of pixels"),
        ({"height": "a"}, "height is str, not a whole number of pixels"),
        ({"height": float("nan")}, "height is float, not a whole number of pixels"),
        ({"fx": None}, "fx is NoneType, not a number of pixels"),
        ({"rotation": "no"}, "rotation is str, not an array of numbers"),
        ({"translation": [1, 2]}, "the pose is not a 3 x 3 rotation and a translation of 3"),
    ],
)
def test_a_camera_of_what_is_no_number(change, message, plush_excerpt_cameras):
    with pytest.raises(DataError, match=message):
        dataclasses.replace(plush_excerpt_cameras[0], **change)


def test_one_camera_stands_for_a_list_of_one(plush_excerpt_cameras):
    assert cameras_of(plush_excerpt_cameras[0], None) == plush_excerpt_cameras[:1]


@pytest.mark.parametrize("cameras", [[np.eye(4)], 3, {"a": 1}])
def test_cameras_that_are_none(cameras, plush_excerpt):
    with pytest.raises(UsageError, match="expected cameras or the path of their file, not"):
        potr_cl.encode(plush_excerpt, cameras, **QUICK)


def test_one_view_by_its_name_or_number(plush_excerpt, plush_excerpt_cameras):
    name = plush_excerpt_cameras[2].name
    by_name, by_number = (potr_cl.render(plush_excerpt, plush_excerpt_cameras, views=view) for view in (name, 2))
    assert [each.cameras[0].name for each in (by_name, by_number)] == [name, name]
    assert len(by_name.pictures) == 1


def test_bytes_of_any_kind_are_decoded(plush_excerpt):
    data = potr_cl.encode(plush_excerpt, prune=False, **QUICK).data
    wanted = potr_cl.decode(data)
    for kind in (bytearray, memoryview):
        assert (potr_cl.decode(kind(data)).sh == wanted.sh).all()
    with pytest.raises(UsageError, match=r"expected the path of a .potr file, its bytes or an Encoded, not Scene"):
        potr_cl.decode(plush_excerpt)


def test_numbers_of_numpy_are_numbers():
    numpys = encode_options(None, "fast", {"keep": np.float32(0.5), "iterations": 1.0}, q=np.float32(0.25))
    assert numpys == encode_options(None, "fast", {"keep": 0.5, "iterations": 1}, q=0.25)
    json.dumps(numpys.as_dict())


@pytest.mark.parametrize(
    ("choices", "message"),
    [
        ({"q": "0.5"}, "the quality q is '0.5': give a number from 0 to 1"),
        ({"q": True}, "the quality q is True: give a number from 0 to 1"),
        ({"memory": "1"}, "--memory is '1': give a number of GiB"),
        ({"iterations": 2.5}, "iterations is 2.5: give a whole number"),
        ({"options": 0.5}, "the options are an EncodeOptions, not float: give a quality as q=0.5"),
    ],
)
def test_what_is_no_number(choices, message, plush_excerpt, plush_excerpt_cameras):
    with pytest.raises(UsageError, match=message):
        potr_cl.encode(plush_excerpt, plush_excerpt_cameras, **choices)


def test_a_tensor_is_taken_as_an_array(plush_excerpt):
    torch = pytest.importorskip("torch")
    means = torch.from_numpy(plush_excerpt.means)
    assert dataclasses.replace(plush_excerpt, means=means) == plush_excerpt
    with pytest.raises(DataError, match=r"scene: means is Tensor, .* requires grad"):
        dataclasses.replace(plush_excerpt, means=means.clone().requires_grad_())
    camera = Camera("a", 10, 10, 10.0, 10.0, 5.0, 5.0, torch.eye(3), torch.zeros(3))  # type: ignore[arg-type]
    assert (camera.rotation == np.eye(3)).all()


@pytest.mark.parametrize("size", ["small", "large"])
def test_no_view_at_all(size, plush_excerpt, plush_excerpt_cameras, monkeypatch):
    """An empty list, as a filter of names leaves it; whatever a scene's size has decided by then."""
    if size == "large":
        monkeypatch.setattr(visibility, "LEAST_SPLATS", 1)
        monkeypatch.setattr(pictures, "_PART", 0.0)
    for call in (potr_cl.render, lambda scene, *given, **views: potr_cl.compare(scene, scene, *given, **views)):
        for none in ([], (), np.array([], str)):
            with pytest.raises(UsageError, match="the list of views is empty: name at least one, or leave it out"):
                call(plush_excerpt, plush_excerpt_cameras, views=none)


def test_photographs_are_looked_for_before_the_work(plush_excerpt, plush_excerpt_cameras, tmp_path):
    def progress(stage, done):
        raise AssertionError(f"{stage} has begun")

    for folder in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(UsageError, match=re.escape(str(folder))):
            potr_cl.encode(plush_excerpt, plush_excerpt_cameras, progress=progress, photos=folder)
        with pytest.raises(UsageError, match=re.escape(str(folder))):
            potr_cl.encode_ladder(plush_excerpt, tmp_path / "out", "0.5", plush_excerpt_cameras, photos=folder)
