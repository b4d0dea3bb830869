"""Inputs for the numerical stress (tools.stress.run): what scenes and users come up with at their worst, by hand and by
hypothesis.

A case's name says all that is needed to make it again.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.raster.rules import GSPLAT, INRIA, RasterRules
from potr_cl.stages.compaction.ridge import CompactionOptions
from potr_cl.stages.refitting.refit_options import RefitOptions
from tests.reference.scenes import (
    plain_splats,
    random_scene,
    random_splats,
    ring_of_cameras,
    straight_camera,
    tilted_camera,
)

F64 = NDArray[np.float64]

#: Conjugate-gradient steps of a re-fit: more than it needs.
REFIT_STEPS = 200
#: Splats of a tile, and layers of a pixel, in the cases with many; the tests take fewer.
MANY = 5000


@dataclasses.dataclass(frozen=True)
class Case:
    """A scene, a view of it and the rules to follow."""

    name: str
    scene: Scene
    view: Camera
    rules: RasterRules = GSPLAT


@dataclasses.dataclass(frozen=True)
class RidgeCase:
    """Systems for the compaction: splats, camera centres, weights (N, S)."""

    name: str
    scene: Scene
    centres: F64
    weights: NDArray[np.float32]
    options: CompactionOptions


@dataclasses.dataclass(frozen=True)
class RefitCase:
    """A scene whose colours are to come near to the pictures of another."""

    name: str
    scene: Scene
    other: Scene
    views: list[Camera]
    options: RefitOptions


# ------------------------------------------------------------------------------------------ by hand


def known_cases() -> Iterator[Case]:
    """What scenes and users come up with at their worst."""
    near, ahead = np.float32(INRIA.near), straight_camera()
    colours = np.random.default_rng(1).uniform(0, 1, (MANY, 3))
    for label, depth in (
        ("in the camera centre", 0.0),
        ("behind", -0.2),
        ("a last digit before the near plane", np.nextafter(near, np.float32(0))),
        ("on the near plane", near),
        ("a last digit behind the near plane", np.nextafter(near, np.float32(1))),
    ):
        yield Case(f"one splat {label}", plain_splats([0.01, 0.01, depth], sigma=0.02, logit=3), ahead)
    aside = [[3, 2, 0.25], [-0.5, 0.1, 0.21], [0.3, -4, 0.3]]
    yield Case("close to the camera centre and to the side", plain_splats(aside, sigma=0.3, logit=2), ahead)
    for sigma in (1e-30, 1e-6, 10, 1e3, 1e6, 1e20, 1e38):
        yield Case(f"sigma {sigma:g}", plain_splats([[0, 0, 2], [0.3, 0.2, 3]], sigma=sigma, logit=1), ahead)
    needles, logits = random_splats(40, 0, seed=9), np.random.default_rng(0).normal(2, 1, 40).astype(np.float32)
    for label, scales in (("1 : 1e5", (-9, -9, 3)), ("1 : 1e9, flat", (-20, 2, 2)), ("1 : 1e13", (-20, -20, 10))):
        log_scales = np.tile(np.array(scales, np.float32), (40, 1))
        scene = dataclasses.replace(needles, log_scales=log_scales, opacity_logits=logits)
        yield Case(f"needles {label}", scene, tilted_camera(9, 80, 60))
    for logit in (-200.0, -50.0, -5.6, -5.5373, -5.5, 0.0, 16.118095, 50.0, 200.0):
        two = plain_splats([[0.01, 0.02, 2], [0, 0, 3]], sigma=0.3, logit=logit)
        for rules in (GSPLAT, INRIA):
            yield Case(f"opacity logit {logit:g}, alpha cap {rules.alpha_cap:g}", two, ahead, rules)
    for length in (1e-12, 1e-3, 1e6, 1e18):
        scene = random_splats(30, 0, seed=11)
        unit = scene.quaternions / np.linalg.norm(scene.quaternions, axis=1, keepdims=True)
        scene = dataclasses.replace(scene, quaternions=unit * np.float32(length))
        yield Case(f"quaternions {length:g} long", scene, tilted_camera(11, 40, 40))
    rng = np.random.default_rng(2)
    layers = np.zeros((MANY, 3))
    layers[:, 2] = rng.uniform(1, 5, MANY)
    yield Case(f"{MANY} layers of alpha 0.0055", plain_splats(layers, 5, -5.2, colours), straight_camera(4, 4))
    for in_front in (0, 10, 100, 300):
        yield layered(in_front)
    alike = plain_splats(np.tile([0.0, 0, 2], (40, 1)), 0.2, -2, colours[:40])
    yield Case("40 identical splats", alike, ahead)
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 12), np.linspace(-1, 1, 12), [2.0]), axis=-1).reshape(-1, 3)
    yield Case("144 splats of one depth", plain_splats(grid, 0.2, -1, colours[:144]), ahead)
    tilted = plain_splats(grid - [0, 0, 2], 0.2, -1, colours[:144])
    yield Case("144 splats of one depth, tilted", tilted, tilted_camera(3, 50, 40))
    for width, height in ((1, 1), (1, 40), (16384, 4), (4, 16384), (17, 16)):
        longest = float(max(width, height))
        rng, n = np.random.default_rng(width), 30 if longest < 1000 else 6
        places = np.ones((n, 3))
        places[:, :2] = rng.uniform(-0.6, 0.6, (n, 2)) * (width, height) / longest
        scene = plain_splats(places, rng.uniform(1e-3, 3e-2, (n, 3)), rng.normal(0, 2, n), colours[:n])
        view = straight_camera(width, height, focal=longest, fy=longest)
        yield Case(f"{width} x {height} pixels", scene, view)
    for offset in (1e3, 1e5, 1e6):
        scene = random_splats(100, 3, seed=12)
        scene = dataclasses.replace(scene, means=scene.means + np.array([offset, 0, 0], np.float32))
        yield Case(f"{offset:g} from the origin", scene, tilted_camera(12, 60, 50, offset))
    rng = np.random.default_rng(4)
    far = plain_splats(rng.uniform(-1e6, 1e6, (500, 3)), np.exp(rng.normal(5, 5, (500, 3))), 1, colours[:500])
    yield Case("coordinates up to 1e6", far, ahead)
    for brightness in (1e3, 1e10, 1e30):
        yield Case(f"colours of {brightness:g}", plain_splats(grid, 0.2, -1, brightness * colours[:144]), ahead)
    for label, mean in (("behind", [0, 0, -3]), ("beside", [100, 0, 1]), ("in the camera centre", [0, 0, 0])):
        yield Case(f"a view that sees nothing: {label}", plain_splats(mean), ahead)
    for degree, rules in itertools.product(range(4), (INRIA, GSPLAT)):
        name = f"100 random splats of degree {degree}, alpha cap {rules.alpha_cap:g}"
        yield Case(name, random_splats(100, degree, seed=degree), tilted_camera(degree, 45, 37), rules)
    for seed in range(3):
        yield Case("extremes of every parameter", extremes(300), tilted_camera(seed, 40, 30))
    means = np.concatenate([rng.uniform(-0.05, 0.05, (MANY, 2)), rng.uniform(1, 2, (MANY, 1))], axis=1)
    yield Case(f"a tile with {MANY} intersections", plain_splats(means, 1e-3, -2, colours), straight_camera(4, 4))


def layered(in_front: int) -> Case:
    """A column of thin layers with one splat of alpha at the cap among them."""
    layers = in_front + 20
    logits = np.full(layers, -4.6, np.float32)
    logits[in_front] = 12
    means = np.zeros((layers, 3))
    means[:, 2] = np.linspace(2, 6, layers)
    colours = np.random.default_rng(0).uniform(0, 1.5, (layers, 3))
    return Case(
        f"alpha at the cap behind {in_front} layers",
        plain_splats(means, 1.6, logits, colours),
        straight_camera(16, 16),
        INRIA,
    )


def extremes(n: int) -> Scene:
    """Random extremes of every parameter."""
    rng = np.random.default_rng(13)
    values = np.array([-1e30, -1e6, -1, -1e-6, 0, 1e-6, 1, 1e6, 1e30], np.float32)
    return Scene(
        np.where(rng.random((n, 3)) < 0.3, rng.choice(values, (n, 3)), rng.normal(size=(n, 3))).astype(np.float32),
        rng.choice(np.array([-200, -30, -3, 0, 3, 30, 88, 200], np.float32), (n, 3)),
        rng.choice(values, (n, 4)),
        rng.choice(np.array([-1e30, -50, -1, 0, 1, 50, 1e30], np.float32), n),
        rng.choice(np.array([-1e30, -1, 0, 1, 1e30], np.float32), (n, 16, 3), p=[0.01, 0.3, 0.38, 0.3, 0.01]),
    )


def around(views: int, spread: float, seed: int) -> F64:
    """Camera centres within an angle of about ``spread`` of each other: the condition number grows with its third
    power.
    """
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    directions = axis / np.linalg.norm(axis) + spread * rng.normal(size=(views, 3))
    camera_centres: F64 = 6 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return camera_centres


def ridge_case(log_lam: float, alpha: float, decades: float, spread: float) -> RidgeCase:
    """Four splats in forty views, weights over so many decades, camera centres within so large an angle."""
    scene = random_scene(4, 3, seed=9)
    scene = dataclasses.replace(scene, means=(spread * scene.means).astype(np.float32))
    dense = 10 ** np.random.default_rng(9).uniform(-decades, min(decades, 6), (4, 40))
    options = CompactionOptions(lam=0.0 if log_lam < -8 else 10**log_lam, alpha=alpha)
    over = f"weights over {decades + min(decades, 6):g} decades"
    name = f"views within {spread:g} rad, {over}, λ {options.lam:g}, α {alpha:g}"
    return RidgeCase(name, scene, around(40, spread, 9), dense.astype(np.float32), options)


def known_ridges() -> Iterator[RidgeCase]:
    """From easy to far beyond a condition number of 1e14."""
    for spread, log_lam, alpha in itertools.product((1.0, 0.1, 1e-2, 1e-3, 1e-5), (-9, -6, 0, 6, 12), (0.9, 1.0)):
        yield ridge_case(log_lam, alpha, 1, spread)
    for decades, log_lam in itertools.product((3, 6, 12), (-9, 0)):
        yield ridge_case(log_lam, 1.0, decades, 1.0)
    scene = random_scene(6, seed=10)
    for label, centres in (
        ("one view", around(1, 1, 0)),
        ("two opposite views", np.array([[0.0, 6, 0], [0, -6, 0]])),
        ("seven views from one place", np.tile(around(1, 1, 0), (7, 1))),
        ("nine views on a ring", 6 * np.stack([np.cos(np.arange(9)), np.sin(np.arange(9)), np.zeros(9)], axis=1)),
    ):
        for weight, lam in itertools.product((1e-12, 1.0, 1e6), (0.0, 1.0, 1e12)):
            weights = np.full((6, len(centres)), weight, np.float32)
            name = f"{label}, weights {weight:g}, λ {lam:g}"
            yield RidgeCase(name, scene, centres, weights, CompactionOptions(lam=lam, alpha=1.0))
    offset = np.array([3e5, -2e5, 1e5])
    far = dataclasses.replace(scene, means=(scene.means + offset).astype(np.float32))
    name = "4e5 from the origin"
    yield RidgeCase(name, far, around(30, 1, 0) + offset, np.ones((6, 30), np.float32), CompactionOptions(lam=0.1))


def known_refits() -> Iterator[RefitCase]:
    """Small scenes with few layers, their colours clear of 0 unless that is the point."""
    plain = RefitOptions(steps=REFIT_STEPS, gain=0, prior=3)
    views = ring_of_cameras(3, size=24)

    def visible(count: int, degree: int, seed: int, brightness: float = 2.0) -> Scene:
        scene, rng = random_scene(count, degree, seed), np.random.default_rng(seed)
        scene.sh[:, 0] = brightness + 0.3 * scene.sh[:, 0]
        return dataclasses.replace(
            scene,
            log_scales=rng.normal(-1.5, 0.5, (count, 3)).astype(np.float32),
            opacity_logits=rng.normal(-1, 1, count).astype(np.float32),
        )

    for degree in range(4):
        yield RefitCase(f"30 splats of degree {degree}", visible(30, degree, 1), visible(40, 1, 2), views, plain)
    scene, other = visible(30, 3, 1), visible(40, 1, 2)
    for prior, lam in ((1e-2, 0.0), (0.1, 0.0), (1e6, 0.0), (0.1, 1e6)):
        options = dataclasses.replace(plain, prior=prior, lam=lam)
        yield RefitCase(f"prior {prior:g}, λ {lam:g}", scene, other, views, options)
    rank_deficient = dataclasses.replace(plain, prior=0)
    yield RefitCase("one view, λ and prior 0: rank deficient", scene, other, views[1:2], rank_deficient)
    yield RefitCase("one pixel", scene, other, [straight_camera(1, 1, focal=1.0)], plain)
    for brightness in (-30.0, 0.0, 100.0):
        changed = visible(30, 1, 1, brightness)
        yield RefitCase(f"DC about {brightness:g}", changed, other, views, plain)
        yield RefitCase(f"to pictures of DC about {brightness:g}", scene, changed, views, plain)
    black = dataclasses.replace(other, opacity_logits=np.full(len(other), -30, np.float32))
    yield RefitCase("to black pictures", scene, black, views, plain)
    for offset in (1e3, 1e5):
        moved = [dataclasses.replace(s, means=s.means + np.array([offset, 0, 0], np.float32)) for s in (scene, other)]
        camera_centres = [
            dataclasses.replace(v, translation=v.translation - v.rotation @ np.array([offset, 0, 0])) for v in views
        ]
        yield RefitCase(f"{offset:g} from the origin", moved[0], moved[1], camera_centres, plain)
    column = np.zeros((3000, 3))
    column[:, 2] = np.linspace(2, 6, 3000)
    colours = np.random.default_rng(5).uniform(0.2, 1, (3000, 3))
    tower = plain_splats(column, 0.5, -5.3, colours)
    dim = dataclasses.replace(tower, sh=(0.5 * tower.sh).astype(np.float32))
    yield RefitCase("3000 layers", dim, tower, [straight_camera(4, 4)], plain)
    opaque = dataclasses.replace(scene, opacity_logits=np.full(len(scene), 20, np.float32))
    yield RefitCase("opaque splats", opaque, other, views, plain)
    away = dataclasses.replace(scene, means=scene.means + np.array([0, 0, 1e4], np.float32))
    yield RefitCase("splats that no view sees", away, other, views, plain)


# ------------------------------------------------------------------------------------------ by hypothesis


def numbers(values: Any) -> str:
    """Short and exact enough to be typed in again."""
    return "(" + ", ".join(f"{v:.9g}" for v in np.asarray(values, np.float64).ravel()) + ")"


@st.composite
def small_scenes(draw: st.DrawFn) -> Case:
    """Up to five splats in a view, any of their parameters at its worst."""
    width, height = draw(st.sampled_from([(16, 16), (1, 1), (33, 17), (7, 40), (16384, 1)]))
    offset = draw(st.sampled_from([0.0, 1e3, 1e5]))
    tilted = tilted_camera(draw(st.integers(0, 3)), width, height, offset)
    focal = draw(st.sampled_from([1.0, 10.0, 1000.0])) * max(width, height)
    view = dataclasses.replace(tilted, fx=focal, fy=focal, cx=width / 2, cy=height / 2)
    exponent = st.floats(-14, 8, width=32)
    means, log_scales, quaternions, logits, sh = [], [], [], [], []
    for _ in range(draw(st.integers(1, 5))):
        z = draw(st.sampled_from([0.2001, 0.21, 0.5, 1.0, 1.0000001, 4.0, 30.0, 1e4]))
        x, y = (draw(st.floats(-1.5, 1.5)) * side / (2 * focal) for side in (width, height))
        means.append(view.rotation.T @ np.array([x * z, y * z, z]) + view.centre)
        log_scales.append([draw(exponent) for _ in range(3)])
        quaternions.append([draw(st.floats(-1, 1, width=32)) for _ in range(4)])
        logits.append(draw(st.one_of(st.floats(-6, 8, width=32), st.sampled_from([-50.0, 50.0, 16.118095]))))
        sh.append([draw(st.floats(-2, 2, width=32)) for _ in range(3)])
    arrays = [np.asarray(values, np.float32) for values in (means, log_scales, quaternions, logits)]
    colours = np.asarray(sh, np.float32)[:, None]
    text = "; ".join(
        f"μ {numbers(m)} log σ {numbers(s)} q {numbers(q)} logit {o:.9g} DC {numbers(c)}"
        for m, s, q, o, c in zip(*arrays, colours, strict=True)
    )
    where = f"{width} x {height}, f {focal:g}, R {numbers(view.rotation)}, t {numbers(view.translation)}"
    return Case(f"{where}: {text}", Scene(arrays[0], arrays[1], arrays[2], arrays[3], colours), view)
