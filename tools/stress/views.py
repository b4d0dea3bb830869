"""Every kernel that a view needs, judged on what it was given (:func:`check`): a part of tools.stress.run."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator
from functools import partial
from typing import cast

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.camera import Camera
from potr_cl.opencl.device import Device
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.pruning.removal import RemovalSweep
from potr_cl.stages.pruning.sweep import SweepOptions
from tests.reference import raster as reference
from tools.stress.cases import Case
from tools.stress.derivatives import check_derivatives, tellable
from tools.stress.fits import check_fits
from tools.stress.measures import Measure, Measures
from tools.stress.precise import (
    F64,
    ULP,
    Composited,
    Pixels,
    alphas_of_covariances,
    alphas_of_shapes,
    composite,
    held_image,
    projected,
    removal_effects,
    rounded,
    stand_in,
)

Mask = NDArray[np.bool_]

#: Draws of rounding errors. Seed of all of them.
DRAWS, SEED = 3, 0
#: Splats of a case whose removal is checked, and the brightest colour: effects of more are cut off by design.
REMOVED, BRIGHTEST = 64, 4.0


def check(device: Device, case: Case) -> Measures:
    """Every measure of a view."""
    found, clear = check_rasterizer(device, case)
    if clear is None and not np.isfinite(found["composite"][0]):
        return found
    true = projected(case)
    shown = (alphas_of_covariances(true, Pixels.of(case.view)) >= 1 / 255).any(axis=1)
    sound = tellable(true.covariance[shown], true.colour[shown])
    draw = partial(stand_in, case)
    found |= check_fits(device, case)
    return found | check_derivatives(device, case.scene, case.view, case.rules, clear, sound, draw, DRAWS)


def check_rasterizer(device: Device, case: Case) -> tuple[Measures, Mask | None]:
    """The measures of the rasterizer and of removal; and which pixels are clear of all thresholds by the definition."""
    # By the cap that the kernels get: the float32 nearest to 0.999 lets 1.3e-5 less light through.
    cap = float(np.float32(case.rules.alpha_cap))
    case = dataclasses.replace(case, rules=dataclasses.replace(case.rules, alpha_cap=cap))
    with Rasterizer(device, case.scene, case.rules) as rasterizer:
        lists = rasterized(rasterizer, case.view)
        finite = np.isfinite(lists.image).all() and np.isfinite(lists.transmittance).all()
        finite &= bool(np.isfinite(lists.colours[np.unique(lists.intersections)]).all())
        if not finite or lists.transmittance.min() < 0 or lists.transmittance.max() > 1:
            return {"composite": (np.inf, ULP)}, None
        pixels, true = Pixels.of(case.view), projected(case)
        drawn = list(_drawn(case, true, pixels))
        order = lists.order()
        member = lists.membership(order, len(lists.offsets) - 1)
        inside = member[:, pixels.tile]
        raw = np.where(inside, alphas_of_shapes(lists.shapes[order], pixels), 0)
        found = check_projection(case, lists, pixels, true, drawn)
        found |= check_lists(case, lists, pixels, member)
        found["composite"], clear = check_composite(case, lists, pixels, raw, inside)
        found |= check_removal(case, rasterizer, lists, pixels, raw, inside, clear)
        if case.rules.square_extent:
            return found, None
        found["render"], clear = check_render(case, lists, pixels, true, drawn)
        return found, clear


@dataclasses.dataclass
class Drawn:
    """What rounding may make of the splats of a projection; of those that it hides ``there`` is False, and alpha 0."""

    there: Mask
    alpha: F64
    colour: F64
    depth: F64


def _drawn(case: Case, true: reference.Projected, pixels: Pixels) -> Iterator[Drawn]:
    rng = np.random.default_rng(SEED)
    place = {int(k): i for i, k in enumerate(true.index)}
    for _ in range(DRAWS):
        moved = projected(case, rng)
        at = np.array([place.get(int(k), -1) for k in moved.index], int)
        kept = at >= 0
        alpha = np.zeros((len(true.index), len(pixels.x)))
        drawn = Drawn(np.zeros(len(alpha), bool), alpha, true.colour.copy(), true.depth.copy())
        drawn.there[at[kept]] = True
        drawn.alpha[at[kept]] = alphas_of_covariances(moved, pixels)[kept]
        drawn.colour[at[kept]], drawn.depth[at[kept]] = moved.colour[kept], moved.depth[kept]
        yield drawn


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
    with rasterizer.prepare_set([view]) as prepared:
        image, transmittance = rasterizer.composite(prepared)
        shapes = device.download(prepared.shapes, (rasterizer.stride, 8), np.float32)[: rasterizer.splats]
        colours = device.download(prepared.colours, (rasterizer.stride, 4), np.float32)[: rasterizer.splats, :3]
        with np.errstate(invalid="ignore"):  # colours of splats that are not drawn are never set
            wide = colours.astype(np.float64)
        return Lists(
            shapes.astype(np.float64),
            wide,
            device.download(prepared.offsets, (prepared.tiles + 1,), np.uint32),
            device.download(prepared.intersections, (prepared.capacity,), np.uint32),
            image.reshape(-1, 3).astype(np.float64),
            transmittance.ravel().astype(np.float64),
        )


def check_projection(
    case: Case, lists: Lists, pixels: Pixels, true: reference.Projected, drawn: list[Drawn]
) -> Measures:
    """Ellipses, colours and depths of the splats in front of the near plane."""
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
    for each in drawn:
        changes = (
            np.abs(np.minimum(each.alpha, cap) - alpha)[each.there],
            (np.abs(np.maximum(each.colour, 0) - true.colour) / scale)[each.there],
            np.abs(each.depth - true.depth) / distance,
        )
        expected = np.maximum(expected, [change.max(initial=0) for change in changes])
    return {
        "project: alpha": (float(error.max(initial=0)), expected[0]),
        "project: colour": (float(colour[listed].max(initial=0)), expected[1]),
        "project: depth": (float(depth[listed].max(initial=0)), expected[2]),
    }


def check_lists(case: Case, lists: Lists, pixels: Pixels, member: Mask) -> Measures:
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


def check_composite(case: Case, lists: Lists, pixels: Pixels, raw: F64, inside: Mask) -> tuple[Measure, Mask]:
    """The picture, by the device's own ellipses and lists; and which pixels are clear of all thresholds."""
    rng = np.random.default_rng(SEED)
    order = lists.order()
    colours = lists.colours[order]
    moved = [(moved_raw(lists, order, pixels, inside, rng), rounded(colours, rng)) for _ in range(DRAWS)]
    return _compared(case, lists, raw, colours, moved, np.ones(len(pixels.x), bool))


def check_render(
    case: Case, lists: Lists, pixels: Pixels, true: reference.Projected, drawn: list[Drawn]
) -> tuple[Measure, Mask]:
    """The picture by the definition alone, where no threshold and no tie in depth is near; and where that is."""
    raw = alphas_of_covariances(true, pixels)
    visible = raw.max(axis=1, initial=0) >= 0.5 / 255
    depth = true.depth[visible]
    # Orders that a float32 depth may have either way, and pairs of splats that share a pixel there.
    shown = raw[visible] >= 0.5 / 255
    clear = np.ones(len(pixels.x), bool)
    distance = np.linalg.norm(case.scene.means[true.index[visible]].astype(np.float64) - case.view.centre, axis=1)
    tied = np.diff(depth) < 8 * ULP * np.maximum(distance[1:], distance[:-1])
    for run in np.split(np.arange(len(depth)), np.flatnonzero(~tied) + 1):
        if len(run) > 1:
            clear &= shown[run].sum(axis=0) < 2
    near = np.abs(true.depth - case.rules.near) < 1e-6 * case.rules.near
    clear &= ~(raw[near] >= 0.5 / 255).any(axis=0)
    moved = [(each.alpha[visible], np.clip(each.colour[visible], 0, 1e30)) for each in drawn]
    return _compared(case, lists, raw[visible], np.clip(true.colour[visible], 0, 1e30), moved, clear)


def _compared(
    case: Case, lists: Lists, raw: F64, colours: F64, moved: list[tuple[F64, F64]], clear: Mask
) -> tuple[Measure, Mask]:
    """The device's picture against that of some alphas and colours, where it is clear of thresholds; and where that is.

    Args:
        moved: what rounding may make of alphas and colours.
        clear: pixels that may be.
    """
    true = composite(raw, colours, case.rules)
    brightest = max(1.0, float(colours.max(initial=0)))
    wobble = np.full(len(clear), 16 * ULP)
    for other, _ in moved:
        wobble += (np.abs(other - raw) / np.maximum(raw, 1 / 255)).sum(axis=0)
    clear = clear & (true.margin > 1e-4 + 8 * wobble)

    def off(image: F64, transmittance: F64) -> float:
        error = np.abs(image - true.image).max(axis=1) / brightest
        return float(np.maximum(error, np.abs(transmittance - true.transmittance))[clear].max(initial=0))

    others = [composite(*pair, case.rules) for pair in moved]
    expected = ULP + max(off(other.image, other.transmittance) for other in others)
    return (off(lists.image, lists.transmittance), expected), clear


def moved_raw(lists: Lists, order: NDArray[np.int64], pixels: Pixels, inside: Mask, rng: np.random.Generator) -> F64:
    """Alphas of ellipses that rounding has changed."""
    return np.where(inside, alphas_of_shapes(rounded(lists.shapes[order], rng), pixels), 0)


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
