"""Every kernel that a view needs, judged on what it was given (:func:`check`): a part of tools.stress.run."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator
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
from tools.stress.fits import check_derivatives, check_fits
from tools.stress.measures import Measure, Measures
from tools.stress.precise import (
    DRAWS,
    F64,
    SEED,
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
)

Mask = NDArray[np.bool_]

#: Splats of a case whose removal is checked, and the brightest colour: effects of more are cut off by design.
REMOVED, BRIGHTEST = 64, 4.0


def check(device: Device, case: Case) -> Measures:
    """Every measure of a view."""
    found, clear = check_rasterizer(device, case)
    if clear is None and not np.isfinite(found["composite"][0]):
        return found
    return found | check_fits(device, case) | check_derivatives(device, case, clear)


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
        view = JudgedView(case, lists)
        found = view.projection() | view.lists_of_tiles()
        found["composite"], clear = view.composite()
        found |= view.removal(rasterizer, clear)
        if case.rules.square_extent:
            return found, None
        found["render"], clear = view.render()
        return found, clear


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

    def membership(self, splats: NDArray[np.int64]) -> Mask:
        """(K, tiles) whether a splat is in a tile's list."""
        lengths = self.offsets[1:] - self.offsets[:-1]
        found = np.zeros((len(self.shapes), len(lengths)), bool)
        found[self.intersections, np.repeat(np.arange(len(lengths)), lengths)] = True
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


@dataclasses.dataclass
class Drawn:
    """What rounding may make of the splats of a projection; of those that it hides ``there`` is False, and alpha 0."""

    there: Mask
    alpha: F64
    colour: F64
    depth: F64


class JudgedView:
    """What a device made of a view, each stage judged on what it was given.

    By the definition: ``true``, and alphas ``alpha`` before the cap. By the device's own ellipses: the splats ``order``
    that are in any list, front to back; whether each is in a tile's list, ``member``, and a pixel's, ``inside``; alphas
    ``raw``.
    """

    def __init__(self, case: Case, lists: Lists) -> None:
        self.case, self.lists, self.pixels = case, lists, Pixels.of(case.view)
        self.true = projected(case)
        self.alpha = alphas_of_covariances(self.true, self.pixels)
        self.distance = np.linalg.norm(case.scene.means[self.true.index] - case.view.centre, axis=1)
        self.drawn = list(self._drawn())
        self.order = lists.order()
        self.colours = lists.colours[self.order]
        self.member = lists.membership(self.order)
        self.inside = self.member[:, self.pixels.tile]
        self.raw = np.where(self.inside, alphas_of_shapes(lists.shapes[self.order], self.pixels), 0)

    def _drawn(self) -> Iterator[Drawn]:
        rng = np.random.default_rng(SEED)
        place = {int(k): i for i, k in enumerate(self.true.index)}
        for _ in range(DRAWS):
            moved = projected(self.case, rng)
            at = np.array([place.get(int(k), -1) for k in moved.index], int)
            kept = at >= 0
            there, alpha = np.zeros(len(self.alpha), bool), np.zeros_like(self.alpha)
            drawn = Drawn(there, alpha, self.true.colour.copy(), self.true.depth.copy())
            drawn.there[at[kept]] = True
            drawn.alpha[at[kept]] = alphas_of_covariances(moved, self.pixels)[kept]
            drawn.colour[at[kept]], drawn.depth[at[kept]] = moved.colour[kept], moved.depth[kept]
            yield drawn

    def _rounded(self, rng: np.random.Generator) -> tuple[F64, F64]:
        """Alphas and colours of ellipses that rounding has changed."""
        shapes = rounded(self.lists.shapes[self.order], rng)
        return np.where(self.inside, alphas_of_shapes(shapes, self.pixels), 0), rounded(self.colours, rng)

    def projection(self) -> Measures:
        """Ellipses, colours and depths of the splats in front of the near plane."""
        case, true, lists, distance = self.case, self.true, self.lists, self.distance
        ours, cap = lists.shapes[true.index], case.rules.alpha_cap
        alpha = np.minimum(self.alpha, cap)
        error = np.abs(np.minimum(alphas_of_shapes(ours, self.pixels), cap) - alpha).max(axis=1, initial=0)
        # Splats that are not to be seen need no ellipse; one just at the near plane may be on either side of it.
        error[alpha.max(axis=1, initial=0) < 1 / 255] = 0
        error[np.abs(true.depth - case.rules.near) < 4 * ULP * distance] = 0

        listed = np.isin(true.index, lists.intersections)
        direction = (case.scene.means[true.index] - case.view.centre) / distance[:, None]
        basis = np.abs(reference.sh_basis(direction, case.scene.sh_degree))
        scale = 0.5 + (basis[:, :, None] * np.abs(case.scene.sh[true.index])).sum(axis=1)
        colour = np.abs(lists.colours[true.index] - np.clip(true.colour, 0, 1e30)) / scale
        depth = np.abs(ours[:, 6] - true.depth) / distance
        expected = np.full(3, ULP)
        for each in self.drawn:
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

    def lists_of_tiles(self) -> Measures:
        """That lists hold all that reaches 1/255, by the device's own ellipses, and hold it in order."""
        found: Measures = {}
        lists, rules = self.lists, self.case.rules
        if not rules.square_extent:  # which cuts lists short on purpose
            everything = alphas_of_shapes(lists.shapes, self.pixels)
            drawn = np.isfinite(lists.shapes[:, :7]).all(axis=1) & (lists.shapes[:, 6] > np.float32(rules.near))
            drawn &= np.abs(lists.shapes[:, :5]).sum(axis=1) < 1e30
            everything[self.order] *= ~self.inside
            lacking = everything[drawn].max(initial=0)
            found["tile lists"] = (max(float(lacking) * 255 - 1, 0.0), ULP)
        wrong, depth = 0, lists.shapes[:, 6].astype(np.float32)
        for begin, end in itertools.pairwise(lists.offsets.tolist()):
            run = lists.intersections[begin:end]
            wrong += int(np.count_nonzero(run != run[np.lexsort((run, depth[run]))]))
        return found | {"sort": (float(wrong), 1.0)}

    def composite(self) -> tuple[Measure, Mask]:
        """The picture, by the device's own ellipses and lists; and which pixels are clear of all thresholds."""
        rng = np.random.default_rng(SEED)
        moved = [self._rounded(rng) for _ in range(DRAWS)]
        return self._compared(self.raw, self.colours, moved, np.ones(len(self.pixels.x), bool))

    def render(self) -> tuple[Measure, Mask]:
        """The picture by the definition alone, where no threshold and no tie in depth is near; and where that is."""
        visible = self.alpha.max(axis=1, initial=0) >= 0.5 / 255
        shown = self.alpha >= 0.5 / 255
        near = np.abs(self.true.depth - self.case.rules.near) < 1e-6 * self.case.rules.near
        clear = np.asarray(~shown[near].any(axis=0))
        # Orders that a float32 depth may have either way, and pairs of splats that share a pixel there.
        depth, distance = self.true.depth[visible], self.distance[visible]
        tied = np.diff(depth) < 8 * ULP * np.maximum(distance[1:], distance[:-1])
        for run in np.split(np.flatnonzero(visible), np.flatnonzero(~tied) + 1):
            clear &= shown[run].sum(axis=0) < 2 if len(run) > 1 else True
        moved = [(each.alpha[visible], np.clip(each.colour[visible], 0, 1e30)) for each in self.drawn]
        return self._compared(self.alpha[visible], np.clip(self.true.colour[visible], 0, 1e30), moved, clear)

    def _compared(self, raw: F64, colours: F64, moved: list[tuple[F64, F64]], clear: Mask) -> tuple[Measure, Mask]:
        """The device's picture against that of some alphas and colours, where it is clear of thresholds; and where.

        Args:
            moved: what rounding may make of alphas and colours.
            clear: pixels that may be.
        """
        true = composite(raw, colours, self.case.rules)
        brightest = max(1.0, float(colours.max(initial=0)))
        wobble = np.full(len(clear), 16 * ULP)
        for other, _ in moved:
            wobble += (np.abs(other - raw) / np.maximum(raw, 1 / 255)).sum(axis=0)
        clear = clear & (true.margin > 1e-4 + 8 * wobble)

        def off(image: F64, transmittance: F64) -> float:
            error = np.abs(image - true.image).max(axis=1) / brightest
            return float(np.maximum(error, np.abs(transmittance - true.transmittance))[clear].max(initial=0))

        others = [composite(*pair, self.case.rules) for pair in moved]
        expected = ULP + max(off(other.image, other.transmittance) for other in others)
        return (off(self.lists.image, self.lists.transmittance), expected), clear

    def removal(self, rasterizer: Rasterizer, clear: Mask) -> Measures:
        """Effects and importances once the splats of every third place are gone, by the device's own ellipses."""
        rng, order, rules = np.random.default_rng(SEED), self.order, self.case.rules
        options = SweepOptions(tolerance=-1, transmittance_threshold=None)
        with RemovalSweep(rasterizer, [self.case.view], options) as removal:
            removal.measure()
            gone = order[::3] if len(order) > 2 else order[:0]
            removal.remove(gone)
            effect, importance = removal.measure()
        left = np.flatnonzero(~np.isin(order, gone))
        if not (np.isfinite(effect).all() and np.isfinite(importance).all()):
            return {"removal: effect": (np.inf, ULP)}
        if not len(left) or self.colours.max(initial=0) > BRIGHTEST:
            return {}
        chosen = np.unique(np.linspace(0, len(left) - 1, REMOVED).astype(int))

        def effects(raw: F64, colours: F64) -> tuple[F64, F64, F64, Composited]:
            wanted = held_image(composite(raw, colours, rules).alpha, colours)
            now = composite(raw[left], colours[left], rules)
            return (*removal_effects(now.alpha, colours[left], wanted, chosen), now)

        true, magnitude, shares, now = effects(self.raw, self.colours)
        # A flip shows in every splat of its pixel.
        unclear = ~clear | (now.margin < 1e-4)
        kept = ~(self.raw[left][chosen][:, unclear] > 0.5 / 255).any(axis=1)
        splat = order[left[chosen]]

        def off(effect: F64, importance: F64) -> F64:
            # What the fixed point of the totals resolves, and what no quality ever asks for, is let pass.
            pairs = (effect, true, magnitude), (importance, shares, shares)
            return np.array([(np.abs(a - b) / (c + 1e-15))[kept].max(initial=0) for a, b, c in pairs])

        expected = np.full(2, 4 * ULP)
        for _ in range(DRAWS):
            moved, _, moved_shares, _ = effects(*self._rounded(rng))
            expected = np.maximum(expected, off(moved, moved_shares))
        found = off(effect[splat], importance[splat])
        names = ("removal: effect", "removal: importance")
        return {name: (float(e), float(x)) for name, e, x in zip(names, found, expected, strict=True)}
