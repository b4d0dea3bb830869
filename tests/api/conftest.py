"""Files that several tests of the functions are given."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

import potr_cl
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import list_devices


@pytest.fixture(scope="session")
def files(tmp_path_factory, data) -> dict[str, Path]:
    """What the commands are given: a part of the excerpt, and some of its views, small."""
    folder = tmp_path_factory.mktemp("given")
    views = json.loads((data / "plush_excerpt_cameras.json").read_text())
    tests = [view for view in views if view["split"] == "test"]
    few = [*[view for view in views if view["split"] == "train"][:5], *tests[:2]]
    for number, view in enumerate(few):
        factor = 48 / max(view["width"], view["height"])
        view |= {"img_name": f"view_{number}", "fx": factor * view["fx"], "fy": factor * view["fy"]}
        view |= {side: round(view[side] * factor) for side in ("width", "height")}
    cameras = folder / "cameras.json"
    cameras.write_text(json.dumps(few))
    scene = potr_cl.read_scene(data / "plush_excerpt.ply")
    scene = dataclasses.replace(scene, sh=scene.sh[:, :4]).subset(np.arange(0, len(scene), 5))
    reduced = scene.subset(np.arange(0, len(scene), 2))
    for name, each in (("scene", scene), ("reduced", reduced)):
        potr_cl.save(each, folder / f"{name}.ply")
    potr_cl.encode(scene, prune=False, refit=False, compact=False, q=0.3, output=folder / "scene.potr")
    potr_cl.render(reduced, cameras, output=folder / "photos")
    names = {"scene": "scene.ply", "reduced": "reduced.ply", "reference": "scene.ply", "potr": "scene.potr"}
    chosen = list_devices().index(Device().info)
    given = {name: folder / file for name, file in names.items()}
    return given | {"cameras": cameras, "photos": folder / "photos", "device": Path(str(chosen))}
