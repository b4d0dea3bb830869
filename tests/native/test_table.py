"""Each definition and the C that stands for it: the same bits of the same arguments."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from potr_cl.codec import geometry, octree, quantize
from potr_cl.codec.bundles import encoder
from potr_cl.codec.bundles.encoder import narrow
from potr_cl.codec.octree.builder import Begun
from potr_cl.codec.quantize import HyperParameters
from potr_cl.codec.splat_levels import colour_levels, splat_levels
from potr_cl.codec.steps.prediction import to_residuals
from potr_cl.codec.steps.rule import colour_classes
from potr_cl.model.matter import Matter, horizons_of, shown_of
from potr_cl.model.spherical_harmonics import energy
from potr_cl.native.library import VARIABLE, native
from potr_cl.native.table import TABLE, resolved
from potr_cl.outputs.feedback import unit_factors
from tests.codec.test_bundles import classes_of, integers, steps_of
from tests.reference.scenes import random_scene

Case = tuple[str, Callable[..., Any], tuple[Any, ...]]
NUMBERS = (1, 63, 64, 65, 256, 257, 5000)


def _rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def _axis_rotations() -> np.ndarray:
    """Quaternions of which several equivalent forms have the same real part, and their negatives."""
    half, root = 0.5, np.sqrt(0.5)
    some = [[1, 0, 0, 0], [0, 0, 1, 0], [half] * 4, [half, -half, half, -half], [root, root, 0, 0], [0, root, 0, -root]]
    return np.array(some + [[-x for x in q] for q in some], np.float32)


def _rotations() -> Iterator[Case]:
    quaternions = (_rng(1).normal(0, 1, (5000, 4)) * _rng(2).lognormal(0, 4, (5000, 1))).astype(np.float32)
    quaternions[:12] = _axis_rotations()
    log_scales = _rng(3).normal(0, 2, (5000, 3)).astype(np.float32)
    for number in (0, *NUMBERS):
        order = _rng(number).permutation(5000)[:number]
        yield f"{number}", quantize.canonical_rotations, (quaternions, log_scales, order)
    yield "all", quantize.canonical_rotations, (quaternions, log_scales)


def _colours() -> Iterator[Case]:
    for number in NUMBERS:
        for degree in (0, 1, 3):
            sh = random_scene(number, degree, seed=number).sh
            sh[::3] = np.round(sh[::3] * 20) / 20  # between two levels, exactly
            sh[::5] = 0
            yield f"{number} of degree {degree}", quantize.nonzero_levels, (sh, 10.0)
    sh = (_rng(7).normal(0, 0.3, (40_000, 4, 3)) * _rng(8).choice([0, 1, 3], (40_000, 1, 3))).astype(np.float32)
    sh[:100] = np.round(sh[:100] * 64) / 64
    some = _rng(9).integers(-9, 9, 40_000).astype(np.int8)
    parameters = replace(HyperParameters.from_quality(0.5, "best"), sf_dc=64.0, sf_sh=32.0)
    for largest in (0.0, 100.0, 1023.0, 40_000.0, 1e9):  # levels of 16, 32 and 64 bits
        own = sh.copy()
        own[20_000, 1] = (largest, -largest, largest / 2)
        layouts = {
            "rows": own,
            "columns": np.ascontiguousarray(own.transpose(1, 2, 0)).transpose(2, 0, 1),
            "neither": np.repeat(own, 2, axis=0)[::2],
        }
        for layout, each in layouts.items():
            for classes in ((some, some[::-1].copy()), (np.zeros(40_000, np.int8), some)):
                arguments = (each, _rng(1).permutation(40_000), parameters, classes, map)
                yield f"{largest:g}, {layout}", colour_levels, arguments


def _splats() -> Iterator[Case]:
    for number in (1, 700, 40_000):
        for case in ("usual", "wide", "beyond 32 bits", "balls", "paper"):
            scene = random_scene(number, 0, seed=number)
            preset = "paper" if case == "paper" else "best"
            world = replace(HyperParameters.from_quality(0.5, preset), sf_scale=50.0, sf_opacity=4.0)
            scene.opacity_logits[::3] = np.round(scene.opacity_logits[::3] * 8) / 8
            scene.opacity_logits[::50] = 100
            if case == "wide":
                scene.log_scales[number // 2] = (8, 9, 10)
            elif case == "beyond 32 bits":
                scene.log_scales[number // 2] = 20
            elif case == "balls":
                scene.log_scales[:] = scene.log_scales[:, :1]
            order = _rng(1).permutation(number)[: max(number * 2 // 3, 1)]
            order[0] = number // 2
            yield f"{number}, {case}", splat_levels, (scene, order, world)


def _steps() -> Iterator[Case]:
    for number in NUMBERS:
        rule = steps_of(2 * number + 16)
        for dtype in (np.uint8, np.int16, np.int32):
            levels = _rng(number).integers(0, 127, (4, number)).astype(dtype)
            for start in (0, 16, 5):
                yield f"{number} from {start}", colour_classes, (rule, list(levels[:3]), levels[3], start)
        levels = _rng(number).integers(-(2**40), 2**40, (3, number))
        yield f"{number}", to_residuals, (levels, _rng(number).integers(-32, 32, number).astype(np.int8))


def _places() -> Iterator[Case]:
    for number in NUMBERS:
        points = (_rng(number).normal(size=(number, 3)) * 100).astype(np.float32)
        for others in (1, 5):
            yield f"{number} to {others}", geometry.nearest, (points, _rng(others).normal(size=(others, 3)))


def _clusters(rng: np.random.Generator, n: int) -> np.ndarray:
    means = np.concatenate([rng.normal(size=(n, 3)), rng.normal(size=(n // 3, 3)) / 50]).astype(np.float32)
    return rng.permutation(np.concatenate([means, means[: n // 10], means[: n // 20]]))


def _octrees() -> Iterator[Case]:
    """Trees of no level, and of so many that a splat's octants take one, two or three words."""
    rng = _rng(4)
    scenes = {
        "clusters": _clusters(rng, 3000),
        "many in one place": rng.integers(0, 4, (500, 3)).astype(np.float32),
        "a line": np.stack([np.zeros(300), rng.integers(0, 50, 300), np.zeros(300)], axis=1).astype(np.float32),
        "one place": np.full((7, 3), 3.5, np.float32),
        "one splat": np.ones((1, 3), np.float32),
        "far apart": np.concatenate([_clusters(rng, 100) * 1e-6, [[1e6, 0, -1e6]]]).astype(np.float32),
    }
    for name, means in scenes.items():
        for finest in (3.0, 1e-2, 1e-5, 1e-9, 1e-13):
            for tolerance in (finest, finest * np.exp2(rng.integers(0, 12, len(means)) / 2)):
                for absolute in (True, False):
                    yield f"{name}, {finest:g}", octree.begin, (means, tolerance, absolute)
                yield f"{name}, {finest:g}", octree.leaf_order, (means, tolerance)
                tree, _ = octree.build(means, tolerance, absolute=True)
                yield f"{name}, {finest:g}", octree.parse, (tree, len(means))


def _factors() -> Iterator[Case]:
    for count in (1, 4, 9, 16):
        seen = _rng(count).normal(size=(1003, 6, count)) * _rng(count).lognormal(0, 9, (1003, 1, 1))
        seen[::9] = 0
        blocks = np.einsum("nva,nvb->abn", seen, seen).astype(np.float32)[np.triu_indices(count)]
        yield f"{count}", unit_factors, (np.ascontiguousarray(blocks), slice(5, 1000))


def _bundles() -> Iterator[Case]:
    for splats, spread, known in ((1, 3, 0), (300, 300, 0), (300, 3, 3), (8200, 3, 3), (8200, 300, 0)):
        values = integers(splats, spread, spread=spread)
        arguments = (narrow(values), classes_of(values, steps_of(splats)), frozenset(list(values)[:known]), map)
        yield f"{splats}, {spread}, {known}", encoder.coded, arguments


def _sights() -> Iterator[Case]:
    """Also of points at the camera, straight ahead, behind it and on the edges of the cube map's faces."""
    for number in (1, 255, 256, 3000):
        rng = _rng(number)
        targets = rng.normal(size=(number, 3)) * 2
        targets[::7] = np.round(targets[::7])
        occluders = (rng.normal(size=(3, 2 * number)) * rng.lognormal(0, 1, 2 * number)).astype(np.float32)
        occluders[:, ::5] = np.round(occluders[:, ::5])
        areas = rng.lognormal(-12, 8, 2 * number).astype(np.float32)  # whose sums are rounded
        for count in (3, 8, 15):
            colours = rng.normal(size=(number, count, 3)).astype(np.float32)
            yield f"{number} of {count}", energy, (targets, colours)
            yield f"{number} of {count}, double", energy, (targets, colours.astype(np.float64))
        matter = Matter(targets, np.ones(number), colours, occluders, areas)
        for place in (np.zeros(3), np.ones(3), rng.normal(size=3)):
            yield f"{number} around {place}", horizons_of, (place, matter)
            horizons, _ = horizons_of(place, matter)
            for rotation in (np.eye(3), np.linalg.qr(rng.normal(size=(3, 3)))[0]):
                camera = np.array([*place, *rotation.flat, 300, 280, 150, 140, 320, 240, 0.01])
                yield f"{number} from {place}", shown_of, (camera, horizons, matter)


#: Where the cases of each entry are; None: there in C alone, which tests of whole files compare.
CASES: dict[str, Callable[[], Iterator[Case]] | None] = {
    "codec.block_values:bundle_share": None,
    "codec.bundles.decoder:bundled_file": None,
    "codec.bundles.encoder:coded": _bundles,
    "codec.splat_levels:quantised": _colours,
    "codec.geometry:nearest": _places,
    "codec.octree.builder:begin": _octrees,
    "codec.octree.builder:leaf_order": _octrees,
    "codec.octree.parser:parse": _octrees,
    "codec.quantize:canonical_rotations": _rotations,
    "codec.quantize:nonzero_levels": _colours,
    "codec.splat_levels:splat_levels": _splats,
    "codec.steps.rule:colour_classes": _steps,
    "codec.steps.prediction:to_residuals": _steps,
    "model.matter:horizons_of": _sights,
    "model.matter:shown_of": _sights,
    "model.spherical_harmonics:energy": _sights,
    "outputs.feedback:unit_factors": _factors,
}


@pytest.mark.parametrize("name", TABLE)
def test_arguments_are_the_same(name):
    wanted = inspect.signature(resolved(name)).parameters.values()
    _, *found = inspect.signature(resolved(TABLE[name])).parameters.values()
    assert [(each.name, each.default) for each in found] == [(each.name, each.default) for each in wanted]
    assert CASES.keys() == TABLE.keys()


@pytest.mark.skipif(native() is None, reason="the compiled library is not there: python -m tools.make.native")
@pytest.mark.parametrize("cases", [each for each in dict.fromkeys(CASES.values()) if each is not None])
def test_both_give_the_same_bits(cases, monkeypatch):
    for what, function, arguments in cases():
        found = []
        for way in "01":
            monkeypatch.setenv(VARIABLE, way)
            found.append(_bits(function(*arguments)))
        assert found[0] == found[1], f"{function.__name__}: {what}"


def _bits(found: Any) -> Any:
    if isinstance(found, np.ndarray):
        return found.dtype.str, found.shape, np.ascontiguousarray(found).tobytes()
    if isinstance(found, Begun):
        return _bits((found.order, found.depth, found.streams(), found.decoded(map)))
    if dataclasses.is_dataclass(found):
        return [_bits(getattr(found, field.name)) for field in dataclasses.fields(found)]
    if isinstance(found, tuple | list):
        return [_bits(each) for each in found]
    return found
