"""Every way to ask for an encode, and every way to be told of it."""

from __future__ import annotations

import json

import pytest

from potr_cl import cli
from potr_cl.formats import save_scene
from tests.cli.calls import cameras_json
from tests.reference.scenes import random_scene

#: What may be asked for, one at a time; {photos} is a folder of photographs.
ASKED = {
    "nothing": "",
    "photos": "--photos {photos}",
    "no pruning": "--no-prune",
    "no re-fit": "--refit off",
    "compaction": "--refit off --compact",
    "nothing that looks": "--no-prune --refit off --no-compact",
    "paper": "--preset paper",
    "fast": "--preset fast",
    "re-fits on the way": "--refit-at 0.5",
    "unseen": "--unseen drop",
    "antialiased": "--antialiased yes",
}
#: And how it is told.
TOLD = ["", "--json", "--no-quality --json", "--report {page}", "--report {page} --json"]
#: Each way to ask is told in one way, in turn, and what asks for nothing in each. The first are quick.
TOLD_IN_TURN = [(asked, TOLD[number % len(TOLD)]) for number, asked in enumerate(ASKED)][2:]
PAIRS = [*(("nothing", told) for told in TOLD[2:]), ("photos", TOLD[-1]), *TOLD_IN_TURN]


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pairs")
    scene, cameras, photos = folder / "scene.ply", cameras_json(folder / "cameras.json"), folder / "photos"
    save_scene(scene, random_scene(120, 2))
    assert cli.main(["render", str(scene), "--cameras", str(cameras), "-o", str(photos)]) == 0
    return {"scene": scene, "cameras": cameras, "photos": photos}


@pytest.mark.one_runtime
@pytest.mark.parametrize(
    ("asked", "told"), [pytest.param(*pair, marks=[pytest.mark.slow][: n > 3]) for n, pair in enumerate(PAIRS)]
)
def test_what_is_asked_and_told(given, tmp_path, asked, told, capsys):
    out, page = tmp_path / "out.potr", tmp_path / "page.html"
    words = f"encode {given['scene']} -o {out} --cameras {given['cameras']} {ASKED[asked]} {told}"
    words = words.format(photos=given["photos"], page=page).split()
    words += ["--iterations", "2"] if "--no-prune" not in words else []
    assert cli.main(words) == 0, capsys.readouterr().err
    captured = capsys.readouterr()
    assert out.stat().st_size > 0
    if "--json" in words:
        report = json.loads(captured.out)
        assert report["bytes"] == out.stat().st_size
        assert (report["photographs"] is None) == (asked != "photos")
        assert isinstance(report["quality"], str) == ("--no-quality" in words)
    else:
        assert str(out) in captured.out
    assert page.exists() == ("--report" in words)
