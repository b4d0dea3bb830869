"""Calls of the command line, and what a failed one must look like."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from potr_cl import cli
from tests.reference.scenes import ring_of_cameras

ROOT = Path(__file__).parents[2]
#: Options of an encode that keeps everything, and so looks at no views.
KEEP = ["--no-prune", "--no-compact", "--refit", "off"]


def cameras_json(path: Path, count: int = 8, size: int = 64) -> Path:
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
        for number, camera in enumerate(ring_of_cameras(count, size=size))
    ]
    path.write_text(json.dumps(views))
    return path


def fails(capsys, arguments, code, *words) -> None:
    """One clear line on standard error, the exit code, no traceback."""
    assert cli.main([str(a) for a in arguments]) == code
    err = capsys.readouterr().err
    lines = [line for line in err.splitlines() if line.startswith("potr-cl: ")]
    assert len(lines) == 1, err
    assert "Traceback" not in err
    for word in words:
        assert word in lines[0]


def refused(capsys, call: str, *words: str) -> None:
    """A wrong call of words in a line: one line is all that is said, and the current folder stays as it is."""
    before = contents(Path())
    assert cli.main(call.split()) == 2
    out, err = capsys.readouterr()
    assert err.startswith("potr-cl: ")
    assert (out, err.count("\n")) == ("", 1)
    assert any(word in err for word in words), err
    assert contents(Path()) == before


def contents(folder: Path) -> dict[str, bytes | None]:
    """All that lies in a folder."""
    return {str(path): path.read_bytes() if path.is_file() else None for path in sorted(folder.rglob("*"))}


def run(capsys, *arguments) -> str:
    """Standard output of a command that succeeds."""
    code = cli.main([str(a) for a in arguments])
    captured = capsys.readouterr()
    assert code == 0, captured.err
    return captured.out


def program(*words: object, shell: str = '"$@"', **how: Any) -> subprocess.CompletedProcess[Any]:
    """The program in a process of its own; "$@" of a shell's line stands for it and its arguments."""
    command = [sys.executable, "-m", "potr_cl", *map(str, words)]
    how = {"cwd": ROOT, "capture_output": True, "text": True, "timeout": 300, "check": False} | how
    how["env"] = os.environ | {"PYTHONPATH": str(ROOT)} | how.get("env", {})
    return subprocess.run(command if shell == '"$@"' else ["bash", "-c", shell, "bash", *command], **how)
