"""Pictures of many views written to a folder: packed by threads, in order, few at a time."""

from __future__ import annotations

import runpy
import sys
import threading
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

import potr_cl
from potr_cl import UsageError
from potr_cl.api import pictures
from potr_cl.api.pictures import Rendering, written_pictures
from potr_cl.formats.images import to_8_bits
from potr_cl.opencl.device import Device
from potr_cl.raster.rasterizer import Rasterizer
from tests.reference.scenes import random_scene, ring_of_cameras

CAMERAS = ring_of_cameras(12)


@pytest.fixture
def rasterizer():
    with Rasterizer(Device(), random_scene(80, 1)) as rasterizer:
        yield rasterizer


@pytest.mark.parametrize("waiting", [1, 1 << 29])
def test_all_are_written_in_order_whatever_may_wait(rasterizer, tmp_path, monkeypatch, waiting):
    monkeypatch.setattr(pictures, "_WAITING", waiting)
    paths = [tmp_path / f"{number}.png" for number in range(len(CAMERAS))]
    for number, path in enumerate(written_pictures(rasterizer, CAMERAS, paths)):
        assert path == paths[number]
        with Image.open(path) as image:
            assert np.array_equal(np.asarray(image), to_8_bits(rasterizer.render(CAMERAS[number])[0]))
    assert number == len(CAMERAS) - 1
    assert sorted(tmp_path.iterdir()) == sorted(paths)


def test_others_are_rendered_while_one_is_packed(rasterizer, tmp_path, monkeypatch):
    """The second picture may be written only once the first one waits for it."""
    second = threading.Event()
    save = Rendering.save

    def noted(self, path):
        if path.name == "0.png":
            assert second.wait(300), "nothing else is packed meanwhile"
        else:
            second.set()
        save(self, path)

    monkeypatch.setattr(Rendering, "save", noted)
    monkeypatch.setattr(pictures.os, "cpu_count", lambda: 2)
    paths = [tmp_path / f"{number}.png" for number in range(3)]
    assert list(written_pictures(rasterizer, CAMERAS[:3], paths)) == paths


def test_a_picture_that_cannot_be_written_is_told(rasterizer, tmp_path):
    with pytest.raises(UsageError, match="does not exist"):
        list(written_pictures(rasterizer, CAMERAS[:3], [tmp_path / "no" / f"{number}.png" for number in range(3)]))


@pytest.mark.parametrize(
    ("view", "elsewhere", "windows"),
    [
        ("left/0001", "left_0001", "left_0001"),
        ("2026-01-01T12:00:00", "2026-01-01T12:00:00", "2026-01-01T12_00_00"),
        ('a<b>"c|d?*', 'a<b>"c|d?*', "a_b__c_d__"),
        ("C:\\x", "C:\\x", "C__x"),
        ("con", "con", "_con"),
        ("NUL.left", "NUL.left", "_NUL.left"),
        ("com1 ", "com1 ", "_com1 "),
        ("console", "console", "console"),
        ("grüße", "grüße", "grüße"),
    ],
)
def test_names_of_views_as_names_of_files(view, elsewhere, windows):
    assert pictures.file_name(view, windows=False) == elsewhere
    assert pictures.file_name(view, windows=True) == windows


def test_a_notebook_shows_a_scene_as_a_picture(monkeypatch):
    """Arrays know nothing of rendering: the package tells the notebook, when it is imported there."""
    formatters = pytest.importorskip("IPython.core.formatters")
    shell = SimpleNamespace(display_formatter=formatters.DisplayFormatter())
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
    runpy.run_path(potr_cl.__file__)
    shown, _ = shell.display_formatter.format(random_scene(50))
    assert shown["image/png"].startswith(b"\x89PNG")
