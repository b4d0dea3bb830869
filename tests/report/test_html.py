"""The web page: complete, self-contained, safe against hostile names, the same every time."""

from __future__ import annotations

import base64
import copy
import io
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from potr_cl.formats.images import to_8_bits
from potr_cl.pipeline.target import KINDS
from potr_cl.report.html import PicturePair, html_report, views_to_show

HOSTILE = "<script>alert('1')</script>&\"${title}$"


def view(name, psnr, ssim=0.9):
    return {"name": name, "psnr": psnr, "ssim": ssim}


def step(left, effect, largest):
    return {"left": left, "importance": 0.1, "effect": effect, "largest_effect": largest}


REPORT = {
    "source": {"file": "a/scene.ply", "bytes": 58_161_747, "splats": 234_517, "sh_degree": 3},
    **{"file": "scene.potr", "bytes": 2_957_044, "ratio": 58_161_747 / 2_957_044, "splats": 155_721},
    "bytes_a_splat": 2_957_044 / 155_721,
    "properties": {"position": 1_000_000, "scale": 957_044, "colour: AC": 1_000_000},
    "quality": {
        **{"against": "the uncompressed scene", "kind": "test", "judged_by": "4 held-out test views"},
        **{"psnr": 44.0, "ssim": 0.9912, "worst": view("left", 40.125)},
        "views": [view("front", 46.0), view("left", 40.125), view("back", 45.0), view("right", None, 1.0)],
    },
    "pruning": {
        "iterations": 3,
        "history": [step(200_000, 1e-9, 1e-12), step(170_000, -3e-9, 1e-11), step(155_721, 5e-9, 1e-10)],
    },
    "search": None,
    "options": {"q": 0.5, "count": None, "sweep": {"turns": 1}, "background": [0.0, 0.5, 1.0], "lam": None},
    "parameters": {"lam": 0.316227766, "sf_sh": 51.0},
    "device": {"name": "Some GPU", "platform": "OpenCL", "version": "1.2"},
    "seconds": {"prune": 7.7, "total": 3.25},
    "versions": {"potr_cl": "0.1.0", "numpy": "2.0"},
}

RNG = np.random.default_rng(0)
BEFORE = RNG.random((20, 30, 3)).astype(np.float32)
AFTER = np.clip(BEFORE + np.float32(0.02) * RNG.normal(size=BEFORE.shape).astype(np.float32), 0, 1)
PAIRS = [PicturePair("worst view", "left", 40.125, BEFORE, AFTER)]


class Tags(HTMLParser):
    """Notes start tags with their attributes and checks that all are closed in order."""

    VOID = ("meta", "img", "input", "br")

    def __init__(self, page):
        super().__init__()
        self.tags = []
        self.open = []
        self.text = []
        self.feed(page)
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def with_name(report, name):
    report = copy.deepcopy(report)
    report["source"]["file"] = report["file"] = name
    report["quality"]["views"][0]["name"] = report["quality"]["worst"]["name"] = name
    report["device"]["name"] = name
    report["quality"]["judged_by"] = name
    report["versions"]["numpy"] = name
    report["options"]["sweep"]["turns"] = name
    return report


def test_page_says_what_the_report_says():
    page = Tags(html_report(REPORT, PAIRS))
    text = " ".join(page.text)
    parts = [
        "58.16 MB → 2.96 MB",
        "19.7 ×",
        "155,721",
        "44.00 dB",
        "0.9912",
        "957,044",
        "33.8 %",
        "40.12 dB",
        "(worst)",
    ]
    parts += ["identical", "78,796 of 234,517 splats removed in 3 iterations", "Some GPU", "0.316228", "3.2 s"]
    for part in parts:
        assert part in text, part


def test_nothing_is_loaded():
    page = html_report(REPORT, PAIRS)
    sources = [
        value
        for _, attributes in Tags(page).tags
        for name, value in attributes.items()
        if name in ("src", "href", "srcset", "data", "action")
    ]
    assert len(sources) == 3
    assert all(source.startswith("data:image/") for source in sources)
    assert "default-src 'none'" in page
    assert not re.search(r"https?:|@import|url\(", page)


def test_pictures_are_embedded_without_loss():
    sources = [attributes["src"] for tag, attributes in Tags(html_report(REPORT, PAIRS)).tags if tag == "img"]
    for source, expected in zip(sources[:2], (BEFORE, AFTER), strict=True):
        with Image.open(io.BytesIO(base64.b64decode(source.split(",")[1]))) as image:
            assert np.array_equal(np.asarray(image.convert("RGB")), to_8_bits(expected))


def test_names_cannot_break_out():
    plain, hostile = (
        Tags(html_report(with_name(REPORT, name), [PicturePair(name, name, 1.0, BEFORE, AFTER)]))
        for name in ("name", HOSTILE)
    )
    for a, b in zip(hostile.tags, plain.tags, strict=True):
        assert (a[0], sorted(a[1])) == (b[0], sorted(b[1]))
    assert HOSTILE in "".join(hostile.text)


def test_only_times_differ():
    slower = REPORT | {"seconds": {"prune": 9.5, "total": 99.0}}
    page, other = html_report(REPORT, PAIRS), html_report(slower, PAIRS)
    assert page == html_report(copy.deepcopy(REPORT), PAIRS)
    assert page.replace("7.7 s", "9.5 s").replace("3.2 s", "99.0 s") == other


@pytest.mark.parametrize(
    "change",
    [
        {"quality": "not judged: there are no cameras to look from"},
        {"pruning": None, "device": None},
        {"pruning": {"iterations": 1, "history": []}},
        {"pruning": {"iterations": 1, "history": REPORT["pruning"]["history"][1:2]}},
        {"ratio": 0.5},
        {
            "search": {
                "target": "at most 3,000,000 bytes",
                "reached": "2,957,044 bytes",
                "tries": [{"kind": kind, "q": 0.41, "value": 2957044, "said": "2,957,044 bytes"} for kind in KINDS],
            }
        },
    ],
)
def test_parts_that_may_be_missing(change):
    page = Tags(html_report(REPORT | change, []))
    assert "Some GPU" in " ".join(page.text) or change.get("device", 0) is None
    for value in change.values():
        if isinstance(value, str):
            assert value in page.text


def test_sizes_and_stages_as_people_say_them():
    report = copy.deepcopy(REPORT) | {"bytes": 196_123}
    report["options"]["fit"] = {"on": True, "steps": 0, "cycles": 2}
    text = " ".join(Tags(html_report(report, PAIRS)).text)
    assert "196.12 kB" in text
    assert "cycles" not in text


def test_views_to_show():
    for chosen, wanted in (
        ("right", [("chosen view", "right"), ("typical view", "back"), ("worst view", "left")]),
        ("left", [("chosen view, worst view", "left"), ("typical view", "back")]),
    ):
        assert [(title, entry["name"]) for title, entry in views_to_show(REPORT["quality"], chosen)] == wanted
    assert views_to_show(REPORT["quality"], None)[-1][0] == "first view"
    one = {"views": [view("only", None)]}
    assert views_to_show(one, None) == [("typical view, worst view, first view", view("only", None))]


def test_pictures_that_are_too_wide_for_webp():
    """The page is the last thing that an encode makes: the file is there already."""
    for shape in ((2, 16_384, 3), (16_384, 2, 3)):
        wide = np.linspace(0, 1, int(np.prod(shape)), dtype=np.float32).reshape(shape)
        page = html_report(REPORT, [PicturePair("worst view", "left", 40.0, wide, wide * np.float32(0.5))])
        sources = re.findall(r'src="data:image/(\w+);base64,([^"]*)"', page)
        assert [kind for kind, _ in sources] == ["png"] * 3
        with Image.open(io.BytesIO(base64.b64decode(sources[0][1]))) as image:
            assert np.array_equal(np.asarray(image), to_8_bits(wide))


def test_names_that_cannot_be_written_are_shown_as_escapes():
    report = copy.deepcopy(REPORT)
    report["source"]["file"] = report["file"] = report["device"]["name"] = "odd\udcff\x1b[31m\u202e"
    page = html_report(report, [PicturePair("worst view", "a\ud800\x07", 40.0, BEFORE, BEFORE)])
    page.encode("utf-8")
    assert "odd\\udcff\\x1b[31m\\u202e" in page
    assert "a\\ud800\\x07" in page
    assert all(line.isprintable() for line in page.replace("\t", " ").split("\n"))
