"""Changed camera files: cameras.json, transforms.json with what may lie beside it, COLMAP models as .bin and .txt."""

from __future__ import annotations

import json
import math
import struct
from functools import cache
from random import Random
from typing import Any

from tools.stress.hostile.changes import (
    NUMBERS,
    TEXTS,
    damaged,
    damaged_json,
    damaged_text,
    damaged_value,
    interesting,
    interesting_double,
    json_bytes,
    strange,
)
from tools.stress.hostile.picture_files import small_png

#: A file or several that belong together, by their names; the first is what is read.
Files = dict[str, bytes]

_SIMPLE_PINHOLE, _PINHOLE = 0, 1


@cache
def cameras_json() -> bytes:
    """A good cameras.json with three views."""
    views = []
    for k in range(3):
        c, s = math.cos(k), math.sin(k)
        views.append(
            {
                "id": k,
                "img_name": f"view_{k}.png",
                "width": 64,
                "height": 48,
                "position": [float(k), 0.5, -2.0],
                "rotation": [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]],
                "fx": 60.0,
                "fy": 61.0,
            }
        )
    return json.dumps(views).encode()


def good_cameras_json() -> list[Files]:
    return [{"cameras.json": cameras_json()}]


def changed_cameras_json(rng: Random) -> Files:
    data = cameras_json()
    if rng.random() < 0.6:
        views = json.loads(data)
        for _ in range(1 + rng.randrange(2)):
            view = rng.choice(views)
            key = rng.choice([*view, "split"])
            view[key] = strange(rng) if rng.random() < 0.5 else damaged_value(view.get(key, "train"), rng)
        data = json_bytes(views)
    else:
        data = damaged_json(data, rng)
    files = {"cameras.json": data}
    if rng.random() < 0.1:
        files["images/view_0.png"] = rng.choice((small_png(), b"no picture", b""))
    return files


@cache
def transforms_json() -> bytes:
    """A good transforms.json of nerfstudio with three frames."""
    frames = []
    for k in range(3):
        c, s = math.cos(k), math.sin(k)
        rows = [[c, -s, 0.0, 1.0], [s, c, 0.0, 2.0], [0.0, 0.0, 1.0, 3.0], [0.0, 0.0, 0.0, 1.0]]
        frames.append({"file_path": f"images/view_{k}.png", "transform_matrix": rows})
    content = {
        "camera_model": "OPENCV", "fl_x": 60.0, "fl_y": 61.0, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48, "k1": 0.0,
        "p1": 0.0, "applied_transform": [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0]],
        "train_filenames": ["images/view_0.png", "images/view_1.png"], "frames": frames,
    }  # fmt: skip
    return json.dumps(content).encode()


_BESIDE = {"transform": [[1.0, 0.0, 0.0, 0.1], [0.0, 1.0, 0.0, 0.2], [0.0, 0.0, 1.0, 0.3]], "scale": 0.25}


def good_transforms_json() -> list[Files]:
    content = json.loads(transforms_json())
    del content["w"]
    pictures = {frame["file_path"]: small_png() for frame in content["frames"]}
    return [
        {"transforms.json": transforms_json()},
        {"transforms.json": transforms_json(), "dataparser_transforms.json": json.dumps(_BESIDE).encode()},
        {"transforms.json": json_bytes(content), **pictures},
    ]


def changed_transforms_json(rng: Random) -> Files:
    content = json.loads(transforms_json())
    kind = rng.randrange(10)
    for _ in range(1 + rng.randrange(2)):
        if kind < 4:
            key = rng.choice([*content, "camera_angle_x", "camera_angle_y", "is_fisheye", "val_filenames", "k4"])
            content[key] = strange(rng) if rng.random() < 0.5 else damaged_value(content.get(key, 0.5), rng)
        elif kind < 8:
            frame = rng.choice(content["frames"])
            key = rng.choice([*frame, "w", "fl_x", "camera_angle_x"])
            frame[key] = strange(rng) if rng.random() < 0.5 else damaged_value(frame.get(key, 1), rng)
    if rng.random() < 0.15:
        del content["w"]
    data = json_bytes(content) if kind < 8 else damaged_json(transforms_json(), rng)
    files = {rng.choice(("transforms.json", "transforms.json", "transforms_test.json")): data}
    if rng.random() < 0.2:
        beside = json.dumps(_BESIDE).encode()
        files["dataparser_transforms.json"] = damaged_json(beside, rng) if rng.random() < 0.7 else beside
    if rng.random() < 0.1:
        files["images/view_0.png"] = rng.choice((small_png(), damaged(small_png(), rng), b"GIF89a", b""))
    return files


def _model() -> tuple[list[Any], list[Any]]:
    """Cameras and images of a model: number, lens, sides, parameters; number, pose, camera, name, points."""
    cameras = [(1, _PINHOLE, 64, 48, [60.0, 61.0, 32.0, 24.0]), (2, _SIMPLE_PINHOLE, 64, 48, [60.0, 32.0, 24.0])]
    images = [(k + 1, [1.0, 0.0, 0.0, 0.0], [float(k), 0.0, 2.0], 1 + k % 2, f"view_{k}.png", k % 2) for k in range(3)]
    return cameras, images


def _binary(cameras: list[Any], images: list[Any], said: list[int], rng: Random) -> Files:
    lenses = struct.pack("<Q", said[0])
    for number, model, width, height, params in cameras:
        lenses += struct.pack(f"<IiQQ{len(params)}d", number, model, width, height, *params)
    poses = struct.pack("<Q", said[1])
    for number, rotation, translation, camera, name, points in images:
        poses += struct.pack("<I7dI", number, *rotation, *translation, camera)
        poses += name.encode("utf-8", "surrogatepass") + b"\0" + struct.pack("<Q", points)
        poses += rng.randbytes(24) * min(points, 3)
    return {"images.bin": poses, "cameras.bin": lenses}


def good_colmap_binary() -> list[Files]:
    return [_binary(*_model(), [2, 3], Random(0))]


def changed_colmap_binary(rng: Random) -> Files:
    cameras, images = _model()
    if rng.random() < 0.6:
        _change_model(cameras, images, rng)
    said = [len(cameras), len(images)]
    if rng.random() < 0.15:
        said[rng.randrange(2)] = interesting(rng, 8)
    files = _binary(cameras, images, said, rng)
    for name, chance in (("cameras.bin", 0.25), ("images.bin", 0.35)):
        if rng.random() < chance:
            files[name] = damaged(files[name], rng)
    return files


def _change_model(cameras: list[Any], images: list[Any], rng: Random) -> None:
    """Other numbers, names and references in a model."""
    for _ in range(1 + rng.randrange(2)):
        if rng.random() < 0.4:
            at = rng.randrange(len(cameras))
            camera = list(cameras[at])
            which = rng.randrange(5)
            if which == 4:
                camera[4] = list(camera[4])
                camera[4][rng.randrange(len(camera[4]))] = interesting_double(rng)
            else:
                camera[which] = interesting(rng, 4) >> 1 if which == 1 else interesting(rng, 4 if which == 0 else 8)
                if which == 1:
                    camera[1] = rng.choice((camera[1], 0, 1, 2, 5, -1))
            cameras[at] = tuple(camera)
        else:
            at = rng.randrange(len(images))
            image = list(images[at])
            which = rng.randrange(6)
            if which in (1, 2):
                image[which] = list(image[which])
                image[which][rng.randrange(len(image[which]))] = interesting_double(rng)
            elif which == 4:
                image[4] = rng.choice((*TEXTS, "view_0.png"))
            elif which == 5:
                image[5] = interesting(rng, 8)
            else:
                image[which] = rng.choice((interesting(rng, 4), 1, 2, 3))
            images[at] = tuple(image)


_TEXT_CAMERAS = b"# cameras\n1 PINHOLE 64 48 60.0 61.0 32.0 24.0\n2 SIMPLE_PINHOLE 64 48 60.0 32.0 24.0\n"
_TEXT_IMAGES = (
    b"# images\n1 1.0 0.0 0.0 0.0 0.0 0.0 2.0 1 view_0.png\n\n2 0.8 0.6 0.0 0.0 1.0 0.0 2.0 2 a b.png\n1.0 2.0 -1\n"
    b"3 1.0 0.0 0.0 0.0 2.0 0.0 2.0 1 view_2.png\n\n"
)


def good_colmap_text() -> list[Files]:
    return [{"images.txt": _TEXT_IMAGES, "cameras.txt": _TEXT_CAMERAS}]


def changed_colmap_text(rng: Random) -> Files:
    cameras, images = _TEXT_CAMERAS, _TEXT_IMAGES
    for _ in range(1 + rng.randrange(2)):
        if rng.random() < 0.4:
            cameras = damaged_text(cameras, rng)
        else:
            images = damaged_text(images, rng)
    if rng.random() < 0.05:
        word = rng.choice(NUMBERS).encode()
        cameras = cameras.replace(b"64", word)
    return {"images.txt": images, "cameras.txt": cameras}
