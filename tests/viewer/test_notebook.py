"""A viewer in a notebook: its page, or a still."""

from __future__ import annotations

import base64
import html
import io

import numpy as np
import pytest
from PIL import Image

import potr_cl
from potr_cl.model.camera import Camera
from potr_cl.viewer.notebook import notebook_bundle

pytestmark = pytest.mark.one_runtime
PICTURE = np.full((50, 80, 3), 90, np.uint8)


def test_the_still_is_there_and_the_page_is_hidden_until_it_lives():
    bundle = notebook_bundle('Viewer(<b>"x"</b>)', "http://127.0.0.1:1/", PICTURE)
    still = np.asarray(Image.open(io.BytesIO(base64.b64decode(bundle["image/jpeg"]))))
    assert abs(still.astype(int) - 90).max() <= 2
    page = bundle["text/html"]
    assert bundle["image/jpeg"] in page
    assert 'src="http://127.0.0.1:1/"' in page
    assert "display:none" in page.split("<iframe")[1].split(">")[0]
    assert '<b>"x"</b>' not in page
    assert html.escape('Viewer(<b>"x"</b>)') in page


def test_where_there_is_no_page_the_still_alone_and_where_no_device_the_words():
    assert set(notebook_bundle("closed", None, PICTURE)) == {"text/plain", "image/jpeg"}
    assert notebook_bundle("closed", None, None) == {"text/plain": "closed"}


def test_scenes_and_comparisons_show_themselves(plush_excerpt, plush_excerpt_cameras):
    pytest.importorskip("viser", reason="the extra view is not installed")
    with potr_cl.view(plush_excerpt, cameras=plush_excerpt_cameras) as viewer:
        bundle = viewer._repr_mimebundle_()
        assert viewer.url in bundle["text/html"]
        still = np.asarray(Image.open(io.BytesIO(base64.b64decode(bundle["image/jpeg"]))))
        assert still.std() > 5
    assert "text/html" not in viewer._repr_mimebundle_(), "it is closed"
    fewer = plush_excerpt.subset(np.arange(700))
    compared = potr_cl.compare(plush_excerpt, fewer, plush_excerpt_cameras)
    with compared.show() as viewer:
        assert [len(viewer.session.exhibit(which).scene) for which in "AB"] == [1500, 700]
        assert isinstance(viewer.losses.views[0], Camera)
