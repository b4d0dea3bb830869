"""Encoder and decoder together: every attribute within its step, deterministic, sections apart, old files for ever."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy._core import _multiarray_umath as umath

from potr_cl.codec import quantize
from potr_cl.codec.container import EntropyCoder
from potr_cl.codec.decoder import decode, open_file
from potr_cl.codec.sections import SH, Coder, Property
from potr_cl.errors import DataError, UsageError
from potr_cl.model.camera import camera_centres, train_views
from potr_cl.model.scene import SH_COEFFICIENTS, Scene
from potr_cl.native.library import VARIABLE, native
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from tests.cases.decoded_bits import decoded_bits
from tests.cases.options import as_it_is
from tests.oracles.decoder import decode as decode_independently
from tests.reference.scenes import random_scene, ring_of_cameras

FAST = EntropyCoder("zstd", 1)
KEEP = as_it_is()
DATA = Path(__file__).parents[1] / "data"
GOLDEN = sorted(DATA.glob("golden_*.potr"))
GOLDEN_BITS = json.loads((DATA / "golden_bits.json").read_text())
DISPATCHED = [name for name in umath.__cpu_dispatch__ if umath.__cpu_features__[name]]
ATTRIBUTES = ("means", "log_scales", "quaternions", "opacity_logits", "sh")
WAYS = ("0", "1") if native() else ("0",)


def joined(encoded) -> bytes:
    return b"".join(encoded.pieces)


def check_within_steps(source: Scene, encoded, tolerance, parameters=None):
    """Every attribute within half a step of the file, every centre within its tolerance; float32 rounds each once more.

    With the paper's quantiser, whose parameters are given, steps are those of the parameters.
    """
    data = joined(encoded)
    block, decoded, original = open_file(data).blocks[0], decode(data), source.subset(encoded.order)
    assert encoded.nbytes == len(data)
    assert (len(decoded), decoded.sh_degree) == (len(source), source.sh_degree)
    assert np.all(np.isfinite(decoded.means))

    rounding = np.abs(original.means.astype(np.float64)).max(axis=1) * 2.0**-23
    distance = np.linalg.norm(decoded.means.astype(np.float64) - original.means, axis=1)
    limit = np.maximum(tolerance[encoded.order] if np.ndim(tolerance) else tolerance, rounding)
    assert (distance <= limit + rounding).all()

    imaginary, log_scales = quantize.canonical_rotations(original.quaternions, original.log_scales)
    scales, scales_back = np.exp(log_scales.astype(np.float64)), np.exp(decoded.log_scales.astype(np.float64))
    assert (np.abs(scales_back - scales) <= 0.5 / block.sf_scale + 1e-5 * scales).all()
    turned = np.abs(decoded.quaternions[:, 1:] - imaginary)
    if parameters is not None:
        assert block.quantiser == 0
        factors = (block.sf_dc, block.sf_ac, block.sf_rotation, block.sf_scale, block.sf_opacity)
        wanted = [parameters.sf_sh] * 2 + [parameters.sf_rotation, parameters.sf_scale, parameters.sf_opacity]
        assert np.array_equal(factors, np.float32(wanted))
        assert (turned <= 0.5 / block.sf_rotation + 1e-6).all()
        opacity_error = np.abs(decoded.opacities.astype(np.float64) - original.opacities)
        assert (opacity_error <= 0.75 / block.sf_opacity + 1e-6).all()  # half a step and the quarter's shift
    else:
        assert block.quantiser == 1
        levels = np.round(scales_back * block.sf_scale)
        factor = block.sf_rotation * np.sqrt(np.maximum(levels.max(axis=1, keepdims=True), 1))
        ball = (levels.max(axis=1) == levels.min(axis=1))[:, None]
        assert ((turned <= 0.5 / factor + 1e-5) | ball).all()
        logits = np.clip(original.opacity_logits, -8, 12)
        assert (np.abs(decoded.opacity_logits - logits) <= 0.5 / block.sf_opacity + 1e-5).all()

    for m in range(source.sh.shape[1]):
        wanted, got = (quantize.to_ycocg(of.sh[:, m].astype(np.float64)) for of in (original, decoded))
        # The largest of the three sets the size of float32's rounding in all of them.
        size = np.abs(original.sh[:, m].astype(np.float64)).max(axis=1) + 1
        for w, g in zip(wanted, got, strict=True):
            assert (np.abs(w - g) <= 0.5 / (block.sf_ac if m else block.sf_dc) + 1e-6 * size).all()


def typical_size(scene: Scene) -> float:
    return float(np.median(np.exp(scene.log_scales.max(axis=1).astype(np.float64))))


STEPS = pytest.mark.parametrize(("degree", "q"), [(0, 0.0), (1, 0.5), (2, 1.0), (3, 0.5), (3, 0.0)])


@STEPS
@pytest.mark.parametrize("entropy", [FAST, EntropyCoder()])
def test_within_balanced_steps(degree, entropy, q):
    scene = random_scene(700, degree, seed=degree)
    options = as_it_is("best", entropy, q=q)
    encoded = encode(scene, options=options)
    assert (open_file(joined(encoded)).blocks[0].coder == Coder.BUNDLES) == (entropy.name == "bundles")
    check_within_steps(scene, encoded, options.parameters.beta * typical_size(scene))


@STEPS
def test_within_steps(degree, q):
    scene = random_scene(500, degree, seed=degree)
    options = as_it_is(entropy=FAST, q=q)
    check_within_steps(scene, encode(scene, options=options), options.parameters.gamma, options.parameters)


def test_balanced_steps_do_not_depend_on_the_unit_of_length():
    scene = random_scene(1500, 1)
    millimetres = dataclasses.replace(
        scene, means=scene.means * np.float32(1024), log_scales=scene.log_scales + np.float32(np.log(1024))
    )
    options = as_it_is("best")
    sizes = [encode(s, options=options).nbytes for s in (scene, millimetres)]
    assert abs(sizes[0] - sizes[1]) < 0.002 * sizes[0]
    again = decode(joined(encode(millimetres, options=options)))
    assert np.abs(again.log_scales.max() - millimetres.log_scales.max()) < 0.1


def test_within_the_criterion_of_the_cameras():
    scene = random_scene(2000, 0, extent=20)
    cameras = ring_of_cameras(12)
    options = as_it_is(entropy=FAST)
    centres = camera_centres(train_views(cameras))
    nearest = np.linalg.norm(scene.means[:, None].astype(np.float64) - centres, axis=2).min(axis=1)
    p = options.parameters
    tolerance = np.maximum(p.gamma, p.beta * nearest)
    encoded = encode(scene, cameras, options)
    check_within_steps(scene, encoded, tolerance, p)
    # Coarser far away, and so smaller than without cameras.
    assert encoded.nbytes < encode(scene, None, options).nbytes


def test_only_training_views_count():
    scene, cameras = random_scene(300, 0, extent=20), ring_of_cameras(12)
    assert joined(encode(scene, cameras, KEEP)) == joined(encode(scene, train_views(cameras), KEEP))
    with pytest.raises(UsageError, match="training view"):
        encode(scene, [camera for camera in cameras if camera.split == "test"])


EXTREME = st.one_of(st.floats(-80, 14, width=32), st.sampled_from([0.0, -80.0, 14.0]))


@pytest.mark.slow
@settings(max_examples=40)
@given(st.data(), st.integers(0, 3), st.integers(1, 30), st.floats(0, 1), st.booleans())
def test_any_scene(data, degree, splats, q, balanced):
    def array(shape, elements):
        return data.draw(hnp.arrays(np.float32, shape, elements=elements))

    # One value in common at times: coincident splats, constant streams.
    coordinates = st.one_of(st.just(1.5), st.floats(-1e6, 1e6, width=32))
    quaternions = array((splats, 4), st.floats(-2, 2, width=32))
    quaternions[np.linalg.norm(quaternions, axis=1) < 1e-3] = (1, 0, 0, 0)
    scene = Scene(
        array((splats, 3), coordinates),
        array((splats, 3), EXTREME),
        quaternions,
        array(splats, st.floats(-50, 50, width=32)),
        array((splats, SH_COEFFICIENTS[degree], 3), st.floats(-1000, 1000, width=32)),
    )
    if balanced:
        # Both coders; the steps themselves are checked on scenes that have a typical size.
        for entropy in (FAST, EntropyCoder()):
            options = as_it_is("best", entropy, q=q)
            if options.parameters.beta * typical_size(scene) < np.ptp(scene.means, axis=0).max() * 2.0**-43:
                return  # splats of next to no size may ask for more levels than there are, and be refused
            assert len(decode(joined(encode(scene, options=options)))) == splats
        return
    options = as_it_is(entropy=FAST, q=q)
    check_within_steps(scene, encode(scene, options=options), options.parameters.gamma, options.parameters)


@pytest.mark.parametrize("preset", ["paper", "best"])
def test_same_input_same_bytes_whatever_the_threads(preset):
    scene = random_scene(2000)
    first = joined(encode(scene, options=as_it_is(preset, threads=1)))
    for threads in (1, 2, 5):
        assert joined(encode(scene, options=as_it_is(preset, threads=threads))) == first
    a, b = decode(first), open_file(first).scene(threads=1)
    for name in ATTRIBUTES:
        assert np.array_equal(getattr(a, name), getattr(b, name))


def test_strides_do_not_matter():
    scene = random_scene(200)
    strided = Scene(
        np.asfortranarray(scene.means),
        scene.log_scales[:, ::-1].copy()[:, ::-1],
        scene.quaternions,
        scene.opacity_logits,
        scene.sh.transpose(1, 2, 0).copy().transpose(2, 0, 1),
    )
    assert joined(encode(scene, options=KEEP)) == joined(encode(strided, options=KEEP))


def test_decoding_again_loses_nothing_more():
    """A decoded scene, encoded with the same steps, comes back the same: re-encoding does not wear a scene out."""
    options = as_it_is(entropy=FAST)
    once = decode(joined(encode(random_scene(400), options=options)))
    encoded = encode(once, options=options)
    twice = decode(joined(encoded))
    expected = once.subset(encoded.order)
    assert np.abs(twice.sh - expected.sh).max() < 1e-5
    assert np.abs(twice.opacities - expected.opacities).max() < 1e-5
    assert np.abs(np.sort(twice.scales, axis=1) - np.sort(expected.scales, axis=1)).max() < 1e-5


@pytest.mark.parametrize("preset", ["paper", "best"])
@pytest.mark.parametrize("way", WAYS)
def test_sections_decode_alone(preset, way, monkeypatch):
    data = joined(encode(random_scene(500), options=as_it_is(preset)))
    monkeypatch.setenv(VARIABLE, way)
    whole, file = decode(data), open_file(data)
    assert np.array_equal(file.means(), whole.means)
    for name in ATTRIBUTES:
        assert np.array_equal(getattr(file.body(0), name)(), getattr(whole, name)), name
    # A damaged colour does not keep the positions from decoding.
    block = file.blocks[0]
    section = block.find(Property.SH1)
    damaged = bytearray(data)
    damaged[block.offset + section.offset] ^= 1
    file = open_file(bytes(damaged))
    assert np.array_equal(file.means(), whole.means)
    with pytest.raises(DataError, match=f"'{section.title}' is damaged"):
        file.scene()


def test_zero_streams_take_no_bytes():
    quiet = random_scene(300)
    quiet.sh[:, 4:] = 0
    data = joined(encode(quiet, options=KEEP))
    assert [open_file(data).blocks[0].find(prop) for prop in SH[2:]] == [None, None]
    assert (decode(data).sh[:, 4:] == 0).all()


def agree(decoded: Scene, expected: dict[str, np.ndarray]) -> None:
    opacities = 1 / (1 + np.exp(-decoded.opacity_logits.astype(np.float64)))
    assert np.allclose(decoded.means, expected["means"], rtol=2e-7, atol=0)
    assert np.allclose(np.exp(decoded.log_scales.astype(np.float64)), expected["scales"], rtol=3e-6, atol=0)
    assert np.allclose(decoded.quaternions, expected["quaternions"], rtol=0, atol=1e-4)  # the root near w = 0
    assert np.allclose(decoded.quaternions[:, 1:], expected["quaternions"][:, 1:], rtol=0, atol=1e-6)
    assert np.allclose(opacities, expected["opacities"], rtol=0, atol=1e-6)
    assert np.allclose(decoded.sh, expected["sh"], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("preset", "degree"), [("paper", 0), ("paper", 3), ("fast", 1), ("best", 0), ("best", 3)])
def test_independent_decoder_agrees(degree, preset):
    scene = random_scene(300, degree)
    scene = scene.subset(np.r_[np.arange(300), [0, 0, 7]])
    refitted = EncodeOptions.for_preset(preset, prune=False, compact=False)
    as_they_are = refitted.changed(refit=False)  # without cameras: a re-fit would place hundreds
    for cameras, options in ((None, as_they_are), (ring_of_cameras(8), refitted)):
        data = joined(encode(scene, cameras, options))
        agree(decode(data), decode_independently(data))


@pytest.mark.parametrize("path", GOLDEN, ids=lambda p: p.stem)
def test_golden_files_decode_for_ever(path, monkeypatch):
    """To the same bits by NumPy and by the native path, and to what independent decoders made of them."""
    for way in WAYS:
        monkeypatch.setenv(VARIABLE, way)
        assert decoded_bits(path) == GOLDEN_BITS[path.stem]
    scene = decode(path)
    with np.load(path.with_suffix(".npz")) as expected:
        agree(scene, dict(expected))
    rendered = (False, 0.3)
    if "antialiased" in path.stem or "mip_splatting" in path.stem:
        rendered = (True, 0.1 if "mip_splatting" in path.stem else 0.3)
        independent = decode_independently(path.read_bytes())
        assert (independent["antialiased"], independent["low_pass"]) == rendered
    assert (scene.antialiased, scene.low_pass) == rendered
    json.dumps(open_file(path).metadata)
    assert GOLDEN_BITS.keys() == {golden.stem for golden in GOLDEN}


@pytest.mark.skipif(not DISPATCHED, reason="NumPy has no code of its own for this processor")
def test_other_vector_instructions_give_the_same_bits(tmp_path):
    """NumPy's logarithm differs between them, so this fails where it is used."""
    for preset in ("paper", "best"):
        data = joined(encode(random_scene(2000, 1, seed=3), options=as_it_is(preset, FAST, q=0.9)))
        (tmp_path / f"{preset}.potr").write_bytes(data)
    paths = sorted(tmp_path.iterdir())
    here = {path.stem: decoded_bits(path) for path in paths}
    environment = {**os.environ, "NPY_DISABLE_CPU_FEATURES": " ".join(DISPATCHED)}
    program = (
        "from numpy._core import _multiarray_umath as umath\n"
        "assert not any(umath.__cpu_features__[name] for name in umath.__cpu_dispatch__)\n"
        "import runpy, sys\n"
        "runpy.run_module('tests.cases.decoded_bits', run_name='__main__', alter_sys=True)\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", program, *map(str, paths)],
        cwd=DATA.parents[1],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout) == here


def test_flags_are_all_that_marks_an_antialiased_scene():
    """With the paper's quantiser, whose steps are the same for all."""
    scene = random_scene(100, 1)
    options = EncodeOptions.for_preset("paper", prune=False, compact=False)
    classic, marked = (joined(encode(scene.rendered(kind), None, options)) for kind in (False, True))
    assert (classic[10], marked[10]) == (0, 1)
    changed = [i for i, (a, b) in enumerate(zip(classic, marked, strict=True)) if a != b]
    checksum = int.from_bytes(classic[12:16], "little") - 4
    assert set(changed) <= {10, *range(checksum, checksum + 4)}


@pytest.mark.parametrize("preset", ["fast", "best"])
def test_scales_of_antialiased_scenes_have_finer_steps(preset):
    """A thin splat's width counts twice there, in its shape and in its opacity."""
    scene = random_scene(300, 1)
    options = EncodeOptions.for_preset(preset, prune=False, compact=False, refit=False)
    data = [joined(encode(scene.rendered(kind), None, options)) for kind in (False, True)]
    classic, marked = (open_file(each).blocks[0] for each in data)
    assert marked.sf_scale == 2 * classic.sf_scale
    for each in ("sf_rotation", "sf_opacity", "sf_dc", "sf_ac"):
        assert getattr(marked, each) == getattr(classic, each)
    log_scales = [np.sort(decode(each).log_scales.astype(np.float64), axis=None) for each in data]
    errors = [np.abs(np.exp(each) - np.exp(np.sort(scene.log_scales, axis=None))).mean() for each in log_scales]
    assert errors[1] < 0.6 * errors[0]
