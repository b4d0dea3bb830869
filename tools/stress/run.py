"""Numerical stress of every kernel against float64, on every OpenCL device.

    python -m tools.stress.run [options]

Each stage is judged on what it was given, so that an error belongs to one kernel: projection on the scene, tile lists,
order and compositing on the ellipses that projection left, removal effects on the same, derivatives of pictures on the
scene (tools.stress.derivatives), the ridge on its own systems, the re-fit on small scenes. Inputs (tools.stress.cases):
cases made by hand, and some that hypothesis makes worse and worse.

Beside each error stands what the kernel cannot help: how much the float64 result moves when the numbers that the kernel
gets are rounded to float32 (random relative changes of up to 2^-24, a few draws). An error of a few times that is the
problem's condition; an error of more than LIMIT times that is the kernel's own, "unstable", and is printed as a case
made as small as it goes. Pixels within rounding of a threshold (alpha 1/255, the end of a pixel) or of a tie in depth
are left out where a flip would say nothing; what may not happen anywhere is a value that is not finite.

Every device and kernel family runs in a process of its own. Prints Markdown; --json writes the inputs too, and
--from reads it again.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
from hypothesis import HealthCheck, Phase, find, given, settings, target
from hypothesis import strategies as st
from hypothesis.errors import NoSuchExample
from numpy.typing import NDArray

from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import DeviceInfo, list_devices
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import RasterRules
from potr_cl.raster.view_set import TILE
from potr_cl.reference import raster as reference
from potr_cl.reference.refit import Reference, to_ycocg
from potr_cl.reference.ridge import YCOCG, objective, ridge, weighted_basis
from potr_cl.stages.compaction.ridge import Compactor
from potr_cl.stages.compaction.view_weights import ViewWeights
from potr_cl.stages.pruning.removal import RemovalSweep
from potr_cl.stages.pruning.sweep_options import SweepOptions
from potr_cl.stages.refitting.refit import refit_colours
from potr_cl.stages.refitting.targets import RenderedTargets
from tools.results import circumstances
from tools.stress.cases import (
    Case,
    RefitCase,
    RidgeCase,
    known_cases,
    known_refits,
    known_ridges,
    refit_problems,
    ridge_systems,
    small_scenes,
)
from tools.stress.derivatives import check_derivatives, tellable

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]
#: What a check finds: error, and the part of it that rounding the input explains.
Measures = dict[str, tuple[float, float]]

#: Half a unit in the last place of a float32, relatively.
ULP = 2.0**-24
#: Times what rounding the input explains, beyond which an error is the kernel's own.
LIMIT = 100.0
#: Draws of rounding errors. Seed of all of them.
DRAWS, SEED = 3, 0
#: Splats of a case whose removal is checked, and the brightest colour: effects of more are cut off by design.
REMOVED, BRIGHTEST = 64, 4.0
#: Colour error of a least-squares solution that is a matter of rounding: 1/2000 of a step of 8 bits.
ROUNDING = 2e-6
#: What the re-fit promises beside that: this part of the way to the solution, after enough steps.
REFIT_PROMISE = 1e-3

WHAT = {
    "project: alpha": "largest error of a splat's alpha in a pixel",
    "project: colour": "of a colour, relative to the sum of its terms' magnitudes",
    "project: depth": "of a depth, relative to the distance",
    "tile lists": "255 alpha - 1 of the brightest (pixel, splat) pair that a list lacks",
    "sort": "intersections out of order",
    "composite": "of a pixel, relative to the brightest colour",
    "render": "of a pixel of the whole rasterizer, the same",
    "removal: importance": "of a splat's importance, relative",
    "removal: effect": "of a splat's ΔMSE, relative to the sum of its terms' magnitudes",
    "fit: finite": "a derivative of a picture that is not finite",
    "fit: gradient": "of the pictures' derivatives by a kind of parameters, relative to their length",
    "fit: J x": "x · Jᵀ J x over ‖J x‖², less 1",
    "ridge": "weighted colour error above the optimum, relative to the largest coefficient or 1",
    "re-fit: optimum": "colour error in the pictures above the optimum, or above where the solver had to stop",
    "re-fit: loss": "how much more squared error than the start has, relative",
}
#: Measures whose expectation is a promise, not the effect of rounding.
PROMISES = ("ridge", "re-fit: optimum", "re-fit: loss")


@dataclasses.dataclass
class Worst:
    """The largest of one measure so far, by error and by the part that nothing explains."""

    error: float = -1.0
    expected: float = 0.0
    at: str = ""
    ratio: float = -1.0
    ratio_at: str = ""
    checked: int = 0

    def add(self, error: float, expected: float, name: str) -> None:
        self.checked += 1
        if not error <= self.error:
            self.error, self.expected, self.at = error, expected, name
        if not error / expected <= self.ratio:
            self.ratio, self.ratio_at = error / expected, name


# ------------------------------------------------------------------------------------------ float64


def rounded(values: F64, rng: np.random.Generator) -> F64:
    """Each value off by up to half a unit in the last place of a float32."""
    return values * (1 + ULP * rng.uniform(-1, 1, values.shape))


def stand_in(case: Case, rng: np.random.Generator | None = None) -> tuple[Scene, Camera]:
    """The case's scene and view in float64, or what rounding may make of them."""
    scene, view = case.scene, case.view
    quaternions = scene.quaternions.astype(np.float64)
    length = np.linalg.norm(quaternions, axis=1, keepdims=True)
    quaternions = np.where(length > 0, quaternions / np.where(length > 0, length, 1), (1.0, 0, 0, 0))
    means, log_scales = scene.means.astype(np.float64), scene.log_scales.astype(np.float64)
    # As the rasterizer takes them: nothing can be seen to differ, nothing overflows.
    log_scales = np.minimum(log_scales, np.log(1e12))
    logits, sh = scene.opacity_logits.astype(np.float64), scene.sh.astype(np.float64)
    if rng is not None:
        rotation = rounded(view.rotation, rng)
        means = view.centre + rounded(means - view.centre, rng)
        log_scales = log_scales + ULP * rng.uniform(-1, 1, log_scales.shape)
        quaternions = rounded(quaternions, rng)
        log2_opacities = rounded(-np.logaddexp(0, -logits) / np.log(2), rng)
        with np.errstate(over="ignore"):
            logits = -np.log(np.expm1(-np.minimum(log2_opacities * np.log(2), -1e-300)))
        view = dataclasses.replace(
            view,
            rotation=rotation,
            translation=-rotation @ view.centre,
            fx=float(rounded(np.array(view.fx), rng)),
            fy=float(rounded(np.array(view.fy), rng)),
        )
    count = len(means)

    class Precise(SimpleNamespace):
        def __len__(self) -> int:
            return count

    precise = Precise(
        means=means,
        log_scales=log_scales,
        quaternions=quaternions,
        opacity_logits=logits,
        sh=sh,
        sh_degree=scene.sh_degree,
        antialiased=scene.antialiased,
        low_pass=scene.low_pass,
    )
    return cast(Scene, precise), view


def projected(case: Case, rng: np.random.Generator | None = None) -> reference.Projected:
    """The definition of projection, of the case or of what rounding may make of it."""
    with np.errstate(all="ignore"):
        return reference.project(*stand_in(case, rng), case.rules)


@dataclasses.dataclass
class Pixels:
    """Centres of a view's pixels and the tiles that they lie in, (P,)."""

    x: F64
    y: F64
    tile: NDArray[np.int64]

    @staticmethod
    def of(view: Camera) -> Pixels:
        rows, columns = np.divmod(np.arange(view.width * view.height), view.width)
        return Pixels(columns + 0.5, rows + 0.5, rows // TILE * -(-view.width // TILE) + columns // TILE)


def alphas_of_covariances(p: reference.Projected, pixels: Pixels) -> F64:
    """(K, P) alpha before cap and threshold, by the definition."""
    s = p.covariance
    with np.errstate(all="ignore"):
        dx, dy = pixels.x - p.centre[:, :1], pixels.y - p.centre[:, 1:]
        # Cholesky's factor: the conic's three terms cancel for needles, even in float64.
        c = 1 / np.sqrt(s[:, 1, 1])
        # Lagrange's identity needs the axes; the determinant of the dilated covariance is at least 0.09.
        determinant = np.maximum(s[:, 0, 0] * s[:, 1, 1] - s[:, 0, 1] ** 2, 0.09)
        a = np.sqrt(s[:, 1, 1] / determinant)
        u = a[:, None] * (dx - (s[:, 0, 1] / s[:, 1, 1])[:, None] * dy)
        alpha = p.opacity[:, None] * np.exp(-0.5 * (u * u + (c[:, None] * dy) ** 2))
    return cast(F64, np.nan_to_num(alpha, nan=0.0))


def alphas_of_shapes(shapes: F64, pixels: Pixels) -> F64:
    """(K, P) alpha before cap and threshold, of ellipses as cl/include/splat.clh has them, (K, 8)."""
    x, y, a, b, c, log2_opacity = (shapes[:, i, None] for i in range(6))
    with np.errstate(all="ignore"):
        dx, dy = pixels.x - x, pixels.y - y
        alpha = np.exp2(log2_opacity - (a * dx + b * dy) ** 2 - (c * dy) ** 2)
    return cast(F64, np.nan_to_num(alpha, nan=0.0))


@dataclasses.dataclass
class Composited:
    """One view in float64.

    Attributes:
        image: (P, 3). transmittance: (P,).
        margin: (P,) how near, relatively, a pixel came to a threshold.
        alpha: (K, P) of the pairs that were composited, else 0.
    """

    image: F64
    transmittance: F64
    margin: F64
    alpha: F64


def composite(raw: F64, colours: F64, rules: RasterRules, background: F64 | None = None) -> Composited:
    """Front to back; ``raw`` (K, P) is 0 where a splat is in no list of the pixel's tile."""
    transmittance = np.ones(raw.shape[1])
    alive = np.ones(raw.shape[1], bool)
    margin = np.full(raw.shape[1], np.inf)
    image = np.zeros((raw.shape[1], 3))
    used = np.zeros_like(raw)
    for k in range(len(raw)):
        margin = np.where(alive & (raw[k] > 0), np.minimum(margin, np.abs(raw[k] * 255 - 1)), margin)
        alpha = np.where(raw[k] >= 1 / 255, np.minimum(raw[k], rules.alpha_cap), 0)
        after = transmittance * (1 - alpha)
        touched = alive & (alpha > 0)
        margin = np.where(touched, np.minimum(margin, np.abs(after / rules.transmittance_threshold - 1)), margin)
        alive &= ~(touched & (after < rules.transmittance_threshold))
        used[k] = np.where(touched & alive, alpha, 0)
        image += (transmittance * used[k])[:, None] * colours[k]
        transmittance = transmittance * (1 - used[k])
    if background is not None:
        image += transmittance[:, None] * background
    return Composited(image, transmittance, margin, used)


def held_image(alpha: F64, colours: F64) -> F64:
    """(P, 3) of pairs that are composited whatever the transmittance, over black."""
    before = np.cumprod(1 - alpha, axis=0)
    weights = alpha.copy()
    weights[1:] *= before[:-1]
    return weights.T @ colours


def removal_effects(alpha: F64, colours: F64, wanted: F64, splats: NDArray[np.int64]) -> tuple[F64, F64, F64]:
    """ΔMSE of single removals with the pixels' ends held, the sum of the terms' magnitudes, and importances.

    By the definition: composited with and without each splat.
    """
    now = held_image(alpha, colours)
    before = np.cumprod(1 - alpha, axis=0)
    weights = alpha.copy()
    weights[1:] *= before[:-1]
    effects, magnitudes = np.zeros(len(splats)), np.zeros(len(splats))
    for i, k in enumerate(splats):
        touched = np.flatnonzero(alpha[k])  # no other pixel changes, and most splats are in few of them
        without = alpha[:, touched]
        without[k] = 0
        change, error = held_image(without, colours) - now[touched], (now - wanted)[touched]
        effects[i] = np.sum(change**2 + 2 * change * error)
        magnitudes[i] = np.sum(change**2 + 2 * np.abs(change) * np.abs(error))
    pixels = alpha.shape[1]
    return effects / (3 * pixels), magnitudes / (3 * pixels), weights[splats].sum(axis=1) / pixels


# ------------------------------------------------------------------------------------------ checks


@dataclasses.dataclass
class Lists:
    """What the device made of a view: ellipses (N, 8), colours (N, 3), each tile's intersections, pictures."""

    shapes: F64
    colours: F64
    offsets: NDArray[np.uint32]
    intersections: NDArray[np.uint32]
    image: F64
    transmittance: F64

    def order(self) -> NDArray[np.int64]:
        """The splats in any list, front to back."""
        listed = np.unique(self.intersections).astype(np.int64)
        return listed[np.lexsort((listed, self.shapes[listed, 6].astype(np.float32)))]

    def membership(self, splats: NDArray[np.int64], tiles: int) -> Mask:
        """(K, tiles) whether a splat is in a tile's list."""
        found = np.zeros((len(self.shapes), tiles), bool)
        lengths = self.offsets[1:] - self.offsets[:-1]
        found[self.intersections, np.repeat(np.arange(tiles), lengths)] = True
        return cast(Mask, found[splats])


def rasterized(rasterizer: Rasterizer, view: Camera) -> Lists:
    """All that the rasterizer's stages leave."""
    device = rasterizer.device
    with rasterizer.prepare(view) as prepared:
        image, transmittance = rasterizer.composite(prepared)
        shapes = device.download(prepared.shapes, (rasterizer.stride, 8), np.float32)[: rasterizer.splats]
        colours = device.download(prepared.colours, (rasterizer.stride, 4), np.float32)[: rasterizer.splats, :3]
        with np.errstate(invalid="ignore"):  # colours of splats that are not drawn are never set
            wide = colours.astype(np.float64)
        return Lists(
            shapes.astype(np.float64),
            wide,
            device.download(prepared.offsets, (prepared.tiles + 1,), np.uint32),
            device.download(prepared.intersections, (prepared.intersection_count,), np.uint32),
            image.reshape(-1, 3).astype(np.float64),
            transmittance.ravel().astype(np.float64),
        )


def check_projection(case: Case, lists: Lists, pixels: Pixels) -> Measures:
    """Ellipses, colours and depths of the splats in front of the near plane."""
    rng = np.random.default_rng(SEED)
    true = projected(case)
    ours = lists.shapes[true.index]
    cap = case.rules.alpha_cap
    alpha = np.minimum(alphas_of_covariances(true, pixels), cap)
    error = np.abs(np.minimum(alphas_of_shapes(ours, pixels), cap) - alpha).max(axis=1, initial=0)
    # Splats that are not to be seen need no ellipse; one that is just at the near plane may be on either side of it.
    error[alpha.max(axis=1, initial=0) < 1 / 255] = 0
    distance = np.linalg.norm(case.scene.means[true.index].astype(np.float64) - case.view.centre, axis=1)
    error[np.abs(true.depth - case.rules.near) < 4 * ULP * distance] = 0

    listed = np.isin(true.index, lists.intersections)
    direction = (case.scene.means[true.index].astype(np.float64) - case.view.centre) / distance[:, None]
    terms = np.abs(reference.sh_basis(direction, case.scene.sh_degree))[:, :, None] * np.abs(case.scene.sh[true.index])
    scale = 0.5 + terms.sum(axis=1)
    colour = np.abs(lists.colours[true.index] - np.clip(true.colour, 0, 1e30)) / scale
    depth = np.abs(ours[:, 6] - true.depth) / distance
    expected = np.full(3, ULP)
    for _ in range(DRAWS):
        moved = projected(case, rng)
        place = {int(k): i for i, k in enumerate(moved.index)}
        at = np.array([place.get(int(k), -1) for k in true.index], int)
        there = at >= 0
        if not there.any():
            continue
        moved_alpha = np.minimum(alphas_of_covariances(moved, pixels)[at[there]], cap)
        moved_colour = np.abs(np.maximum(moved.colour[at[there]], 0) - true.colour[there]) / scale[there]
        changes = (
            np.abs(moved_alpha - alpha[there]).max(initial=0),
            moved_colour.max(initial=0),
            (np.abs(moved.depth[at[there]] - true.depth[there]) / distance[there]).max(initial=0),
        )
        expected = np.maximum(expected, changes)
    return {
        "project: alpha": (float(error.max(initial=0)), expected[0]),
        "project: colour": (float(colour[listed].max(initial=0)), expected[1]),
        "project: depth": (float(depth[listed].max(initial=0)), expected[2]),
    }


def check_lists(case: Case, lists: Lists, pixels: Pixels, raw: F64, member: Mask) -> Measures:
    """That lists hold all that reaches 1/255, by the device's own ellipses, and hold it in order."""
    found: Measures = {}
    if not case.rules.square_extent:  # which cuts lists short on purpose
        everything = alphas_of_shapes(lists.shapes, pixels)
        drawn = np.isfinite(lists.shapes[:, :7]).all(axis=1) & (lists.shapes[:, 6] > np.float32(case.rules.near))
        drawn &= np.abs(lists.shapes[:, :5]).sum(axis=1) < 1e30
        order = lists.order()
        inside = np.zeros(everything.shape, bool)
        inside[order] = member[:, pixels.tile]
        lacking = np.where(drawn[:, None] & ~inside, everything, 0)
        found["tile lists"] = (max(float(lacking.max(initial=0)) * 255 - 1, 0.0), ULP)
    wrong = 0
    depth = lists.shapes[:, 6].astype(np.float32)
    for begin, end in itertools.pairwise(lists.offsets.tolist()):
        run = lists.intersections[begin:end]
        wrong += int(np.count_nonzero(run != run[np.lexsort((run, depth[run]))]))
    found["sort"] = (float(wrong), 1.0)
    return found


def moved_raw(lists: Lists, order: NDArray[np.int64], pixels: Pixels, inside: Mask, rng: np.random.Generator) -> F64:
    """Alphas of ellipses that rounding has changed."""
    return np.where(inside, alphas_of_shapes(rounded(lists.shapes[order], rng), pixels), 0)


def check_composite(case: Case, lists: Lists, pixels: Pixels, raw: F64, inside: Mask) -> tuple[Measures, Mask]:
    """The picture, by the device's own ellipses and lists; and which pixels are clear of all thresholds."""
    rng = np.random.default_rng(SEED)
    order = lists.order()
    colours = lists.colours[order]
    true = composite(raw, colours, case.rules)
    brightest = max(1.0, float(colours.max(initial=0)))
    wobble = np.full(len(pixels.x), 16 * ULP)
    changes = []
    for _ in range(DRAWS):
        moved = moved_raw(lists, order, pixels, inside, rng)
        wobble += (np.abs(moved - raw) / np.maximum(raw, 1 / 255)).sum(axis=0)
        other = composite(moved, rounded(colours, rng), case.rules)
        changes.append(difference(other.image, other.transmittance, true, brightest))
    clear = true.margin > 1e-4 + 8 * wobble
    error = difference(lists.image, lists.transmittance, true, brightest)
    expected = ULP + max(float(change[clear].max(initial=0)) for change in changes)
    return {"composite": (float(error[clear].max(initial=0)), expected)}, clear


def difference(image: F64, transmittance: F64, true: Composited, brightest: float) -> F64:
    """(P,) of a picture to another."""
    error: F64 = np.abs(image - true.image).max(axis=1) / brightest
    return np.maximum(error, np.abs(transmittance - true.transmittance))


def check_render(case: Case, lists: Lists, pixels: Pixels) -> tuple[Measures, Mask | None]:
    """The picture by the definition alone, where no threshold and no tie in depth is near; and where that is."""
    if case.rules.square_extent:
        return {}, None
    rng = np.random.default_rng(SEED)
    true = projected(case)
    raw = alphas_of_covariances(true, pixels)
    visible = raw.max(axis=1, initial=0) >= 0.5 / 255
    place = {int(k): i for i, k in enumerate(true.index)}
    colours = np.clip(true.colour, 0, 1e30)
    picture = composite(raw[visible], colours[visible], case.rules)
    brightest = max(1.0, float(colours[visible].max(initial=0)))
    depth = true.depth[visible]
    # Orders that a float32 depth may have either way, and pairs of splats that share a pixel there.
    shown = raw[visible] >= 0.5 / 255
    clear = np.ones(len(pixels.x), bool)
    distance = np.linalg.norm(case.scene.means[true.index[visible]].astype(np.float64) - case.view.centre, axis=1)
    tied = np.diff(depth) < 8 * ULP * np.maximum(distance[1:], distance[:-1])
    for run in np.split(np.arange(len(depth)), np.flatnonzero(~tied) + 1):
        if len(run) > 1:
            clear &= shown[run].sum(axis=0) < 2
    wobble = np.full(len(pixels.x), 16 * ULP)
    changes = []
    for _ in range(DRAWS):
        moved = projected(case, rng)
        at = np.array([place.get(int(k), -1) for k in moved.index], int)
        kept = at >= 0
        moved_alpha = np.zeros_like(raw)
        moved_alpha[at[kept]] = alphas_of_covariances(moved, pixels)[kept]
        moved_colours = colours.copy()
        moved_colours[at[kept]] = np.clip(moved.colour[kept], 0, 1e30)
        moved_alpha, moved_colours = moved_alpha[visible], moved_colours[visible]
        wobble += (np.abs(moved_alpha - raw[visible]) / np.maximum(raw[visible], 1 / 255)).sum(axis=0)
        other = composite(moved_alpha, moved_colours, case.rules)
        changes.append(difference(other.image, other.transmittance, picture, brightest))
    clear &= picture.margin > 1e-4 + 8 * wobble
    near = np.abs(true.depth - case.rules.near) < 1e-6 * case.rules.near
    if near.any():
        clear &= ~(raw[near] >= 0.5 / 255).any(axis=0)
    error = difference(lists.image, lists.transmittance, picture, brightest)
    expected = ULP + max(float(change[clear].max(initial=0)) for change in changes)
    return {"render": (float(error[clear].max(initial=0)), expected)}, clear


def check_removal(
    case: Case, rasterizer: Rasterizer, lists: Lists, pixels: Pixels, raw: F64, inside: Mask, clear: Mask
) -> Measures:
    """Effects and importances once the splats of every third place are gone, by the device's own ellipses."""
    rng = np.random.default_rng(SEED)
    with RemovalSweep(rasterizer, [case.view], SweepOptions(tolerance=-1, transmittance_threshold=None)) as removal:
        removal.measure()
        order = lists.order()
        gone = order[::3] if len(order) > 2 else order[:0]
        removal.remove(gone)
        effect, importance = removal.measure()
    left = np.flatnonzero(~np.isin(order, gone))
    if not (np.isfinite(effect).all() and np.isfinite(importance).all()):
        return {"removal: effect": (np.inf, ULP)}
    colours = lists.colours[order]
    if not len(left) or colours.max(initial=0) > BRIGHTEST:
        return {}

    def effects(raw: F64, colours: F64) -> tuple[F64, F64, F64, Composited]:
        wanted = held_image(composite(raw, colours, case.rules).alpha, colours)
        now = composite(raw[left], colours[left], case.rules)
        return (*removal_effects(now.alpha, colours[left], wanted, chosen), now)

    chosen = np.unique(np.linspace(0, len(left) - 1, REMOVED).astype(int))
    true, magnitude, shares, now = effects(raw, colours)
    # A flip shows in every splat of its pixel.
    unclear = ~clear | (now.margin < 1e-4)
    flips = (raw[left][chosen][:, unclear] > 0.5 / 255).any(axis=1)
    splat = order[left[chosen]]
    # What the fixed point of the totals resolves, and what no quality ever asks for.
    floor = 1e-15
    error = np.abs(effect[splat] - true) / (magnitude + floor)
    share_error = np.abs(importance[splat] - shares) / (shares + floor)
    expected, share_expected = 4 * ULP, 4 * ULP
    for _ in range(DRAWS):
        moved, _, moved_shares, _ = effects(moved_raw(lists, order, pixels, inside, rng), rounded(colours, rng))
        change, share_change = (
            np.abs(moved - true) / (magnitude + floor),
            np.abs(moved_shares - shares) / (shares + floor),
        )
        expected = max(expected, float(change[~flips].max(initial=0)))
        share_expected = max(share_expected, float(share_change[~flips].max(initial=0)))
    return {
        "removal: effect": (float(error[~flips].max(initial=0)), expected),
        "removal: importance": (float(share_error[~flips].max(initial=0)), share_expected),
    }


def check(device: Device, case: Case) -> Measures:
    """Every measure of a view."""
    # By the cap that the kernels get: the float32 nearest to 0.999 lets 1.3e-5 less light through.
    cap = float(np.float32(case.rules.alpha_cap))
    case = dataclasses.replace(case, rules=dataclasses.replace(case.rules, alpha_cap=cap))
    with Rasterizer(device, case.scene, case.rules) as rasterizer:
        lists = rasterized(rasterizer, case.view)
        finite = np.isfinite(lists.image).all() and np.isfinite(lists.transmittance).all()
        finite &= bool(np.isfinite(lists.colours[np.unique(lists.intersections)]).all())
        if not finite or lists.transmittance.min() < 0 or lists.transmittance.max() > 1:
            return {"composite": (np.inf, ULP)}
        pixels = Pixels.of(case.view)
        order = lists.order()
        member = lists.membership(order, len(lists.offsets) - 1)
        inside = member[:, pixels.tile]
        raw = np.where(inside, alphas_of_shapes(lists.shapes[order], pixels), 0)
        found = check_projection(case, lists, pixels)
        found |= check_lists(case, lists, pixels, raw, member)
        composited, clear = check_composite(case, lists, pixels, raw, inside)
        render, tellable_pixels = check_render(case, lists, pixels)
        found |= composited | render
        found |= check_removal(case, rasterizer, lists, pixels, raw, inside, clear)
    true = projected(case)
    shown = np.isin(true.index, lists.intersections)
    sound = tellable(true.covariance[shown], true.colour[shown])
    draw = partial(stand_in, case)
    return found | check_derivatives(device, case.scene, case.view, case.rules, tellable_pixels, sound, draw, DRAWS)


def check_ridge(device: Device, case: RidgeCase) -> Measures:
    """How far the compaction's colours are above the optimum over the coefficients that it left free.

    A channel that kept its coefficients because its solution would have been out of bounds is left out.
    """
    dense = case.weights
    offsets = np.concatenate([[0], np.cumsum((dense > 0).sum(axis=1))])
    weights = ViewWeights(offsets, np.nonzero(dense)[1].astype(np.int32), dense[dense > 0].astype(np.float32))
    compacted = Compactor(device).compact(case.scene, case.centres, weights, case.options)
    if not np.isfinite(compacted.sh).all():
        return {"ridge": (np.inf, ROUNDING)}
    before = case.scene.sh @ YCOCG.T
    after = compacted.sh @ YCOCG.T
    worst = 0.0
    for k in range(len(case.scene)):
        rows = dense[k] > 0
        if not rows.any():
            continue
        strength = dense[k, rows].astype(np.float64)
        basis = weighted_basis(
            case.scene.means[k].astype(np.float64), case.centres[rows], strength, case.scene.sh_degree
        )
        scale = max(1.0, float(np.abs(before[k]).max()))
        for c in range(3):
            if np.allclose(after[k, :, c], before[k, :, c], rtol=1e-5, atol=1e-6 * scale):
                continue
            lam = case.options.lam * (case.options.chroma_factor if c else 1)
            used = np.abs(after[k, :, c]) > 1e-6 * np.abs(compacted.sh[k]).max(initial=1e-30)
            used[0] = True
            best = objective(basis, before[k, :, c], ridge(basis, before[k, :, c], used, lam), lam)
            ours = objective(basis, before[k, :, c], np.where(used, after[k, :, c], 0), lam)
            worst = max(worst, np.sqrt(max(ours - 1.001 * best, 0) / np.sum(strength**2)) / scale)
    return {"ridge": (float(worst), ROUNDING)}


def check_refit(device: Device, case: RefitCase) -> Measures:
    """How far the pictures are above the optimum, cut colours staying cut, and whether anything was lost."""
    with Rasterizer(device, case.other) as rasterizer:
        pictures = [rasterizer.render(view)[0] for view in case.views]
        targets = RenderedTargets(rasterizer, case.views)
        refitted = refit_colours(device, case.scene, case.views, targets, case.options)
    if not np.isfinite(refitted.sh).all():
        return {"re-fit: loss": (np.inf, ULP)}
    before, after = refitted.errors
    found = {"re-fit: loss": (max(after - before, 0.0) / max(before, 1e-12), ULP)}
    try:
        true = Reference(case.scene, case.views, pictures, case.options.lam, case.options.prior)
    except ValueError:  # a pixel too near a threshold: whose pictures are meant?
        return found
    x, best = to_ycocg(refitted.sh), true.solution()

    def length(way: F64) -> float:
        # At the optimum the gradient is 0: the excess is the square of the way, without a difference of objectives.
        squares = sum(v.weight * np.sum(i**2) for v, i in zip(true.views, true.forward(way), strict=True))
        squares += np.sum(true.pull * way**2) + true.prior * np.sum(way**2)
        return float(np.sqrt(squares / sum(3 * v.weight * len(v.blend) for v in true.views)))

    # Where colours cut on the way made it worse, the solver goes only a part of it, or stays.
    parts = [0.0, *(0.5**n for n in range(5))]
    off = min(length(x - true.start - part * (best - true.start)) for part in parts)
    return found | {"re-fit: optimum": (off, ROUNDING + REFIT_PROMISE * length(best - true.start))}


# ------------------------------------------------------------------------------------------ the search


def _settings(examples: int, *phases: Phase) -> settings:
    return settings(
        max_examples=examples,
        database=None,
        deadline=None,
        derandomize=True,
        suppress_health_check=list(HealthCheck),
        phases=phases,
    )


def search(
    measure: str, cases: st.SearchStrategy[Any], run: Callable[[Any], Measures], worst: dict[str, Worst], examples: int
) -> None:
    """Have hypothesis raise one measure's error, and that error over what rounding explains."""

    def attempt(case: Any) -> None:
        found = run(case)
        note(worst, found, case.name)
        error, expected = found.get(measure, (0.0, 1.0))
        target(float(np.log10(max(min(error, 1e30), 1e-12))), label=f"{measure}: error")
        target(float(np.log10(max(min(error / expected, 1e30), 1e-12))), label=f"{measure}: ratio")

    given(cases)(_settings(examples, Phase.generate, Phase.target)(attempt))()


def limit(measure: str) -> float:
    """Times its expectation beyond which a measure is a fault."""
    return 1.0 if measure in PROMISES else LIMIT


def smallest_failure(
    measure: str, cases: st.SearchStrategy[Any], run: Callable[[Any], Measures], examples: int
) -> str | None:
    """The smallest input in which a measure is beyond the limit, if hypothesis comes upon one."""

    def fails(case: Any) -> bool:
        error, expected = run(case).get(measure, (0.0, 1.0))
        return not error <= limit(measure) * expected

    try:
        return str(find(cases, fails, settings=_settings(examples, Phase.generate, Phase.target, Phase.shrink)).name)
    except NoSuchExample:
        return None


def note(worst: dict[str, Worst], found: Measures, name: str) -> None:
    """Keep what is worse than before."""
    for measure, (error, expected) in found.items():
        worst.setdefault(measure, Worst()).add(error, expected, name)


# ------------------------------------------------------------------------------------------ the run


def run_device(device: Device, examples: int, only: str = "") -> dict[str, Any]:
    """All cases, then ``examples`` attempts at each measure whose name begins with ``only``."""
    worst: dict[str, Worst] = {}

    def view(case: Case) -> Measures:
        return check(device, case)

    def system(case: RidgeCase) -> Measures:
        return check_ridge(device, case)

    def problem(case: RefitCase) -> Measures:
        return check_refit(device, case)

    lists: tuple[tuple[Callable[[Any], Measures], Iterator[Any]], ...] = (
        (view, known_cases()),
        (system, known_ridges()),
        (problem, known_refits()),
    )
    for run, cases in lists:
        for case in cases:
            found = run(case)
            if not any(measure.startswith(only) for measure in found):
                break  # the list is of other kernels
            note(worst, {measure: pair for measure, pair in found.items() if measure.startswith(only)}, case.name)
    searches: dict[str, tuple[Callable[[Any], Measures], st.SearchStrategy[Any]]] = {
        measure: (view, small_scenes()) for measure in WHAT
    }
    searches["ridge"] = system, ridge_systems()
    searches["re-fit: optimum"] = searches["re-fit: loss"] = problem, refit_problems()
    failures = {}
    for measure, (run, strategy) in searches.items():
        if not measure.startswith(only):
            continue
        if examples:
            search(measure, strategy, run, worst, examples)
        if measure in worst and not worst[measure].ratio <= limit(measure):
            smallest = smallest_failure(measure, strategy, run, 10 * examples) if examples else None
            failures[measure] = smallest or worst[measure].ratio_at
    kept = {name: dataclasses.asdict(w) for name, w in worst.items() if name.startswith(only)}
    return {"worst": kept, "failures": failures}


def families(info: DeviceInfo) -> tuple[str, ...]:
    """The kernel families that a device can run: GPU kernels anywhere, row kernels where vectors pay."""
    return ("cpu", "gpu") if info.family == "cpu" else ("gpu",)


def in_process(info: DeviceInfo, family: str, examples: int, only: str = "") -> dict[str, Any]:
    """The run in a process of its own, so that a runtime that crashes is one line of the table."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "result.json"
        command = [sys.executable, "-m", "tools.stress.run", "--device", str(info.index), "--family", family]
        command += ["--examples", str(examples), "--only", only, "--json", str(path)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            message = done.stderr.strip().splitlines()
            return {"failed": message[-1] if message else f"exit code {done.returncode}"}
        result: dict[str, Any] = json.loads(path.read_text())[0]
        return result


def shortened(name: str) -> str:
    """For a table's cell."""
    return name if len(name) <= 120 else "found: " + name[:60] + " …"


def print_report(results: list[dict[str, Any]]) -> None:
    """Markdown: the worst of every kernel over all devices, then a row for every device and family."""
    sound = [r for r in results if "failed" not in r]
    print("| kernel | error | worst | of it explained by rounding | with | worst ratio | with | inputs |")
    print("|---|---|---|---|---|---|---|---|")
    for measure, what in WHAT.items():
        rows = [r["worst"][measure] for r in sound if measure in r["worst"]]
        if not rows:
            continue
        by_error, by_ratio = (max(rows, key=lambda w: w[key]) for key in ("error", "ratio"))
        print(
            f"| {measure} | {what} | {by_error['error']:.1e} | {by_error['expected']:.1e} "
            f"| {shortened(by_error['at'])} "
            f"| {by_ratio['ratio']:.2g} | {shortened(by_ratio['ratio_at'])} | {sum(w['checked'] for w in rows)} |"
        )
    print("\nWorst error (worst ratio) by device:\n")
    measured = [measure for measure in WHAT if any(measure in r["worst"] for r in sound)]
    print("| device | kernels | " + " | ".join(measured) + " |")
    print("|---" * (len(measured) + 2) + "|")
    for r in results:
        if "failed" in r:
            print(f"| {r['device']} | {r['family']} | failed: {r['failed']}" + " |" * len(measured))
            continue
        found = [r["worst"].get(measure) for measure in measured]
        cells = (f"{w['error']:.0e} ({w['ratio']:.1g})" if w else "" for w in found)
        print(f"| {r['device']} | {r['family']} | " + " | ".join(cells) + " |")
    failures = [(r, *failure) for r in sound for failure in r["failures"].items()]
    print(
        f"\nBeyond {LIMIT:g} times what rounding explains, or beyond the promise ({', '.join(PROMISES)}): "
        f"{len(failures) or 'none'}."
    )
    for r, measure, name in failures:
        print(f"\n- {measure} on {r['device']}, {r['family']} kernels: {name}")


def main() -> None:
    os.environ.setdefault("RUSTICL_ENABLE", "llvmpipe")
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", type=int, help="index of one device; default: every one there is")
    parser.add_argument("--family", choices=("cpu", "gpu"), help="one family of kernels; default: all that run")
    parser.add_argument("--examples", type=int, default=100, help="attempts of the search at every measure")
    parser.add_argument("--only", default="", metavar="PREFIX", help="measures whose names begin so, such as fit")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--from", dest="kept", type=Path, nargs="+", help="results of earlier runs, instead of a run")
    args = parser.parse_args()
    if args.kept:
        print_report([result for path in args.kept for result in json.loads(path.read_text())])
        return
    results = []
    chosen = [info for info in list_devices() if args.device in (None, info.index)]
    for info in chosen:
        for family in families(info):
            if args.family not in (None, family):
                continue
            if args.device is None:
                result = in_process(info, family, args.examples, args.only)
            else:
                result = run_device(Device(info, family=family), args.examples, args.only)  # type: ignore[arg-type]
            results.append({**circumstances(info), "device": str(info), "family": family, **result})
            print(f"{info}, {family} kernels: done", file=sys.stderr, flush=True)
            if args.json is not None:
                args.json.write_text(json.dumps(results, indent=1))
    print_report(results)


if __name__ == "__main__":
    main()
