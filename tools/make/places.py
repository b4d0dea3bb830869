"""Places that people stand in, made out of trained scenes: a house with rooms, a street, a site under a drone.

    python -m tools.make.places house|street|site SCENE... -o OUT --splats 750e3 [--views 24] [--degree 0]

A SCENE is what any command reads; its middle, upright, becomes furniture and figures. Walls, ground and trees are
splats with a texture, thin across and as fine as --splats allows. OUT gets point_cloud.ply and cameras.json with test
views alone, from where somebody would stand: in the rooms and on the ground at the height of eyes, over the site as a
drone flies. So it can be measured what an encode without cameras did to the place. Every run writes the same bytes.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from potr_cl.formats import load_scene, save_scene
from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene, joined
from potr_cl.model.spherical_harmonics import quaternions_of
from tests.reference.captures import looking
from tests.reference.frames import moved
from tools.make.city import of_size, write_cameras

F64 = NDArray[np.float64]

_SH0 = 0.28209479177387814
#: Part of a scene's splats, those nearest to its middle, that becomes a thing.
_OF_THING = 0.75
#: Part of a place's splats that things have.
_THINGS = 0.3
EYES = 1.6


@dataclass
class Place:
    """What has been built so far, in metres, z up.

    Attributes:
        panels: corner, two edges, and a texture's seed for each wall, floor or roof.
        clouds: middle, radius and colour of each crown of leaves.
        stands: where a thing may stand, and how high it should be.
        spots: where somebody may stand, and where they look.
    """

    rng: np.random.Generator
    panels: list[tuple[F64, F64, F64, int]] = field(default_factory=list)
    clouds: list[tuple[F64, float, F64]] = field(default_factory=list)
    stands: list[tuple[F64, float]] = field(default_factory=list)
    spots: list[tuple[F64, F64]] = field(default_factory=list)

    def panel(self, corner: Sequence[float], along: Sequence[float], across: Sequence[float]) -> None:
        arrays = (np.asarray(each, np.float64) for each in (corner, along, across))
        self.panels.append((*arrays, int(self.rng.integers(1 << 30))))  # type: ignore[arg-type]

    def box(self, x: float, y: float, wide: float, deep: float, high: float) -> None:
        """Four walls and a flat roof."""
        for corner, along in (
            ((x, y, 0), (wide, 0, 0)),
            ((x, y + deep, 0), (wide, 0, 0)),
            ((x, y, 0), (0, deep, 0)),
            ((x + wide, y, 0), (0, deep, 0)),
        ):
            self.panel(corner, along, (0, 0, high))
        self.panel((x, y, high), (wide, 0, 0), (0, deep, 0))

    def spot(self, place: tuple[float, float, float], turn: float, pitch: float) -> None:
        """Somebody at a place who looks at so many radians to the left of x, and up."""
        at = np.array(place)
        ahead = np.array([math.cos(turn) * math.cos(pitch), math.sin(turn) * math.cos(pitch), math.sin(pitch)])
        self.spots.append((at, at + ahead))


def house(rng: np.random.Generator, views: int, size: float) -> Place:
    """Rooms of 5 x 4.5 x 2.8 with doors between them, windows, and a garden that is seen through these."""
    place = Place(rng)
    wide, deep, high, rooms = 5.0, 4.5, 2.8, max(round(3.3 * size), 2)
    for z in (0.0, high):
        for i in range(rooms):
            for j in range(rooms):
                place.panel((i * wide, j * deep, z), (wide, 0, 0), (0, deep, 0))
    for i in range(rooms + 1):
        for j in range(rooms):
            _wall(place, (i * wide, j * deep, 0), (0, deep, 0), high, outer=i in (0, rooms))
            _wall(place, (j * wide, i * deep, 0), (wide, 0, 0), high, outer=i in (0, rooms))
    for turn in np.linspace(0, 2 * np.pi, 24, endpoint=False):
        middle = np.array([rooms * wide / 2, rooms * deep / 2, 1.5])
        at = middle + (3.4 * rooms + 8) * np.array([math.cos(turn), math.sin(turn), 0])
        place.clouds.append((at, 3.5, np.array([0.2, 0.4, 0.15])))
    for i in range(rooms):
        for j in range(rooms):
            corner = np.array([i * wide, j * deep, 0])
            for x, y in ((0.8, 0.8), (4.2, 3.7), (2.5, 0.7)):
                place.stands.append((corner + np.array([x, y, 0]), rng.uniform(0.7, 1.4)))
    for number in range(views):
        i, j = number % rooms, number // rooms % rooms
        eye = (i * wide + rng.uniform(1.6, wide - 1.6), j * deep + rng.uniform(1.6, deep - 1.2), rng.uniform(1.3, 1.7))
        place.spot(eye, rng.uniform(-np.pi, np.pi), rng.uniform(-0.35, 0.15))
    return place


def _wall(place: Place, corner: Sequence[float], along: Sequence[float], high: float, outer: bool) -> None:
    """A wall with a door in it, or with a window."""
    start, whole = np.asarray(corner, float), np.asarray(along, float)
    for first, last, low, top in (
        (0.0, 0.4, 0.0, high),
        (0.6, 1.0, 0.0, high),
        (0.4, 0.6, 2.0, high),
        *(((0.4, 0.6, 0.0, 0.9),) if outer else ()),
    ):
        place.panel(start + first * whole + (0, 0, low), (last - first) * whole, (0, 0, top - low))


def street(rng: np.random.Generator, views: int, size: float) -> Place:
    """A street between houses of two to three storeys, with trees; people walk along it."""
    place = Place(rng)
    houses = max(round(6 * size**2), 3)
    half = 5.0 * houses
    place.panel((-half, -6, 0), (2 * half, 0, 0), (0, 12, 0))
    for side in (-1, 1):
        for number in range(houses):
            deep, high = 7.0, rng.uniform(6, 9)
            place.box(-half + 10 * number, 6 if side > 0 else -6 - deep, 9.4, deep, high)
            at = np.array([5 - half + 10 * number, side * 4.3, 0])
            if number % 2:
                place.clouds.append((at + np.array([0, 0, 3.2]), 1.3, np.array([0.2, 0.45, 0.15])))
            else:
                place.stands.append((at, rng.uniform(1.4, 2.0)))
    for number in range(views):
        eye = ((2 * number / max(views - 1, 1) - 1) * (half - 3), rng.uniform(-2.5, 2.5), rng.uniform(1.5, 1.8))
        place.spot(eye, rng.uniform(-np.pi, np.pi), rng.uniform(-0.15, 0.35))
    return place


def site(rng: np.random.Generator, views: int, size: float) -> Place:
    """Ground with sheds, trees and things on it, 54 x 26 at 750,000 splats, as drones fly, and whoever walks there."""
    place = Place(rng)
    x, y, many = 27 * size, 13 * size, size**2
    place.panel((-x, -y, 0), (2 * x, 0, 0), (0, 2 * y, 0))
    for _ in range(max(round(4 * many), 1)):
        corner = rng.uniform(-x, x - 6), rng.uniform(-y, y - 6)
        place.box(*corner, rng.uniform(4, 6), rng.uniform(4, 6), rng.uniform(2.5, 4))
    for _ in range(max(round(14 * many), 3)):
        at = np.array([rng.uniform(-x, x), rng.uniform(-y, y), rng.uniform(2.2, 3.5)])
        place.clouds.append((at, rng.uniform(1, 1.8), np.array([0.25, 0.4, 0.15])))
    for _ in range(max(round(10 * many), 3)):
        place.stands.append((np.array([rng.uniform(-x, x), rng.uniform(-y, y), 0]), rng.uniform(1.0, 2.2)))
    for number in range(views):
        above = number % 3 > 0
        eye = (rng.uniform(-x, x), rng.uniform(-y, y), rng.uniform(5, 14) if above else rng.uniform(4.2, 5.0))
        inward = math.atan2(-eye[1], -eye[0]) + rng.uniform(-0.8, 0.8)
        place.spot(eye, inward, rng.uniform(-1.2, -0.5) if above else rng.uniform(-0.4, -0.1))
    return place


PLACES: dict[str, Callable[[np.random.Generator, int, float], Place]] = {"house": house, "street": street, "site": site}


def _textured(points: F64, seed: int) -> F64:
    """(N, 3) colours on a plane, of (N, 2) metres: plaster, boards, stains and pictures."""
    rng = np.random.default_rng(seed)
    base = rng.uniform(0.25, 0.75, 3)
    colour = np.tile(base, (len(points), 1))
    for scale, strength in ((0.5, 0.10), (2.0, 0.08), (7.0, 0.07), (20.0, 0.06)):
        wave = rng.normal(size=(3, 2)) * scale * 2
        colour += strength * np.sin(points @ wave.T + rng.uniform(0, 6, 3))
    span = points.max(axis=0)
    for _ in range(max(int(span.prod() / 3), 2)):
        middle, half = rng.uniform(0, 1, 2) * span, rng.uniform(0.1, 0.5, 2)
        inside = (np.abs(points - middle) < half).all(axis=1)
        colour[inside] = rng.uniform(0.05, 0.95, 3) + 0.15 * np.sin(30 * points[inside] @ rng.normal(size=(2, 3)))
    return np.clip(colour, 0.02, 0.98)


def _splats(means: F64, scales: F64, quaternions: F64, opacities: F64, colours: F64) -> Scene:
    logits = np.log(opacities / (1 - opacities))
    sh = ((colours - 0.5) / _SH0)[:, None]
    single = np.float32
    shapes = means.astype(single), np.log(scales).astype(single), quaternions.astype(single)
    return Scene(*shapes, logits.astype(single), sh.astype(single))


def _panel(rng: np.random.Generator, corner: F64, along: F64, across: F64, seed: int, spacing: float) -> Scene:
    """Splats on a rectangle: three in four a little smaller than their spacing, the others twice as large."""
    lengths = np.linalg.norm(along), np.linalg.norm(across)
    count = max(int(lengths[0] * lengths[1] / spacing**2), 4)
    place = rng.uniform(0, 1, (count, 2))
    means = corner + place[:, :1] * along + place[:, 1:] * across
    axes = np.stack([along / lengths[0], across / lengths[1], np.cross(along / lengths[0], across / lengths[1])])
    means += axes[2] * rng.normal(0, 0.1 * spacing, (count, 1))
    sizes = 0.6 * spacing * rng.lognormal(-0.1, 0.4, (count, 2)) * np.where(rng.random((count, 1)) < 0.25, 2.0, 1.0)
    scales = np.column_stack([sizes, np.full(count, 0.1 * spacing)])
    colours = _textured(place * lengths, seed) + rng.normal(0, 0.03, (count, 3))
    return _splats(
        means,
        scales,
        np.tile(quaternions_of(axes.T[None]), (count, 1)),
        rng.beta(4, 1.2, count).clip(0.02, 0.99),
        colours,
    )


def _cloud(rng: np.random.Generator, middle: F64, radius: float, colour: F64, count: int) -> Scene:
    """A crown of leaves and a trunk under it: splats turned in all directions."""
    away = rng.normal(size=(count, 3))
    away *= (radius * rng.uniform(0.3, 1, (count, 1)) ** 0.5) / np.linalg.norm(away, axis=1, keepdims=True)
    trunk = rng.random(count) < 0.1
    away[trunk] = np.column_stack([rng.normal(0, 0.12, (trunk.sum(), 2)), -rng.uniform(0, middle[2], trunk.sum())])
    leaf = radius * 2.2 / math.sqrt(count)
    scales = leaf * rng.lognormal(0, 0.5, (count, 3)) * (1, 0.6, 0.2)
    colours = np.clip(
        np.where(trunk[:, None], (0.35, 0.25, 0.15), colour) * rng.lognormal(0, 0.35, (count, 1)), 0.02, 0.98
    )
    turns = rng.normal(size=(count, 4))
    return _splats(middle + away, scales, turns, rng.beta(2, 1, count).clip(0.02, 0.99), colours.clip(0.02, 0.98))


def _thing(scene: Scene, splats: int, at: F64, high: float, rng: np.random.Generator) -> Scene:
    """The middle of a scene, upright (its z), ``high`` metres high, with so many of its splats."""
    middle = np.median(scene.means, axis=0)
    near = np.argsort(np.linalg.norm(scene.means - middle, axis=1), kind="stable")[: int(_OF_THING * len(scene))]
    chosen = np.sort(near if splats >= len(near) else near[rng.permutation(len(near))[:splats]])
    taken = scene.subset(chosen)
    # Those that are left cover what all did.
    grown = 0.5 * math.log(max(len(near) / len(chosen), 1.0))
    taken = dataclasses.replace(taken, log_scales=taken.log_scales + np.float32(grown))
    low, top = np.quantile(taken.means[:, 2], [0.005, 0.995])
    scale = high / (top - low)
    yaw = rng.uniform(0, 2 * np.pi)
    turn = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
    shift = at - scale * (turn @ (middle[0], middle[1], low))
    return moved(taken, turn, scale, shift.tolist())


def build(kind: str, things: Sequence[Scene], splats: int, views: int, degree: int) -> tuple[Scene, list[Camera]]:
    """A place of about so many splats, and test views in it."""
    rng = np.random.default_rng(0)
    place = PLACES[kind](rng, views, math.sqrt(splats / 750e3))
    each = int(_THINGS * splats / max(len(place.stands), 1))
    parts = [
        _thing(things[number % len(things)], each, at, high, rng) for number, (at, high) in enumerate(place.stands)
    ]
    left = splats - sum(map(len, parts))
    # A crown has as much to show as a panel of its section's area, four times.
    crowns = [4 * math.pi * min(radius, 2.0) ** 2 for _, radius, _ in place.clouds]
    panels = [float(np.linalg.norm(along) * np.linalg.norm(across)) for _, along, across, _ in place.panels]
    spacing = math.sqrt((sum(crowns) + sum(panels)) / left)
    parts += [_panel(rng, *panel, spacing) for panel in place.panels]
    parts += [
        _cloud(rng, *cloud, max(int(area / spacing**2), 10)) for cloud, area in zip(place.clouds, crowns, strict=True)
    ]
    coefficients = (degree + 1) ** 2
    parts = [_of_degree(part, coefficients) for part in parts]
    cameras = [
        dataclasses.replace(
            of_size(looking(at, ahead, name=f"{kind}_{number:03d}", wide=0.75), 1080, 720), split="test"
        )
        for number, (at, ahead) in enumerate(place.spots)
    ]
    return joined(parts), cameras


def _of_degree(scene: Scene, coefficients: int) -> Scene:
    sh = np.zeros((len(scene), coefficients, 3), np.float32)
    shared = min(coefficients, scene.sh.shape[1])
    sh[:, :shared] = scene.sh[:, :shared]
    return dataclasses.replace(scene, sh=sh)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=PLACES)
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="a folder")
    parser.add_argument("--splats", type=float, default=750e3, metavar="N")
    parser.add_argument("--views", type=int, default=24, metavar="N", help="test views")
    parser.add_argument("--degree", type=int, default=0, choices=range(4), help="of the spherical harmonics")
    args = parser.parse_args()
    scene, cameras = build(
        args.kind, [load_scene(path) for path in args.scenes], int(args.splats), args.views, args.degree
    )
    args.output.mkdir(parents=True, exist_ok=True)
    save_scene(args.output / "point_cloud.ply", scene)
    write_cameras(args.output, cameras)
    print(f"{len(scene):,} splats and {len(cameras)} views in {args.output}")


if __name__ == "__main__":
    main()
