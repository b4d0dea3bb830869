"""Labels of pictures: they are there, can be told apart and read, cover nothing, and are those of the report."""

from __future__ import annotations

import numpy as np
import pytest

from potr_cl.quality.compare import side_by_side
from potr_cl.report.html import PicturePair, html_report
from potr_cl.report.labels import comparison_picture, contact_sheet, difference_label, labelled, view_label


def picture(height: int, width: int, level: int = 60) -> np.ndarray:
    return np.full((height, width, 3), level, np.uint8)


def ink(strip: np.ndarray) -> np.ndarray:
    """(H, W) where there are letters."""
    return strip.min(axis=-1) > 120


@pytest.mark.parametrize(("height", "width"), [(8, 12), (64, 64), (742, 990)])
def test_pictures_stay_as_they_are_below_their_labels(height, width):
    pictures = [picture(height, width, level) for level in (30, 60, 90)]
    made = labelled([(each, name) for each, name in zip(pictures, "ABC", strict=True)], "the heading")
    assert made.shape[1:] == (3 * width, 3)
    assert made.dtype == np.uint8
    assert np.array_equal(made[-height:], np.concatenate(pictures, axis=1))
    assert made.shape[0] > height


@pytest.mark.parametrize("width", [40, 400])
def test_every_picture_has_its_own_label_readably(width):
    made = labelled([(picture(width, width), name) for name in ("A", "B", "")])
    strip = made[:-width]
    letters = [ink(strip[:, k * width : (k + 1) * width]) for k in range(3)]
    assert letters[0].any()
    assert letters[1].any()
    assert not letters[2].any(), "a picture without a label has none"
    assert not np.array_equal(letters[0], letters[1])
    rows = np.flatnonzero(letters[0].any(axis=1))
    assert 7 <= len(rows) <= 30, "capital letters of 7 pixels can be read"
    columns = np.flatnonzero(letters[0].any(axis=0))
    assert columns[-1] < width - 1, "the label stays above its picture"


def test_the_longest_text_that_fits_is_taken():
    def of(width: int) -> np.ndarray:
        return labelled([(picture(100, width), ["a rather long label that says it all", "short"])])[:-100]

    wide, narrow = of(400), of(60)
    short = labelled([(picture(100, 60), "short")])[:-100]
    assert np.array_equal(narrow, short)
    assert ink(wide).any(axis=0).sum() > 3 * ink(narrow).any(axis=0).sum()
    # What fits nowhere is cut, but not lost.
    cut = labelled([(picture(100, 60), "a label without a shorter form")])[:-100]
    assert ink(cut).any()
    assert np.flatnonzero(ink(cut).any(axis=0))[-1] < 60


@pytest.mark.parametrize("text", ["\x1b[31mred", "Bild ä", "図", "line\nline", "‮reversed", "x" * 5000])
def test_names_that_others_chose_do_no_harm(text):
    made = labelled([(picture(50, 200), text)])
    plain = labelled([(picture(50, 200), "A")])
    assert made.shape == plain.shape
    assert ink(made[:-50]).any()


def test_letters_with_accents_are_shown_without():
    with_accent, without = (labelled([(picture(50, 200), text)])[:-50] for text in ("Zürich", "Zurich"))
    assert np.array_equal(with_accent, without)


def test_a_comparison_is_the_same_pictures_with_labels():
    a = np.random.default_rng(0).random((64, 80, 3)).astype(np.float32)
    b = np.clip(a + 0.01, 0, 1)
    made, factor = comparison_picture(a, b, "view_4", 38.25, ("scene.ply", "scene.potr"))
    below, factor_below = side_by_side(a, b)
    assert factor == factor_below
    assert np.array_equal(made[-64:], below)
    other, _ = comparison_picture(a, b, "view_5", 38.25, ("scene.ply", "scene.potr"))
    assert not np.array_equal(made, other), "the view's name is in the picture"
    another, _ = comparison_picture(a, b, "view_4", 31.25, ("scene.ply", "scene.potr"))
    assert not np.array_equal(made, another), "the PSNR is in the picture"


def test_the_report_says_the_same():
    a = np.random.default_rng(0).random((16, 16, 3)).astype(np.float32)
    b = np.clip(a + 0.1, 0, 1)
    report = {
        "source": {"file": "a.ply", "bytes": 100, "splats": 2},
        "file": "a.potr", "bytes": 10, "ratio": 10.0, "splats": 1, "bytes_a_splat": 10.0, "properties": {"other": 10},
        "quality": "not judged", "pruning": None, "search": None, "options": {}, "parameters": {}, "device": None,
        "seconds": {}, "versions": {},
    }  # fmt: skip
    page = html_report(report, [PicturePair("worst view", "view_4", 20.5, a, b)])
    assert f"<h3>worst view: {view_label('view_4', 20.5)}</h3>" in page
    factor = comparison_picture(a, b, "v", 20.5)[1]
    assert f"<figcaption>{difference_label(factor)}: white is {round(255 / factor)} of 255 or more</figcaption>" in page
    assert view_label("view_4", 20.5) == "view_4, PSNR 20.50 dB"
    assert view_label("view_4", None) == "view_4, identical"


@pytest.mark.parametrize("count", [1, 4, 6])
def test_a_contact_sheet_holds_all_pictures(count):
    pictures = [(picture(300, 600, 40 + 20 * k), f"view_{k}") for k in range(count)]
    sheet = contact_sheet(pictures, "a heading")
    columns = min(count, 4)
    assert sheet.shape[1] == columns * 320
    levels = {int(level) for level in np.unique(sheet[:, :, 0])}
    assert {40 + 20 * k for k in range(count)} <= levels
    assert sheet.shape[0] > -(-count // columns) * 160


def test_a_contact_sheet_of_pictures_of_several_sizes():
    sheet = contact_sheet([(picture(40, 20, 200), "tall"), (picture(20, 40, 220), "wide"), (picture(1, 1, 240), "dot")])
    assert sheet.shape[1] == 3 * 40
    assert {200, 220, 240} <= set(np.unique(sheet[-40:]).tolist())
