"""COLMAP models, binary and text."""

from __future__ import annotations

import os
import shutil
import struct
import sys
from pathlib import Path

import numpy as np
import pytest

from potr_cl import UsageError
from potr_cl.formats import load_cameras
from tests.cases.cameras import refused, write_image


@pytest.fixture
def model(data, tmp_path):
    return Path(shutil.copytree(data / "plush_sparse_binary", tmp_path / "sparse" / "0"))


@pytest.fixture
def text_model(data, tmp_path):
    return Path(shutil.copytree(data / "plush_sparse_text", tmp_path / "text"))


@pytest.fixture
def of_camera(text_model):
    """The text model with another line for its camera."""

    def write(line):
        (text_model / "cameras.txt").write_text(line)
        return text_model

    return write


#: What the camera of the model is.
CAMERA = "1 PINHOLE 990 742 800 800 495 371\n"


@pytest.mark.parametrize("write", ["write_binary", "write_text"])
def test_a_model_with_points_rigs_and_several_cameras(write, tmp_path):
    """Against what pycolmap itself reads from the whole model."""
    pycolmap = pytest.importorskip("pycolmap")
    options = pycolmap.SyntheticDatasetOptions()
    options.camera_model_id = pycolmap.CameraModelId.SIMPLE_PINHOLE
    options.camera_params = [900.0, 500.0, 380.0]
    options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 2, 9, 60
    options.sensor_from_rig_translation_stddev = 0.1
    options.sensor_from_rig_rotation_stddev = 5.0
    reconstruction = pycolmap.synthesize_dataset(options)
    getattr(reconstruction, write)(tmp_path)
    expected = {Path(image.name).stem: image for image in reconstruction.images.values()}
    assert sum(image.num_points3D for image in expected.values()) > 100
    cameras = load_cameras(tmp_path)
    assert sorted(camera.name for camera in cameras) == sorted(expected)
    for camera in cameras:
        pose = expected[camera.name].cam_from_world().matrix()
        np.testing.assert_allclose(np.column_stack([camera.rotation, camera.translation]), pose, atol=1e-9)
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (900, 900, 500, 380)
    in_order = [camera.split for camera in sorted(cameras, key=lambda camera: camera.name)]
    assert [i for i, split in enumerate(in_order) if split == "test"] == list(range(0, len(cameras), 8))


def test_ground_truth_of_a_model(model, tmp_path):
    assert load_cameras(model)[0].image_path is None
    image = write_image(tmp_path / "images" / "20240212_003919.jpg")
    assert [c.image_path for c in load_cameras(tmp_path)] == [image, *[None] * 16]


def test_names_and_numbers_of_images(text_model):
    """Folders in names tell views apart, names may have blanks, and no two images have the same name or number."""
    images = text_model / "images.txt"
    original = images.read_text()
    renamed = original.replace("20240212_003920.jpg", "right/20240212_003919.jpg")
    images.write_text(renamed.replace("20240212_003922.jpg", "the first one.jpg"))
    names = [camera.name for camera in load_cameras(text_model)]
    assert names[0] == "20240212_003919"
    assert names[-2:] == ["right/20240212_003919", "the first one"]
    images.write_text(renamed.replace("20240212_003921", "20240212_003919"))
    refused(text_model, r"more than one view has the image '20240212_003919\.jpg'")
    images.write_text(original.replace("\n2 0.99", "\n1 0.99"))
    refused(text_model, "two images have the same number")


def test_camera_models_that_are_not_read(model):
    data = (model / "cameras.bin").read_bytes()
    for number, name in ((7, "FOV"), (11, "RAD_TAN_THIN_PRISM_FISHEYE"), (99, "number 99"), (-1, "number -1")):
        (model / "cameras.bin").write_bytes(data[:12] + struct.pack("<i", number) + data[16:])
        refused(model, f"camera 1 has the model '{name}', which is not supported: .* 'colmap image_undistorter'")


DISTORTED = {
    "SIMPLE_RADIAL": (2, [800, 495, 371, -0.05]),
    "RADIAL": (3, [800, 495, 371, -0.05, 0.01]),
    "OPENCV": (4, [800, 810, 495, 371, -0.05, 0.01, 0.001, -0.001]),
    "OPENCV_FISHEYE": (5, [600, 610, 495, 371, 0.01, 0.001, 0, 0]),
    "FULL_OPENCV": (6, [800, 810, 495, 371, -0.05, 0.01, 0.001, -0.001, 0, 0.01, 0, 0]),
    "SIMPLE_RADIAL_FISHEYE": (8, [600, 495, 371, 0.01]),
    "RADIAL_FISHEYE": (9, [600, 495, 371, 0.01, 0.001]),
    "THIN_PRISM_FISHEYE": (10, [600, 610, 495, 371, 0.01, 0.001, 0.001, -0.001, 0, 0, 0.001, 0]),
}


@pytest.mark.parametrize("name", DISTORTED)
def test_distorted_cameras_cover_the_same_field(model, of_camera, caplog, name):
    number, params = DISTORTED[name]
    header = struct.pack("<QIiQQ", 1, 1, number, 990, 742)
    (model / "cameras.bin").write_bytes(header + struct.pack(f"<{len(params)}d", *params))
    cameras = load_cameras(model)
    assert caplog.text.count("lens distortion") == 1
    (lens,) = {camera.lens for camera in cameras}
    assert lens is not None
    assert lens.fisheye == ("FISHEYE" in name)
    assert (lens.fx, lens.cx, lens.cy) == (params[0], 495, 371)
    assert {(camera.width, camera.height) for camera in cameras} == {lens.covering()[0][:2]}
    # The middle and a point off it are where COLMAP has them.
    pycolmap = pytest.importorskip("pycolmap")
    theirs = pycolmap.Camera(model=name, width=990, height=742, params=params)
    u, v = lens.distorted(np.array([0.0, 0.3]), np.array([0.0, -0.2]))
    wanted = theirs.img_from_cam(np.array([[0, 0, 1], [0.3, -0.2, 1]]))
    np.testing.assert_allclose(np.stack([u * lens.fx + lens.cx, v * lens.fy + lens.cy], axis=1), wanted, atol=1e-9)
    text = of_camera(f"1 {name} 990 742 {' '.join(map(str, params))}\n")
    assert {camera.lens for camera in load_cameras(text)} == {lens}


def test_a_lens_that_bends_nothing_is_none(of_camera):
    (camera, *_) = load_cameras(of_camera("1 OPENCV 990 742 800 810 495 371 0 0 0 0\n"))
    assert camera.lens is None
    assert (camera.width, camera.height, camera.fx, camera.fy) == (990, 742, 800, 810)


TRUNCATED = r"cameras\.txt' is truncated, or is no file of a COLMAP model"
NO_NUMBER = "is not a (whole )?number|is truncated"


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1 FOV 990 742 800 800 495 371 0.9\n", "'1' has the model 'FOV', which is not supported"),
        ("1 SIMPLE_RADIAL 990 742 800 495 371 -50\n", "view .*folds the picture over"),
        ("1 SIMPLE_RADIAL 990 742 800 495 371 nan\n", "coefficient"),
        ("1 SIMPLE_RADIAL 990 742 -800 495 371 0.1\n", "intrinsics"),
        ("1 SIMPLE_RADIAL 990 99999999 800 495 371 0.1\n", "not a number of pixels"),
        ("1 SIMPLE_RADIAL 990 742 800 495 371\n", "truncated"),
        ("1 PINHOLE 990\n", TRUNCATED),
        ("1 PINHOLE 990 742 800 800 495\n", TRUNCATED),
        ("PINHOLE\n", TRUNCATED),
        ("", "is a damaged COLMAP model: "),
        ("# nothing\n", "is a damaged COLMAP model: "),
        (CAMERA.replace("1", "2", 1), "is a damaged COLMAP model: "),
        ("1 PINHOLE x y 800 800 495 371\n", "is a damaged COLMAP model: "),
        ("1 PINHOLE 990 742 nan 800 495 371\n", "intrinsics|damaged"),
        ("1 PINHOLE 990 99999999 800 800 495 371\n", "the height of its camera is 99999999, not a number of pixels"),
        (CAMERA * 2, "camera 1 stands twice"),
        # Numbers that only Python reads.
        *((f"1 PINHOLE 990 742 {field} 800 495 371\n", NO_NUMBER) for field in ("1_0", "0x10", "١", "1e", "1 0 0")),
        *((f"1 PINHOLE {field} 742 800 800 495 371\n", NO_NUMBER) for field in ("1_0", "0x10", "١", "1e", "1 0 0")),
    ],
)
def test_damaged_text_models(of_camera, line, message):
    refused(of_camera(line), message)


def test_every_truncation_of_a_binary_model(model):
    """The library itself would take the missing bytes from whatever is in memory, or never return."""
    for name in ("cameras.bin", "images.bin"):
        data = (model / name).read_bytes()
        cut = [data[:size] for size in range(0, len(data), 1 if name == "cameras.bin" else 13)]
        for bad in (*cut, data + b"\0", struct.pack("<Q", 1 << 60) + data[8:]):
            (model / name).write_bytes(bad)
            refused(model, f"{name}' is truncated, or is no file of a COLMAP model")
        (model / name).write_bytes(data)
    assert len(load_cameras(model)) == 17


def test_unusable_values_in_a_binary_model(model):
    data = (model / "images.bin").read_bytes()
    for at, value, message in [
        (12, struct.pack("<d", np.nan), "view '20240212_003919': its rotation is not a unit quaternion"),
        (12, bytes(32), "view '20240212_003919': its rotation is not a unit quaternion"),
        (44, struct.pack("<d", np.inf), "the pose holds a non-finite value"),
        (68, struct.pack("<I", 77), "is a damaged COLMAP model"),
        (72, b"\xff\xfe", "the name of an image is not UTF-8"),
        (72, b"\n", "not the name of an image"),
    ]:
        (model / "images.bin").write_bytes(data[:at] + value + data[at + len(value) :])
        refused(model, message)
    (model / "images.bin").write_bytes(bytes(8))
    refused(model, "has no views")
    os.remove(model / "images.bin")
    refused(model, r"cannot read '.*images\.bin': No such file", UsageError)


@pytest.mark.parametrize("name", ["plush_sparse_binary", "plush_sparse_text"])
def test_poses_have_the_digits_of_the_library_without_it(name, data, tmp_path, monkeypatch):
    """The library would parse again what has been checked, and wants it in a folder, which a killed run would leave."""
    pycolmap = pytest.importorskip("pycolmap")
    shutil.copytree(data / name, tmp_path, dirs_exist_ok=True)
    ending = next(tmp_path.iterdir()).suffix
    (tmp_path / f"points3D{ending}").write_bytes(bytes(8) if ending == ".bin" else b"")
    expected = {Path(image.name).stem: image for image in pycolmap.Reconstruction(tmp_path).images.values()}
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    monkeypatch.setattr("tempfile.mkdtemp", lambda *args, **kwargs: pytest.fail("a temporary folder was made"))
    cameras = load_cameras(data / name)
    assert len(cameras) == 17
    for camera in cameras:
        pose = np.column_stack([camera.rotation, camera.translation])
        assert np.array_equal(pose, expected[camera.name].cam_from_world().matrix())
