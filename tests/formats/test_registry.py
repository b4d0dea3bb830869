"""The tables of formats: what is declared holds, and everything that people see follows the tables."""

from __future__ import annotations

import dataclasses
import importlib
import os
import pkgutil
import re
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from potr_cl import DataError, UsageError, cli, info
from potr_cl.formats import cameras, load_cameras, load_scene, registry, save_scene, scene_writer, scenes
from potr_cl.formats.declaration import CameraFormat, SceneFormat
from potr_cl.formats.ladder import Ladder, Rung
from potr_cl.formats.registry import CAMERA_FORMATS, SCENE_FORMATS, listed
from potr_cl.formats.scenes.scene_files import opened
from tests.cases.cameras import nerfstudio, view, write_json
from tests.cases.scenes import in_order_of, turned_by
from tests.reference.scenes import random_scene

ROOT = Path(__file__).parents[2]
WRITTEN = [entry for entry in SCENE_FORMATS if entry.save is not None]


def name(entry: Any) -> str:
    return str(entry.name)


# Declarations --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("package", "table"), [(scenes, SCENE_FORMATS), (cameras, CAMERA_FORMATS)])
def test_every_declared_format_is_in_its_table(package, table):
    names = [f"{package.__name__}.{each.name}" for each in pkgutil.iter_modules(package.__path__)]
    values = [each for module in names for each in vars(importlib.import_module(module)).values()]
    declared = {id(each): each for each in values if isinstance(each, (SceneFormat, CameraFormat))}
    assert declared == {id(entry): entry for entry in table}


def test_no_two_formats_claim_one_suffix_without_a_recogniser():
    suffixes = Counter(suffix for entry in SCENE_FORMATS for suffix in entry.suffixes)
    assert set(suffixes.values()) == {1}
    for extension in {extension for entry in SCENE_FORMATS for extension in entry.extensions}:
        having_it = [entry for entry in SCENE_FORMATS if extension in entry.extensions]
        assert sum(entry.recognises is None for entry in having_it) == 1, extension


def test_declarations_are_complete():
    for entry in (*SCENE_FORMATS, *CAMERA_FORMATS):
        assert all(re.fullmatch(r"(\.[a-z0-9]+)+", suffix) for suffix in entry.suffixes), entry.name
        assert entry.suffixes or getattr(entry, "names", ()), entry.name
        assert entry.note, entry.name
        assert not {"\n", "|"} & set(entry.name + entry.note), "it would break the documentation's table"
    for entry in SCENE_FORMATS:
        assert bool(entry.not_written) == (entry.save is None), entry.name
        assert all(re.fullmatch(r"[a-z0-9-]+\.[a-z0-9]+", each) for each in entry.names), entry.name
    for each in CAMERA_FORMATS:
        assert bool(each.json_mark) == (".json" in each.suffixes), each.name


def test_formats_import_no_heavy_library():
    program = "import sys, potr_cl.formats; sys.exit(bool({'gsply', 'pycolmap', 'PIL'} & set(sys.modules)))"
    subprocess.run([sys.executable, "-c", program], check=True)


# Reading and writing -------------------------------------------------------------------------------------------------


# What a page holds is rounded as encode rounds: tests/outputs/test_page.py.
@pytest.mark.parametrize("entry", [entry for entry in WRITTEN if entry.name != "web page"], ids=name)
@given(splats=st.integers(1, 200), degree=st.integers(0, 3), seed=st.integers(0, 99))
@settings(
    max_examples=8,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
    phases=[Phase.explicit, Phase.reuse, Phase.generate],  # a format that fails does so for nearly every scene
)
def test_every_format_reads_what_it_writes(entry, splats, degree, seed, tmp_path):
    scene = random_scene(splats, degree, seed)
    for suffix in entry.suffixes:
        path = tmp_path / f"scene{suffix}"
        save_scene(path, scene)
        assert registry.format_of(path) is entry
        back = in_order_of(scene, load_scene(path))
        assert back.sh.shape == scene.sh.shape
        # The coarsest steps of all formats, and some; a format's own test knows its steps.
        assert np.abs(back.means - scene.means).max() < 0.01
        assert np.abs(back.opacities - scene.opacities).max() < 0.01
        angles, differences = turned_by(scene, back)
        assert np.quantile(np.abs(differences), 0.9) < 0.1
        assert np.cos(angles / 2).min() > 0.999
        assert np.quantile(np.abs(back.sh - scene.sh), 0.9) < 0.05


def test_suffixes_in_capitals_and_after_points():
    for entry in WRITTEN:
        assert all(registry.written_format(Path(f"v1.2{suffix.upper()}")) is entry for suffix in entry.suffixes)


def test_content_decides_between_formats_of_one_extension(data, tmp_path):
    plain, compressed = (
        next(entry for entry in SCENE_FORMATS if suffix in entry.suffixes) for suffix in (".ply", ".compressed.ply")
    )
    for name in ("a.ply", "a.compressed.ply"):
        shutil.copy(data / "plush_excerpt.ply", tmp_path / name)
        assert registry.format_of(tmp_path / name) is plain
        shutil.copy(data / "foreign" / "degree_0.compressed.ply", tmp_path / name)
        assert registry.format_of(tmp_path / name) is compressed
    assert registry.format_of(tmp_path / "missing.compressed.ply") is plain


def test_unknown_suffixes(tmp_path):
    for unknown in ("a.obj", "a", ".ply.d"):
        for call, formats, said in (
            (load_scene, SCENE_FORMATS, "unknown kind of scene, expected a"),
            (scene_writer, WRITTEN, "give it one of"),
        ):
            with pytest.raises(UsageError, match=said) as caught:
                call(tmp_path / unknown)
            assert all(suffix in str(caught.value) for entry in formats for suffix in entry.suffixes)
        assert not any(tmp_path.iterdir())


def test_formats_that_are_not_written_say_what_to_do(tmp_path):
    for entry in SCENE_FORMATS:
        if entry.save is None:
            with pytest.raises(UsageError, match=re.escape(entry.not_written)):
                save_scene(tmp_path / (f"a{entry.suffixes[0]}" if entry.suffixes else entry.names[0]), random_scene(3))


@pytest.mark.parametrize("suffix", [suffix for entry in SCENE_FORMATS for suffix in entry.suffixes])
def test_a_file_that_is_gone_or_is_none(suffix, tmp_path):
    """Also where it was there a moment ago, when its content told the format, or no file system takes its name."""
    for entry in SCENE_FORMATS:
        with pytest.raises(UsageError, match=r"cannot (open|read)"):
            entry.load(tmp_path / f"gone{suffix}")
    (tmp_path / f"folder{suffix}").mkdir()
    with pytest.raises(UsageError, match=r"directory|not a regular file"):
        load_scene(tmp_path / f"folder{suffix}")
    for read in (load_scene, info):
        with pytest.raises(UsageError, match=r"cannot (open|read)"):
            read(tmp_path / ("x" * 300 + suffix))


# Cameras -------------------------------------------------------------------------------------------------------------


def test_order_in_which_a_folder_is_searched(data, tmp_path):
    """From the last place to the first: each new file wins over those that were there."""

    def model(folder, source):
        shutil.copytree(data / source, folder, dirs_exist_ok=True)

    def outer(folder):
        model(folder, "plush_sparse_text")
        images = folder / "images.txt"
        images.write_text(images.read_text().replace("20240212", "outer"))

    for name, write, first in (
        ("sparse", outer, "outer_003919"),
        ("sparse/0", lambda path: model(path, "plush_sparse_binary"), "20240212_003919"),
        ("transforms.json", lambda path: write_json(path, nerfstudio(["b.png"])), "b"),
        ("transforms_train.json", lambda path: write_json(path, nerfstudio(["c.png", "d.png"])), "c"),
        ("cameras.json", lambda path: write_json(path, [view(img_name="a")]), "a"),
        (".", lambda path: model(path, "plush_sparse_binary"), "20240212_003919"),
    ):
        write(tmp_path / name)
        assert load_cameras(tmp_path)[0].name == first, name


# What people see -----------------------------------------------------------------------------------------------------


def test_a_format_is_one_line_of_the_table(tmp_path, monkeypatch, capsys):
    """Reading, writing, messages and help know a format as soon as the table does."""
    scene, ply, other = random_scene(3, 0), str(tmp_path / "a.ply"), str(tmp_path / "a.centres")

    def save(path, scene):
        np.save(path.open("wb"), scene.means)

    def load(path, trust=False):
        return dataclasses.replace(scene, means=np.load(path))

    added = SceneFormat("Centres", (".centres",), "of this test", load, save)
    monkeypatch.setattr(registry, "SCENE_FORMATS", (*SCENE_FORMATS, added))
    save_scene(ply, scene)
    assert cli.main(["convert", ply, other]) == 0
    assert load_scene(other) == scene
    for names in ((ply, "a.obj"), ("a.obj", "b.ply")):
        assert cli.main(["convert", *names]) == 2
        assert "or .centres" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        cli.main(["convert", "--help"])
    assert " ".join(capsys.readouterr().out.split()).count("or .centres") == 2


def test_lists_for_people():
    assert [listed(list("abc")[:n]) for n in range(4)] == ["", "a", "a or b", "a, b or c"]
    assert listed(["a", "b"], "and") == "a and b"


@pytest.mark.parametrize("broken", [False, True])
def test_a_file_of_any_format_that_is_written_while_it_is_read(tmp_path, broken):
    path = tmp_path / "scene.splat"
    path.write_bytes(bytes(64))
    os.utime(path, ns=(0, 0))

    def read():
        with opened(path):
            path.write_bytes(bytes(65))
            if broken:
                raise ValueError("it ends too early")

    with pytest.raises(DataError, match="was changed while it was read"):
        read()


@pytest.mark.parametrize(
    ("files", "named"),
    [
        (["input.ply", "point_cloud/iteration_7000/a.ply", "point_cloud/iteration_30000/a.ply"], 2),
        (["ply/point_cloud_6999.ply", "ply/point_cloud_29999.ply", "cfgs/a.yml"], 1),
        (["iteration_7000/point_cloud.ply", "iteration_30000/point_cloud.ply"], 1),
        (["splat.ply"], 0),
        (["images/a.png"], None),
    ],
)
def test_the_folder_of_a_training_is_refused_with_the_name_of_its_scene(tmp_path, files, named):
    for file in files:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).touch()
    with pytest.raises(UsageError) as caught:
        load_scene(tmp_path)
    said = str(caught.value)
    if named is None:
        assert "has no scene: there is no .ply in it, and no meta.json, lod-meta.json or tileset.json" in said
    assert [file for file in files if f"'{tmp_path / file}'" in said] == ([] if named is None else [files[named]])


@pytest.mark.parametrize("read", [load_scene, info])
def test_what_is_no_scene_is_refused_with_what_to_do(tmp_path, data, read):
    Ladder(tmp_path / "ladder.json", "a.ply", 9, "", (Rung(0.5, "a_q0.5.potr", 3, 1),)).save()
    for name in ("ckpt_29999_rank0.pt", "a.pth", "step-000029999.ckpt"):
        (tmp_path / name).write_bytes(b"PK\x03\x04")
    scenes = tmp_path / "scenes"
    scenes.mkdir()
    for name in ("a.ply", "b.ply"):
        shutil.copy(data / "plush_excerpt.ply", scenes / name)
    a_ladder = r"is a ladder, .* see all of them with potr-cl view SCENE"
    cameras_here = "holds cameras, not a scene: give the scene's file, and these as --cameras"
    a_checkpoint = "is a checkpoint of a training, not a scene: export it as PLY, .*"
    for path, said in (
        (tmp_path, a_ladder),
        (tmp_path / "ladder.json", a_ladder),
        (data / "plush_excerpt_cameras.json", cameras_here),
        (data / "plush_sparse_text", cameras_here),
        (data / "plush_transforms", cameras_here),
        (tmp_path / "ckpt_29999_rank0.pt", a_checkpoint + "gsplat"),
        (tmp_path / "a.pth", a_checkpoint + "gsplat"),
        (tmp_path / "step-000029999.ckpt", a_checkpoint + "ns-export"),
        (scenes, r"holds 2 scenes: give one of them, such as '.*b\.ply', or all, \*\.ply$"),
    ):
        with pytest.raises(UsageError, match=said):
            read(path)
