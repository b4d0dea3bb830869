"""Calls of the command line, and what a failed one must look like."""

from __future__ import annotations

import json
from pathlib import Path

from potr_cl import cli
from tests.reference.scenes import ring_of_cameras

#: Options of an encode that keeps everything, and so looks at no views.
KEEP = ["--no-prune", "--no-compact", "--refit", "off"]


def cameras_json(path: Path, count: int = 8) -> Path:
    """Write that many cameras around the origin."""
    views = [
        {
            "id": number,
            "img_name": camera.name,
            "width": camera.width,
            "height": camera.height,
            "position": camera.centre.tolist(),
            "rotation": camera.rotation.T.tolist(),
            "fx": camera.fx,
            "fy": camera.fy,
            "split": camera.split,
        }
        for number, camera in enumerate(ring_of_cameras(count))
    ]
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


def run(capsys, *arguments) -> str:
    """Standard output of a command that succeeds."""
    code = cli.main([str(a) for a in arguments])
    captured = capsys.readouterr()
    assert code == 0, captured.err
    return captured.out
