"""Steps of colours that fit each splat: what a file says of them, what is decoded with them, what they save."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potr_cl.codec import quantize
from potr_cl.codec.container import EntropyCoder
from potr_cl.codec.decoder import decode, open_file
from potr_cl.codec.encoder import code_scene
from potr_cl.codec.geometry import Geometry, quantise_geometry
from potr_cl.codec.quantize import HyperParameters
from potr_cl.codec.sections import SH, Property
from potr_cl.codec.steps import prediction
from potr_cl.codec.steps.fitting import FEWEST, fit_steps
from potr_cl.codec.steps.rule import KNOTS, ColourSteps
from potr_cl.errors import DataError
from potr_cl.native.library import VARIABLE, native
from potr_cl.report.file import file_report, format_report
from tests.oracles import decoder as oracle
from tests.reference.file_parts import File
from tests.reference.scenes import random_scene

BEST = HyperParameters.from_quality(0.5, "best")
STEPS = ColourSteps(
    group_bits=2,
    knot_shift=3,
    first_knot=1,
    powers=(8, 5),
    offsets=(20, -900),
    scales=(188, -86, 55),
    opacities=tuple(range(-160, -160 + 20 * KNOTS, 20)),
    groups=np.arange(-3, 4, dtype=np.int8),
)


def effects_of(geometry: Geometry, seed: int = 1) -> np.ndarray:
    """As large splats of high opacity show more, and some places are seen better; in the order of the scene."""
    rng = np.random.default_rng(seed)
    n = len(geometry.order)
    of_file = (1.0 + geometry.scales[0]) * (1 + geometry.scales[1]) * (1.0 + geometry.opacities) ** 2
    of_file = of_file * np.exp(np.repeat(rng.normal(size=n // 20 + 1), 20)[:n] + 0.3 * rng.normal(size=n))
    effects = np.empty(n)
    effects[geometry.order] = of_file
    return effects


def adapted(scene, parameters=BEST) -> Geometry:
    geometry = quantise_geometry(scene, parameters, ())
    return geometry.with_steps(effects_of(geometry))


def file_of(scene, geometry, entropy="bundles", parameters=BEST) -> bytes:
    return b"".join(code_scene(scene, parameters, geometry=geometry, entropy=EntropyCoder(entropy, 3)).pieces)


def colour_bytes(data: bytes) -> int:
    """What colours and their steps take."""
    sections = open_file(data).blocks[0].sections
    return sum(section.stored_bytes for section in sections if section.kind in (*SH, Property.STEPS))


@pytest.fixture(params=["0", "1"], ids=["numpy", "native"])
def path(request, monkeypatch):
    if request.param == "1" and native() is None:
        pytest.skip("the compiled library is not there")
    monkeypatch.setenv(VARIABLE, request.param)


@pytest.mark.parametrize(
    ("degree", "entropy", "own_steps"), [(1, "bundles", True), (0, "zstd", True), (1, "zstd", False)]
)
def test_the_independent_decoder_agrees(degree, entropy, own_steps, path):
    scene = random_scene(300, degree, seed=degree)
    geometry = adapted(scene) if own_steps else quantise_geometry(scene, BEST, ())
    data = file_of(scene, geometry, entropy)
    file, wanted = open_file(data), oracle.decode(data)
    assert (file.blocks[0].find(Property.STEPS) is not None) == own_steps
    assert not own_steps or len(np.unique(geometry.colour_classes()[0])) > 5
    for threads in (1, 3):
        got = file.scene(threads)
        assert np.allclose(got.sh, wanted["sh"], rtol=1e-6, atol=1e-7)
        assert np.allclose(got.means, wanted["means"], rtol=1e-6, atol=1e-7)
        assert np.allclose(np.exp(got.log_scales), wanted["scales"], rtol=1e-5)
    assert np.array_equal(file.body(0).sh(), got.sh)
    assert np.array_equal(file.body(0).sh(0), got.sh[:, :1])
    assert own_steps or np.abs(got.sh[:, 0] - scene.sh[geometry.order, 0]).max() <= 1.5 / BEST.sf_dc + 1e-6


def test_colours_are_within_half_of_each_splats_own_step():
    scene = random_scene(2000, 1, seed=3)
    geometry = adapted(scene)
    back = decode(file_of(scene, geometry))
    source = scene.sh[geometry.order].astype(np.float64)
    for m in range(4):
        factor = (BEST.sf_sh if m else BEST.sf_dc) * 2 ** (geometry.colour_classes()[min(m, 1)] / 4)
        channels = zip(quantize.to_ycocg(source[:, m]), quantize.to_ycocg(back.sh[:, m].astype(float)), strict=True)
        for wanted, got in channels:
            assert (np.abs(wanted - got) <= 0.5 / factor + 1e-5).all()


def test_the_same_error_costs_fewer_bits():
    """The error that the steps add stays as it was, with steps that are coarser on average."""
    scene = random_scene(8000, 0, seed=6)
    geometry = quantise_geometry(scene, BEST, ())
    effects = effects_of(geometry)[geometry.order]
    adapted_geometry = geometry.with_steps(effects_of(geometry))
    for classes in adapted_geometry.colour_classes():
        squared = 4.0 ** (-classes / 4)
        assert (effects * squared).sum() == pytest.approx(effects.sum(), rel=0.1)
        assert -classes.mean() / 4 > 0.3
    assert colour_bytes(file_of(scene, adapted_geometry)) < 0.9 * colour_bytes(file_of(scene, geometry))


def test_a_scene_of_which_nothing_is_known_has_no_steps():
    scene = random_scene(400, 0, seed=7)
    geometry = quantise_geometry(scene, BEST, ())
    assert geometry.with_steps(np.zeros(400)).steps is None
    assert geometry.with_steps(np.full(400, np.inf)).steps is None
    few = quantise_geometry(random_scene(FEWEST - 1, 0, seed=8), BEST, ())
    assert few.with_steps(np.ones(FEWEST - 1)).steps is None
    assert geometry.with_steps(np.ones(400)).steps is not None


@pytest.mark.parametrize("sf_opacity", [1e-3, 5.5, 1e9])
def test_steps_of_any_scale_factor(sf_opacity):
    parameters = dataclasses.replace(BEST, sf_opacity=sf_opacity)
    scene = random_scene(400, 0, seed=9)
    data = file_of(scene, adapted(scene, parameters), "zstd", parameters)
    assert np.allclose(decode(data).sh, oracle.decode(data)["sh"], rtol=1e-6, atol=1e-7)


def test_steps_come_back_from_their_bytes():
    for splats in (25, 28):
        back = ColourSteps.from_bytes(STEPS.to_bytes(), splats)
        assert np.array_equal(back.groups, STEPS.groups)
        assert dataclasses.replace(back, groups=STEPS.groups) == STEPS


@pytest.mark.parametrize(
    "raw",
    [
        b"",
        STEPS.to_bytes()[:49],
        STEPS.to_bytes()[:-1],
        STEPS.to_bytes() + b"\0",
        bytes([41]) + STEPS.to_bytes()[1:],
        bytes([2, 41]) + STEPS.to_bytes()[2:],
        STEPS.to_bytes()[:5] + b"\1" + STEPS.to_bytes()[6:],
    ],
    ids=["nothing", "half a head", "a group less", "a group more", "huge groups", "huge places", "reserved"],
)
def test_bytes_that_say_nothing_are_refused(raw):
    with pytest.raises(DataError, match="section 'steps' describes impossible steps"):
        ColourSteps.from_bytes(raw, 28)


@pytest.mark.parametrize("seed", range(4))
def test_hostile_rules_give_what_the_page_says(seed):
    """Numbers at the ends of their ranges, and levels of 64 bits."""
    rng = np.random.default_rng(seed)
    n = 40
    ends = np.array([-32768, 32767])
    group_bits = int(rng.integers(0, 7))
    steps = ColourSteps(
        group_bits=group_bits,
        knot_shift=int(rng.choice([0, 3, 40])),
        first_knot=int(rng.choice([0, 255])),
        powers=(int(rng.choice([0, 8, 255])), 255),
        offsets=(int(rng.choice(ends)), int(rng.choice(ends))),
        scales=tuple(rng.choice(ends, 3).tolist()),
        opacities=tuple(rng.choice(ends, KNOTS).tolist()),
        groups=rng.choice(np.array([-128, 127], np.int8), -(-n >> group_bits)),
    )
    levels = [
        (rng.integers(0, 2**63, n, dtype=np.uint64) * 2 + 1) >> rng.integers(0, 64, n, dtype=np.uint64)
        for _ in range(4)
    ]
    block = oracle.Block(0, 0, 0, n, (), (), 0, (), [], 0, 1)
    integers = {"SCAL": [[int(v) for v in axis] for axis in levels[:3]], "OPAC": [[int(v) for v in levels[3]]]}
    wanted = oracle.decode_classes({"STEP": steps.to_bytes()}, integers, block)
    got = ColourSteps.from_bytes(steps.to_bytes(), n).classes(levels[:3], levels[3])
    assert [part.tolist() for part in got] == list(wanted)


@pytest.mark.parametrize("n", [1, 3, 256, 1030])
@pytest.mark.parametrize("bits", [4, 63])
def test_predictions_are_undone(n, bits, path):
    """Also where products wrap round."""
    rng = np.random.default_rng(n)
    levels = rng.integers(-(2**bits), 2**bits, (3, n), dtype=np.int64)
    classes = rng.integers(-32, 32, n).astype(np.int8)
    residuals = prediction.to_residuals(levels, classes)
    assert np.array_equal(prediction.from_residuals(residuals, classes), levels)
    assert oracle.undo_prediction(residuals[1].tolist(), classes.tolist()) == levels[1].tolist()


def test_colours_are_predicted_as_colours():
    """A surface of one colour leaves nothing, whatever the steps are."""
    classes = np.random.default_rng(3).integers(-8, 9, 256).astype(np.int8)
    levels = np.rint(1000 * 2.0 ** (classes / 4)).astype(np.int64)[None]
    residuals = prediction.to_residuals(levels, classes)
    assert np.abs(residuals[:, 4:]).max() <= 3


def test_the_papers_quantiser_has_no_steps():
    scene = random_scene(400, 0, seed=10)
    file = File.of(file_of(scene, adapted(scene), "zstd"))
    file.quantiser = 0
    with pytest.raises(DataError, match=r"section 'steps' holds .* bytes, more than"):
        decode(file.bytes())
    with pytest.raises(ValueError, match="STEP is too long"):
        oracle.decode(file.bytes())


def test_rules_do_not_depend_on_the_order_of_threads_or_the_unit_of_effects():
    scene = random_scene(5000, 0, seed=11)
    geometry = quantise_geometry(scene, BEST, ())
    effects = effects_of(geometry)[geometry.order]
    first, second = (
        fit_steps(geometry.scales, geometry.opacities, geometry.parameters.sf_opacity, effects * unit)
        for unit in (1.0, 2.0**-20)
    )
    assert first is not None
    assert second is not None
    assert first.to_bytes() == second.to_bytes()


def test_the_report_says_what_the_header_holds():
    scene = random_scene(400, 0, seed=12)
    geometry = adapted(scene)
    report = file_report(open_file(file_of(scene, geometry)))
    assert report["colour_steps"]["scales"] == list(geometry.steps.scales)
    assert report["colour_steps"]["groups"] == 25
    assert report["sections"]["colour: precision"]["serialised_bytes"] == 50 + 25
    assert "its group of 16 splats" in format_report(report)
    alike = file_report(open_file(file_of(scene, quantise_geometry(scene, BEST, ()))))
    assert alike["colour_steps"] is None
    assert "the same for all splats" in format_report(alike)
