"""The commands of one stage each: prune, compact and refit."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from PIL import Image

from potr_cl import cli
from potr_cl.formats import load_scene
from potr_cl.formats.scenes import ply
from tests.cli.calls import cameras_json, fails, run


@pytest.fixture
def dimmed_path(tmp_path, scene_path):
    """The scene with darker colours, and coefficients that are 0."""
    scene = load_scene(scene_path)
    scene.sh[:, 0] *= np.float32(0.8)
    scene.sh[:, 1:] = 0
    scene.sh[::2, 1] = 0.01
    ply.save(tmp_path / "dimmed.ply", scene)
    return tmp_path / "dimmed.ply"


def test_prune(tmp_path, scene_path, capsys):
    cameras = cameras_json(tmp_path / "cameras.json")
    out, order = tmp_path / "pruned.ply", tmp_path / "order.npy"
    arguments = ["prune", scene_path, "--cameras", cameras, "-o", out, "--iterations", "4"]
    assert cli.main([str(a) for a in [*arguments, "--count", "50", "--order", order]]) == 0
    assert "kept 50 of 200 splats" in capsys.readouterr().out
    scene, pruned = ply.load(scene_path), ply.load(out)
    removal_order = np.load(order)
    assert sorted(removal_order) == list(range(200))
    assert np.array_equal(pruned.means, scene.means[np.sort(removal_order[150:])])
    assert cli.main([str(a) for a in [*arguments, "--keep", "0.5"]]) == 0
    assert len(ply.load(out)) == 100
    for limit, kept in (("0", 200), ("1e9", 1)):
        assert cli.main([str(a) for a in [*arguments, "--unseen", "drop", "--delta-mse-max", limit]]) == 0
        assert len(ply.load(out)) <= kept
    capsys.readouterr()


def test_interrupted_pruning_leaves_nothing(tmp_path, scene_path, capsys, monkeypatch):
    def interrupted(*_args, **_kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr("potr_cl.stages.prune.prune_scene", interrupted)
    cameras = cameras_json(tmp_path / "cameras.json")
    before = sorted(tmp_path.iterdir())
    for command, out in (("prune", "out.ply"), ("encode", "out.potr")):
        fails(capsys, [command, scene_path, "--cameras", cameras, "-o", tmp_path / out], 130, "interrupted")
        assert sorted(tmp_path.iterdir()) == before


def test_compact(tmp_path, scene_path, capsys):
    cameras, out = cameras_json(tmp_path / "cameras.json"), tmp_path / "compact.ply"
    assert cli.main(["compact", str(scene_path), "--cameras", str(cameras), "-o", str(out), "--lambda", "10"]) == 0
    assert "quantise to 0" in capsys.readouterr().out
    scene, compacted = ply.load(scene_path), ply.load(out)
    assert np.array_equal(scene.means, compacted.means)
    assert np.abs(compacted.sh[:, 1:]).sum() < np.abs(scene.sh[:, 1:]).sum()


@pytest.mark.slow
def test_each_part_of_compaction_can_be_left_out(tmp_path, scene_path):
    cameras = cameras_json(tmp_path / "cameras.json")
    choices = ([], ["--colour-model", "rgb"], ["--weighting", "visibility"], ["--one-pass"], ["--alpha", "1"])
    for command, suffix, preset in (("compact", ".ply", []), ("encode", ".potr", ["--preset", "paper"])):
        files = set()
        for number, options in enumerate(choices):
            out = tmp_path / f"{command}{number}{suffix}"
            arguments = [command, str(scene_path), "--cameras", str(cameras), "-o", str(out), *preset, *options]
            assert cli.main(arguments) == 0
            files.add(out.read_bytes())
        assert len(files) == len(choices)


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

    whole = load_scene(scene_path)
    run(capsys, *["refit", scene_path, *refit[2:]], "--drop", "1e-7")
    assert 0 < np.count_nonzero(load_scene(out).sh) < np.count_nonzero(whole.sh)
    run(capsys, *["refit", scene_path, *refit[2:]], "--drop", "1000")
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
    out.unlink()
    Image.new("RGB", (32, 64)).save(photos / "view_4.png")
    fails(capsys, refit, 2, "32 x 64", "64 x 64")
    assert not out.exists()
    (photos / "view_4.png").unlink()
    assert cli.main([str(a) for a in refit]) == 0
    assert "view 'view_4' has no photograph and is left out" in capsys.readouterr().err
    for photo in photos.iterdir():
        photo.unlink()
    fails(capsys, refit, 2, "no photograph of any of the")


def test_refit_to_ground_truth_without_held_out_views(tmp_path, scene_path, dimmed_path, cameras_path, capsys):
    views = [{**view, "split": "train"} for view in json.loads(cameras_path.read_text())]
    cameras_path.write_text(json.dumps(views))
    photos, out = tmp_path / "photos", tmp_path / "out.ply"
    run(capsys, "render", scene_path, "--cameras", cameras_path, "-o", photos)
    refit = ["refit", dimmed_path, "--reference", scene_path, "--cameras", cameras_path, "--photos", photos, "-o", out]
    assert cli.main([str(a) for a in refit]) == 0
    captured = capsys.readouterr()
    assert "8 training views" in captured.out
    assert "no view is held out" in captured.err
