"""Where a scene's splats are, how large, how turned and how opaque: as the levels of a file, and as decoded again.

That is all but the colours: a re-fit solves for these on the geometry that a decoder will see, and what is coded in the
end is the same geometry. Splats so far from the others that the octree has no levels left for these are refused.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec import octree, quantize
from potr_cl.codec.native import quantising
from potr_cl.codec.quantisers import QUANTISERS
from potr_cl.codec.splat_levels import BLOCK, SplatLevels, splat_levels
from potr_cl.codec.steps.fitting import fit_steps
from potr_cl.codec.steps.rule import ColourSteps, colour_classes
from potr_cl.errors import DataError
from potr_cl.host.threads import Run, in_background
from potr_cl.model.camera import Camera, camera_centres
from potr_cl.model.scene import Scene
from potr_cl.native.declarations import CFunctions
from potr_cl.native.table import definition

#: An octree that is no deeper has cells fine enough for its tolerances, and float64 tells them apart.
_SAFE_DEPTH = 44
#: An error that is smaller than this part of a splat, or of half the scene's typical extent, is none.
_PART_OF_A_SPLAT, _PART_OF_THE_SCENE = 2.0**-20, 2.0**-32
#: Splats that a message names.
_NAMED = 3


def may_be_coarse(depth: int) -> bool:
    """Whether there is something to check for :func:`check_positions` in an octree of so many levels."""
    return depth > _SAFE_DEPTH


def check_positions(
    centres: NDArray[np.float32],
    log_scales: NDArray[np.float32],
    tolerance: NDArray[np.float64],
    tree: octree.OctreeStreams,
    order: NDArray[np.int64],
) -> None:
    """Refuse a scene where a far splat would make the positions of others coarser than they are without it.

    Args:
        centres: (N, 3) as they were given to the octree.
        log_scales: (N, 3) of the splats.
        tolerance: (N,) allowed distances of centres, world units.
        tree, order: what :func:`potr_cl.codec.octree.build` made of them.

    Raises:
        DataError: there is such a splat.
    """
    means = centres.astype(np.float64)
    resolution = np.abs(means).max(axis=1) * 2.0**-23
    sizes = np.exp(np.clip(log_scales.max(axis=1).astype(np.float64), -60, 60))
    distance = np.abs(means - np.median(means, axis=0)).max(axis=1)
    harmless = np.maximum(sizes * _PART_OF_A_SPLAT, float(np.median(distance)) * _PART_OF_THE_SCENE)
    allowed = np.maximum(np.maximum(tolerance, resolution), harmless)
    decoded = np.empty_like(means)
    decoded[order] = octree.parse(tree, len(centres))
    decoded -= means
    # Single precision rounds once more.
    if (np.sqrt(np.einsum("ij,ij->i", decoded, decoded)) <= allowed + resolution).all():
        return
    far = centres[_far(means, distance, allowed)]
    named = ", ".join(f"({x:.4g}, {y:.4g}, {z:.4g})" for x, y, z in far[:_NAMED])
    what = f"the splat at {named} is" if len(far) == 1 else f"{len(far)} splats, such as those at {named}, are"
    raise DataError(
        f"{what} so far from the others that the others would lose their exact positions: remove what is out there, "
        "or let pruning do it (it needs views that show nothing of it)"
    )


def _far(means: NDArray[np.float64], distance: NDArray[np.float64], allowed: NDArray[np.float64]) -> NDArray[np.int64]:
    """Indices of the fewest splats, those at the largest distance, without which the deepest level would do."""
    nearest_first = np.argsort(distance, kind="stable")
    sorted_means = means[nearest_first]
    extent = np.maximum.accumulate(sorted_means) - np.minimum.accumulate(sorted_means)
    # Twice the half diagonal of a cell: float64 rounds by as much at the deepest level.
    error = extent.max(axis=1) * np.sqrt(3) * 2.0**-octree.DEEPEST_LEVEL
    fits = np.flatnonzero(error <= np.minimum.accumulate(allowed[nearest_first]))
    kept = min(int(fits[-1]) + 1 if len(fits) else 0, len(means) - 1)
    return nearest_first[kept:]


@dataclass(frozen=True)
class Geometry:
    """A scene's quantised geometry, in the order of the file.

    Attributes:
        asked: the parameters that it was quantised with.
        parameters: those in world units.
        written: returns the centres as a file's streams have them, once they are written; several may ask.
        order: (N,) index in the scene of each splat of the file.
        scales, rotations: levels of the three axes, (N,) each.
        opacities: (N,) levels.
        antialiased, low_pass: as of the scene.
        steps: what fits the steps of each splat's colours to it, where something is known of what it shows.
        centres: (N, 3) as a decoder finds them, in the order of the file, where they are known without.
    """

    asked: quantize.HyperParameters
    parameters: quantize.HyperParameters
    written: Callable[[], octree.OctreeStreams]
    order: NDArray[np.int64]
    scales: list[quantize.Integers]
    rotations: list[quantize.Integers]
    opacities: quantize.Integers
    antialiased: bool
    low_pass: float
    steps: ColourSteps | None = None
    centres: NDArray[np.float32] | None = None

    @property
    def tree(self) -> octree.OctreeStreams:
        """The centres, as a file's streams have them."""
        return self.written()

    def decoded(self, sh: NDArray[np.float32], run: Run = map) -> Scene:
        """What a decoder makes of it, bit for bit, in the order of the scene.

        Args:
            sh: (N, M, 3) colours, in the order of the scene.
            run: in place of :func:`map`, to work with several threads.
        """
        scene = undecoded(sh, self)
        self.decode_to(scene, self.order, run)
        return scene

    def decode_to(self, scene: Scene, order: NDArray[np.int64], run: Run = map) -> None:
        """Fill all but the colours of some splats of a scene; ``order`` (N,) are their numbers there."""
        parameters, n = self.parameters, len(order)
        rules = QUANTISERS[parameters.quantiser]
        found = octree.parse(self.tree, n, run, -(-n // BLOCK)) if self.centres is None else self.centres

        def fill(start: int) -> None:
            part = slice(start, min(start + BLOCK, n))
            rows, scales = order[part], [axis[part] for axis in self.scales]
            scene.means[rows] = found[part]
            log_scales = [quantize.dequantize_scales(levels, parameters.sf_scale) for levels in scales]
            scene.log_scales[rows] = np.stack(log_scales, axis=1)
            turned = np.empty((len(rows), 4), np.float32)
            factors = rules.rotation_factors(scales, parameters.sf_rotation)
            quantize.dequantize_rotations([axis[part] for axis in self.rotations], factors, turned)
            scene.quaternions[rows] = turned
            scene.opacity_logits[rows] = rules.dequantize_opacities(self.opacities[part], parameters.sf_opacity)

        list(run(fill, range(0, n, BLOCK)))

    def colour_classes(self) -> tuple[NDArray[np.int8], NDArray[np.int8]]:
        """(N,) classes of the steps of DC and of AC, in the order of the file: :class:`ColourSteps`; 0 without any."""
        if self.steps is None:
            none = np.zeros(len(self.order), np.int8)
            return none, none
        return colour_classes(self.steps, self.scales, self.opacities)

    def with_steps(self, effects: NDArray[np.floating]) -> Geometry:
        """The same with steps of colours by what each splat shows.

        Args:
            effects: (N,) >= 0 in the order of the scene: by how much an error of its colour shows, in any unit.
        """
        steps = fit_steps(self.scales, self.opacities, self.parameters.sf_opacity, effects[self.order])
        return replace(self, steps=steps)

    def with_centres_of(self, means: NDArray[np.float32], views: Sequence[Camera], run: Run = map) -> Geometry:
        """The same splats at other places: all their other levels stay.

        Args:
            means: (N, 3) in the order of the scene, not rounded yet.
            views, run: as of :func:`quantise_geometry`.

        Raises:
            DataError: a splat is too far from the others to keep them exact.
        """
        world = self.parameters
        tolerance = np.maximum(world.gamma, world.beta * distances_to_views(means, views, run))
        tree, order = octree.build(means, tolerance, absolute=QUANTISERS[world.quantiser].absolute_leaf_levels)
        place = np.empty(len(order), np.int64)
        place[self.order] = np.arange(len(order))
        was = place[order]
        moved = replace(
            self, written=partial(_itself, tree), order=order, scales=[levels[was] for levels in self.scales],
            rotations=[levels[was] for levels in self.rotations], opacities=self.opacities[was], steps=None,
            centres=None,
        )  # fmt: skip
        if may_be_coarse(tree.depth):
            log_scales = moved.decoded(np.empty((len(order), 1, 3), np.float32)).log_scales
            check_positions(means, log_scales, tolerance, tree, order)
        return moved

    def with_shapes_of(self, scene: Scene, run: Run = map) -> Geometry:
        """The same centres with the scales, rotations and opacities of a scene, not rounded yet.

        Args:
            scene: in its order; its centres and colours are of no account.
            run: as of :func:`quantise_geometry`.

        Raises:
            DataError: a value too large to quantise.
        """
        levels = splat_levels(scene, self.order, self.parameters, run)
        return replace(self, scales=levels.scales, rotations=levels.rotations, opacities=levels.opacities, steps=None)

    def with_colour_steps(self, parameters: quantize.HyperParameters) -> Geometry:
        """The same for parameters that differ in the steps of colours alone, which geometry does not depend on."""
        world = replace(self.parameters, sf_dc=parameters.sf_dc, sf_sh=parameters.sf_sh)
        return replace(self, asked=parameters, parameters=world)


def undecoded(sh: NDArray[np.float32], like: Geometry) -> Scene:
    """A scene with some colours, (N, M, 3), and nothing else yet, that is to be drawn as a file's scene is."""
    n = len(sh)
    return Scene(
        np.empty((n, 3), np.float32), np.empty((n, 3), np.float32), np.empty((n, 4), np.float32),
        np.empty(n, np.float32), sh, like.antialiased, like.low_pass,
    )  # fmt: skip


def quantise_geometry(
    scene: Scene, parameters: quantize.HyperParameters, views: Sequence[Camera], run: Run = map
) -> Geometry:
    """Quantise a scene's geometry.

    Args:
        scene: clean, at least one splat.
        parameters: γ, β and the scale factors of scales, rotations and opacities count.
        views: they decide how coarse centres may be; without any, γ alone does.
        run: in place of :func:`map`, to work with several threads.

    Raises:
        DataError: a value too large to quantise, or a splat too far from the others to keep them exact.
    """
    rules = QUANTISERS[parameters.quantiser]
    nearest = distances_to_views(scene.means, views, run)
    world = rules.in_world_units(parameters, scene, nearest, run)
    return quantise_in_world_units(scene, None, parameters, world, nearest, run)[0]


def quantise_in_world_units(
    scene: Scene,
    rows: Sequence[NDArray[np.int64]] | None,
    parameters: quantize.HyperParameters,
    world: quantize.HyperParameters,
    nearest: NDArray[np.float64],
    run: Run = map,
) -> list[Geometry]:
    """Quantise the geometry of parts of a scene, which know nothing of each other.

    Args:
        scene: as of :func:`quantise_geometry`; its colours are not looked at.
        rows: numbers of the splats of each part; None: the scene is the only one. A part's order is one of its splats.
        parameters: as asked for.
        world: the same in world units.
        nearest: (N,) distance to the nearest view; 0 where there is none.
        run: in place of :func:`map`, to work with several threads.

    Raises:
        As :func:`quantise_geometry`.
    """
    absolute = QUANTISERS[parameters.quantiser].absolute_leaf_levels

    def begun(numbers: NDArray[np.int64] | None, run: Run = map) -> octree.Begun:
        own = slice(None) if numbers is None else numbers
        tolerance = np.maximum(world.gamma, world.beta * nearest[own])
        tree = octree.begin(scene.means[own], tolerance, absolute, run)
        if may_be_coarse(tree.depth):
            streams = tree.streams()
            check_positions(scene.means[own], scene.log_scales[own], tolerance, streams, tree.order)
            tree = replace(tree, streams=partial(_itself, streams))
        return tree

    def made(
        order: NDArray[np.int64],
        levels: SplatLevels,
        written: Callable[[], octree.OctreeStreams],
        centres: NDArray[np.float32] | None = None,
    ) -> Geometry:
        return Geometry(
            parameters, world, written, order, levels.scales, levels.rotations, levels.opacities,
            scene.antialiased, scene.low_pass, centres=centres,
        )  # fmt: skip

    if rows is None:
        tree = begun(None, run)
        # Nobody needs the streams before the file is written.
        written = in_background(tree.streams).result
        return [made(tree.order, splat_levels(scene, tree.order, world, run), written, tree.decoded(run))]

    def built(numbers: NDArray[np.int64]) -> tuple[NDArray[np.int64], octree.OctreeStreams]:
        tree = begun(numbers)
        return tree.order, tree.streams()

    # Threads share out the parts here, and each part's splats there.
    return [
        made(order, splat_levels(scene, own[order], world, run), partial(_itself, streams))
        for own, (order, streams) in zip(rows, run(built, rows), strict=True)
    ]


def _itself(streams: octree.OctreeStreams) -> octree.OctreeStreams:
    return streams


def distances_to_views(means: NDArray[np.float32], views: Sequence[Camera], run: Run) -> NDArray[np.float64]:
    """(N,) distance to the nearest view; without views 0, which leaves the tolerance to γ."""
    if not views:
        return np.zeros(len(means))
    centres = camera_centres(views)
    starts = range(0, len(means), BLOCK)
    return np.concatenate(list(run(lambda start: nearest(means[start : start + BLOCK], centres), starts)))


@definition
def nearest(points: NDArray[np.float32], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) the least distance of (n, 3) points to (v, 3) others."""
    axes = points.T.astype(np.float64)
    least = np.full(len(points), np.inf)
    squared, part = np.empty_like(least), np.empty_like(least)
    for other in others:
        for axis, (coordinates, at) in enumerate(zip(axes, other, strict=True)):
            to = part if axis else squared
            np.subtract(coordinates, at, out=to)
            np.square(to, out=to)
            if axis:
                np.add(squared, part, out=squared)
        np.minimum(least, squared, out=least)
    distances: NDArray[np.float64] = np.sqrt(least, out=least)
    return distances


def _nearest_by_c(c: CFunctions, points: NDArray[np.float32], others: NDArray[np.float64]) -> NDArray[np.float64]:
    least = np.empty(len(points))
    quantising.nearest(c, np.ascontiguousarray(points, np.float32), others, least)
    return least
