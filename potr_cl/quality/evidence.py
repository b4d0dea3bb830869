"""What lies beside cameras and tells whether they are in a scene's frame: :func:`evidence_of`. Pure NumPy.

Photographs: the scene is drawn from some of the cameras, 64 pixels wide and roughly, and its details are correlated
with those of the photographs. What is coarser than details (exposure, white balance, backgrounds) has no say, nor have
pixels that show nothing of the scene. Where no photograph decides, the points of the reconstruction may speak against
the cameras that come from it: splats lie near them, and what is a little beside the splats does not. They cannot speak
for them, as a room's walls lie near each other's places after many a motion. docs/benchmarks/frames.md has the margins.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import PotrError
from potr_cl.formats.cameras.view_files import read_points
from potr_cl.formats.images import read_thumbnail
from potr_cl.formats.scenes.scene_files import SH_0
from potr_cl.model.agreement import Evidence
from potr_cl.model.camera import Camera, resized, within_photographs
from potr_cl.model.lens import Pinhole
from potr_cl.model.scene import Scene, opacities_of
from potr_cl.model.sightings import looked_at
from potr_cl.model.spherical_harmonics import ac_basis
from potr_cl.model.splat_groups import NEAR
from potr_cl.quality.photographs import undistorted

F64 = NDArray[np.float64]

#: Pixels of a drawing's longer side; half of the window within which what is coarser is taken out; photographs that are
#: looked at.
_SIDE, _COARSE, _PHOTOGRAPHS = 64, 3, 8
#: Pixels of the scene that make a view worth comparing; and what it takes to refuse views: pixels of all of them, and
#: splats, as few large ones are more than the pixels of their centres.
_LEAST_PIXELS, _ENOUGH_PIXELS, _ENOUGH_SPLATS = 40, 500, 2000
#: Correlation of details that the second best view reaches where cameras are right, and where they are wrong.
_ALIKE, _UNLIKE = 0.4, 0.3
#: By how much a photograph's shape may differ from its view's.
_SHAPE = 0.02
#: How near is near, as a part of the points' median distance from their middle; how far beside the splats it is counted
#: again, in that unit; and how many times as many are near at least where cameras are right.
_REACH, _BESIDE, _CONTRAST = 0.04, 4.0, 2.2
#: Fewer points, or opaque splats, tell nothing.
_LEAST_POINTS, _LEAST_SPLATS = 2_000, 500
_OPAQUE = 0.1


def evidence_of(scene: Scene, cameras: Sequence[Camera]) -> Evidence | None:
    """What photographs, or else points of a reconstruction, say of cameras; None if there are none that could tell.

    Args:
        scene: clean, at least one splat.
        cameras: the training views.
    """
    found = by_photographs(scene, [camera for camera in cameras if camera.image_path is not None])
    if found is not None and found.agrees is not None:
        return found
    paths = {camera.points_path for camera in cameras}
    path = paths.pop()
    if path is not None and not paths:
        try:
            points = by_points(scene, read_points(path))
            return points if found is None or (points is not None and points.agrees is False) else found
        except PotrError:  # no command needs the points
            pass
    return found


def by_photographs(scene: Scene, cameras: Sequence[Camera]) -> Evidence | None:
    """What photographs say; those that cannot be read or have another shape than their view are passed over."""
    found: list[float] = []
    pixels = 0.0
    sampled: _Splats | None = None
    for number in _far_apart(len(cameras)):
        try:
            camera, photograph = _small(cameras[number])
        except PotrError:
            continue
        sampled = sampled or _Splats.of(scene)
        picture, shown = sampled.drawn(camera)
        if shown.sum() >= _LEAST_PIXELS:
            pixels += float(shown.sum())
            found.append(_correlation(picture, photograph, shown))
            if len(found) > 1 and sorted(found)[-2] >= _ALIKE:
                break
    if not found:
        return None
    best = sorted(found)[-2:][0]
    enough = pixels >= _ENOUGH_PIXELS and len(scene) >= _ENOUGH_SPLATS
    agrees = True if best >= _ALIKE else False if best < _UNLIKE and enough else None
    looks = "hardly looks" if agrees is None else "does not look"
    views = "1 view correlate" if len(found) == 1 else f"{len(found)} views correlate"
    return Evidence(
        agrees,
        best,
        f"seen from the cameras, the scene {looks} like the photos (details of {views} by {best:.2f}, of right cameras "
        f"by {_ALIKE} or more)",
    )


def by_points(scene: Scene, points: F64) -> Evidence | None:
    """What the points of a reconstruction say, (P, 3) in the cameras' frame."""
    splats = _Splats.of(scene).means
    if len(points) < _LEAST_POINTS or len(splats) < _LEAST_SPLATS:
        return None
    middle = np.median(points, axis=0)
    reach = max(_REACH * float(np.median(np.linalg.norm(points - middle, axis=1))), 1e-12)
    cells = np.unique(_cells((points - middle) / reach))
    beside = np.random.default_rng(0).normal(size=splats.shape)
    beside *= _BESIDE / np.linalg.norm(beside, axis=1, keepdims=True)
    at = (splats - middle) / reach
    on, off, other = (float(np.isin(_cells(each), cells).sum()) for each in (at, at + beside, at - beside))
    contrast = (on + 1) / (0.5 * (off + other) + 1)
    if contrast >= _CONTRAST:
        return Evidence(None, contrast)
    return Evidence(
        False,
        contrast,
        f"{on / len(splats):.1%} of the splats lie near points of the reconstruction, {contrast:.1f} times as many as "
        f"would by chance (with right cameras {_CONTRAST} times or more)",
    )


@dataclass(frozen=True)
class _Splats:
    """Opaque splats of a scene, some of them where there are many: what is drawn of it."""

    means: F64
    opacities: F64
    extents: F64  # product of the two largest standard deviations, for as many splats as each stands for
    sh: F64

    @classmethod
    def of(cls, scene: Scene) -> _Splats:
        rows = looked_at(len(scene))
        share = len(scene) / len(rows)
        rows = rows[opacities_of(scene.opacity_logits[rows]) > _OPAQUE]
        scales = np.sort(scene.log_scales[rows].astype(np.float64), axis=1)[:, 1:].sum(axis=1)
        return cls(
            scene.means[rows].astype(np.float64),
            opacities_of(scene.opacity_logits[rows]).astype(np.float64),
            share * np.exp(np.clip(scales, -80, 80)),
            scene.sh[rows].astype(np.float64),
        )

    def drawn(self, camera: Camera) -> tuple[F64, F64]:
        """(H, W, 3) a picture, each splat in the pixel of its centre alone, and (H, W) how much of it is scene."""
        width, height = camera.width, camera.height
        with np.errstate(all="ignore"):
            x, y, depth = camera.rotation @ self.means.T + camera.translation[:, None]
            x, y = camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy
        rows = np.flatnonzero((depth > NEAR) & (x >= 0) & (x < width) & (y >= 0) & (y < height))
        depth, pixel = depth[rows], y[rows].astype(np.int64) * width + x[rows].astype(np.int64)
        order = np.lexsort((depth, pixel))
        rows, depth, pixel = rows[order], depth[order], pixel[order]
        area = np.minimum(2 * math.pi * camera.fx * camera.fy * self.extents[rows] / depth**2, 1)
        passing = np.log1p(-np.minimum(self.opacities[rows] * area, 0.99))
        before = np.cumsum(passing) - passing
        first = np.searchsorted(pixel, pixel)  # of the splats of the same pixel
        weights = np.exp(before - before[first]) * -np.expm1(passing)
        rays = self.means[rows] - camera.centre
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        basis = ac_basis(rays)[:, : self.sh.shape[1] - 1]
        colours = 0.5 + SH_0 * self.sh[rows, 0] + np.einsum("nm,nmc->nc", basis, self.sh[rows, 1:])
        sums = [np.bincount(pixel, weights * each, width * height) for each in np.clip(colours, 0, 2).T]
        shown = np.bincount(pixel, weights, width * height)
        picture = np.stack(sums, axis=1) / np.maximum(shown, 1e-9)[:, None]
        return picture.reshape(height, width, 3), np.minimum(shown, 1).reshape(height, width)


def _far_apart(count: int) -> list[int]:
    """Numbers of so many things as are looked at, neighbours not one after the other."""
    numbers = np.unique(np.linspace(0, count - 1, min(count, _PHOTOGRAPHS)).astype(np.int64)).tolist()
    return [number for start in (0, 4, 2, 6, 1, 5, 3, 7) for number in numbers[start::8]]


def _small(camera: Camera) -> tuple[Camera, F64]:
    """A view in few pixels, and (H, W, 3) its photograph in as many."""
    path, (width, height) = camera.image_path, camera.photograph_size
    assert path is not None
    camera = within_photographs([camera])[0]
    lens, scale = camera.lens, _SIDE / max(camera.width, camera.height)
    view = resized(camera, max(round(scale * camera.width), 1), max(round(scale * camera.height), 1))
    if lens is None:
        return view, read_thumbnail(path, view.width, view.height, width / height, _SHAPE)
    x, y = (max(round(2 * scale * side), 1) / side for side in (width, height))
    lens = replace(
        lens, width=round(x * width), height=round(y * height), fx=x * lens.fx, fy=y * lens.fy, cx=x * lens.cx,
        cy=y * lens.cy,
    )  # fmt: skip
    photograph = read_thumbnail(path, lens.width, lens.height, width / height, _SHAPE)
    pinhole = Pinhole(view.width, view.height, view.fx, view.fy, view.cx, view.cy)
    return view, undistorted(photograph.astype(np.float32), lens, pinhole).astype(np.float64)


def _correlation(picture: F64, photograph: F64, shown: F64) -> float:
    """Of details, where the scene is shown."""
    weights = shown[..., None]
    around = np.maximum(_mean_around(weights), 1e-6)
    a, b = (each - _mean_around(each * weights) / around for each in (picture, photograph))
    norm = math.sqrt(float((weights * a * a).sum() * (weights * b * b).sum()))
    return float((weights * a * b).sum()) / max(norm, 1e-12)


def _mean_around(values: F64) -> F64:
    """(H, W, C) means over a window around each pixel; at the border its pixels are repeated."""
    for axis in (0, 1):
        ends = [(_COARSE + 1, _COARSE) if each == axis else (0, 0) for each in range(3)]
        sums = np.moveaxis(np.cumsum(np.pad(values, ends, mode="edge"), axis=axis), axis, 0)
        window = 2 * _COARSE + 1
        values = np.moveaxis(sums[window:] - sums[:-window], 0, axis) / window
    return values


def _cells(points: F64) -> NDArray[np.int64]:
    """A number for the unit cell that each of some points lies in."""
    x, y, z = np.floor(np.clip(np.nan_to_num(points), -1e9, 1e9)).astype(np.int64).T
    numbers: NDArray[np.int64] = x * 73_856_093 ^ y * 19_349_663 ^ z * 83_492_791
    return numbers
