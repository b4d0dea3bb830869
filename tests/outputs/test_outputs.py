"""What an encode ends in: every kind of file is what its reader sees, and the colours are fitted on that."""

from __future__ import annotations

import dataclasses
import functools
import logging
from pathlib import Path

import numpy as np
import pytest

import potr_cl
from potr_cl.codec.quantize import HyperParameters, to_ycocg
from potr_cl.errors import UsageError
from potr_cl.formats import load_scene
from potr_cl.formats.scenes import sog
from potr_cl.model.camera import test_views as held_out
from potr_cl.model.camera import train_views
from potr_cl.model.scene import MIP_SPLATTING_LOW_PASS
from potr_cl.opencl.device import Device
from potr_cl.outputs.output import Output, Request
from potr_cl.outputs.potr import Page, Potr
from potr_cl.outputs.registry import OUTPUTS, output_of, output_of_suffix
from potr_cl.outputs.spz import Gltf, Spz
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.refitting.colour_refit import ColourRefit
from potr_cl.stages.refitting.refit_options import RefitOptions
from potr_cl.views.targets import RenderedTargets
from tests.cases import judging
from tests.cases.scenes import antialiased
from tests.reference.scenes import random_scene

#: A glTF file holds an SPZ file, so no whole encode ends in one here.
EVERY = [kind() for kind in OUTPUTS if kind not in (Page, Gltf)]
OTHERS = [*EVERY[1:], Gltf(), Spz(version=3), Spz(version=4)]


def name(output: Output) -> str:
    return output.suffix + str(getattr(output, "version", ""))


@pytest.fixture(scope="module")
def device():
    device = Device()
    yield device
    assert device.allocated == 0, "an encode did not give all its memory back"


@pytest.fixture(scope="module")
def encoded_to(plush_excerpt, plush_excerpt_cameras, device):
    """The excerpt, or another scene, encoded to a kind of output."""

    def encoded(output, scene=plush_excerpt, **changes):
        options = EncodeOptions(output=output).changed(**changes)
        return potr_cl.encode(scene, plush_excerpt_cameras, options, device=device)

    return encoded


@pytest.fixture(scope="module")
def encodes(encoded_to):
    """The same of the excerpt, as it comes, once to each."""
    return functools.cache(encoded_to)


@pytest.fixture(scope="module")
def psnr(plush_excerpt, plush_excerpt_cameras, device):
    """How close a scene comes to the excerpt, dB."""
    return lambda scene: judging.psnr(device, plush_excerpt, scene, held_out(plush_excerpt_cameras))


@pytest.mark.parametrize("output", EVERY, ids=name)
def test_the_file_is_what_its_reader_sees(output, encodes, plush_excerpt, tmp_path, psnr):
    encoded = encodes(output)
    path = tmp_path / f"file{output.suffix}"
    encoded.save(path)
    seen = load_scene(path)  # which need not be what the output says that it holds
    assert len(seen) == len(encoded.order) < len(plush_excerpt)
    # Splat by splat those of the source that are said to be there.
    near = plush_excerpt.subset(encoded.order)
    size = np.exp(np.median(near.log_scales.max(axis=1)))
    assert np.abs(seen.means - near.means).max() < size
    assert np.corrcoef(seen.opacities, near.opacities)[0, 1] > 0.99
    for field in ("means", "log_scales", "opacities", "sh"):
        assert np.allclose(getattr(encoded.scene, field), getattr(seen, field), rtol=1e-5, atol=2e-5), field
    assert psnr(seen) > 49


@pytest.mark.parametrize("output", OTHERS, ids=name)
@pytest.mark.parametrize("degree", [0, 3])
def test_geometry_and_fixed_coefficients_are_those_of_the_file(output, degree):
    scene = random_scene(700, degree).rendered(True)
    request = Request(HyperParameters.from_quality(0.5 if degree == 0 else 0.3, "best"))
    rounded = output.geometry(scene, request)
    worth = np.random.default_rng(1).lognormal(-20, 2, scene.sh.shape[:2]).astype(np.float32)
    before = scene.sh.copy()
    fixed, sh = output.fix_ac(rounded, scene.sh, worth, request)
    assert np.array_equal(scene.sh, before), "the re-fit still needs what it has handed out"
    coded = output.file(dataclasses.replace(scene, sh=sh), fixed, request)
    assert np.array_equal(coded.order, rounded.order)
    assert sorted(coded.order) == list(range(700))
    seen, told = output.read(b"".join(coded.pieces)), rounded.decoded(scene.sh).subset(rounded.order)
    for field in ("means", "log_scales", "opacities"):
        assert np.allclose(getattr(seen, field), getattr(told, field), rtol=1e-5, atol=2e-5), field
    same_turn = np.abs((seen.quaternions * told.quaternions).sum(axis=1))
    lengths = np.linalg.norm(seen.quaternions, axis=1) * np.linalg.norm(told.quaternions, axis=1)
    assert (same_turn / lengths).min() > 1 - 1e-5
    assert (seen.antialiased, told.antialiased) == (True, True)
    assert np.abs(seen.sh[:, 1:] - sh[coded.order, 1 : seen.sh.shape[1]]).max(initial=0) < 1e-6
    assert not sh[:, seen.sh.shape[1] :].any()
    alone = output.file(scene, None, request)
    whole = output.read(b"".join(alone.pieces))
    assert np.array_equal(alone.order, coded.order)
    assert np.array_equal(whole.means, seen.means)
    assert whole.sh.shape == scene.sh.shape


def test_sog_is_smaller_than_the_whole_scene_as_sog(encodes, plush_excerpt, tmp_path):
    sog.save(tmp_path / "whole.sog", plush_excerpt)
    assert 2.5 * encodes(output_of_suffix("sog")).nbytes < (tmp_path / "whole.sog").stat().st_size


def test_a_potr_file_holds_the_coefficients_of_the_refit(encodes):
    """They are on the file's grid already: nothing of what the rounds have chosen is rounded to another level."""
    file = encodes(EVERY[0])
    splats = np.argsort(np.argsort(file.order))  # the re-fit's are in the order of the source
    assert np.abs(file.scene.sh[:, 1:] - file.refitted.sh[splats][:, 1:]).max() < 1e-5


@pytest.mark.slow
def test_potr_files_have_less_error_than_with_the_nearest_levels(encodes, monkeypatch, encoded_to, psnr):
    def fix_ac(self, rounded, sh, worth, request):
        geometry, grid = self.colour_grid(rounded, worth[:, 0], request)
        return geometry, nearest_levels(sh, grid.others)

    rounds = encodes(EVERY[0])
    monkeypatch.setattr(Potr, "fix_ac", fix_ac)
    monkeypatch.setattr(Potr, "on_grid", lambda self, request: False)
    plain = encoded_to(EVERY[0])
    assert rounds.nbytes < 1.005 * plain.nbytes
    assert psnr(rounds.scene) > psnr(plain.scene) + 0.1


def nearest_levels(sh: np.ndarray, steps: np.ndarray) -> np.ndarray:
    y, co, cg = to_ycocg(sh[:, 1:].reshape(-1, 3).astype(np.float64))
    step = np.repeat(steps.astype(np.float64), sh.shape[1] - 1)
    y, co, cg = (np.floor(channel / step + 0.5) * step for channel in (y, co, cg))
    rounded = sh.copy()
    rounded[:, 1:] = np.stack([y + co - cg, y + cg, y - co - cg], axis=-1).reshape(sh[:, 1:].shape)
    return rounded


@pytest.mark.slow
@pytest.mark.parametrize("output", OTHERS, ids=name)
def test_bytes_do_not_depend_on_threads(output):
    scene = random_scene(20_000, 2)
    files = []
    for threads in (1, 3):
        request = Request(HyperParameters.from_quality(0.5, "best"), threads=threads)
        worth = np.random.default_rng(1).lognormal(-20, 2, scene.sh.shape[:2]).astype(np.float32)
        fixed, sh = output.fix_ac(output.geometry(scene, request), scene.sh, worth, request)
        files.append(b"".join(output.file(dataclasses.replace(scene, sh=sh), fixed, request).pieces))
    assert files[0] == files[1]


def test_levels_of_spz_follow_what_errors_cost(encoded_to, psnr):
    """With a re-fit, which knows what errors cost, files are smaller than with the nearest levels, and hardly worse."""
    fitted, plain = (encoded_to(Spz(), q=0.2, prune=False, refit={"steps": steps}) for steps in (4, 0))
    assert fitted.nbytes < 0.85 * plain.nbytes
    assert psnr(fitted.scene) > psnr(plain.scene) - 1


def test_constant_colours_make_up_for_coarse_coefficients(encoded_to, psnr):
    """Compressed PLY rounds AC coefficients to 1/32: without splats lost, that is nearly all that it loses."""
    output = output_of(Path("a.compressed.ply"))
    fitted, plain = encoded_to(output, prune=False), encoded_to(output, prune=False, refit={"steps": 0})
    assert plain.nbytes == fitted.nbytes
    assert psnr(fitted.scene) > psnr(plain.scene) + 1


@pytest.mark.slow
@pytest.mark.parametrize(("suffix", "size", "least"), [(".spz", 40_000, 48), (".compressed.ply", 84_000, 62)])
def test_a_size_and_a_psnr_are_met(suffix, size, least, plush_excerpt, plush_excerpt_cameras, device, psnr):
    given, told = (plush_excerpt, plush_excerpt_cameras), {"to": suffix, "iterations": 8, "device": device}
    assert 0.9 * size < potr_cl.encode(*given, max_size=size, **told).nbytes <= size
    encoded = potr_cl.encode(*given, min_psnr=least, **told)
    assert least <= psnr(encoded.scene) < least + 1.5


@pytest.mark.slow
def test_quality_decides_of_size(encodes, encoded_to):
    for output in EVERY[1:]:
        smaller = encoded_to(output, q=0.2)
        assert smaller.nbytes < encodes(output).nbytes, output


@pytest.mark.parametrize("suffix", ["ply", "compressed.ply"])
def test_highlights_of_a_few_splats_keep_a_degree_unless_a_target_asks_for_its_bytes(suffix, plush_excerpt):
    """What few splats need costs more than q gives up elsewhere, though less than the bytes of all are worth."""
    output = output_of_suffix(suffix)
    request = Request(HyperParameters.from_quality(0.1, "best"))
    rounded = output.geometry(plush_excerpt, request)
    count, coefficients = plush_excerpt.sh.shape[:2]
    sh = np.zeros_like(plush_excerpt.sh)
    sh[:, 1:] = 0.25
    faint = np.full((count, coefficients), 1e-14, np.float32)
    bright = faint.copy()
    # About a sixth of what the bytes of degree 3 are worth, in one splat of fifty.
    bright[::50, 9:] = 2 * request.parameters.delta_mse_max

    def degree(output, worth):
        fixed = output.fix_ac(rounded, sh, worth, request)[1]
        return next(degree for degree in (3, 2, 1, 0) if degree == 0 or fixed[:, degree**2 : (degree + 1) ** 2].any())

    assert degree(output, faint) == 0
    assert degree(output, bright) == 3
    assert degree(output.to_meet_a_target(), bright) == 0


def test_degrees_that_are_left_out_are_told_once(plush_excerpt, caplog, encoded_to):
    flat = dataclasses.replace(plush_excerpt, sh=plush_excerpt.sh.copy())
    flat.sh[:, 9:] = 0
    with caplog.at_level(logging.WARNING, "potr_cl"):
        output, iterations = output_of_suffix(".compressed.ply"), {"iterations": 8}
        found, whole = (
            encoded_to(output, scene, q=q, prune=iterations, refit={"steps": 2})
            for scene, q in ((flat, 0.2), (plush_excerpt, 0.8))
        )
    assert (found.scene.sh_degree, whole.scene.sh_degree) == (2, 3)
    (said,) = [record.getMessage() for record in caplog.records if "no SH coefficients" in record.getMessage()]
    assert "of degree 3:" in said


@pytest.mark.slow
def test_what_a_format_cannot_hold_is_said_once(plush_excerpt, plush_excerpt_cameras, caplog):
    scene = dataclasses.replace(antialiased(plush_excerpt), low_pass=MIP_SPLATTING_LOW_PASS)
    with caplog.at_level(logging.WARNING, "potr_cl"):
        potr_cl.encode(scene, plush_excerpt_cameras, to="compressed.ply", max_size=80_000, iterations=4, refit=2)
    said = [record.getMessage() for record in caplog.records if "cannot hold" in record.getMessage()]
    assert len(said) == 1
    assert "low-pass filter of 0.1" in said[0]
    assert "\n" not in said[0]


@pytest.mark.slow
def test_results_are_saved_in_their_own_format_and_others(plush_excerpt, tmp_path):
    nothing = {"prune": False, "refit": False, "compact": False}
    encoded = potr_cl.encode(plush_excerpt, output=tmp_path / "a.spz", **nothing)
    assert (tmp_path / "a.spz").read_bytes() == encoded.data
    potr_cl.save(encoded, tmp_path / "b.spz")
    assert (tmp_path / "b.spz").read_bytes() == encoded.data
    potr_cl.save(encoded, tmp_path / "c.ply")
    assert len(load_scene(tmp_path / "c.ply")) == len(plush_excerpt)
    again = potr_cl.encode(encoded, to="ply", **nothing)
    potr_cl.save(again, tmp_path / "d.compressed.ply")
    assert (tmp_path / "d.compressed.ply").read_bytes().find(b"packed_position") > 0


def test_a_name_picks_the_longest_suffix():
    assert output_of(Path("a.compressed.ply")).format.name == "compressed PLY"
    assert output_of(Path("a.ply")).format.name == "3DGS PLY"
    assert output_of(Path("A.SPZ"), version=4) == Spz(version=4)
    for wrong, choices in (("a.xyz", {}), ("a", {}), ("a.ply", {"version": 2}), ("a.spz", {"version": 7})):
        with pytest.raises(UsageError):
            output_of(Path(wrong), **choices)


def test_without_views_files_are_made_too(plush_excerpt):
    for output in (*EVERY[1:], Gltf()):
        scene = plush_excerpt[:99].rendered(True)
        encoded = potr_cl.encode(scene, None, EncodeOptions(output=output), prune=False, refit=False)
        assert (len(encoded.scene), encoded.scene.antialiased) == (99, True)


def test_worth_is_about_training_views_and_coefficients_make_up_for_each_other(
    plush_excerpt, plush_excerpt_cameras, device, psnr
):
    """Rounded in turn, the coefficients of a splat lose less than each for itself, and the file is no larger."""
    views, output = train_views(plush_excerpt_cameras), output_of(Path("a.compressed.ply"))
    request = Request(HyperParameters.from_quality(0.5, "best"))
    with (
        Rasterizer(device, plush_excerpt) as rasterizer,
        ColourRefit(device, plush_excerpt, views) as refit,
    ):
        refit.solve(plush_excerpt.sh, RenderedTargets(rasterizer, views), RefitOptions(steps=1))
        worth, in_turn = refit.worth(), dataclasses.replace(request, blocks=refit.blocks)
        alone, together = (
            output.fix_ac(output.geometry(plush_excerpt, each), plush_excerpt.sh, worth, each)[1]
            for each in (request, in_turn)
        )
        # An error in a coefficient that is worth much is worth that in pictures: the sum over one channel's error.
        sh = plush_excerpt.sh.copy()
        splat = int(worth[:, 0].argmax())
        sh[splat, 2, 1] += 0.05
        with Rasterizer(device, dataclasses.replace(plush_excerpt, sh=sh)) as other:
            errors = [np.mean((rasterizer.render(v)[0] - other.render(v)[0]) ** 2) for v in views]
    # The mean over three channels of which one has changed; colours that are cut at 0 change nothing.
    assert np.mean(errors) == pytest.approx(worth[splat, 2] * 0.05**2, rel=0.1)
    alone, together = (psnr(dataclasses.replace(plush_excerpt, sh=sh)) for sh in (alone, together))
    assert together > alone + 3
