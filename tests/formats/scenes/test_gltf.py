"""glTF with KHR_gaussian_splatting: every kind of accessor and buffer, nodes' transforms, and bad files."""

from __future__ import annotations

import json
import ntpath
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from potr_cl import DataError, UsageError
from potr_cl.formats import load_scene, save_scene
from potr_cl.formats.scenes.scene_files import related
from potr_cl.host.inputs import FREE_SPLATS
from tests.cases.gltf import PREFIX, Attributes, attributes, described, glb, gltf
from tests.reference.raster import sh_basis
from tests.reference.scenes import covariances, random_scene


def written(path: Path, parts: Attributes, node: dict[str, Any] | None = None) -> Path:
    path.write_bytes(glb(*described(parts, node)))
    return path


@pytest.mark.parametrize("degree", range(4))
def test_floats(degree, tmp_path):
    scene = random_scene(300, degree)
    back = load_scene(written(tmp_path / "a.glb", attributes(scene)))
    np.testing.assert_array_equal(back.means, scene.means)
    np.testing.assert_array_equal(back.quaternions, scene.quaternions)
    np.testing.assert_array_equal(back.sh, scene.sh)
    np.testing.assert_allclose(back.log_scales, scene.log_scales, rtol=0, atol=1e-6)
    np.testing.assert_allclose(back.opacities, scene.opacities, rtol=0, atol=2e-7)


@pytest.mark.parametrize("uri", [None, "parts/a.bin", "a%20b.bin"])
def test_buffers_of_a_gltf(uri, tmp_path):
    description, content = described(attributes(random_scene(20, 1)))
    (tmp_path / "parts").mkdir()
    (tmp_path / (uri or "unused").replace("%20", " ")).write_bytes(content)
    (tmp_path / "a.gltf").write_bytes(gltf(description, content, uri))
    np.testing.assert_array_equal(load_scene(tmp_path / "a.gltf").sh, random_scene(20, 1).sh)


def test_integers(tmp_path):
    """As the specification allows: rotations in signed integers, scales and opacities in unsigned ones."""
    rng = np.random.default_rng(0)
    parts = attributes(random_scene(50, 0))
    position = rng.integers(-32767, 32768, (50, 3)).astype("<i2")
    rotation = rng.integers(-127, 128, (50, 4)).astype("i1")
    scale = rng.integers(1, 65536, (50, 3)).astype("<u2")
    opacity = rng.integers(1, 255, (50, 1)).astype("u1")
    for name, values in (("ROTATION", rotation), ("OPACITY", opacity)):
        parts[PREFIX + name] = values, True
    for normalised, most in ((True, (32767, 65535)), (False, (1, 1))):
        parts["POSITION"], parts[f"{PREFIX}SCALE"] = (position, normalised), (scale, normalised)
        scene = load_scene(written(tmp_path / "a.glb", parts))
        np.testing.assert_allclose(scene.means, position / most[0], atol=1e-7)
        np.testing.assert_allclose(scene.quaternions, rotation[:, [3, 0, 1, 2]] / 127, atol=1e-7)
        np.testing.assert_allclose(scene.scales, scale / most[1], rtol=1e-6)
        np.testing.assert_allclose(scene.opacities, opacity[:, 0] / 255, atol=1e-6)


def test_odd_values(tmp_path):
    """Flat and opaque splats are kept, values that are none dropped, logarithms and large opacities refused."""
    parts = attributes(random_scene(10, 0))
    position, scale, opacity = (parts[name][0] for name in ("POSITION", f"{PREFIX}SCALE", f"{PREFIX}OPACITY"))
    scale[0, 2] = 0
    opacity[:2, 0] = (0, 1)
    scene = load_scene(written(tmp_path / "a.glb", parts))
    assert len(scene) == 10
    assert scene.scales[0, 2] == pytest.approx(1e-9, rel=1e-5)
    assert scene.opacities[:2] == pytest.approx([0, 1], abs=1e-8)
    position[0] = scale[1] = opacity[2] = np.nan
    assert len(load_scene(written(tmp_path / "a.glb", parts, NODES["stretch"]))) == 7
    opacity[3] = 1.5
    with pytest.raises(DataError, match="opacities that are not between 0 and 1"):
        load_scene(written(tmp_path / "a.glb", parts))
    scale[:] = np.log(scale.clip(1e-9))
    with pytest.raises(DataError, match="negative scales: an early draft"):
        load_scene(written(tmp_path / "a.glb", parts))


NODES: dict[str, dict[str, Any]] = {
    "shift": {"translation": [1, -2, 3]},
    "half a turn": {"rotation": [0, 0, 1, 0]},
    "any rotation": {"rotation": [0.5, -0.1, 0.7, 0.5], "translation": [5, 0, 0]},
    "scale": {"scale": [3, 3, 3], "rotation": [0.1, 0.2, 0.3, 0.4]},
    "stretch": {"scale": [3, 0.5, 1], "rotation": [0.1, 0.2, 0.3, 0.4]},
    "matrix": {"matrix": [0, 2, 0, 0, -2, 0, 0, 0, 0, 0, 2, 0, 1, 2, 3, 1]},
}


def matrix_of(node: dict[str, Any]) -> np.ndarray:
    """By the definition of glTF, with the quaternion as an exponential."""
    if "matrix" in node:
        return np.array(node["matrix"], float).reshape(4, 4).T
    x, y, z, w = np.array(node.get("rotation", [0, 0, 0, 1])) / np.linalg.norm(node.get("rotation", [0, 0, 0, 1]))
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix = np.eye(4)
    matrix[:3, :3] = (np.eye(3) + 2 * w * cross + 2 * cross @ cross) @ np.diag(node.get("scale", [1, 1, 1]))
    matrix[:3, 3] = node.get("translation", [0, 0, 0])
    return matrix


@pytest.mark.parametrize("name", NODES)
def test_transforms_of_nodes(name, tmp_path):
    scene, matrix = random_scene(100, 3), matrix_of(NODES[name])
    back = load_scene(written(tmp_path / "a.glb", attributes(scene), NODES[name]))
    linear = matrix[:3, :3]
    np.testing.assert_allclose(back.means, scene.means @ linear.T + matrix[:3, 3], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(covariances(back), linear @ covariances(scene) @ linear.T, rtol=1e-4, atol=1e-6)
    # Seen from a direction that turns with the scene, a colour stays.
    rotation = linear / np.linalg.norm(linear, axis=0)
    directions = np.random.default_rng(1).normal(size=(100, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before = np.einsum("nm,nmc->nc", sh_basis(directions, 3), scene.sh)
    after = np.einsum("nm,nmc->nc", sh_basis(directions @ rotation.T, 3), back.sh)
    np.testing.assert_allclose(after, before, atol=1e-5)


def test_nodes_below_nodes_and_several_meshes(tmp_path):
    description, content = described(attributes(random_scene(10, 1)))
    description["nodes"] = [
        {"children": [1, 2], "translation": [10, 0, 0]},
        {"mesh": 0, "scale": [2, 2, 2]},
        {"mesh": 0, "rotation": [0, 1, 0, 0]},
        {"mesh": 0},  # in no scene
    ]
    (tmp_path / "a.glb").write_bytes(glb(description, content))
    scene, means = load_scene(tmp_path / "a.glb"), random_scene(10, 1).means
    assert len(scene) == 20
    np.testing.assert_allclose(scene.means[:10], means * 2 + (10, 0, 0), atol=1e-5)
    np.testing.assert_allclose(scene.means[10:], means * (-1, 1, -1) + (10, 0, 0), atol=1e-5)
    del description["scenes"], description["scene"]
    (tmp_path / "a.glb").write_bytes(glb(description, content))
    assert len(load_scene(tmp_path / "a.glb")) == 30


SPZ = "KHR_gaussian_splatting_compression_spz_2"


def opened(path: Path) -> tuple[dict[str, Any], bytes]:
    """The description and the buffer of a .glb file."""
    data = path.read_bytes()
    size = int.from_bytes(data[12:16], "little")
    assert int.from_bytes(data[8:12], "little") == len(data)
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def refused(path: Path, description: dict[str, Any], content: bytes, change: Any, message: str) -> None:
    change(description)
    path.write_bytes(glb(description, content))
    with pytest.raises(DataError, match=message) as caught:
        load_scene(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def kind_of(description: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = description["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]
    return found


def names_of(description: dict[str, Any]) -> dict[str, int]:
    found: dict[str, int] = description["meshes"][0]["primitives"][0]["attributes"]
    return found


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.pop("asset"), "no glTF file"),
        (lambda d: d["asset"].update(version="1.0"), "version '1.0', only 2"),
        (lambda d: d["meshes"][0]["primitives"][0].pop("extensions"), "no Gaussian splats.* mesh or a point cloud"),
        (lambda d: d["nodes"][0].pop("mesh"), "no Gaussian splats"),
        (lambda d: kind_of(d).update(extensions={SPZ[:-2]: {"bufferView": 0}}), "spz', .* export it .* or as .spz"),
        (lambda d: kind_of(d).update(kernel="gabor"), "kernel is 'gabor': only ellipse"),
        (lambda d: kind_of(d).update(projection="orthographic"), "projection is 'orthographic'"),
        (lambda d: kind_of(d).update(colorSpace="BT.2020-HLG"), "colorSpace is"),
        (lambda d: d.update(extensionsRequired=["KHR_draco_mesh_compression"]), "needs the glTF extension 'KHR_draco"),
        (lambda d: d["bufferViews"][0].update(extensions={"EXT_meshopt_compression": {}}), "packed with 'EXT_meshopt"),
        (lambda d: d["meshes"][0]["primitives"][0].update(mode=4), "no points"),
        (lambda d: names_of(d).pop("KHR_gaussian_splatting:SCALE"), "no KHR_gaussian_splatting:SCALE"),
        (lambda d: names_of(d).pop("KHR_gaussian_splatting:SH_DEGREE_1_COEF_2"), "no .*SH_DEGREE_1_COEF_2"),
        (lambda d: names_of(d).update(POSITION=99), "there is no 99 among its accessors"),
        (lambda d: d["accessors"][1].update(count=9), "ROTATION is not as long as POSITION"),
        (lambda d: d["accessors"][0].update(count=10**9), "--trust"),
        (lambda d: [each.update(count=60_000) for each in d["accessors"]], "does not lie within its buffer"),
        (lambda d: d["accessors"][0].update(byteOffset=10**6), "does not lie within its buffer"),
        (lambda d: d["accessors"][0].update(componentType=7), "of an unknown type"),
        (lambda d: d["accessors"][0].update(type="VEC4"), "of type VEC4"),
        (lambda d: d["accessors"][0].update(sparse={}), "sparse"),
        (lambda d: d["bufferViews"][0].update(byteStride=1), "does not lie within its buffer"),
        (lambda d: d["bufferViews"][0].update(byteLength=10**8), "a view does not lie"),
        (lambda d: d["bufferViews"][0].update(byteOffset=-1), "impossible 'byteOffset': -1"),
        (lambda d: d["buffers"][0].update(byteLength=10**8), "buffer 0 is truncated"),
        (
            lambda d: (d["buffers"].append({"byteLength": 4}), d["bufferViews"][0].update(buffer=1)),
            "buffer 1 is nowhere",
        ),
        (lambda d: d["nodes"][0].update(children=[0]), "node 0 stands twice"),
        (lambda d: d["nodes"][0].update(scale=[1, 1, -1]), "sheared or mirrored"),
        (lambda d: d["nodes"][0].update(matrix=[1, 0, 0, 0, 1, 1, *[0] * 4, 1, *[0] * 4, 1]), "sheared or mirrored"),
        (lambda d: d["nodes"][0].update(scale=[0, 1, 1]), "transform is invalid"),
        (lambda d: d["nodes"][0].update(rotation=[0, 0, 0, 0]), "length zero"),
        (lambda d: d["nodes"][0].update(translation=[1, 2]), "'translation' of a node is not 3 numbers"),
        (lambda d: d["nodes"][0].update(translation=[1, 2, "x"]), "not 3 numbers"),
        (lambda d: d.update(nodes=5), "among its nodes"),
        (lambda d: d.update(scenes=[5]), "not an object"),
    ],
)
def test_what_is_refused(change, message, tmp_path):
    refused(tmp_path / "a.glb", *described(attributes(random_scene(10, 1))), change, message)


@pytest.mark.parametrize("degree", range(4))
def test_splats_packed_as_spz(degree, tmp_path):
    scene = random_scene(300, degree)
    for suffix in ("glb", "spz"):
        save_scene(tmp_path / f"a.{suffix}", scene)
    back, expected = (load_scene(tmp_path / f"a.{suffix}") for suffix in ("glb", "spz"))
    assert back == expected
    assert (tmp_path / "a.glb").stat().st_size < (tmp_path / "a.spz").stat().st_size + 6000
    description, content = opened(tmp_path / "a.glb")
    # The rules of glTF, and the names that CesiumJS asks its SPZ reader for.
    assert content[: description["buffers"][0]["byteLength"]] == (tmp_path / "a.spz").read_bytes()
    assert set(description["extensionsRequired"]) == {"KHR_gaussian_splatting", f"{PREFIX[:-1]}_compression_spz_2"}
    assert sorted(names_of(description).values()) == list(range(len(description["accessors"])))
    assert len(names_of(description)) == 4 + (degree + 1) ** 2 - 1
    assert all(accessor["count"] == 300 for accessor in description["accessors"])
    node: dict[str, Any] = NODES["any rotation"]
    description["nodes"][0].update(node)
    (tmp_path / "turned.glb").write_bytes(glb(description, content))
    turned = load_scene(tmp_path / "turned.glb")
    np.testing.assert_allclose(turned.means, expected.means @ matrix_of(node)[:3, :3].T + (5, 0, 0), atol=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: kind_of(d)["extensions"].update({SPZ: 3}), "is not an object"),
        (lambda d: kind_of(d)["extensions"].update({SPZ: {"bufferView": 1}}), "no 1 among its bufferViews"),
        (lambda d: kind_of(d)["extensions"].update({SPZ: {}}), "no None among its bufferViews"),
        (lambda d: d["bufferViews"][0].update(byteLength=200), "damaged or truncated"),
        (lambda d: d["bufferViews"][0].update(byteOffset=8), "a view does not lie within its buffer"),
        (lambda d: d["accessors"][0].update(count=31), "not hold as many splats as POSITION"),
    ],
)
def test_damaged_spz_in_it(change, message, tmp_path):
    save_scene(tmp_path / "a.glb", random_scene(30, 1))
    refused(tmp_path / "a.glb", *opened(tmp_path / "a.glb"), change, message)


@pytest.mark.parametrize("size", [0, 3, 4, 11, 19, 20, 30, 500, -1])
def test_truncated_files(size, tmp_path):
    data = glb(*described(attributes(random_scene(10, 1))))
    size %= len(data)
    for content in (data[:size], struct.pack("<4sII", b"glTF", 2, size)[:size] + data[12:size]):
        (tmp_path / "a.glb").write_bytes(content)
        with pytest.raises(DataError):
            load_scene(tmp_path / "a.glb")


@pytest.mark.parametrize(
    ("uri", "kind", "message"),
    [
        *((uri, DataError, "it names a file") for uri in ("../a.bin", "%2e%2e/a.bin")),
        ("gone.bin", UsageError, r"cannot open '.*gone.bin'"),
        ("https://example.com/a.bin", UsageError, "download it"),
        ("data:application/octet-stream,abc", DataError, "base64"),
        ("data:;base64,%%%", DataError, "base64"),
    ],
)
def test_buffers_that_are_outside_of_the_folder_or_not_there(uri, kind, message, tmp_path):
    description, content = described(attributes(random_scene(10, 0)))
    (tmp_path / "a.bin").write_bytes(content)
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "a.gltf").write_bytes(gltf(description, content, uri))
    with pytest.raises(kind, match=message):
        load_scene(tmp_path / "scene" / "a.gltf")


#: As files in a scene's folder, on Windows too.
NAMES = (
    "means.webp", "level/means.webp", "aux.webp", "level/CON", "nul.tar.gz", "com1 .webp", "means.webp:stream",
    "C:x.webp", "C:/x.webp", "level/C:x.webp", "..\\x.webp", "a/..\\..\\x.webp", "\\\\server\\share\\x.webp",
    "//server/share/x.webp", "../x.webp", "a/../../x.webp", "/x.webp", "", ".", "console.webp", "com.webp",
)  # fmt: skip
HARMLESS = {"means.webp", "level/means.webp", "console.webp", "com.webp"}
ON_OTHER_SYSTEMS = {"aux.webp", "level/CON", "nul.tar.gz", "com1 .webp", "means.webp:stream"}


@pytest.mark.parametrize("windows", [True, False])
@pytest.mark.parametrize("name", NAMES)
def test_names_that_lead_elsewhere_are_refused(tmp_path, name, windows):
    if name in HARMLESS or (not windows and name in ON_OTHER_SYSTEMS):
        found = related(tmp_path / "meta.json", name, windows)
        assert tmp_path in found.parents
        there = ntpath.normpath(ntpath.join("C:\\scene", *found.relative_to(tmp_path).parts))
        assert there.startswith("C:\\scene\\")
    else:
        with pytest.raises(DataError, match="is damaged: it names a file"):
            related(tmp_path / "meta.json", name, windows)


def test_one_mesh_in_countless_nodes(tmp_path):
    """Its splats would be as many as the file has bytes, times a thousand."""
    description, content = described(attributes(random_scene(500, 0)))
    description["nodes"] = [{"mesh": 0}] * 800
    description["scenes"] = [{"nodes": list(range(800))}]
    (tmp_path / "a.glb").write_bytes(glb(description, content))
    with pytest.raises(DataError, match=r"400000 splats in \d+ bytes .*--trust"):
        load_scene(tmp_path / "a.glb")
    assert len(load_scene(tmp_path / "a.glb", trust=True)) == 400_000 > FREE_SPLATS


def test_other_parts_are_left_out(tmp_path, caplog):
    description, content = described(attributes(random_scene(10, 0)))
    description["meshes"][0]["primitives"].append({"attributes": {"POSITION": 0}})
    kind_of(description)["colorSpace"] = "lin_rec709_display"
    (tmp_path / "a.glb").write_bytes(glb(description, content))
    assert len(load_scene(tmp_path / "a.glb")) == 10
    assert "left out 1 parts" in caplog.text
    assert "linear colours" in caplog.text


def test_deep_descriptions(tmp_path):
    for text in (b"[" * 100_000, b'{"asset": ' * 50_000, b"\xff\xfe", b"null", json.dumps({"asset": 3}).encode()):
        (tmp_path / "a.gltf").write_bytes(text)
        with pytest.raises(DataError):
            load_scene(tmp_path / "a.gltf")
