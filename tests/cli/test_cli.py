"""The command line: what it prints, what it leaves behind, how it fails."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from potr_cl import cli
from potr_cl.errors import DeviceError
from potr_cl.formats import load_cameras, load_scene
from potr_cl.formats.images import to_8_bits
from potr_cl.formats.scenes import ply
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import DEVICE_VARIABLE, compiler_fault, list_devices
from potr_cl.pipeline.amounts import size_in_bytes
from potr_cl.quality.compare import side_by_side
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import GSPLAT
from potr_cl.reference.scenes import random_scene, ring_of_cameras

#: Options of an encode that keeps everything, and so looks at no views.
KEEP = ["--no-prune", "--no-compact", "--refit", "off"]


@pytest.fixture
def scene_path(tmp_path):
    path = tmp_path / "scene.ply"
    ply.save(path, random_scene(200, 2))
    return path


@pytest.fixture
def potr_path(tmp_path, scene_path, capsys):
    path = tmp_path / "scene.potr"
    assert cli.main(["encode", str(scene_path), "-o", str(path), "--zstd-level", "1", *KEEP]) == 0
    capsys.readouterr()
    return path


def cameras_json(path: Path) -> Path:
    views = []
    for k, c in enumerate(ring_of_cameras(8)):
        views.append(
            {
                "id": k,
                "img_name": c.name,
                "width": c.width,
                "height": c.height,
                "position": c.centre.tolist(),
                "rotation": c.rotation.T.tolist(),
                "fx": c.fx,
                "fy": c.fy,
                "split": c.split,
            }
        )
    path.write_text(json.dumps(views))
    return path


def fails(capsys, arguments, code, *words) -> None:
    """One clear line on standard error, the exit code, no traceback."""
    assert cli.main([str(a) for a in arguments]) == code
    captured = capsys.readouterr()
    lines = [line for line in captured.err.splitlines() if line.startswith("potr-cl: ")]
    assert len(lines) == 1, captured.err
    assert "Traceback" not in captured.err
    for word in words:
        assert word in lines[0]


def test_what_looks_at_no_views_opens_no_device(tmp_path, scene_path, monkeypatch):
    opened = []
    monkeypatch.setattr("potr_cl.cli.encode.Device", opened.append)
    assert cli.main(["encode", str(scene_path), "-o", str(tmp_path / "scene.potr"), *KEEP]) == 0
    assert not opened


def test_encode_decode_info(tmp_path, scene_path, capsys):
    potr, back = tmp_path / "a.potr", tmp_path / "back.ply"
    cameras = cameras_json(tmp_path / "cameras.json")
    arguments = ["encode", scene_path, "-o", potr, "-q", "0.7", "--cameras", cameras, *KEEP]
    assert cli.main([str(a) for a in arguments]) == 0
    assert "200 of 200" in capsys.readouterr().out
    assert cli.main(["decode", str(potr), "-o", str(back)]) == 0
    assert len(ply.load(back)) == 200
    capsys.readouterr()
    assert cli.main(["info", str(potr), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["splats"], report["sh_degree"], report["q"]) == (200, 2, 0.7)
    assert sum(s["bytes"] for s in report["sections"].values()) == report["bytes"] == potr.stat().st_size
    assert report["source_bytes"] == scene_path.stat().st_size
    assert report["ply_bytes"] == pytest.approx(back.stat().st_size, rel=0.05)
    assert cli.main(["info", str(potr)]) == 0
    text = capsys.readouterr().out
    assert "colour: AC degree 2" in text
    assert "rotation" in text


def test_encode_tells_what_it_did(tmp_path, scene_path, capsys):
    potr, cameras = tmp_path / "a.potr", cameras_json(tmp_path / "cameras.json")
    encode = ["encode", scene_path, "-o", potr, "--cameras", cameras, "--iterations", "3", "--count", "90"]
    encode += ["--preset", "paper"]
    report = json.loads(run(capsys, *encode, "--json"))
    assert (report["bytes"], report["source"]["bytes"]) == (potr.stat().st_size, scene_path.stat().st_size)
    assert report["ratio"] == report["source"]["bytes"] / report["bytes"]
    assert (report["splats"], report["source"]["splats"]) == (90, 200)
    assert sum(report["properties"].values()) == report["bytes"]
    assert report["pruning"]["history"][-1]["left"] == 90
    stages = ["prepare views", "prune", "compact", "octree", "quantise and code", "evaluate", "total"]
    assert list(report["seconds"]) == stages
    assert sum(report["seconds"][stage] for stage in stages[:-1]) <= report["seconds"]["total"]
    assert report["device"]["name"] == Device().info.name

    judged = json.loads(run(capsys, "compare", scene_path, potr, "--cameras", cameras, "--json"))
    quality = report["quality"]
    assert quality["kind"] == "test"
    assert quality["psnr"] == pytest.approx(judged["mean"]["b_against_a"]["psnr"])
    assert quality["ssim"] == pytest.approx(judged["mean"]["b_against_a"]["ssim"])
    assert quality["worst"]["name"] == judged["worst_view"]
    assert [view["name"] for view in quality["views"]] == ["view_0", "view_4"]

    text = run(capsys, *encode)
    for part in (f"{report['bytes']:,} bytes", "90 of 200", f"PSNR {quality['psnr']:.2f} dB", "colour: AC", "compact"):
        assert part in text
    assert f"worst view {quality['worst']['name']}" in text
    assert "not judged, as asked" in run(capsys, *encode, "--no-quality")
    assert "evaluate" not in json.loads(run(capsys, *encode, "--no-quality", "--json"))["seconds"]


@pytest.fixture
def excerpt(data):
    """Arguments that encode a real excerpt fast."""
    return ["encode", data / "plush_excerpt.ply", "--cameras", data / "plush_excerpt_cameras.json", "--iterations", "4"]


def test_encode_to_a_size(tmp_path, excerpt, capsys):
    potr = tmp_path / "a.potr"
    report = json.loads(run(capsys, *excerpt, "-o", potr, "--max-size", "20 kB", "--json"))
    assert 19_600 <= potr.stat().st_size == report["bytes"] <= 20_000
    assert report["search"]["target"] == "at most 20,000 bytes"
    assert report["search"]["max_bytes"] == 20_000
    assert report["search"]["tries"][-1]["value"] == report["bytes"]
    assert report["search"]["reached"] == f"{report['bytes']:,} bytes"
    assert "asked for  at most 20,480 bytes; reached" in run(capsys, *excerpt, "-o", potr, "--max-size", "20KiB")


def test_encode_to_a_psnr(tmp_path, excerpt, capsys):
    report = json.loads(run(capsys, *excerpt, "-o", tmp_path / "a.potr", "--min-psnr", "43", "--json"))
    assert 43 <= report["quality"]["psnr"] <= 43.1


def test_encode_to_the_impossible(tmp_path, excerpt, capsys):
    potr = tmp_path / "a.potr"
    fails(
        capsys, [*excerpt, "-o", potr, "--max-size", "1k"], 1, "at most 1,000 bytes cannot be reached: quality 0 gives"
    )
    fails(capsys, [*excerpt, "-o", potr, "--min-psnr", "99"], 1, "at least 99 dB cannot be reached", "quality 1 gives")
    for size in ("8 bananas", "", "-5", "1e", "0.1", "1.2.3M"):
        fails(capsys, [*excerpt, "-o", potr, f"--max-size={size}"], 2)
    fails(capsys, [*excerpt, "-o", potr, "--min-psnr", "-3"], 2, "-3 dB")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(SystemExit) as exit_:
        cli.main([str(a) for a in [*excerpt, "-o", potr, "--max-size", "1M", "-q", "0.2"]])
    assert exit_.value.code == 2
    capsys.readouterr()


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("1234567", 1_234_567),
        ("8MB", 8_000_000),
        ("8 MiB", 8 << 20),
        ("800k", 800_000),
        ("1.5e6", 1_500_000),
        ("2 gib", 2 << 30),
        ("0.5GB", 500_000_000),
        ("12_000 B", 12_000),
        ("3Ki", 3072),
    ],
)
def test_sizes_as_people_write_them(text, size):
    assert size_in_bytes(text) == size


def test_encode_report_page(tmp_path, excerpt, capsys):
    page = tmp_path / "page.html"
    encode = [*excerpt, "-o", tmp_path / "a.potr"]
    report = json.loads(run(capsys, *encode, "--report", page, "--report-view", "20240212_003919", "--json"))
    text = page.read_text()
    assert f"worst view: {report['quality']['worst']['name']}" in text
    assert "chosen view: 20240212_003919" in text
    assert text.count("<img") == 9
    run(capsys, *encode, "--report", page, "--no-quality")
    assert "not judged, as asked" in page.read_text()
    page.unlink()
    fails(capsys, [*encode, "--report", page, "--report-view", "nobody"], 2, "no view 'nobody'", "'20240212_003919'")
    fails(capsys, [*encode, "--report-view", "20240212_003919"], 2, "--report")
    fails(capsys, [*encode, "--report", tmp_path / "a.potr"], 2, "name the same file")
    fails(capsys, [*encode, "--report", tmp_path / "nowhere" / "page.html"], 2, "does not exist")
    assert [path.name for path in tmp_path.iterdir()] == ["a.potr"]


def test_encode_judges_by_training_views_if_there_are_no_others(tmp_path, scene_path, capsys):
    path = cameras_json(tmp_path / "cameras.json")
    path.write_text(json.dumps([view for view in json.loads(path.read_text()) if view["split"] == "train"]))
    text = run(capsys, "encode", scene_path, "-o", tmp_path / "a.potr", "--cameras", path, "--iterations", "2")
    assert "all 6 training views, for the cameras name no test views" in text


def test_a_device_that_fails_while_judging_leaves_the_file(tmp_path, scene_path, capsys, monkeypatch):
    potr, cameras = tmp_path / "a.potr", cameras_json(tmp_path / "cameras.json")

    def fail(*_args):
        raise DeviceError("device 'X' vanished")

    monkeypatch.setattr("potr_cl.api.encoding.Evaluator", fail)
    text = run(capsys, "encode", scene_path, "-o", potr, "--cameras", cameras, "--iterations", "2")
    assert "not judged: device 'X' vanished" in text
    assert load_scene(potr)


def test_every_parameter_can_be_set(tmp_path, scene_path, capsys):
    potr = tmp_path / "a.potr"
    options = {
        "--gamma": 0.01,
        "--beta": 0.001,
        "--sf-sh": 20,
        "--sf-opacity": 30,
        "--sf-rotation": 40,
        "--sf-scale": 50,
    }
    flat = [str(x) for pair in options.items() for x in pair]
    cameras = cameras_json(tmp_path / "cameras.json")
    paper = ["--preset", "paper"]
    assert cli.main(["encode", str(scene_path), "-o", str(potr), "--cameras", str(cameras), *paper, *flat]) == 0
    capsys.readouterr()
    assert cli.main(["info", str(potr), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["scale_factors"] == {"scale": 50, "rotation": 40, "opacity": 30, "DC": 20, "AC": 20}
    assert (report["gamma"], report["beta"]) == (0.01, 0.001)


def test_both_entropy_stages(tmp_path, scene_path, capsys):
    scenes = []
    for entropy in ("zstd", "npz"):
        potr = tmp_path / f"{entropy}.potr"
        assert cli.main(["encode", str(scene_path), "-o", str(potr), "--entropy", entropy, *KEEP]) == 0
        assert cli.main(["decode", str(potr), "-o", str(tmp_path / "back.ply")]) == 0
        scenes.append(ply.load(tmp_path / "back.ply"))
    assert np.array_equal(scenes[0].sh, scenes[1].sh)
    capsys.readouterr()


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


def test_encode_prunes(tmp_path, scene_path, capsys):
    cameras = cameras_json(tmp_path / "cameras.json")
    potr = tmp_path / "a.potr"
    arguments = ["encode", scene_path, "-o", potr, "--cameras", cameras, "--iterations", "3", "--memory", "0.00001"]
    assert cli.main([str(a) for a in [*arguments, "--count", "60"]]) == 0
    assert "60 of 200, " in capsys.readouterr().out
    assert cli.main(["info", str(potr), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["splats"], report["source_splats"]) == (60, 200)


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (["--keep", "0"], "--keep"),
        (["--keep", "1.5"], "--keep"),
        (["--count", "0"], "at least 1"),
        (["--iterations", "0"], "iterations"),
        (["--delta-mse-max", "-1"], "delta_mse_max"),
        (["--tolerance", "nan"], "tolerance"),
        (["--memory", "-2"], "memory"),
        (["--background", "octarine"], "octarine"),
    ],
)
def test_wrong_pruning_options(tmp_path, scene_path, capsys, options, word):
    cameras = cameras_json(tmp_path / "cameras.json")
    for command, out in (("prune", tmp_path / "out.ply"), ("encode", tmp_path / "out.potr")):
        fails(capsys, [command, scene_path, "--cameras", cameras, "-o", out, *options], 2, word)
        assert not out.exists()


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


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (["--lambda", "-1"], "lam"),
        (["--alpha", "0"], "alpha"),
        (["--alpha", "1.5"], "alpha"),
        (["--sf-sh", "0"], "sf_sh"),
        (["-q", "2"], "quality"),
        (["--memory", "-1"], "memory"),
        (["--background", "octarine"], "octarine"),
        (["--device", "abacus"], "abacus"),
    ],
)
def test_wrong_compaction_options(tmp_path, scene_path, capsys, options, word):
    cameras, out = cameras_json(tmp_path / "cameras.json"), tmp_path / "out.ply"
    code = 1 if "--device" in options else 2
    fails(capsys, ["compact", scene_path, "--cameras", cameras, "-o", out, *options], code, word)
    assert not out.exists()


def test_compaction_of_bad_files(tmp_path, scene_path, capsys):
    cameras, out = cameras_json(tmp_path / "cameras.json"), tmp_path / "out.ply"
    fails(capsys, ["compact", tmp_path / "none.ply", "--cameras", cameras, "-o", out], 2, "none.ply")
    fails(capsys, ["compact", scene_path, "--cameras", tmp_path / "none.json", "-o", out], 2, "none.json")
    fails(capsys, ["compact", scene_path, "--cameras", scene_path, "-o", out], 2, "scene.ply")
    for option in ("compact", "refit"):
        late = [f"--{option}-at", "2"]
        fails(capsys, ["encode", scene_path, "--cameras", cameras, "-o", out, *late], 2, f"{option}_at")
    assert not out.exists()


def test_without_cameras_virtual_ones_are_placed(tmp_path, scene_path, capsys):
    potr = tmp_path / "a.potr"
    few = ["--iterations", "2", "--virtual-views", "8", "--count", "90"]
    assert cli.main(["encode", str(scene_path), "-o", str(potr), *few]) == 0
    said = capsys.readouterr()
    assert "no --cameras: 8 virtual views and 1 to judge by placed" in said.err
    assert "1 held-out virtual view" in said.out
    assert "place cameras" in said.out
    assert json.loads(run(capsys, "info", potr, "--json"))["cameras"] == "virtual"
    assert "virtual" in run(capsys, "info", potr)
    for command, options in (("prune", few), ("compact", few[2:4])):
        assert cli.main([command, str(scene_path), "-o", str(tmp_path / "out.ply"), *options]) == 0
        assert "8 virtual views" in capsys.readouterr().err
        assert len(ply.load(tmp_path / "out.ply")) == (90 if command == "prune" else 200)
    fails(capsys, ["encode", scene_path, "-o", tmp_path / "b.potr", "--virtual-views", "0"], 2, "at least 1")
    assert not (tmp_path / "b.potr").exists()


def test_whose_cameras_is_in_the_file(tmp_path, scene_path, capsys):
    cameras, potr = cameras_json(tmp_path / "cameras.json"), tmp_path / "a.potr"
    for options, said in (([*KEEP], None), ([*KEEP, "--cameras", cameras], "given")):
        run(capsys, "encode", scene_path, "-o", potr, *options)
        assert json.loads(run(capsys, "info", potr, "--json"))["cameras"] == said


def test_order_and_output_must_differ(tmp_path, scene_path, capsys):
    cameras = cameras_json(tmp_path / "cameras.json")
    arguments = ["prune", scene_path, "--cameras", cameras, "-o", tmp_path / "x.ply"]
    arguments += ["--order", tmp_path / "x.ply"]
    fails(capsys, arguments, 2, "same file")


def test_no_such_input(tmp_path, capsys):
    for command, out in (("encode", "out.potr"), ("decode", "out.ply")):
        fails(capsys, [command, tmp_path / "none.potr", "-o", tmp_path / out], 2, "none.potr")
    fails(capsys, ["info", tmp_path / "none.potr"], 2, "none.potr")
    assert list(tmp_path.iterdir()) == []


def test_directories(tmp_path, scene_path, potr_path, capsys):
    fails(capsys, ["decode", tmp_path, "-o", tmp_path / "out.ply"], 2, str(tmp_path))
    fails(capsys, ["info", tmp_path], 2, str(tmp_path))
    fails(capsys, ["prune", scene_path, "-o", tmp_path], 2, str(tmp_path))
    fails(capsys, ["encode", scene_path, "-o", tmp_path / "a.potr", "--report", tmp_path], 2, str(tmp_path))
    fails(capsys, ["encode", scene_path, "-o", tmp_path / "nowhere" / "a.potr"], 2, "nowhere")


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (b"", "empty"),
        (b"ply\nformat ascii 1.0\n", "not a .potr"),
        (b"POTR\r\n\x1a\n", "truncated"),
        (bytes(500), "not a"),
    ],
)
def test_other_files(tmp_path, capsys, content, word):
    path = tmp_path / "a.potr"
    path.write_bytes(content)
    fails(capsys, ["decode", path, "-o", tmp_path / "out.ply"], 1, str(path), word)
    fails(capsys, ["info", path], 1, str(path), word)
    assert not (tmp_path / "out.ply").exists()


def test_damaged_file_keeps_the_old_output(tmp_path, potr_path, capsys):
    out = tmp_path / "out.ply"
    out.write_bytes(b"precious")
    data = potr_path.read_bytes()
    for damaged in (data[: len(data) // 2], data[:-3] + b"abc", data[:200] + b"\xff" + data[201:]):
        path = tmp_path / "damaged.potr"
        path.write_bytes(damaged)
        fails(capsys, ["decode", path, "-o", out], 1, "damaged.potr")
        assert out.read_bytes() == b"precious"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["damaged.potr", "out.ply", "scene.ply", "scene.potr"]


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (["-q", "1.5"], "quality"),
        (["-q", "nan"], "quality"),
        (["--sf-sh", "0"], "sf_sh"),
        (["--gamma", "-1"], "gamma"),
        (["--zstd-level", "40"], "level 40"),
        (["--threads", "-2"], "--threads"),
    ],
)
def test_wrong_options(tmp_path, scene_path, capsys, options, word):
    fails(capsys, ["encode", scene_path, "-o", tmp_path / "a.potr", *options], 2, word)
    assert not (tmp_path / "a.potr").exists()


def test_wrong_arguments_exit_with_2(capsys):
    for arguments in (["encode"], ["fly"], [], ["encode", "a.ply", "-o", "b", "-q", "good"]):
        with pytest.raises(SystemExit) as caught:
            cli.main(arguments)
        assert caught.value.code == 2
    capsys.readouterr()


def test_bad_cameras(tmp_path, scene_path, capsys):
    path = tmp_path / "cameras.json"
    path.write_text('{"neither": "nor"}')
    fails(capsys, ["encode", scene_path, "-o", tmp_path / "a.potr", "--cameras", path], 1, "cameras.json")
    fails(capsys, ["encode", scene_path, "-o", tmp_path / "a.potr", "--cameras", tmp_path / "no"], 2, "no")
    assert not (tmp_path / "a.potr").exists()


def test_a_scene_too_large_to_quantise(tmp_path, capsys):
    scene = random_scene(5, 0)
    scene.sh[2] = 1e30
    ply.save(tmp_path / "scene.ply", scene)
    fails(capsys, ["encode", tmp_path / "scene.ply", "-o", tmp_path / "a.potr", *KEEP], 1, "too large to quantise")
    assert not (tmp_path / "a.potr").exists()


@pytest.mark.skipif(os.name != "posix", reason="needs resource limits")
def test_disk_full(tmp_path, scene_path, potr_path):
    """A file size limit stands for a full disk: the write fails in the middle."""
    script = (
        "import resource, signal, sys; signal.signal(signal.SIGXFSZ, signal.SIG_IGN);"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000));"
        "from potr_cl.cli import main; sys.exit(main(sys.argv[1:]))"
    )
    encode = ["encode", scene_path, "-o", tmp_path / "x.potr", *KEEP]
    for arguments in (encode, ["decode", potr_path, "-o", tmp_path / "x.ply"]):
        result = subprocess.run(
            [sys.executable, "-c", script, *map(str, arguments)], capture_output=True, text=True, check=False
        )
        assert result.returncode == 1
        assert "cannot write" in result.stderr
        assert "Traceback" not in result.stderr
        assert sorted(p.name for p in tmp_path.iterdir()) == ["scene.ply", "scene.potr"]


@pytest.mark.skipif(os.name != "posix", reason="needs POSIX permissions")
def test_no_permission(scene_path):
    with tempfile.TemporaryDirectory() as folder:  # not tmp_path, which nobody else may even enter
        locked, scene = Path(folder) / "locked", Path(folder) / "scene.ply"
        shutil.copy(scene_path, scene)
        locked.mkdir()
        secret = Path(folder) / "secret.ply"
        shutil.copy(scene_path, secret)
        for path, mode in ((Path(folder), 0o755), (locked, 0o555), (scene, 0o644), (secret, 0o000)):
            path.chmod(mode)
        # Root may do anything: give the right up, once everything is imported.
        script = (
            "import locale, os, sys; from potr_cl.cli import encode, main; os.geteuid() or os.setuid(65534); "
            "sys.exit(main(sys.argv[1:]))"
        )
        for source, target in ((scene, locked / "a.potr"), (secret, Path(folder) / "a.potr")):
            command = [sys.executable, "-c", script, "encode", str(source), "-o", str(target), *KEEP]
            result = subprocess.run(command, capture_output=True, text=True, check=False)
            assert result.returncode == 2, result.stderr
            assert "Permission denied" in result.stderr
            assert "Traceback" not in result.stderr
            assert not target.exists()


def test_interrupt(tmp_path, scene_path, capsys, monkeypatch):
    def interrupted(*_args, **_kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr("potr_cl.cli.encode.encode", interrupted)
    fails(capsys, ["encode", scene_path, "-o", tmp_path / "a.potr", *KEEP], 130, "interrupted")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["scene.ply"]


def test_decoding_imports_what_decoding_needs(potr_path, tmp_path):
    """To decode takes less time than to open an OpenCL loader."""
    program = "import sys; from potr_cl import cli; code = cli.main(sys.argv[1:]); print(*sys.modules); sys.exit(code)"
    command = [sys.executable, "-c", program, "decode", str(potr_path), "-o", str(tmp_path / "out.ply")]
    modules = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    assert "potr_cl.codec.decoder" in modules
    assert "pyopencl" not in modules


def test_the_driver_loads_while_other_modules_are_imported():
    """So nothing may come before it that takes long; and an encode without pictures does without Pillow."""
    program = (
        "import sys, potr_cl.cli; heavy = {'numpy', 'pyopencl', 'PIL'}; print(sorted(heavy & set(sys.modules)));"
        "import potr_cl.cli.encode; print(sorted(heavy & set(sys.modules)))"
    )
    said = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True).stdout
    assert said.splitlines() == ["[]", "['numpy', 'pyopencl']"]


def test_every_command_has_its_help(capsys):
    with pytest.raises(SystemExit) as left:
        cli.main(["--help"])
    assert left.value.code == 0
    listed = capsys.readouterr().out
    for command in cli.COMMANDS:
        with pytest.raises(SystemExit) as left:
            cli.main([command, "--help"])
        assert left.value.code == 0
        assert f"potr-cl {command}" in capsys.readouterr().out
        assert re.search(rf"^    {command} ", listed, re.MULTILINE)


def test_module_runs():
    command = [sys.executable, "-m", "potr_cl", "--version"]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert result.stdout.startswith("potr-cl ")


# ------------------------------------------------------------------------------------------ render


@pytest.fixture
def cameras_path(tmp_path):
    return cameras_json(tmp_path / "cameras.json")


def run(capsys, *arguments) -> str:
    """Standard output of a command that succeeds."""
    code = cli.main([str(a) for a in arguments])
    captured = capsys.readouterr()
    assert code == 0, captured.err
    return captured.out


def test_render_writes_what_the_rasterizer_sees(tmp_path, potr_path, cameras_path, capsys):
    out = tmp_path / "new" / "folder"
    options = ["--background", "1,0.5,0", "--rules", "gsplat"]
    text = run(capsys, "render", potr_path, "--cameras", cameras_path, "-o", out, *options)
    assert "8 images" in text
    rasterizer = Rasterizer(Device(), load_scene(potr_path), GSPLAT, (1, 0.5, 0))
    cameras = load_cameras(cameras_path)
    assert sorted(file.name for file in out.iterdir()) == sorted(f"{c.name}.png" for c in cameras)
    for camera in cameras:
        with Image.open(out / f"{camera.name}.png") as image:
            assert np.array_equal(np.asarray(image), to_8_bits(rasterizer.render(camera)[0]))


@pytest.mark.parametrize(
    ("options", "views"),
    [
        (["--split", "test"], [0, 4]),
        (["--split", "train"], [1, 2, 3, 5, 6, 7]),
        (["--split", "all"], range(8)),
        (["--views", "view_3", "5", "view_5"], [3, 5]),
    ],
)
def test_render_chosen_views(tmp_path, scene_path, cameras_path, capsys, options, views):
    run(capsys, "render", scene_path, "--cameras", cameras_path, "-o", tmp_path / "out", *options)
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == [f"view_{k}.png" for k in views]


def test_a_view_named_like_a_number_is_that_view(tmp_path, scene_path, cameras_path, capsys):
    views = json.loads(cameras_path.read_text())
    views[7]["img_name"] = "0"
    cameras_path.write_text(json.dumps(views))
    run(capsys, "render", scene_path, "--cameras", cameras_path, "-o", tmp_path / "out", "--views", "0", "1")
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == ["0.png", "view_1.png"]


def test_pictures_stay_in_their_folder(tmp_path, scene_path, cameras_path, capsys):
    """Names of views come from files that others wrote."""
    views = json.loads(cameras_path.read_text())[:3]
    for view, name in zip(views, ("../../x.png", "/x.png", "a/x.png"), strict=True):
        view["img_name"] = name
    cameras_path.write_text(json.dumps(views))
    out = tmp_path / "out"
    before = set(tmp_path.iterdir())
    run(capsys, "render", scene_path, "--cameras", cameras_path, "-o", out)
    assert set(tmp_path.iterdir()) == before | {out}
    assert sorted(file.name for file in out.iterdir()) == [".._.._x.png", "_x.png", "a_x.png"]
    views[0]["img_name"] = "a_x.png"
    views[1]["img_name"] = "b/x.png"
    cameras_path.write_text(json.dumps(views))
    fails(capsys, ["render", scene_path, "--cameras", cameras_path, "-o", out], 1, "two views", "--views")


def test_render_bad_calls(tmp_path, scene_path, cameras_path, capsys):
    out = tmp_path / "out"
    render = ["render", scene_path, "--cameras", cameras_path, "-o", out]
    fails(capsys, ["render", tmp_path / "none.ply", *render[2:]], 2, "none.ply")
    fails(capsys, ["render", cameras_path, *render[2:]], 2, "cameras.json", "unknown kind of scene")
    fails(capsys, [*render[:3], tmp_path / "none.json", *render[4:]], 2, "none.json")
    fails(capsys, [*render, "--views", "view_9"], 2, "'view_9'", "0 ('view_0') to 7 ('view_7')")
    fails(capsys, [*render, "--views", "8"], 2, "'8'")
    fails(capsys, [*render, "--background", "beige-ish"], 2, "'beige-ish' is no colour")
    fails(capsys, [*render, "--device", "no such thing"], 1, "'no such thing'", list_devices()[0].name)
    (tmp_path / "file").write_bytes(b"")
    fails(capsys, [*render[:5], tmp_path / "file"], 2, "cannot make the folder")
    (tmp_path / "folder" / "view_0.png").mkdir(parents=True)
    fails(capsys, [*render[:5], tmp_path / "folder"], 2, "view_0.png")
    views = [view for view in json.loads(cameras_path.read_text()) if view["split"] == "train"]
    cameras_path.write_text(json.dumps(views))
    fails(capsys, [*render, "--split", "test"], 2, "--split all")


def test_device_by_environment(tmp_path, scene_path, cameras_path, capsys, monkeypatch):
    render = ["render", scene_path, "--cameras", cameras_path, "--views", "0", "-o", tmp_path / "out"]
    monkeypatch.setenv(DEVICE_VARIABLE, "no such thing")
    fails(capsys, render, 1, "'no such thing'")
    able = next(info for info in list_devices() if compiler_fault(info) is None)
    assert able.name in run(capsys, *render, "--device", able.index)


# ------------------------------------------------------------------------------------------ compare


def test_compare_from_cameras(tmp_path, scene_path, potr_path, cameras_path, capsys):
    both = [scene_path, potr_path, "--cameras", cameras_path]
    report = json.loads(run(capsys, "compare", *both, "--json"))
    assert [view["name"] for view in report["views"]] == ["view_0", "view_4"]  # the test views
    assert report["a"]["bytes"] == scene_path.stat().st_size
    assert report["b"]["bytes"] == potr_path.stat().st_size
    assert report["size_ratio"] == report["a"]["bytes"] / report["b"]["bytes"]
    assert report["rules"] == "inria"
    psnrs = [view["b_against_a"]["psnr"] for view in report["views"]]
    assert report["mean"]["b_against_a"]["psnr"] == pytest.approx(np.mean(psnrs))
    assert min(psnrs) > 30
    text = run(capsys, "compare", *both)
    assert f"{np.mean(psnrs):.2f}" in text
    assert "LPIPS" in text  # its column, or that it is left out
    assert len(json.loads(run(capsys, "compare", *both, "--json", "--split", "all"))["views"]) == 8
    assert json.loads(run(capsys, "compare", *both, "--json", "--views", "2"))["worst_view"] == "view_2"


def test_compare_with_itself_is_valid_json(scene_path, cameras_path, capsys):
    report = json.loads(run(capsys, "compare", scene_path, scene_path, "--cameras", cameras_path, "--json"))
    assert report["mean"]["b_against_a"] == {"psnr": None, "ssim": 1}
    assert "identical" in run(capsys, "compare", scene_path, scene_path, "--cameras", cameras_path)


def test_compare_without_cameras(scene_path, potr_path, capsys):
    assert cli.main(["compare", str(scene_path), str(potr_path)]) == 0
    captured = capsys.readouterr()
    assert "times smaller" in captured.out
    assert "8 virtual views of 800 x 800 pixels" in captured.err
    placed = [line for line in captured.err.splitlines() if "no --cameras" in line]
    assert len(placed) == 1
    report = json.loads(run(capsys, "compare", scene_path, potr_path, "--json", "--virtual-views", 2, "--size", 64))
    assert (report["a"]["splats"], report["b"]["splats"]) == (200, 200)
    assert [view["name"] for view in report["views"]] == ["virtual_000", "virtual_001"]
    assert all(25 < view["b_against_a"]["psnr"] < 70 for view in report["views"])
    turning = json.loads(run(capsys, "compare", scene_path, potr_path, "--json", "--turntable", 3, "--size", 64))
    assert [view["name"] for view in turning["views"]] == ["turntable_000", "turntable_001", "turntable_002"]
    one = run(capsys, "compare", scene_path, potr_path, "--turntable", 3, "--views", "1", "--size", 64)
    assert "turntable_001" in one
    assert "turntable_000" not in one
    fails(capsys, ["compare", scene_path, potr_path, "--truth", "x"], 2, "--cameras")


def test_compare_tells_sizes_where_there_is_no_device(scene_path, potr_path, capsys, monkeypatch):
    monkeypatch.setattr("potr_cl.cli.pictures.list_devices", list)
    assert cli.main(["compare", str(scene_path), str(potr_path)]) == 0
    captured = capsys.readouterr()
    assert "times smaller" in captured.out
    assert "virtual" not in captured.out
    assert "no OpenCL device" in captured.err
    assert set(json.loads(run(capsys, "compare", scene_path, potr_path, "--json"))) == {"a", "b", "size_ratio"}


def test_render_without_cameras_places_views(tmp_path, scene_path, capsys):
    assert cli.main(["render", str(scene_path), "-o", str(tmp_path / "around"), "--size", "40"]) == 0
    placed = [line for line in capsys.readouterr().err.splitlines() if "no --cameras" in line]
    assert len(placed) == 1
    assert "8 virtual views of 40 x 40 pixels" in placed[0]
    files = sorted((tmp_path / "around").iterdir())
    assert [file.name for file in files] == [f"virtual_{k:03d}.png" for k in range(8)]
    run(capsys, "render", scene_path, "-o", tmp_path / "turn", "--turntable", 5, "--size", 40, "--up=-y")
    files += sorted((tmp_path / "turn").iterdir())
    assert [file.name for file in files[8:]] == [f"turntable_{k:03d}.png" for k in range(5)]
    for file in files:
        with Image.open(file) as image:
            assert image.size == (40, 40)
            assert np.asarray(image).std() > 5, "the scene is in the picture"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--turntable", "0"], ["0 views"]),
        (["--virtual-views", "100000"], ["100000 views"]),
        (["--size", "0"], ["0 x 0"]),
        (["--size", "99999"], ["99999 x 99999"]),
        (["--up", "sideways"], ["'sideways' is no direction", "--up=x|y|z|-x|-y|-z"]),
        (["--up", "0,0,0"], ["'0,0,0' is no direction"]),
        (["--up", "nan,0,1"], ["is no direction"]),
    ],
)
def test_wrong_views_to_place(tmp_path, scene_path, cameras_path, capsys, options, words):
    render = ["render", scene_path, "-o", tmp_path / "out"]
    fails(capsys, [*render, *options], 2, *words)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("option", ["--turntable", "--virtual-views", "--up", "--size"])
def test_views_are_placed_only_without_cameras(tmp_path, scene_path, cameras_path, capsys, option):
    value = "z" if option == "--up" else "3"
    for command in (["render", scene_path, "-o", tmp_path / "out"], ["compare", scene_path, scene_path]):
        fails(capsys, [*command, "--cameras", cameras_path, option, value], 2, option, "without cameras")


def test_compare_picture(tmp_path, scene_path, potr_path, cameras_path, capsys):
    picture = tmp_path / "worst.png"
    text = run(capsys, "compare", scene_path, potr_path, "--cameras", cameras_path, "-o", picture)
    factor = int(text.split("difference times ")[1].split()[0])
    worst = text.split("worst view: ")[1].split(",")[0]
    a, b = (Rasterizer(Device(), load_scene(path)) for path in (scene_path, potr_path))
    view = next(camera for camera in load_cameras(cameras_path) if camera.name == worst)
    with Image.open(picture) as image:
        assert image.width == 3 * 64
        assert image.height > 64 + 20, "there are labels above the pictures"
        pixels = np.asarray(image)
        assert np.array_equal(pixels[-64:], side_by_side(a.render(view)[0], b.render(view)[0])[0])
        labels = pixels[:-64]
        assert labels.max() > 200
        assert all((labels[len(labels) // 2 :, k * 64 : (k + 1) * 64].max() > 200) for k in range(3))
        assert image.text["Description"] == (
            f"view {worst}: A, B and their difference times {factor}; A is scene.ply, B is scene.potr"
        )


def test_compare_with_ground_truth(tmp_path, scene_path, potr_path, cameras_path, capsys):
    """The uncompressed scene's own pictures as photographs: 8 bits are all that A loses."""
    photos = tmp_path / "photos"
    run(capsys, "render", scene_path, "--cameras", cameras_path, "-o", photos, "--background", "white")
    both = ["compare", scene_path, potr_path, "--cameras", cameras_path, "--background", "white"]
    mean = json.loads(run(capsys, *both, "--truth", photos, "--json"))["mean"]
    assert mean["a_against_truth"]["psnr"] > 55
    assert mean["b_against_truth"]["psnr"] == pytest.approx(mean["b_against_a"]["psnr"], abs=0.5)
    assert "loss by photo" in run(capsys, *both, "--truth", photos)

    picture = tmp_path / "worst.png"
    with_truth = [*both, "--truth", photos, "-o", picture]
    fails(capsys, [*both, "--truth", tmp_path / "nowhere"], 2, "nowhere")
    whole = (photos / "view_4.png").read_bytes()
    (photos / "view_4.png").write_bytes(whole[: len(whole) // 2])
    fails(capsys, with_truth, 1, "view_4.png", "damaged")
    Image.new("RGB", (32, 64)).save(photos / "view_4.png")
    fails(capsys, with_truth, 2, "32 x 64", "64 x 64")
    assert not picture.exists()
    (photos / "view_4.png").unlink()
    assert "view 'view_4' has no photograph" in run(capsys, *with_truth)


def test_compare_bad_calls(tmp_path, scene_path, potr_path, cameras_path, capsys):
    call = ["compare", scene_path, potr_path, "--cameras", cameras_path]
    fails(capsys, ["compare", scene_path, tmp_path / "none.potr"], 2, "none.potr")
    fails(capsys, ["compare", scene_path, potr_path, "--cameras", tmp_path / "none.json"], 2, "none.json")
    fails(capsys, [*call, "-o", tmp_path], 2, "it is a directory")
    fails(capsys, [*call, "--device", "77"], 1, "'77'")
    fails(capsys, [*call, "--views", "nobody"], 2, "'nobody'")
    potr_path.write_bytes(potr_path.read_bytes()[:-20])
    fails(capsys, [*call, "-o", tmp_path / "worst.png"], 1, str(potr_path))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cameras.json", "scene.ply", "scene.potr"]


# ------------------------------------------------------------------------------------------ refit


@pytest.fixture
def dimmed_path(tmp_path, scene_path):
    """The scene with darker colours, and coefficients that are 0."""
    scene = load_scene(scene_path)
    scene.sh[:, 0] *= np.float32(0.8)
    scene.sh[:, 1:] = 0
    scene.sh[::2, 1] = 0.01
    ply.save(tmp_path / "dimmed.ply", scene)
    return tmp_path / "dimmed.ply"


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


def test_refit_bad_calls(tmp_path, scene_path, cameras_path, capsys):
    out = tmp_path / "out.ply"
    refit = ["refit", scene_path, "--reference", scene_path, "--cameras", cameras_path, "-o", out]
    for option, value in (("--steps", -1), ("--prior", -1), ("--lambda", "nan"), ("--drop", "inf"), ("--memory", -1)):
        fails(capsys, [*refit, f"{option}={value}"], 2)
    fails(capsys, ["refit", scene_path, "--reference", tmp_path / "none.ply", *refit[4:]], 2, "none.ply")
    assert not out.exists()


# ------------------------------------------------------------------------------------------ devices


def test_devices(capsys):
    report = json.loads(run(capsys, "devices", "--json"))
    assert [entry["index"] for entry in report] == list(range(len(list_devices())))
    assert [entry["name"] for entry in report if entry["chosen"]] == [Device().info.name]
    lines = [line for line in run(capsys, "devices").splitlines() if "cannot compile anything: " not in line]
    assert len(lines) == 1 + len(report)
    assert [line.startswith("*") for line in lines[1:]] == [entry["chosen"] for entry in report]


def test_devices_check(capsys, monkeypatch):
    """What can compile computes right on this machine; what cannot is passed over, and only marked."""
    assert cli.main(["devices", "--check", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert [entry["check"] == "passed" for entry in report] == [entry["fault"] is None for entry in report]

    def broken(self):
        raise DeviceError("1 + 1 is 3")

    monkeypatch.setattr(Device, "self_check", broken)
    assert cli.main(["devices", "--check"]) == 1
    captured = capsys.readouterr()
    assert "\n*!" in captured.out
    assert "self-check: 1 + 1 is 3" in captured.out
    assert captured.err.startswith("potr-cl: ")
    assert captured.err.endswith("none works\n")


@pytest.mark.parametrize(
    ("checks", "code", "said"),
    [
        (["passed", "wrong"], 0, ""),
        (["wrong", "passed"], 1, "choose another with --device: 1"),
        (["wrong", "wrong"], 1, "none works"),
    ],
)
def test_devices_check_fails_if_the_one_to_be_taken_does(capsys, monkeypatch, checks, code, said):
    entry = json.loads(run(capsys, "devices", "--json"))[0] | {"fault": None}
    entries = [entry | {"index": i, "chosen": i == 0, "check": check} for i, check in enumerate(checks)]
    monkeypatch.setattr("potr_cl.cli.devices.device_report", lambda check: entries)
    assert cli.main(["devices", "--check"]) == code
    captured = capsys.readouterr()
    assert said in captured.err
    marks = [line[:2].strip() for line in captured.out.splitlines() if line[2:3].isdigit()]
    assert marks == [("*" if i == 0 else "") + ("" if check == "passed" else "!") for i, check in enumerate(checks)]


def test_no_device(capsys, monkeypatch):
    monkeypatch.setattr("potr_cl.opencl.discovery.list_devices", list)
    fails(capsys, ["devices"], 1, "no OpenCL device found")


def test_encode_to_ground_truth(tmp_path, scene_path, capsys):
    """Photographs that are darker than the scene: the file comes nearer to them than the scene is."""
    cameras_path, photos, out = cameras_json(tmp_path / "cameras.json"), tmp_path / "photos", tmp_path / "out.potr"
    run(capsys, "render", scene_path, "--cameras", cameras_path, "-o", photos)
    for photo in photos.iterdir():
        with Image.open(photo) as image:
            darker = image.point(lambda value: value * 0.8)
        darker.save(photo)
    encode = ["encode", scene_path, "-o", out, "--cameras", cameras_path, "--iterations", "2", "--no-quality"]
    said = run(capsys, *encode, "--photos", photos)
    before, after = (
        float(value) for value in re.findall(r"([\d.]+) dB", said.split("photos ")[1].split("PSNR")[1])[:2]
    )
    assert after > before + 3
    assert "those fitted to photographs are kept" in said
    (photos / "view_4.png").unlink()
    page = tmp_path / "page.html"
    report = json.loads(run(capsys, *encode[:-1], "--photos", photos, "--json", "--report", page))["photographs"]
    assert report["held_out"]["kept"]
    assert report["missing"] == "view 'view_4' has no photograph and is left out"
    assert report["file"] > report["uncompressed"] + 3
    shown = page.read_text()
    assert ", photograph" in shown
    assert "colours fitted to the others reach" in shown
    assert f"potr-cl encode {scene_path} -o" in shown
    fails(capsys, [*encode, "--photos", photos, "--refit", "off"], 2, "--photos", "re-fit")
    fails(capsys, ["encode", scene_path, "-o", out, "--photos", photos], 2, "--photos", "--cameras")
    fails(capsys, [*encode, "--photos", tmp_path / "nowhere"], 2, "nowhere")
