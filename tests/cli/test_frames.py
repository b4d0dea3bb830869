"""Cameras in another frame, on the command line: refused where something is thrown away, else a warning."""

from __future__ import annotations

import pytest

from potr_cl.cli import main
from potr_cl.formats.scenes import ply
from tests.cli.calls import fails
from tests.reference.frames import MOTIONS, moved


@pytest.fixture(scope="module")
def turned(tmp_path_factory, plush_excerpt):
    """The excerpt as ``splat-transform -r 180,0,0`` leaves it."""
    path = tmp_path_factory.mktemp("frames") / "turned.ply"
    ply.save(path, moved(plush_excerpt, *MOTIONS["turned by 180 degrees about x"]))
    return path


@pytest.mark.parametrize("command", ["encode", "prune", "compact", "refit", "fit"])
def test_what_throws_away_refuses(command, turned, data, tmp_path, capsys):
    output = tmp_path / ("out.potr" if command == "encode" else "out.ply")
    more = ["--reference", turned] if command in ("refit", "fit") else []
    call = [command, turned, "--cameras", data / "plush_excerpt_cameras.json", "-o", output, *more]
    fails(capsys, call, 2, "not seem to be in the scene's frame", "turned by 180 degrees about x", "--cameras-anyway")
    assert not output.exists()
    if command == "encode":
        few = ["--cameras-anyway", "--preset", "fast", "--iterations", "2"]
        assert main([*map(str, call), *few]) == 0
        assert output.exists()


@pytest.mark.parametrize("command", ["render", "compare"])
def test_what_only_looks_warns(command, turned, data, tmp_path, capsys):
    scene, views = data / "plush_excerpt.ply", ["--views", "0", "4", "8", "11"]
    for each in (turned, scene):
        call = [command, each, *([scene] if command == "compare" else ["-o", tmp_path]), *views]
        assert main([*map(str, call), "--cameras", str(data / "plush_excerpt_cameras.json")]) == 0
        assert ("warning" in capsys.readouterr().err) == (each == turned)
