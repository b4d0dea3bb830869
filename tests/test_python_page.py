"""docs/python.md and the examples: their code runs, in the order of the page, and prints what they say."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

import potr_cl

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"
NOTEBOOKS = sorted(EXAMPLES.glob("*.ipynb"))
EACH_NOTEBOOK = pytest.mark.parametrize("notebook", NOTEBOOKS, ids=[path.name for path in NOTEBOOKS])
#: Bytes of a notebook with its pictures, beyond which a clone of the repository would notice.
MOST_BYTES = 500_000


@pytest.fixture
def clone(tmp_path, data, monkeypatch) -> Path:
    """A folder in which the data are where they are in a clone, and in which anything may be written."""
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "data").symlink_to(data)
    (tmp_path / "examples").mkdir()
    for file in EXAMPLES.iterdir():
        (tmp_path / "examples" / file.name).symlink_to(file)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def expected(code: str) -> list[str]:
    return re.findall(r"# -> (.+)$", code, re.MULTILINE)


def run(code: str, names: dict[str, object], name: str) -> str:
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(code, name, "exec"), names)
    return printed.getvalue()


def check_printed(code: str, printed: str) -> None:
    """Each line that the code promises is printed, in this order; … stands for anything."""
    at = 0
    for line in expected(code):
        pattern = ".*?".join(map(re.escape, line.strip().split("…")))
        found = re.compile(rf"^{pattern}", re.MULTILINE).search(printed, at)
        assert found, f"not printed: {line}\nbut: {printed[at:]}"
        at = found.end()


@pytest.mark.slow
def test_the_code_of_the_page_runs(clone):
    page = (ROOT / "docs" / "python.md").read_text("utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    assert len(blocks) > 10
    names: dict[str, object] = {"__name__": "__main__"}
    for number, block in enumerate(blocks):
        check_printed(block, run(block, names, f"docs/python.md, block {number}"))
    assert {"excerpt.potr", "report.html", "worst.png", "pictures"} <= {path.name for path in clone.iterdir()}


@pytest.mark.slow
@EACH_NOTEBOOK
def test_a_notebook_runs_in_jupyter(notebook, clone, monkeypatch):
    nbformat = pytest.importorskip("nbformat")
    nbclient = pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    document = nbformat.read(notebook, as_version=4)
    committed = scenes_shown(document)
    client = nbclient.NotebookClient(document, timeout=300, resources={"metadata": {"path": str(clone / "examples")}})
    # The kernel is another process, which is to find this clone's package.
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")])))
    client.execute()
    kinds = {kind for cell in document.cells for output in cell.get("outputs", []) for kind in output.get("data", {})}
    assert {"image/png", "text/plain"} <= kinds
    assert scenes_shown(document) == committed != [], "the outputs are of another scene: run the notebook anew"


def scenes_shown(document) -> list[str]:
    """Scenes that are a cell's last expression, which are read and do not depend on the device."""
    outputs = [output for cell in document.cells for output in cell.get("outputs", [])]
    texts = ["".join(output.get("data", {}).get("text/plain", [])) for output in outputs]
    return [text for text in texts if text.startswith("Scene(")]


@EACH_NOTEBOOK
def test_a_notebook_is_committed_with_small_outputs(notebook):
    cells = json.loads(notebook.read_text("utf-8"))["cells"]
    outputs = [output for cell in cells if cell["cell_type"] == "code" for output in cell["outputs"]]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not any(output["output_type"] == "error" for output in outputs)
    assert notebook.stat().st_size < MOST_BYTES
    kinds = ("text/plain", "text/html")
    texts = [output.get("data", {}).get(kind, []) for output in outputs for kind in kinds]
    said = ["".join(text) for text in [*texts, *(output.get("text", []) for output in outputs)]]
    assert any(said)
    assert not [text for text in said if re.search(r"(?<![\w/:.<])/[a-z]+/\w", text)], "it names a machine's folders"


def test_there_are_examples():
    assert NOTEBOOKS
    listed = (EXAMPLES / "README.md").read_text("utf-8")
    for file in EXAMPLES.iterdir():
        assert file.name == "README.md" or f"({file.name})" in listed, f"examples/README.md does not list {file.name}"


@pytest.mark.slow
def test_the_bundled_scene_shows_something():
    scene = potr_cl.read_scene(EXAMPLES / "playbot.sog")
    assert (len(scene), scene.sh_degree) == (31_000, 2)
    (picture,) = potr_cl.render(scene, turntable=1, size=128)
    assert picture.pixels.std() > 20
    assert "CC BY 4.0" in (EXAMPLES / "README.md").read_text("utf-8")


@pytest.mark.slow
def test_quality_ladder(clone, monkeypatch, capsys):
    scene, cameras = "tests/data/plush_excerpt.ply", "tests/data/plush_excerpt_cameras.json"
    monkeypatch.setattr(sys, "argv", ["quality_ladder.py", scene, cameras, "--preset", "fast", "--steps", "2"])
    runpy.run_path(str(EXAMPLES / "quality_ladder.py"), run_name="__main__")
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "q,bytes,splats,psnr,ssim"
    rows = [[float(value) for value in line.split(",")] for line in lines[1:]]
    assert [row[0] for row in rows] == [0.0, 1.0]
    for worse, better in zip(*(np.array(row)[[1, 3, 4]] for row in rows), strict=True):
        assert worse < better, "better is larger"
