"""The decoder for browsers (web/) in Node: its own tests, and that it says of any file what Python says.

``python -m tools.make.web`` builds it; where it is not built, or no Node is there, these tests are skipped.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import subprocess
from pathlib import Path

import pytest

import potr_cl
from potr_cl.pipeline.options import EncodeOptions
from tests.cases.web import GOLDEN, WEB, judged
from tests.reference.file_parts import sealed
from tests.reference.scenes import random_scene

NODE = shutil.which("node")
#: Changed files of each golden one; more by the same variable as in Node.
CHANGES = int(os.environ.get("POTR_FUZZ", "12"))

pytestmark = [
    pytest.mark.one_family,
    pytest.mark.skipif(NODE is None, reason="there is no Node"),
    pytest.mark.skipif(
        not all((WEB / "dist" / name).exists() for name in ("potr.js", "potr.wasm", "potr-simd.wasm")),
        reason="the decoder for browsers is not built: python -m tools.make.web",
    ),
]


def run(*arguments: str) -> str:
    assert NODE is not None
    done = subprocess.run([NODE, *arguments], cwd=WEB, capture_output=True, text=True, timeout=900, check=False)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
    return done.stdout


def test_its_own_tests() -> None:
    run("--test", *(str(path.relative_to(WEB)) for path in sorted((WEB / "test").glob("*.test.mjs"))))


@pytest.mark.parametrize("preset", ["best", "paper"])
@pytest.mark.parametrize("build", ["simd", "general"])
def test_large_sections(build: str, preset: str, tmp_path: Path) -> None:
    """Zstandard frames of many blocks, and many bundles, the last one of which is not whole."""
    options = EncodeOptions.for_preset(preset).changed(prune=False, refit=False, compact=False)
    encoded = potr_cl.encode(random_scene(50_001, degree=2, seed=3), None, options)
    encoded.save(tmp_path / "large.potr")
    assert json.loads(run("test/judge.mjs", build, str(tmp_path / "large.potr"))) == [judged(encoded.data)]


def changed(data: bytes, chance: random.Random) -> bytes:
    out = bytearray(data)
    place = chance.randrange(min(len(out), 400) if chance.random() < 0.4 else len(out))
    for _ in range(chance.randint(1, 3)):
        out[(place + chance.randrange(16)) % len(out)] = chance.choice([0, 1, 127, 128, 255, chance.randrange(256)])
    return sealed(bytes(out)) if chance.random() < 0.8 else bytes(out)


def frame_differs(ours: str, theirs: str) -> bool:
    """Whether a Zstandard frame was changed and summed anew: decoders differ in which of these they refuse, and how."""
    frames = ("decompress", "describes its contexts at an impossible length", "describes impossible contexts")
    return "does not decompress" in theirs or any(words in ours for words in frames)


@pytest.mark.parametrize("build", ["simd", "general"])
def test_says_what_python_says(build: str, tmp_path: Path) -> None:
    chance = random.Random(5)
    files = [path.read_bytes() for path in GOLDEN]
    files += [changed(data, chance) for data in files for _ in range(CHANGES)]
    names = []
    for number, data in enumerate(files):
        names.append(tmp_path / f"{number}.potr")
        names[-1].write_bytes(data)
    found = json.loads(run("test/judge.mjs", build, *map(str, names)))
    differ = [
        (path.name, ours, theirs)
        for path, data, ours in zip(names, files, found, strict=True)
        if ours != (theirs := judged(data))
    ]
    wrong = [each for each in differ if not frame_differs(*each[1:])]
    assert found[: len(GOLDEN)] == [judged(data) for data in files[: len(GOLDEN)]]
    assert not wrong, json.dumps(wrong, indent=1)
    assert len(differ) < len(files) / 10, json.dumps(differ, indent=1)
    assert sum(" " in words for words in found) > len(files) / 4, "hardly a change was noticed"
