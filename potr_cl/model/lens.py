"""Lens distortion: what a photograph's lens did (:class:`Lens`), and the pinhole views that stand for its photographs.

A scene is looked at through pinholes. Of a distorted camera two of them are of use: the one that covers the field of
the photograph (:meth:`Lens.covering`), so that the encoder sees whatever was photographed; and the one that the
photograph fills without a gap (:meth:`Lens.within`), where a picture is compared with the photograph, undistorted.

The formulas are those of COLMAP (Schönberger and Frahm 2016, src/colmap/sensor/models.h), which agree with OpenCV's
(modules calib3d and fisheye): Brown's radial and tangential terms, also as a quotient, and the equidistant fisheye.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import DataError

F64 = NDArray[np.float64]

#: Half of the widest field, radians: pictures of a pinhole grow without end towards 90 degrees.
MOST_HALF_FIELD = math.radians(60)
#: A pinhole view gets at most so many times the photograph's pixels; beyond, it is coarser.
_MOST_PIXELS = 2.0
#: Points on each side of a photograph that tell how far its field reaches.
_SIDE_POINTS = 257
#: Points of the curve of the radius, up to the widest field.
_RADII = 4097
#: Newton's steps, the difference of its derivative, and the error with which it is content, as parts of a focal length.
_STEPS, _DIFFERENCE, _CONTENT = 12, 1e-6, 1e-7
_LARGEST_COEFFICIENT = 1e3
#: Focal length in sides of the picture; and of the points on a side, every so many are tried for folds.
_SHORTEST, _TRIED = 1e-3, 4


class Pinhole(NamedTuple):
    """Size, focal lengths and principal point of a pinhole view, in pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


@dataclass(frozen=True)
class Lens:
    """How the lens of a photograph bends.

    A point at ``(x, y)`` of the pinhole's image plane (depth 1) is turned to ``atan(r) / r · (x, y)`` first if the lens
    is a fisheye, and then to::

        d · x + 2 p1 x y + p2 (r² + 2 x²) + s1 r²,   d · y + 2 p2 x y + p1 (r² + 2 y²) + s2 r²
        d = (1 + k1 r² + k2 r⁴ + …) / (1 + q1 r² + q2 r⁴ + …)

    Attributes:
        width, height: of the photograph in pixels.
        fx, fy, cx, cy: focal lengths and principal point of the photograph, in pixels.
        fisheye: whether it is one.
        radial: k1, k2 and so on.
        quotient: q1, q2 and so on.
        tangential: p1 and p2.
        prism: s1 and s2.

    Raises:
        DataError: no lens has these values, or they fold the picture over in its middle.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    fisheye: bool = False
    radial: tuple[float, ...] = ()
    quotient: tuple[float, ...] = ()
    tangential: tuple[float, float] = (0.0, 0.0)
    prism: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        coefficients = (*self.radial, *self.quotient, *self.tangential, *self.prism)
        if not all(abs(value) <= _LARGEST_COEFFICIENT for value in coefficients):
            raise DataError(f"lens distortion with a coefficient beyond {_LARGEST_COEFFICIENT:g} is no lens's")
        intrinsics = (self.fx, self.fy, self.cx, self.cy)
        if not np.isfinite(intrinsics).all() or min(self.fx / self.width, self.fy / self.height) < _SHORTEST:
            raise DataError(f"intrinsics (fx, fy, cx, cy) = {intrinsics} are not a camera's")
        if not (0 < self.cx < self.width and 0 < self.cy < self.height):
            raise DataError("the principal point of a distorted camera lies outside its picture")
        with np.errstate(all="ignore"):
            # Halfway from the principal point to the border; what lies beyond the widest field need not be found.
            middle = self._sides(0.5)[:, :, ::_TRIED].reshape(2, -1)
            points, found = self.undistorted(*middle)
            # On the whole way there the picture must not be turned inside out.
            way = (points[:, None] * np.linspace(0, 1, 17)[1:, None]).reshape(2, -1)
            (a, c), (b, d) = self._slopes(way, np.stack(self.distorted(*way)))
            found &= (a * d > b * c).reshape(16, -1).all(axis=0)
        radii, bent = self._radii
        if len(radii) == _RADII:
            found |= np.hypot(*middle) > bent[-1]
        if not found.all():
            raise DataError("its lens distortion folds the picture over: the coefficients do not fit the focal length")

    def distorted(self, x: F64, y: F64) -> tuple[F64, F64]:
        """Where points of the image plane, of any shape, are in the photograph, in focal lengths from its middle."""
        if self.fisheye:
            r = np.hypot(x, y)
            turned = np.where(r > 1e-9, np.arctan(r) / np.maximum(r, 1e-9), 1.0)
            x, y = x * turned, y * turned
        square = x * x + y * y
        d = _polynomial(self.radial, square)
        if self.quotient:
            d = d / _polynomial(self.quotient, square)
        (p1, p2), (s1, s2) = self.tangential, self.prism
        u, v = d * x, d * y
        # Most lenses have few of the terms, and files of views can have a lens for each.
        if any(self.tangential):
            u = u + 2 * p1 * x * y + p2 * (square + 2 * x * x)
            v = v + 2 * p2 * x * y + p1 * (square + 2 * y * y)
        return (u + s1 * square, v + s2 * square) if any(self.prism) else (u, v)

    def undistorted(self, u: F64, v: F64) -> tuple[F64, NDArray[np.bool_]]:
        """Points of the image plane of points of the photograph: the inverse of :meth:`distorted`.

        Args:
            u, v: (N,) in focal lengths from the principal point.

        Returns:
            (2, N) x and y, and whether each was found; those beyond the widest field are not.
        """
        radii, bent = self._radii
        far = np.hypot(u, v)
        guess = np.interp(far, bent, radii) / np.maximum(far, 1e-12)
        points = np.stack([u * guess, v * guess])
        wanted = np.stack([u, v])
        for _ in range(_STEPS):
            here = np.stack(self.distorted(points[0], points[1]))
            missing = here - wanted
            (a, c), (b, d) = self._slopes(points, here)
            determinant = a * d - b * c
            points[0] -= (d * missing[0] - b * missing[1]) / determinant
            points[1] -= (a * missing[1] - c * missing[0]) / determinant
        left = np.abs(np.stack(self.distorted(points[0], points[1])) - wanted).max(axis=0)
        found = (left < _CONTENT) & (np.hypot(points[0], points[1]) <= radii[-1] * 1.001)
        return points, found

    def covering(self) -> tuple[Pinhole, bool]:
        """The pinhole view that covers the photograph's field.

        Returns:
            The view, and whether it covers all of it: what is beyond 60 degrees from the axis is cut off, and what the
            formula does not describe, for it folds over there.
        """
        sides, found = self._undistorted_sides()
        low, high = sides.min(axis=(1, 2)), sides.max(axis=(1, 2))
        return self._pinhole(low, high, math.ceil), bool(found.all())

    def within(self) -> Pinhole:
        """The largest usual pinhole view that the photograph fills: the border of the photograph lies outside it.

        Raises:
            DataError: there is none.
        """
        (x, y), _ = self._undistorted_sides()
        # Top, right, bottom and left.
        low, high = np.array([x[3].max(), y[0].max()]), np.array([x[1].min(), y[2].min()])
        for _ in range(64):
            if (low < 0).all() and (high > 0).all():
                view = self._pinhole(low, high, math.floor)
                if self.fills(view):
                    return view
            low, high = 0.95 * low, 0.95 * high
        raise DataError("no pinhole view lies within the photograph: its lens distortion is too strong")

    def fills(self, view: Pinhole) -> bool:
        """Whether the photograph shows all that a pinhole view shows."""
        x = (np.linspace(0.5, view.width - 0.5, _SIDE_POINTS) - view.cx) / view.fx
        y = (np.linspace(0.5, view.height - 0.5, _SIDE_POINTS) - view.cy) / view.fy
        across, down = np.meshgrid(x, y)
        radii, _ = self._radii
        u, v = self.distorted(across, down)
        columns, rows = u * self.fx + self.cx, v * self.fy + self.cy
        inside = (columns >= 0) & (columns <= self.width) & (rows >= 0) & (rows <= self.height)
        # Where the radius grows no more the picture is folded over.
        return bool((inside & (np.hypot(across, down) <= radii[-1] * 1.001)).all())

    def _slopes(self, points: F64, here: F64) -> tuple[F64, F64]:
        """How the bent points, (2, N), which are ``here``, move with x and with y."""
        right = np.stack(self.distorted(points[0] + _DIFFERENCE, points[1]))
        down = np.stack(self.distorted(points[0], points[1] + _DIFFERENCE))
        return (right - here) / _DIFFERENCE, (down - here) / _DIFFERENCE

    def _pinhole(self, low: F64, high: F64, whole: Callable[[float], int]) -> Pinhole:
        """The view from ``low`` to ``high`` on the image plane, with the photograph's focal length where that is not
        too many pixels."""
        sides = (high - low) * (self.fx, self.fy)
        scale = min(1.0, math.sqrt(_MOST_PIXELS * self.width * self.height / max(sides[0] * sides[1], 1e-9)))
        fx, fy = self.fx * scale, self.fy * scale
        width, height = (max(whole(round(float(side) * scale, 6)), 1) for side in sides)
        # What rounding to whole pixels leaves goes to both sides.
        cx, cy = width / 2 - fx * (low[0] + high[0]) / 2, height / 2 - fy * (low[1] + high[1]) / 2
        return Pinhole(width, height, fx, fy, float(cx), float(cy))

    def _sides(self, part: float) -> F64:
        """(2, 4, points) of top, right, bottom and left, so far on the way from the principal point to them."""
        along = np.linspace(0, 1, _SIDE_POINTS)
        none, all_of_it = np.zeros(_SIDE_POINTS), np.ones(_SIDE_POINTS)
        across = np.stack([along, all_of_it, along, none]) * self.width
        down = np.stack([none, along, all_of_it, along]) * self.height
        return part * np.stack([(across - self.cx) / self.fx, (down - self.cy) / self.fy])

    def _undistorted_sides(self) -> tuple[F64, NDArray[np.bool_]]:
        """(2, 4, points) of the sides on the image plane, the widest field where they lie beyond; whether found."""
        sides = self._sides(1.0)
        with np.errstate(all="ignore"):
            points, found = self.undistorted(*sides.reshape(2, -1))
        far = np.hypot(*sides.reshape(2, -1))
        edge = sides.reshape(2, -1) / far * self._radii[0][-1]
        points = np.where(found, points, edge)
        return points.reshape(sides.shape), found

    @cached_property
    def _radii(self) -> tuple[F64, F64]:
        """Distances from the middle on the image plane and in the photograph, as far as both grow."""
        radii = np.linspace(0, math.tan(MOST_HALF_FIELD), _RADII)
        x = np.arctan(radii) if self.fisheye else radii
        with np.errstate(all="ignore"):
            bent = x * _polynomial(self.radial, x * x) / _polynomial(self.quotient, x * x)
        falls = np.flatnonzero(~(np.diff(bent) > 0))
        end = (falls[0] + 1) if len(falls) else _RADII
        return radii[:end], bent[:end]


def _polynomial(coefficients: tuple[float, ...], square: F64) -> F64:
    """1 + c1 s + c2 s² + …"""
    value: Any = 0.0
    for coefficient in reversed(coefficients):
        value = (value + coefficient) * square
    return np.asarray(value + 1)
