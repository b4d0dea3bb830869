"""Encoding to SOG."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import potr_cl
from potr_cl import encode, load_scene
from potr_cl.codec.quantize import HyperParameters
from potr_cl.formats.scenes import sog
from potr_cl.formats.scenes.sog_values import areas
from potr_cl.opencl.device import Device
from potr_cl.outputs.output import Request
from potr_cl.outputs.sog import Sog
from potr_cl.outputs.sog_geometry import rounded_geometry
from potr_cl.quality.evaluator import EvaluationViews, Evaluator
from tests.devices import FAMILIES, open_device


def parameters(q):
    return HyperParameters.from_quality(q, "best")


@pytest.fixture(scope="module", params=FAMILIES)
def device(request):
    return open_device(request.param)


def written(tmp_path, scene, request):
    """What is read of a file, in the scene's order, and what the output said that would be read."""
    output = Sog()
    rounded, sh = output.prepared(scene, None, request)
    coded = output.file(replace(scene, sh=sh), rounded, request)
    (tmp_path / "a.sog").write_bytes(b"".join(coded.pieces))
    back = sog.load(tmp_path / "a.sog")
    places = np.empty_like(coded.order)
    places[coded.order] = np.arange(len(places))
    return back.subset(places), rounded.decoded(sh)


def test_readers_see_what_the_colours_are_fitted_on(tmp_path, plush_excerpt, device):
    back, said = written(tmp_path, plush_excerpt.rendered(True), Request(parameters(0.5), device=device))
    assert back.antialiased
    assert np.abs(back.sh[:, 0] - said.sh[:, 0]).mean() < 0.05
    back.sh[:, 0] = said.sh[:, 0]
    assert back == said


@pytest.mark.parametrize(("splats", "degree"), [(300, 0), (300, 1), (300, 2), (1, 3), (2, 3), (9, 3)])
def test_lower_degrees_and_hardly_any_splats(tmp_path, plush_excerpt, device, splats, degree):
    scene = replace(plush_excerpt, sh=plush_excerpt.sh[:, : (degree + 1) ** 2])[:splats]
    back, _ = written(tmp_path, scene, Request(parameters(0.5), device=device))
    assert back.sh.shape == scene.sh.shape


def test_coarser_steps_are_the_same_ones_less_often(plush_excerpt):
    distances = np.full(len(plush_excerpt), 3.0)
    errors, kinds = [], []
    for q in (0.2, 0.5, 0.9):
        found = rounded_geometry(plush_excerpt, parameters(q), distances)
        errors.append(np.abs(found.seen(plush_excerpt).means - plush_excerpt.means).mean())
        kinds.append(
            len(np.unique(found.steps)) + len(np.unique(found.scales)) + len(np.unique(found.quaternions[:, 0]))
        )
        assert np.array_equal(np.sort(found.order), np.arange(len(plush_excerpt)))
    assert errors[0] > errors[1] > errors[2]
    assert kinds[0] < kinds[1] < kinds[2]


def test_far_splats_are_rounded_more(plush_excerpt):
    distances = np.where(np.arange(len(plush_excerpt)) % 2, 0.5, 50.0)
    seen = rounded_geometry(plush_excerpt, parameters(0.5), distances).seen(plush_excerpt)
    errors = np.abs(seen.means - plush_excerpt.means).mean(axis=1)
    assert errors[::2].mean() > 10 * errors[1::2].mean()


@pytest.mark.slow
def test_a_higher_quality_is_larger_and_better(tmp_path, plush_excerpt, plush_excerpt_cameras):
    usual, files, psnrs = Device(), [], []
    with Evaluator(usual, plush_excerpt, EvaluationViews.of(plush_excerpt_cameras), (0, 0, 0)) as evaluator:
        for q in (0.3, 0.5, 0.5, 0.8):
            path = tmp_path / f"{q}.sog"
            files.append(encode(plush_excerpt, plush_excerpt_cameras, q=q, output=path, device=usual).data)
            psnrs.append(evaluator.psnr(load_scene(path)))
            assert path.read_bytes() == files[-1]
    assert files[1] == files[2], "not the same bytes every time"
    assert len(files[0]) < len(files[1]) < len(files[3])
    assert psnrs[0] < psnrs[1] < psnrs[3]
    assert psnrs[1] > 40


def test_without_stages_that_look_at_views_and_bytes_by_what_they_are_for(tmp_path, plush_excerpt):
    encoded = encode(plush_excerpt, q=0.5, output=tmp_path / "a.sog", prune=False, refit="off", compact=False)
    back = load_scene(tmp_path / "a.sog").subset(np.argsort(encoded.order))
    errors = np.abs(back.sh - plush_excerpt.sh)
    assert errors[:, 0].mean() < 1 / 31  # a step of the constant coefficients
    covered = areas(plush_excerpt)[:, None, None]
    assert (errors[:, 1:] * covered).sum() < 0.3 * (np.abs(plush_excerpt.sh[:, 1:]) * covered).sum()
    properties = Sog().properties(encoded.data)
    assert len(properties) == 6
    assert min(properties.values()) > 0
    assert sum(properties.values()) == encoded.nbytes


def test_options_of_other_formats_are_refused(tmp_path, plush_excerpt):
    with pytest.raises(potr_cl.UsageError, match="entropy"):
        encode(plush_excerpt, q=0.5, output=tmp_path / "a.sog", prune=False, refit="off", entropy="zstd")
