"""Scenes as glTF files (.glb, .gltf) with the extension KHR_gaussian_splatting of the Khronos Group.

Read are all splats of the asset's scene, where its nodes put them. Scales and opacities are stored as they are, not as
logarithms and logits; a rotation has w last. The axes are the file's: glTF's y points up, where the PLY files of most
trainers have it point down, and splat-transform turns a scene by 180 degrees about z when it writes one.

Specification: github.com/KhronosGroup/glTF, extensions/2.0/Khronos/KHR_gaussian_splatting.
"""

from __future__ import annotations

import dataclasses
import io
import logging
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.logarithm import natural_logarithm
from potr_cl.errors import DataError
from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes import gltf_file, spz
from potr_cl.formats.scenes.gltf_file import EXTENSION, LINEAR, POINTS, SPZ_EXTENSION, SRGB, Asset
from potr_cl.formats.scenes.scene_files import check_splats, cleaned, joined, log_of_scales, reading, shown
from potr_cl.host.atomic_write import write_pieces
from potr_cl.model.scene import SH_COEFFICIENTS, FloatArray, Scene
from potr_cl.model.spherical_harmonics import quaternions_of, rotated_sh, rotation_matrices

_log = logging.getLogger("potr_cl")

#: Extensions of the asset that change nothing of what is read here, or are read.
_HARMLESS = {EXTENSION, SPZ_EXTENSION, "KHR_mesh_quantization", "KHR_materials_unlit", "KHR_texture_transform"}
#: Every scene may have so many meshes with splats, each of which takes time.
_MOST_PARTS = 4096
#: Largest difference from a rotation that a node's matrix may have by rounding.
_ROUNDING = 1e-3

Matrix = NDArray[np.float64]


def load(path: str | os.PathLike[str], trust: bool = False) -> Scene:
    """The splats of a .glb or .gltf file; see :class:`potr_cl.formats.declaration.SceneLoader`."""
    asset = Asset(path)
    with reading(path):
        return cleaned(path, _scene(asset, trust))


def files(path: Path) -> list[Path]:
    """A .glb file; a .gltf file and those that its buffers are in.

    Raises:
        UsageError: it cannot be opened, or a buffer is elsewhere.
        DataError: it is damaged.
    """
    return [path] if path.suffix.lower() == ".glb" else Asset(path).files()


def save(path: str | os.PathLike[str], scene: Scene) -> None:
    """Write a .glb file, whose splats are packed as SPZ, or a .gltf file, which has them in float32.

    See :class:`potr_cl.formats.declaration.SceneSaver`.
    """
    if Path(path).suffix.lower() != ".gltf":
        content = gltf_file.binary(scene, spz.content_of(path, scene))
    else:
        content = [gltf_file.text(scene)]
        if scene.antialiased:
            _log.warning("'%s': glTF cannot say that the scene is antialiased: it will be drawn as the others", path)
    write_pieces(path, content)


FORMAT = SceneFormat(
    name="glTF",
    suffixes=(".glb", ".gltf"),
    note="with the Khronos Group's KHR_gaussian_splatting, in floats, integers or packed as SPZ; nodes' transforms are "
    "applied, axes kept; `.glb` is written with SPZ, `.gltf` in float32",
    load=load,
    save=save,
    starts=(b"glTF",),
    files=files,
)


def _scene(asset: Asset, trust: bool) -> Scene:
    others = [name for name in asset.description.get("extensionsRequired", []) if name not in _HARMLESS]
    found: list[tuple[dict[str, Any], _Node]] = []
    left_out = 0
    for node in _nodes(asset):
        for primitive in asset.entry("meshes", node.entry["mesh"]).get("primitives", []):
            if isinstance(primitive, dict) and EXTENSION in primitive.get("extensions", {}):
                found.append((primitive, node))
            else:
                left_out += 1
    if not found:
        raise DataError(
            f"'{asset.path}' has no Gaussian splats: no part of its scene has the extension {EXTENSION}; it is a mesh "
            "or a point cloud"
        )
    primitives = {id(primitive): primitive for primitive, _ in found}
    for primitive in primitives.values():
        _check_kind(asset, primitive)
    if others:
        raise DataError(f"'{asset.path}' needs the glTF extension {shown(others[0])}, which is not supported")
    counts = {number: _count(asset, primitive) for number, primitive in primitives.items()}
    check_splats(asset.path, sum(counts[id(primitive)] for primitive, _ in found), asset.size, trust)
    if len(found) > _MOST_PARTS and not trust:
        raise DataError(
            f"'{asset.path}': {len(found)} meshes with splats are more than are read without --trust (trust=True)"
        )
    if left_out:
        _log.warning("'%s': left out %d parts of the scene that are no splats", asset.path, left_out)
    scenes = {number: _splats(asset, primitive, trust) for number, primitive in primitives.items()}
    return joined([_placed(asset, scenes[id(primitive)], node.matrix(asset)) for primitive, node in found])


@dataclasses.dataclass
class _Node:
    """A node of the scene: what the file says of it, and the node above it."""

    entry: dict[str, Any]
    above: _Node | None
    known: Matrix | None = None

    def matrix(self, asset: Asset) -> Matrix:
        """(4, 4) from its axes to those of the scene."""
        chain: list[_Node] = []
        node: _Node | None = self
        while node is not None and node.known is None:
            chain.append(node)
            node = node.above
        matrix = np.eye(4) if node is None or node.known is None else node.known
        for below in reversed(chain):
            matrix = below.known = matrix @ _matrix(asset, below.entry)
        return matrix


def _nodes(asset: Asset) -> list[_Node]:
    """The nodes of the scene that have a mesh."""
    nodes = asset.description.get("nodes", [])
    if "scenes" in asset.description:
        roots = asset.entry("scenes", asset.description.get("scene", 0)).get("nodes", [])
    else:
        children = {child for node in nodes for child in node.get("children", [])}
        roots = [number for number in range(len(nodes)) if number not in children]
    found, seen = [], set()
    left: list[tuple[Any, _Node | None]] = [(number, None) for number in reversed(roots)]
    while left:
        number, above = left.pop()
        node = _Node(asset.entry("nodes", number), above)
        if number in seen:
            raise asset.damaged(f"node {number} stands twice in its scene")
        seen.add(number)
        if "mesh" in node.entry:
            found.append(node)
        left += [(child, node) for child in reversed(node.entry.get("children", []))]
    return found


def _matrix(asset: Asset, node: dict[str, Any]) -> Matrix:
    """(4, 4) from a node's axes to those of the node above it."""
    if "matrix" in node:
        return _numbers(asset, node, "matrix", [0.0] * 16).reshape(4, 4).T
    matrix = np.eye(4)
    rotation = _numbers(asset, node, "rotation", [0.0, 0.0, 0.0, 1.0])
    scale = _numbers(asset, node, "scale", [1.0, 1.0, 1.0])
    length = np.linalg.norm(rotation)
    if not length > 0:
        raise asset.damaged("a node's rotation has the length zero")
    matrix[:3, :3] = rotation_matrices(rotation[[3, 0, 1, 2]] / length) * scale
    matrix[:3, 3] = _numbers(asset, node, "translation", [0.0, 0.0, 0.0])
    return matrix


def _numbers(asset: Asset, node: dict[str, Any], key: str, default: list[float]) -> Matrix:
    values = node.get(key, default)
    if (
        not isinstance(values, list)
        or len(values) != len(default)
        or not all(type(value) in (int, float) and abs(value) < 1e30 for value in values)
    ):
        raise asset.damaged(f"the '{key}' of a node is not {len(default)} numbers")
    return np.array(values, np.float64)


def _check_kind(asset: Asset, primitive: dict[str, Any]) -> None:
    """That splats are of the kind that the base extension describes, which is that of 3DGS."""
    kind = primitive["extensions"][EXTENSION]
    if not isinstance(kind, dict):
        raise asset.damaged(f"its {EXTENSION} is not an object")
    unknown = [name for name in kind.get("extensions", {}) if name != SPZ_EXTENSION]
    if unknown:
        raise DataError(
            f"'{asset.path}' has its splats in the extension {shown(unknown[0])}, which cannot be read: export it "
            "without compression, or as .spz"
        )
    for key, default, known in (
        ("kernel", "ellipse", ("ellipse",)),
        ("projection", "perspective", ("perspective",)),
        ("colorSpace", SRGB, (SRGB, LINEAR)),
    ):
        if kind.get(key, default) not in known:
            raise DataError(f"'{asset.path}' has splats whose {key} is {shown(kind[key])}: only {known[0]} can be read")
    if kind.get("colorSpace", SRGB) == LINEAR:
        _log.warning("'%s' has linear colours: they are kept as they are, and look darker than they should", asset.path)
    if primitive.get("mode", 4) != POINTS:
        raise asset.damaged("its splats are no points")
    if not isinstance(primitive.get("attributes"), dict):
        raise asset.damaged("its splats have no attributes")


def _count(asset: Asset, primitive: dict[str, Any]) -> int:
    return asset.count(primitive["attributes"].get("POSITION"))


def _splats(asset: Asset, primitive: dict[str, Any], trust: bool) -> Scene:
    """The splats of a primitive, in the axes of its node."""
    packed = primitive["extensions"][EXTENSION].get("extensions", {}).get(SPZ_EXTENSION)
    if packed is not None:
        if not isinstance(packed, dict):
            raise asset.damaged(f"its {SPZ_EXTENSION} is not an object")
        content = asset.content(packed.get("bufferView"))
        scene = spz.read(asset.path, io.BytesIO(content), len(content), trust)
        if len(scene) != _count(asset, primitive):
            raise asset.damaged("its SPZ does not hold as many splats as POSITION")
        return scene
    attributes: dict[str, Any] = primitive["attributes"]
    count = _count(asset, primitive)

    def values(name: str, parts: int) -> FloatArray:
        if name not in attributes:
            raise asset.damaged(f"its splats have no {name}")
        if asset.count(attributes[name]) != count:
            raise asset.damaged(f"{name} is not as long as POSITION")
        return asset.values(attributes[name], parts)

    degree = 0
    while degree < 3 and f"{EXTENSION}:SH_DEGREE_{degree + 1}_COEF_0" in attributes:
        degree += 1
    if f"{EXTENSION}:SH_DEGREE_4_COEF_0" in attributes:
        _log.warning("'%s': SH degree 4 is left out: only degrees 0 to 3 are kept", asset.path)
    sh = np.empty((count, SH_COEFFICIENTS[degree], 3), np.float32)
    names = [f"{EXTENSION}:SH_DEGREE_{k}_COEF_{n}" for k in range(degree + 1) for n in range(2 * k + 1)]
    for k, name in enumerate(names):
        sh[:, k] = values(name, 3)
    scales = values(f"{EXTENSION}:SCALE", 3)
    if (scales < 0).any():
        raise DataError(
            f"'{asset.path}' has negative scales: an early draft of {EXTENSION} had logarithms there, which cannot be "
            "told from damage: export it anew"
        )
    opacities = values(f"{EXTENSION}:OPACITY", 1)[:, 0]
    if not ((opacities >= 0) & (opacities <= 1) | np.isnan(opacities)).all():
        raise asset.damaged("there are opacities that are not between 0 and 1")
    rotations = values(f"{EXTENSION}:ROTATION", 4)
    return Scene(values("POSITION", 3), log_of_scales(scales), rotations[:, [3, 0, 1, 2]], _logits(opacities), sh)


def _logits(opacities: FloatArray) -> FloatArray:
    """Logits of float32 opacities; infinite ones, which are mended later, of 0 and 1."""
    inside = (opacities > 0) & (opacities < 1)
    middle = np.where(inside, opacities, np.float32(0.5))
    logits = natural_logarithm(middle) - natural_logarithm(np.float32(1) - middle)
    return np.where(inside, logits, np.where(opacities >= 1, np.inf, np.where(opacities <= 0, -np.inf, np.nan))).astype(
        np.float32
    )


def _placed(asset: Asset, scene: Scene, matrix: Matrix) -> Scene:
    """Splats in the axes of the scene."""
    if np.array_equal(matrix, np.eye(4)):
        return scene
    linear = matrix[:3, :3]
    lengths = np.linalg.norm(linear, axis=0)
    if not np.isfinite(matrix).all() or not (lengths > 0).all():
        raise DataError(f"'{asset.path}' is damaged: a node's transform is invalid")
    rotation = linear / lengths
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > _ROUNDING or np.linalg.det(rotation) < 0:
        raise DataError(f"'{asset.path}' has splats in a node that is sheared or mirrored, which splats cannot be")
    scene = dataclasses.replace(
        scene, means=(scene.means.astype(np.float64) @ linear.T + matrix[:3, 3]).astype(np.float32)
    )
    if np.abs(rotation - np.eye(3)).max() > 0:
        scene = dataclasses.replace(scene, sh=rotated_sh(scene.sh, rotation))
    if np.ptp(lengths) > _ROUNDING * lengths.max():
        return _stretched(scene, linear)
    logarithms = scene.log_scales + np.float32(np.log(lengths.mean()))
    return dataclasses.replace(
        scene, log_scales=logarithms, quaternions=_turned(scene.quaternions, quaternions_of(rotation[None])[0])
    )


def _stretched(scene: Scene, linear: Matrix) -> Scene:
    """Splats whose axes a matrix scales differently: their new axes are the singular vectors."""
    log_scales, quaternions = np.empty_like(scene.log_scales), np.empty_like(scene.quaternions)
    block = 1 << 14
    for start in range(0, len(scene), block):
        rows = slice(start, start + block)
        unit = scene.quaternions[rows].astype(np.float64)
        unit /= np.maximum(np.linalg.norm(unit, axis=1, keepdims=True), 1e-30)
        axes = rotation_matrices(unit) * np.exp(scene.log_scales[rows].astype(np.float64))[:, None, :]
        good = np.isfinite(axes.reshape(len(axes), 9)).all(axis=1)
        axes[~good] = np.eye(3)
        vectors, values, _ = np.linalg.svd(linear @ axes)
        vectors[np.linalg.det(vectors) < 0, :, 2] *= -1
        log_scales[rows] = log_of_scales(values.astype(np.float32))
        log_scales[rows][~good] = np.nan
        quaternions[rows] = quaternions_of(vectors)
    return dataclasses.replace(scene, log_scales=log_scales, quaternions=quaternions)


def _turned(quaternions: FloatArray, by: Matrix) -> FloatArray:
    """The product of one quaternion with each of many, w first."""
    w, x, y, z = by
    matrix = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    turned: FloatArray = (quaternions.astype(np.float64) @ matrix.T).astype(np.float32)
    return turned
