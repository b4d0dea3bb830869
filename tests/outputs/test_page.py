"""Pages that hold a scene: what encode and convert write, and what reads it."""

from __future__ import annotations

import base64
import gzip
import json
from pathlib import Path

import numpy as np
import pytest

import potr_cl
from potr_cl.cli import main
from potr_cl.errors import DataError, UsageError
from potr_cl.formats.scenes import page as pages
from potr_cl.outputs.potr import Page, Potr
from potr_cl.pipeline.options import EncodeOptions

pytestmark = [pytest.mark.one_family, pytest.mark.one_runtime]
#: The page without the viewer's program, which takes Node to build.
SOURCE = Path(__file__).parents[2] / "web" / "src" / "page" / "page.html"


@pytest.fixture(autouse=True)
def template(tmp_path_factory, monkeypatch):
    path = tmp_path_factory.mktemp("template") / "page.html"
    viewer = base64.b64encode(gzip.compress(b"the program", mtime=0)).decode()
    path.write_text(SOURCE.read_text("utf-8").replace("@viewer@", viewer), "utf-8")
    monkeypatch.setattr(pages, "TEMPLATE", path)
    return path


def test_holds_what_a_potr_file_holds_and_loads_nothing_from_elsewhere(plush_excerpt, template, tmp_path):
    options = {"prune": False, "refit": False, "compact": False}
    whole, alone = (
        potr_cl.encode(plush_excerpt, None, EncodeOptions(output=output).changed(**options))
        for output in (Page(), Potr())
    )
    inner = pages.scene_in(whole.data)
    assert len(inner) == alone.nbytes
    scene = potr_cl.load_scene(_written(tmp_path / "a.html", whole.data))
    assert np.array_equal(scene.means, potr_cl.decode(inner).means)
    assert sum(Page().properties(whole.data).values()) == len(whole.data)
    assert Page().properties(whole.data)["viewer"] == template.stat().st_size
    assert pages.viewer_script() == b"the program"
    text = (tmp_path / "a.html").read_text("utf-8")
    assert "default-src 'none'" in text
    assert "@" not in text.split('<script id="viewer"')[0].replace("@media", "")


def test_needs_its_viewer(monkeypatch, tmp_path, data, capsys):
    monkeypatch.setattr(pages, "TEMPLATE", tmp_path / "none")
    with pytest.raises(UsageError, match=r"python -m tools.make.web"):
        Page()
    assert main(["convert", str(data / "golden_blocks.potr"), str(tmp_path / "a.html")]) == 2
    assert "python -m tools.make.web" in capsys.readouterr().err
    assert not any(tmp_path.iterdir())


def test_convert_takes_over_a_file_as_it_is(data, template, tmp_path, capsys):
    first, second, third = (tmp_path / f"{name}.html" for name in "abc")
    sound = data / "golden_bundles_antialiased.potr"
    assert main(["convert", str(sound), str(first)]) == 0
    assert f"{template.stat().st_size:,} of them the viewer" in capsys.readouterr().out
    assert pages.scene_in(first.read_bytes()) == sound.read_bytes()
    potr_cl.convert(first, second, title="Again")
    assert pages.scene_in(second.read_bytes()) == sound.read_bytes()
    broken = bytearray(sound.read_bytes())
    broken[-1] ^= 1
    assert main(["convert", str(_written(tmp_path / "b.potr", bytes(broken))), str(third)]) != 0
    assert not third.exists()


def test_convert_leaves_no_splat_out(data, plush_excerpt, tmp_path):
    path = tmp_path / "a.html"
    assert main(["convert", str(data / "plush_excerpt.ply"), "-o", str(path)]) == 0
    scene = potr_cl.load_scene(path)
    assert len(scene) == len(plush_excerpt)
    assert scene.sh_degree == plush_excerpt.sh_degree
    for found, wanted, most in (
        (scene.means, plush_excerpt.means, 0.01),
        (scene.opacities, plush_excerpt.opacities, 0.05),
        (scene.sh, plush_excerpt.sh, 0.1),
    ):
        assert np.abs(np.sort(found, axis=0) - np.sort(wanted, axis=0)).max() < most


def test_titles_are_text(data, tmp_path):
    path, title = tmp_path / "a.html", '</script><b>@about@ @scene@ & "x"\n\udc80'
    named = ["--title", title, "--author", "<Ada>"]
    assert main(["convert", str(data / "golden_blocks.potr"), str(path), *named]) == 0
    text = path.read_text("utf-8")
    shown = "&lt;/script&gt;&lt;b&gt;@about@ @scene@ &amp; &quot;x&quot;"
    assert f"<title>{shown}" in text
    assert '<meta name="author" content="&lt;Ada&gt;">' in text
    about = json.loads(text.split('type="application/json">')[1].split("</script>")[0])
    assert about["words"].startswith('</script><b>@about@ @scene@ & "x"')
    assert "by <Ada> · " in about["words"]
    assert pages.scene_in(path.read_bytes()) == (data / "golden_blocks.potr").read_bytes()


def test_only_pages_have_titles(data, tmp_path, capsys):
    assert main(["convert", str(data / "golden_blocks.potr"), str(tmp_path / "a.ply"), "--title", "x"]) == 2
    assert "PLY has no title to choose" in capsys.readouterr().err
    encode = ["encode", str(data / "plush_excerpt.ply"), "-o", str(tmp_path / "a.potr"), "--author", "x"]
    assert main(encode) == 2
    assert "has no author to choose" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"<html></html>", "no scene in it"),
        (pages.BEGIN + b"QUJD", "no scene in it"),
        (pages.BEGIN + b"QUJ" + pages.END, "cut off"),
        (pages.BEGIN + base64.b64encode(b"ply") + pages.END, "not a .potr file"),
    ],
)
def test_refuses_other_pages(content, words, tmp_path):
    path = _written(tmp_path / "a.html", content)
    with pytest.raises(DataError, match=words) as caught:
        potr_cl.load_scene(path)
    assert str(path) in str(caught.value)


def _written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path
