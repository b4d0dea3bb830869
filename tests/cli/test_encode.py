"""The command encode, and what decode and info make of its files."""

from __future__ import annotations

import json
import re

import pytest
from PIL import Image

import potr_cl
from potr_cl import cli
from potr_cl.errors import DeviceError, UsageError
from potr_cl.formats import load_scene
from potr_cl.formats.scenes import ply
from potr_cl.opencl.device import Device
from potr_cl.pipeline.target import size_in_bytes
from tests.cli.calls import KEEP, ROOT, fails, run
from tests.reference.scenes import random_scene, ring_of_cameras


@pytest.fixture
def excerpt(data):
    """Arguments that encode a real excerpt fast."""
    return ["encode", data / "plush_excerpt.ply", "--cameras", data / "plush_excerpt_cameras.json", "--iterations", "2"]


@pytest.fixture
def encode(tmp_path, scene_path, cameras_path):
    """A short encode to a.potr."""
    return ["encode", scene_path, "-o", tmp_path / "a.potr", "--cameras", cameras_path, "--iterations", "2"]


def test_encode_decode_info(tmp_path, scene_path, cameras_path, capsys):
    potr, back = tmp_path / "a.potr", tmp_path / "back.ply"
    encode = ["encode", scene_path, "-o", potr, "-q", "0.7", *KEEP]
    assert "200 of 200" in run(capsys, *encode, "--cameras", cameras_path)
    run(capsys, "decode", potr, "-o", back)
    assert len(ply.load(back)) == 200
    report = json.loads(run(capsys, "info", potr, "--json"))
    assert (report["splats"], report["sh_degree"], report["q"], report["cameras"]) == (200, 2, 0.7, "given")
    assert sum(s["bytes"] for s in report["sections"].values()) == report["bytes"] == potr.stat().st_size
    assert report["source_bytes"] == scene_path.stat().st_size
    assert report["ply_bytes"] == pytest.approx(back.stat().st_size, rel=0.05)
    text = run(capsys, "info", potr)
    assert "colour: AC degree 2" in text
    assert "rotation" in text
    run(capsys, *encode)
    assert json.loads(run(capsys, "info", potr, "--json"))["cameras"] is None


def test_encode_tells_what_it_did(encode, scene_path, cameras_path, capsys):
    potr = encode[3]
    encode += ["--count", "90", "--preset", "paper"]
    report = json.loads(run(capsys, *encode, "--json"))
    page = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (`.*?) \|", page.split("## What `encode --json` prints")[1].split("\n## ")[0], re.MULTILINE)
    assert sorted(re.findall(r"`(\w+)`", " ".join(rows))) == sorted(report), "every key is documented"
    assert (report["bytes"], report["source"]["bytes"]) == (potr.stat().st_size, scene_path.stat().st_size)
    assert report["ratio"] == report["source"]["bytes"] / report["bytes"]
    assert (report["splats"], report["source"]["splats"]) == (90, 200)
    assert sum(report["properties"].values()) == report["bytes"]
    assert report["pruning"]["history"][-1]["left"] == 90
    stages = ["prepare views", "prune", "compact", "octree", "entropy coding", "evaluate", "total"]
    assert list(report["seconds"]) == stages
    assert sum(report["seconds"][stage] for stage in stages[:-1]) <= report["seconds"]["total"]
    assert report["device"]["name"] == Device().info.name

    judged = json.loads(run(capsys, "compare", scene_path, potr, "--cameras", cameras_path, "--json"))
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


@pytest.mark.slow
def test_encode_to_a_size(tmp_path, excerpt, capsys):
    potr = tmp_path / "a.potr"
    assert cli.main([*map(str, excerpt), "--preset", "fast", "-o", str(potr), "--max-size", "20 kB", "--json"]) == 0
    said = capsys.readouterr()
    report = json.loads(said.out)
    assert 19_600 <= potr.stat().st_size == report["bytes"] <= 20_000
    assert report["search"]["target"] == "at most 20,000 bytes"
    assert report["search"]["max_bytes"] == 20_000
    assert report["search"]["tries"][-1]["value"] == report["bytes"]
    assert report["search"]["reached"] == f"{report['bytes']:,} bytes"
    assert said.err.count("the cameras were taken as they are") == 1


def test_encode_to_the_impossible(tmp_path, scene_path, capsys):
    encode = ["encode", scene_path, "-o", tmp_path / "a.potr", "--max-size", "1k", *KEEP]
    fails(capsys, encode, 1, "cannot reach at most 1,000 bytes: quality 0 gives", "quality 1")
    assert [path.name for path in tmp_path.iterdir()] == ["scene.ply"]


@pytest.mark.parametrize(
    ("text", "size"),
    [("1234567", 1_234_567), ("8MB", 8_000_000), ("8 MiB", 8 << 20), ("800k", 800_000), ("1.5e6", 1_500_000),
     ("2 gib", 2 << 30), ("0.5GB", 500_000_000), ("12_000 B", 12_000), ("3Ki", 3072)],
)  # fmt: skip
def test_sizes_as_people_write_them(text, size):
    assert size_in_bytes(text) == size


@pytest.mark.parametrize("text", ["8", "1.5", "99 "])
def test_a_size_without_its_unit(text):
    with pytest.raises(UsageError, match=f"would be {text.strip()} bytes: give a unit, as in {text.strip()}MB"):
        size_in_bytes(text)


def test_encode_report_page(tmp_path, encode, capsys):
    page = tmp_path / "page.html"
    report = json.loads(run(capsys, *encode, "--report", page, "--report-view", "view_4", "--json"))
    text = page.read_text()
    worst = report["quality"]["worst"]["name"]
    assert f"worst view: {worst}" in text or f"chosen view, worst view: {worst}" in text
    assert re.search("chosen view.*: view_4", text)
    assert text.count("<img") == 3 * len(re.findall("<h3>[^<]* view", text)) > 0
    run(capsys, *encode, "--report", page, "--no-quality")
    assert "not judged, as asked" in page.read_text()
    page.unlink()
    fails(capsys, [*encode, "--report", page, "--report-view", "nobody"], 2, "no view 'nobody'", "'view_0'")
    fails(capsys, [*encode, "--report-view", "view_4"], 2, "--report")
    assert not page.exists()


def test_encode_judges_by_training_views_if_there_are_no_others(encode, cameras_path, capsys):
    """And says where these are few: not where each part of the scene is shown by many."""
    train = [view for view in json.loads(cameras_path.read_text()) if view["split"] == "train"]
    more = [
        view | {"id": 10 * turn + view["id"], "img_name": f"{turn}_{n}"}
        for turn in range(4)
        for n, view in enumerate(train)
    ]
    for views, few in ((train, True), (more, False)):
        cameras_path.write_text(json.dumps(views))
        text = run(capsys, *encode)
        assert f"all {len(views)} training views, for the cameras name no test views" in text
        assert ("is shown by no more than 2 of them" in text) == few


def test_a_device_that_fails_while_judging_leaves_the_file(encode, capsys, monkeypatch):
    def fail(*_args, **_named):
        raise DeviceError("device 'X' vanished")

    monkeypatch.setattr("potr_cl.api.encoder.Evaluator", fail)
    assert "not judged: device 'X' vanished" in run(capsys, *encode)
    assert load_scene(encode[3])


@pytest.mark.slow
def test_without_cameras_virtual_ones_are_placed(tmp_path, scene_path, capsys):
    potr = tmp_path / "a.potr"
    few = ["--iterations", "2", "--virtual-views", "8", "--count", "90"]
    assert cli.main(["encode", str(scene_path), "-o", str(potr), *few]) == 0
    said = capsys.readouterr()
    assert "no --cameras given: 8 virtual views and 1 to judge by, " in said.err
    assert "1 held-out virtual view" in said.out
    assert "place cameras" in said.out
    assert json.loads(run(capsys, "info", potr, "--json"))["cameras"] == "virtual"
    for command, options in (("prune", few), ("compact", few[2:4])):
        assert cli.main([command, str(scene_path), "-o", str(tmp_path / "out.ply"), *options]) == 0
        assert "8 virtual views" in capsys.readouterr().err
        assert len(ply.load(tmp_path / "out.ply")) == (90 if command == "prune" else 200)


def test_a_scene_too_large_to_quantise(tmp_path, capsys):
    scene = random_scene(5, 0)
    scene.sh[2] = 1e30
    ply.save(tmp_path / "scene.ply", scene)
    fails(capsys, ["encode", tmp_path / "scene.ply", "-o", tmp_path / "a.potr", *KEEP], 1, "too large to quantise")
    assert not (tmp_path / "a.potr").exists()


def test_encode_to_ground_truth(tmp_path, scene_path, cameras_path, encode, capsys):
    """Photographs that are darker than the scene: the file comes nearer to them than the scene is."""
    photos, page = tmp_path / "photos", tmp_path / "page.html"
    run(capsys, "render", scene_path, "--cameras", cameras_path, "-o", photos)
    for photo in photos.iterdir():
        with Image.open(photo) as image:
            darker = image.point(lambda value: value * 0.8)
        darker.save(photo)
    (photos / "view_4.png").unlink()
    report = json.loads(run(capsys, *encode, "--photos", photos, "--json", "--report", page))["photographs"]
    assert report["held_out"]["kept"]
    assert report["missing"] == "view 'view_4' has no photograph and is left out"
    assert report["file"] > report["uncompressed"] + 3
    shown = page.read_text()
    assert ", photograph" in shown
    assert "colours fitted to the others reach" in shown
    assert f"potr-cl encode {scene_path} -o" in shown
    said = run(capsys, *encode, "--no-quality", "--photos", photos)
    for part in (f"PSNR {report['uncompressed']:.2f} dB", f"{report['file']:.2f} dB", "fitted to photographs are kept"):
        assert part in said
    fails(capsys, [*encode, "--photos", photos, "--refit", "off"], 2, "--photos", "re-fit")
    fails(capsys, [*encode[:4], "--photos", photos], 2, "--photos", "--cameras")


@pytest.mark.parametrize("asked", ["--no-prune", "--refit off --compact", "--refit-at 0.5", "--unseen drop"])
def test_what_is_left_out_is_left_out_of_the_page_too(encode, tmp_path, asked, capsys):
    page = tmp_path / "page.html"
    encode = encode if asked != "--no-prune" else encode[:6]
    report = json.loads(run(capsys, *encode, *asked.split(), "--report", page, "--json"))
    assert report["bytes"] == encode[3].stat().st_size
    assert (report["pruning"] is None) == (asked == "--no-prune")
    assert ("refit" in report["seconds"]) == ("--refit off" not in asked)
    assert "</html>" in page.read_text()


@pytest.mark.parametrize("name", ["encode", "encode_ladder", "prune", "compact", "refit", "fit"])
def test_virtual_views_beside_cameras_are_refused_from_python(tmp_path, name):
    scene, cameras = random_scene(20, 0), ring_of_cameras(4)
    more = {"encode_ladder": (tmp_path, "0.5"), "refit": (scene,), "fit": (scene,)}.get(name, ())
    with pytest.raises(UsageError, match="for scenes without cameras"):
        getattr(potr_cl, name)(scene, *more, cameras, virtual_views=8)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_few_cameras_are_told_where_held_out_views_suffer(tmp_path, data, capsys):
    """Not where training views show what held-out ones show."""
    scene, every = data / "plush_excerpt.ply", json.loads((data / "plush_excerpt_cameras.json").read_text())
    training = [camera for camera in every if camera["split"] == "train"]
    few = [*training[:1], *(dict(camera, split="test") for camera in training[4:])]
    same = [*training, *(dict(camera, id=100 + n, split="test") for n, camera in enumerate(training))]
    told, gap = [], []
    for name, cameras in (("few", few), ("same", same)):
        path = tmp_path / f"{name}.json"
        path.write_text(json.dumps(cameras))
        arguments = ["encode", scene, "--cameras", path, "--iterations", "4", "-q", "0.3", "-o", tmp_path / "a.potr"]
        arguments += ["--preset", "fast"]
        told.append("the held-out views are matched" in run(capsys, *arguments))
        quality = json.loads(run(capsys, *arguments, "--json"))["quality"]
        assert quality["training"]["views"] == (1 if name == "few" else 4)
        assert (quality["training"]["said"] is not None) == told[-1]
        gap.append(quality["training"]["psnr"] - quality["psnr"])
    assert told == [True, False], gap
    assert gap[0] > 6 > gap[1]
