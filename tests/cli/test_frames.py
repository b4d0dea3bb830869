"""Cameras in another frame, on the command line: refused where something is thrown away, else a warning."""

from __future__ import annotations

from pathlib import Path

import pytest

from potr_cl.cli import main
from potr_cl.formats.scenes import ply
from tests.reference.frames import MOTIONS, moved


@pytest.fixture(scope="module")
def turned(tmp_path_factory, plush_excerpt) -> Path:
    """The excerpt as ``splat-transform -r 180,0,0`` leaves it."""
    path = tmp_path_factory.mktemp("frames") / "turned.ply"
    ply.save(path, moved(plush_excerpt, *MOTIONS["turned by 180 degrees about x"]))
    return path


@pytest.mark.parametrize("command", ["encode", "prune", "compact", "refit", "fit"])
def test_what_throws_away_refuses(command, turned, data, tmp_path, capsys):
    output = tmp_path / ("out.potr" if command == "encode" else "out.ply")
    more = ["--reference", str(turned)] if command in ("refit", "fit") else []
    cameras = str(data / "plush_excerpt_cameras.json")
    assert main([command, str(turned), "--cameras", cameras, "-o", str(output), *more]) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    for part in ("not seem to be in the scene's frame", "turned by 180 degrees about x", "--cameras-anyway"):
        assert part in said
    assert not output.exists()


def test_whoever_wants_them_anyway_gets_them(turned, data, tmp_path, capsys):
    output = tmp_path / "out.potr"
    given = [
        "--cameras",
        str(data / "plush_excerpt_cameras.json"),
        "--cameras-anyway",
        "--preset",
        "fast",
        "--iterations",
        "2",
    ]
    assert main(["encode", str(turned), "-o", str(output), *given]) == 0
    assert output.exists()


@pytest.mark.parametrize("command", ["render", "compare"])
def test_what_only_looks_warns(command, turned, data, tmp_path, capsys):
    cameras = ["--cameras", str(data / "plush_excerpt_cameras.json")]
    scene = str(data / "plush_excerpt.ply")
    if command == "render":
        calls = [[command, each, "--views", "0", "4", "8", "11", "-o", str(tmp_path)] for each in (str(turned), scene)]
    else:
        calls = [[command, each, scene, "--split", "all"] for each in (str(turned), scene)]
    for call, warned in zip(calls, (True, False), strict=True):
        assert main([*call, *cameras]) == 0
        assert ("warning" in capsys.readouterr().err) == warned
