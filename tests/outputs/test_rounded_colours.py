"""Colours of .potr files: rounded in rounds by the re-fit, and what that brings over the nearest levels."""

from __future__ import annotations

import numpy as np
import pytest

import potr_cl
from potr_cl.codec.quantize import to_ycocg
from potr_cl.model.camera import test_views as held_out
from potr_cl.opencl.device import Device
from potr_cl.outputs.potr import Potr
from potr_cl.pipeline.encoded import Encoded
from potr_cl.pipeline.options import EncodeOptions
from tests.cases import judging


@pytest.fixture(scope="module")
def device():
    with_views = Device()
    yield with_views
    assert with_views.allocated == 0, "an encode did not give all its memory back"


@pytest.fixture
def encoded(plush_excerpt, plush_excerpt_cameras, device):
    return lambda: potr_cl.encode(plush_excerpt, plush_excerpt_cameras, EncodeOptions(), device=device)


def nearest_levels(sh: np.ndarray, steps: np.ndarray) -> np.ndarray:
    y, co, cg = to_ycocg(sh[:, 1:].reshape(-1, 3).astype(np.float64))
    step = np.repeat(steps.astype(np.float64), sh.shape[1] - 1)
    y, co, cg = (np.floor(channel / step + 0.5) * step for channel in (y, co, cg))
    rounded = sh.copy()
    rounded[:, 1:] = np.stack([y + co - cg, y + cg, y - co - cg], axis=-1).reshape(sh[:, 1:].shape)
    return rounded


@pytest.mark.slow
def test_less_error_at_no_more_bytes_than_with_the_nearest_levels(
    encoded, plush_excerpt, plush_excerpt_cameras, device, monkeypatch
):
    def psnr(file: Encoded) -> float:
        return judging.psnr(device, plush_excerpt, file.scene, held_out(plush_excerpt_cameras))

    rounds = encoded()

    def fix_ac(self, rounded, sh, worth, request):
        geometry, grid = self.colour_grid(rounded, worth[:, 0], request)
        return geometry, nearest_levels(sh, grid.others)

    monkeypatch.setattr(Potr, "fix_ac", fix_ac)
    monkeypatch.setattr(Potr, "on_grid", lambda self, request: False)
    plain = encoded()
    assert rounds.nbytes < 1.005 * plain.nbytes
    assert psnr(rounds) > psnr(plain) + 0.1


def test_the_file_holds_the_coefficients_of_the_refit(encoded):
    """They are on the file's grid already: nothing of what the rounds have chosen is rounded to another level."""
    file = encoded()
    assert file.refitted is not None
    splats = np.argsort(np.argsort(file.order))  # the re-fit's are in the order of the source
    decoded, left = file.scene.sh, file.refitted.sh[splats]
    assert np.abs(decoded[:, 1:] - left[:, 1:]).max() < 1e-5
