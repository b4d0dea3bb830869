"""The commands of one stage each: prune, compact and refit."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from potr_cl import cli
from potr_cl.formats import load_scene
from potr_cl.formats.scenes import ply
from tests.cli.calls import fails, run


@pytest.fixture
def dimmed_path(tmp_path, scene_path):
    """The scene with darker colours, and coefficients that are 0."""
    scene = load_scene(scene_path)
    scene.sh[:, 0] *= np.float32(0.8)
    scene.sh[:, 1:] = 0
    scene.sh[::2, 1] = 0.01
    ply.save(tmp_path / "dimmed.ply", scene)
    return tmp_path / "dimmed.ply"


def test_prune(tmp_path, scene_path, cameras_path, capsys):
    out, order = tmp_path / "pruned.ply", tmp_path / "order.npy"
    arguments = ["prune", scene_path, "--cameras", cameras_path, "-o", out, "--iterations", "4"]
    assert "kept 50 of 200 splats" in run(capsys, *arguments, "--count", "50", "--order", order)
    removal_order = np.load(order)
    assert sorted(removal_order) == list(range(200))
    assert np.array_equal(ply.load(out).means, ply.load(scene_path).means[np.sort(removal_order[150:])])
    for more, kept in (
        (["--keep", "0.5"], 100),
        (["--delta-mse-max", "0"], 200),
        (["--delta-mse-max", "1e9", "--unseen", "drop"], 1),
    ):
        run(capsys, *arguments, *more)
        assert len(ply.load(out)) == kept


def test_compact(tmp_path, scene_path, cameras_path, capsys):
    out = tmp_path / "compact.ply"
    said = run(capsys, "compact", scene_path, "--cameras", cameras_path, "-o", out, "--lambda", "10")
    assert "quantise to 0" in said
    scene, compacted = ply.load(scene_path), ply.load(out)
    assert np.array_equal(scene.means, compacted.means)
    assert np.abs(compacted.sh[:, 1:]).sum() < np.abs(scene.sh[:, 1:]).sum()


def test_each_part_of_compaction_can_be_left_out(tmp_path, scene_path, cameras_path, capsys):
    out, made = tmp_path / "out.ply", set()
    choices = ([], ["--colour-model", "rgb"], ["--weighting", "visibility"], ["--one-pass"], ["--alpha", "1"])
    for options in choices:
        run(capsys, "compact", scene_path, "--cameras", cameras_path, "-o", out, "-q", "0.2", *options)
        made.add(out.read_bytes())
    assert len(made) == len(choices)


def test_refit(tmp_path, scene_path, dimmed_path, cameras_path, capsys):
    out = tmp_path / "out.ply"
    refit = ["refit", dimmed_path, "--reference", scene_path, "--cameras", cameras_path, "-o", out]
    text = run(capsys, *refit, "--steps", "10")
    assert "6 training views" in text
    assert "2 held-out test views" in text
    before, after = map(float, re.findall(r"([\d.]+) dB", text.splitlines()[-1]))
    assert after > before + 1
    dimmed, refitted = load_scene(dimmed_path), load_scene(out)
    assert np.array_equal(dimmed.means, refitted.means)
    assert not refitted.sh[1::2, 1:].any()  # what was 0 stays 0
    assert refitted.sh[::2, 1].any()
    judged = json.loads(run(capsys, "compare", scene_path, out, "--cameras", cameras_path, "--json"))
    assert judged["mean"]["b_against_a"]["psnr"] == pytest.approx(after, abs=0.01)
    run(capsys, "refit", scene_path, *refit[2:], "--drop", "1000", "--steps", "1")
    assert not load_scene(out).sh[:, 1:].any()


@pytest.mark.slow
def test_refit_to_ground_truth(tmp_path, scene_path, dimmed_path, cameras_path, capsys):
    photos, out = tmp_path / "photos", tmp_path / "out.ply"
    run(capsys, "render", scene_path, "--cameras", cameras_path, "-o", photos, "--background", "white")
    refit = ["refit", dimmed_path, "--reference", scene_path, "--cameras", cameras_path, "-o", out]
    refit += ["--background", "white", "--photos", photos]
    # The reference is what the photographs show: nothing comes as close to them.
    assert cli.main([str(a) for a in refit]) == 0
    captured = capsys.readouterr()
    assert "2 held-out photographs" in captured.out
    assert "warning: on held-out photographs the result is " in captured.err
    # With the parts exchanged the reference is the darker one.
    exchanged = ["refit", scene_path, "--reference", dimmed_path, *refit[4:]]
    assert cli.main([str(a) for a in exchanged]) == 0
    assert "warning" not in capsys.readouterr().err
    fails(capsys, [*refit[:4], *refit[6:]], 2, "--photos", "--cameras")


def test_refit_to_ground_truth_without_held_out_views(tmp_path, scene_path, dimmed_path, cameras_path, capsys):
    views = [{**view, "split": "train"} for view in json.loads(cameras_path.read_text())]
    cameras_path.write_text(json.dumps(views))
    photos, out = tmp_path / "photos", tmp_path / "out.ply"
    run(capsys, "render", scene_path, "--cameras", cameras_path, "-o", photos)
    refit = ["refit", dimmed_path, "--reference", scene_path, "--cameras", cameras_path, "--photos", photos, "-o", out]
    assert cli.main([*map(str, refit), "--steps", "1"]) == 0
    captured = capsys.readouterr()
    assert "8 training views" in captured.out
    assert "no view is held out" in captured.err
