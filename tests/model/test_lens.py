"""Lens distortion: the formulas against COLMAP's own library, and the pinhole views that stand for photographs."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from potr_cl import Camera, DataError
from potr_cl.model.camera import within_photographs
from potr_cl.model.lens import Lens, Pinhole, coverings

WIDTH, HEIGHT = 640, 480
#: COLMAP's name of a model, its parameters, and the same lens.
MODELS: list[tuple[str, tuple[float, ...], dict[str, Any]]] = [
    ("SIMPLE_RADIAL", (500, 320, 240, -0.1), {"radial": (-0.1,)}),
    ("RADIAL", (500, 320, 240, 0.1, -0.05), {"radial": (0.1, -0.05)}),
    (
        "OPENCV",
        (500, 510, 310, 250, -0.2, 0.05, 0.001, -0.002),
        {"radial": (-0.2, 0.05), "tangential": (0.001, -0.002)},
    ),
    (
        "FULL_OPENCV",
        (500, 510, 310, 250, -0.2, 0.05, 0.001, -0.002, 0.01, 0.02, 0.003, 0.004),
        {"radial": (-0.2, 0.05, 0.01), "quotient": (0.02, 0.003, 0.004), "tangential": (0.001, -0.002)},
    ),
    ("OPENCV_FISHEYE", (300, 310, 310, 250, -0.02, 0.005, 0.001, -0.002), {"radial": (-0.02, 0.005, 0.001, -0.002)}),
    ("SIMPLE_RADIAL_FISHEYE", (300, 320, 240, -0.02), {"radial": (-0.02,)}),
    ("RADIAL_FISHEYE", (300, 320, 240, -0.02, 0.01), {"radial": (-0.02, 0.01)}),
    (
        "THIN_PRISM_FISHEYE",
        (300, 310, 310, 250, -0.02, 0.005, 0.001, -0.002, 0.001, 0.002, 0.003, -0.001),
        {"radial": (-0.02, 0.005, 0.001, 0.002), "tangential": (0.001, -0.002), "prism": (0.003, -0.001)},
    ),
]


def lens_of(model: str, params: tuple[float, ...], rest: dict[str, Any]) -> Lens:
    two = not model.startswith(("SIMPLE_", "RADIAL"))
    fx, fy, cx, cy = params[:4] if two else (params[0], params[0], *params[1:3])
    return Lens(WIDTH, HEIGHT, fx, fy, cx, cy, fisheye="FISHEYE" in model, **rest)


LENSES = [pytest.param(lens_of(*each), id=each[0]) for each in MODELS]


@pytest.mark.parametrize(("model", "params", "rest"), MODELS, ids=[each[0] for each in MODELS])
def test_the_formulas_are_colmaps(model, params, rest):
    pycolmap = pytest.importorskip("pycolmap")
    theirs = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=params)
    lens = lens_of(model, params, rest)
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (1000, 2))
    wanted = theirs.img_from_cam(np.column_stack([points, np.ones(1000)]))
    u, v = lens.distorted(*points.T)
    assert np.abs(np.stack([u * lens.fx + lens.cx, v * lens.fy + lens.cy], axis=1) - wanted).max() < 1e-9
    back, found = lens.undistorted(u, v)
    assert found.all()
    assert np.abs(back.T - points).max() < 1e-9


def around(width: int, height: int, inset: float) -> np.ndarray[Any, Any]:
    """(2, N) points of a picture along its border, and so far within."""
    x, y = np.linspace(inset, width - inset, 399), np.linspace(inset, height - inset, 399)
    sides = [(x, 0 * x + inset), (x, 0 * x + height - inset), (0 * y + inset, y), (0 * y + width - inset, y)]
    return np.concatenate(sides, axis=1)


@pytest.mark.parametrize("lens", LENSES)
def test_a_view_covers_what_was_photographed_and_a_photograph_fills_another(lens):
    view, whole = lens.covering()
    columns, rows = around(lens.width, lens.height, 0)
    points, found = lens.undistorted((columns - lens.cx) / lens.fx, (rows - lens.cy) / lens.fy)
    assert whole == found.all() == (not lens.fisheye)
    columns, rows = points[0] * view.fx + view.cx, points[1] * view.fy + view.cy
    slack = 1e-3 if whole else 1  # where it is cut off: between the points that are looked at
    assert columns[found].min() >= -slack
    assert columns[found].max() <= view.width + slack
    assert rows[found].min() >= -slack
    assert rows[found].max() <= view.height + slack
    # And not much more: nothing on any side could be cut off.
    assert view.width * view.height <= 2.01 * lens.width * lens.height
    if whole:
        assert columns.min() < 2
        assert rows.max() > view.height - 2
    assert lens.fills(view) is False

    view = lens.within()
    columns, rows = around(view.width, view.height, 0.5)
    u, v = lens.distorted((columns - view.cx) / view.fx, (rows - view.cy) / view.fy)
    assert (u * lens.fx + lens.cx).min() >= 0
    assert (u * lens.fx + lens.cx).max() <= lens.width
    assert (v * lens.fy + lens.cy).min() >= 0
    assert (v * lens.fy + lens.cy).max() <= lens.height
    assert lens.fills(view)
    assert view.width * view.height > 0.7 * lens.width * lens.height


def test_a_field_of_more_than_half_the_world_is_cut_off():
    lens = Lens(1000, 1000, 290, 290, 500, 500, fisheye=True)  # 197 degrees from side to side
    view, whole = lens.covering()
    assert not whole
    half = math.degrees(math.atan(view.width / 2 / view.fx))
    assert half == pytest.approx(60, abs=0.2)
    assert view.width * view.height <= 2.01e6


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"radial": (math.nan,)}, "coefficient"),
        ({"radial": (1e9,)}, "coefficient"),
        ({"radial": (-20.0,)}, "folds the picture over"),
        ({"radial": (-5.0, 1.0), "fisheye": True}, "folds the picture over"),
        ({"quotient": (30.0,)}, "folds the picture over"),
        ({"fx": 0.0}, "are not a camera's"),
        ({"fx": 5e-324, "radial": (0.1,)}, "are not a camera's"),
        ({"fy": 1e-300, "fisheye": True}, "are not a camera's"),
        ({"cy": math.inf}, "are not a camera's"),
        ({"cx": -3.0}, "principal point"),
        ({"tangential": (500.0, 0.0)}, "folds the picture over"),
    ],
)
def test_what_is_no_lens(changes, said):
    with pytest.raises(DataError, match=said):
        Lens(**({"width": 640, "height": 480, "fx": 500, "fy": 500, "cx": 320, "cy": 240} | changes)).covering()


def test_many_lenses_are_looked_at_together():
    """Each is found as it is alone, to the last digit, whatever is beside it."""
    lenses = [lens_of(*each) for each in MODELS]
    lenses += [replace(lens, fx=lens.fx + shift) for lens in lenses for shift in (0.5, 31)]
    folded = replace(lenses[1], radial=(-20.0, 1.0))
    found = coverings([*lenses, folded])
    assert found[:-1] == [lens.covering() for lens in lenses]
    assert isinstance(found[-1], DataError)


def test_only_views_with_a_lens_are_changed():
    lens = Lens(WIDTH, HEIGHT, 500, 500, 320, 240, radial=(-0.1,))
    pose = {"rotation": np.eye(3), "translation": np.zeros(3)}
    plain = Camera("a", 64, 48, 50, 50, 32, 24, **pose)
    bent = Camera("b", **lens.covering()[0]._asdict(), **pose, lens=lens)
    kept, changed = within_photographs([plain, bent])
    assert kept is plain
    assert (changed.width, changed.height) < (bent.width, bent.height)
    assert lens.fills(Pinhole(changed.width, changed.height, changed.fx, changed.fy, changed.cx, changed.cy))
    assert within_photographs([changed])[0].width == changed.width
    assert (plain.photograph_size, bent.photograph_size) == ((64, 48), (640, 480))
