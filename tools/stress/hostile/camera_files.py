"""cameras.json, transforms.json with what may lie beside it, COLMAP models as .bin and .txt: small good ones, and what
is worth changing in them."""

from __future__ import annotations

import json
import math
import struct
from random import Random

from tools.stress.hostile.changes import TEXTS, Files, Rules
from tools.stress.hostile.picture_files import saved_as

_SIMPLE_PINHOLE, _PINHOLE = 0, 1
_SIDES = (0, 1, -1, 64.5, 65536, 65537, 2**31, True, None, "64", 1e400)
_FOCAL = (0, -1, 1e-300, 1e300, float("nan"), float("inf"), "60", None, [60])
_NAMES = (*TEXTS, "view_0.png", "images/view_0.png", 0, None)
_MATRICES = ([[0.0] * 3] * 3, [[1e300] * 4] * 4, [[1.0] * 4] * 4, [[1, 0, 0]], [1, 2, 3], [0.0] * 16, None)
_PNG = saved_as("RGB", "PNG")
_PICTURES = (_PNG, _PNG[:40], b"no picture", b"GIF89a", b"")
_HINTS = {
    **dict.fromkeys(("width", "height", "w", "h"), _SIDES),
    **dict.fromkeys(("fx", "fy", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y", "k1", "k4"), _FOCAL),
    **dict.fromkeys(("img_name", "file_path"), _NAMES),
    **dict.fromkeys(("train_filenames", "val_filenames"), ([], ["a"], _NAMES, None)),
    **dict.fromkeys(("rotation", "transform_matrix", "applied_transform", "transform"), _MATRICES),
    "position": ([0, 0], [1e300] * 3, [None] * 3, "a"), "split": ("train", "test", "both", None, 0),
    "camera_model": ("PINHOLE", "OPENCV_FISHEYE", "FULL_OPENCV", "", None), "is_fisheye": (True, 0),
    "scale": (0, -1, 1e300, None),
}  # fmt: skip


def _turn(angle: float) -> list[list[float]]:
    c, s = math.cos(angle), math.sin(angle)
    return [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]


def cameras(_: Random) -> Files:
    """Three views."""
    shared = {"width": 64, "height": 48, "fx": 60.0, "fy": 61.0}
    views = [
        {"id": k, "img_name": f"view_{k}.png", "position": [float(k), 0.5, -2.0], "rotation": _turn(k), **shared}
        for k in range(3)
    ]
    return {"cameras.json": json.dumps(views).encode()}


def transforms(rng: Random) -> Files:
    """Three frames of nerfstudio; alone, beside its dataparser's file, or with pictures that alone tell the width."""
    beside = rng.choice(({}, {"dataparser_transforms.json": _BESIDE}, {f"images/view_{k}.png": _PNG for k in range(3)}))
    frames = []
    for k in range(3):
        rows = [[*row, n + 1.0] for n, row in enumerate(_turn(k))]
        frames.append({"file_path": f"images/view_{k}.png", "transform_matrix": [*rows, [0.0, 0.0, 0.0, 1.0]]})
    content = {
        "camera_model": "OPENCV", "fl_x": 60.0, "fl_y": 61.0, "cx": 32.0, "cy": 24.0, "h": 48, "k1": 0.0, "p1": 0.0,
        "applied_transform": [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0]],
        "train_filenames": ["images/view_0.png", "images/view_1.png"], "frames": frames,
    } | ({} if len(beside) == 3 else {"w": 64})  # fmt: skip
    name = rng.choice(("transforms.json", "transforms.json", "transforms_test.json"))
    return {name: json.dumps(content).encode(), **beside}


_BESIDE = json.dumps(
    {"transform": [[1.0, 0.0, 0.0, 0.1], [0.0, 1.0, 0.0, 0.2], [0.0, 0.0, 1.0, 0.3]], "scale": 0.25}
).encode()


def colmap_binary(_: Random) -> Files:
    """Cameras: number, lens, sides, parameters; images: number, pose, camera, name, points."""
    lenses = struct.pack("<Q", 2)
    for number, model, params in ((1, _PINHOLE, (60.0, 61.0, 32.0, 24.0)), (2, _SIMPLE_PINHOLE, (60.0, 32.0, 24.0))):
        lenses += struct.pack(f"<IiQQ{len(params)}d", number, model, 64, 48, *params)
    poses = struct.pack("<Q", 3)
    for k in range(3):
        poses += struct.pack("<I7dI", k + 1, 1.0, 0.0, 0.0, 0.0, float(k), 0.0, 2.0, 1 + k % 2)
        poses += b"view_%d.png\0" % k + struct.pack("<Q", k % 2) + bytes(24 * (k % 2))
    return {"images.bin": poses, "cameras.bin": lenses}


#: Of the counts, and of the first camera and image.
_FIELDS = {
    "cameras.bin": ((0, 8), (8, 4), (12, 4), (16, 8), (24, 8), *((32 + 8 * k, 8) for k in range(4))),
    "images.bin": ((0, 8), (8, 4), *((12 + 8 * k, 8) for k in range(7)), (68, 4), (72, 8), (83, 8)),
}


def colmap_text(_: Random) -> Files:
    lenses = b"# cameras\n1 PINHOLE 64 48 60.0 61.0 32.0 24.0\n2 SIMPLE_PINHOLE 64 48 60.0 32.0 24.0\n"
    poses = (b"1 1.0 0.0 0.0 0.0 0.0 0.0 2.0 1 view_0.png", b"2 0.8 0.6 0.0 0.0 1.0 0.0 2.0 2 a b.png\n1.0 2.0 -1")
    images = b"# images\n%b\n\n%b\n3 1.0 0.0 0.0 0.0 2.0 0.0 2.0 1 view_2.png\n\n" % poses
    return {"images.txt": images, "cameras.txt": lenses}


VIEWS = Rules(_HINTS, beside={"images/view_0.png": _PICTURES})
FRAMES = Rules(_HINTS, beside={"images/view_0.png": _PICTURES, "dataparser_transforms.json": (_BESIDE, b"{}")})
MODEL = Rules(fields=lambda name, data: _FIELDS.get(name, ()))
