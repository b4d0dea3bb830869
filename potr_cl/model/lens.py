"""Lens distortion: what a photograph's lens did (:class:`Lens`), and the pinhole views that stand for its photographs.

A scene is looked at through pinholes. Of a distorted camera two of them are of use: the one that covers the field of
the photograph (:meth:`Lens.covering`), so that the encoder sees whatever was photographed; and the one that the
photograph fills without a gap (:meth:`Lens.within`), where a picture is compared with the photograph, undistorted.
Reconstructions can have a lens for each photograph: :func:`coverings` looks at many at a time.

The formulas are those of COLMAP (Schönberger and Frahm 2016, src/colmap/sensor/models.h), which agree with OpenCV's
(modules calib3d and fisheye): Brown's radial and tangential terms, also as a quotient, and the equidistant fisheye.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import DataError

F64 = NDArray[np.float64]

#: Half of the widest field, radians: pictures of a pinhole grow without end towards 90 degrees.
MOST_HALF_FIELD = math.radians(60)
#: A pinhole view gets at most so many times the photograph's pixels; beyond, it is coarser.
_MOST_PIXELS = 2.0
#: Points on each side of a photograph that tell how far its field reaches; every so many are looked at first.
_SIDE_POINTS, _COARSE = 257, 16
#: Points of the curve of the radius, up to the widest field.
_RADII = np.linspace(0, math.tan(MOST_HALF_FIELD), 4097)
#: How far on the way to the middle of a photograph its picture must not be turned inside out.
_WAY = np.linspace(0, 1, 17)[1:]
#: Newton's steps, the difference of its derivative, and the errors with which it is content and with which it goes no
#: further, as parts of a focal length.
_STEPS, _DIFFERENCE, _CONTENT, _EXACT = 12, 1e-6, 1e-7, 1e-13
_LARGEST_COEFFICIENT = 1e3
_FOLDS = "its lens distortion folds the picture over: the coefficients do not fit the focal length"
#: Focal length in sides of the picture.
_SHORTEST = 1e-3
#: Lenses that are looked at together: what of them is looked at fits a processor's cache.
_TOGETHER = 64


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
        DataError: no lens has these values.
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
            raise DataError(f"no lens has a distortion coefficient beyond {_LARGEST_COEFFICIENT:g}")
        intrinsics = (self.fx, self.fy, self.cx, self.cy)
        if not all(map(math.isfinite, intrinsics)) or min(self.fx / self.width, self.fy / self.height) < _SHORTEST:
            raise DataError(f"intrinsics (fx, fy, cx, cy) = {intrinsics} are not a camera's")
        if not (0 < self.cx < self.width and 0 < self.cy < self.height):
            raise DataError("the principal point of a distorted camera lies outside its picture")

    def distorted(self, x: F64, y: F64) -> tuple[F64, F64]:
        """Where points of the image plane, of any shape, are in the photograph, in focal lengths from its middle."""
        u, v = self._terms.bent(np.stack([x, y]))
        return u, v

    def undistorted(self, u: F64, v: F64) -> tuple[F64, NDArray[np.bool_]]:
        """Points of the image plane of points of the photograph: the inverse of :meth:`distorted`.

        Args:
            u, v: (N,) in focal lengths from the principal point.

        Returns:
            (2, N) x and y, and whether each was found; those beyond the widest field are not.
        """
        with np.errstate(all="ignore"):
            points, found = _Together([self]).undistorted(np.stack([u, v])[:, None])
        return points[:, 0], found[0]

    def covering(self) -> Covering:
        """The pinhole view that covers the photograph's field; see :func:`coverings` for many lenses.

        Returns:
            The view, and whether it covers all of it: what is beyond 60 degrees from the axis is cut off, and what the
            formula does not describe, for it folds over there.

        Raises:
            DataError: the lens folds the picture over in its middle.
        """
        (found,) = coverings([self])
        if isinstance(found, DataError):
            raise found
        return found

    def within(self) -> Pinhole:
        """The largest usual pinhole view that the photograph fills: the border of the photograph lies outside it.

        Raises:
            DataError: there is none, or the lens folds the picture over in its middle.
        """
        with np.errstate(all="ignore"):
            alone = _Together([self])
            if not alone.unfolded()[0]:
                raise DataError(_FOLDS)
            x, y = alone.undistorted_sides()[0][:, 0]
        # Top, right, bottom and left.
        low, high = np.array([x[3].max(), y[0].max()]), np.array([x[1].min(), y[2].min()])
        for _ in range(64):
            if (low < 0).all() and (high > 0).all():
                view = self.pinhole(low, high, math.floor)
                if self.fills(view):
                    return view
            low, high = 0.95 * low, 0.95 * high
        raise DataError("no pinhole view lies within the photograph: its lens distortion is too strong")

    def fills(self, view: Pinhole) -> bool:
        """Whether the photograph shows all that a pinhole view shows."""
        x = (np.linspace(0.5, view.width - 0.5, _SIDE_POINTS) - view.cx) / view.fx
        y = (np.linspace(0.5, view.height - 0.5, _SIDE_POINTS) - view.cy) / view.fy
        across, down = np.meshgrid(x, y)
        with np.errstate(all="ignore"):
            u, v = self.distorted(across, down)
            widest = _Together([self]).widest[0, 0]
        columns, rows = u * self.fx + self.cx, v * self.fy + self.cy
        inside = (columns >= 0) & (columns <= self.width) & (rows >= 0) & (rows <= self.height)
        # Where the radius grows no more the picture is folded over.
        return bool((inside & (np.hypot(across, down) <= widest * 1.001)).all())

    @property
    def kind(self) -> tuple[bool, int, int, bool, bool]:
        """Lenses of one kind have the same terms."""
        return self.fisheye, len(self.radial), len(self.quotient), any(self.tangential), any(self.prism)

    @property
    def _terms(self) -> _Terms:
        # Most lenses have few of them.
        tangential, prism = (each if any(each) else () for each in (self.tangential, self.prism))
        return _Terms(self.fisheye, self.radial, self.quotient, tangential, prism)

    def pinhole(self, low: F64, high: F64, whole: Callable[[float], int]) -> Pinhole:
        """The view from ``low`` to ``high`` on the image plane, with the photograph's focal length where that is not
        too many pixels."""
        sides = (high - low) * (self.fx, self.fy)
        scale = min(1.0, math.sqrt(_MOST_PIXELS * self.width * self.height / max(sides[0] * sides[1], 1e-9)))
        fx, fy = self.fx * scale, self.fy * scale
        width, height = (max(whole(round(float(side) * scale, 6)), 1) for side in sides)
        # What rounding to whole pixels leaves goes to both sides.
        cx, cy = width / 2 - fx * (low[0] + high[0]) / 2, height / 2 - fy * (low[1] + high[1]) / 2
        return Pinhole(width, height, fx, fy, float(cx), float(cy))


#: What :meth:`Lens.covering` returns.
Covering: TypeAlias = "tuple[Pinhole, bool]"


def coverings(lenses: Sequence[Lens]) -> list[Covering | DataError]:
    """What :meth:`Lens.covering` returns, or raises, of each of many lenses, in a small part of the time."""
    found: list[Covering | DataError] = [DataError()] * len(lenses)
    kinds: dict[Any, list[int]] = {}
    for number, lens in enumerate(lenses):
        kinds.setdefault(lens.kind, []).append(number)
    for numbers in kinds.values():
        for start in range(0, len(numbers), _TOGETHER):
            some = numbers[start : start + _TOGETHER]
            with np.errstate(all="ignore"):
                covered = _Together([lenses[number] for number in some]).coverings()
            for number, each in zip(some, covered, strict=True):
                found[number] = each
    return found


class _Terms(NamedTuple):
    """The coefficients of one lens, or as columns, (L, 1), those of some that have the same terms."""

    fisheye: bool
    radial: tuple[Any, ...]
    quotient: tuple[Any, ...]
    tangential: tuple[Any, ...]
    prism: tuple[Any, ...]

    def bent(self, points: F64) -> F64:
        """:meth:`Lens.distorted` of points, (2, …)."""
        x, y = points
        square = x * x + y * y
        if self.fisheye:
            r = np.sqrt(square)
            turned = np.where(r > 1e-9, np.arctan(r) / np.maximum(r, 1e-9), 1.0)
            points = points * turned
            x, y = points
            square = x * x + y * y
        d = _polynomial(self.radial, square)
        if self.quotient:
            d = d / _polynomial(self.quotient, square)
        bent: F64 = points * d
        if self.tangential:
            (p1, p2), across = self.tangential, x * y
            bent[0] += 2 * p1 * across + p2 * (square + 2 * x * x)
            bent[1] += 2 * p2 * across + p1 * (square + 2 * y * y)
        if self.prism:
            bent += np.stack([s * square for s in self.prism])
        return bent


class _Together:
    """Some lenses that have the same terms.

    Args:
        lenses: L of them.

    Attributes:
        widest: (L, 1) how far from the middle of the image plane the radius in the photograph still grows.
    """

    def __init__(self, lenses: Sequence[Lens]) -> None:
        self._lenses = lenses
        terms = [lens._terms for lens in lenses]
        radial, quotient, tangential, prism = (
            tuple(np.array(column)[:, None] for column in zip(*(each[place] for each in terms), strict=True))
            for place in range(1, 5)
        )
        self._terms = _Terms(terms[0].fisheye, radial, quotient, tangential, prism)
        x = np.arctan(_RADII) if self._terms.fisheye else _RADII
        bent = x * _polynomial(radial, x * x) / _polynomial(quotient, x * x)
        self._radii = np.broadcast_to(bent, (len(lenses), len(_RADII)))  # in the photograph
        falls = ~(self._radii[:, 1:] > self._radii[:, :-1])
        self._ends = np.where(falls.any(axis=1), falls.argmax(axis=1) + 1, len(_RADII))
        self.widest = _RADII[self._ends - 1][:, None]

    def coverings(self) -> list[Covering | DataError]:
        """See :func:`coverings`."""
        sound = self.unfolded()
        low, high, whole = self._bounds()
        return [
            (lens.pinhole(low[:, place], high[:, place], math.ceil), bool(whole[place]))
            if sound[place]
            else DataError(_FOLDS)
            for place, lens in enumerate(self._lenses)
        ]

    def undistorted(self, wanted: F64) -> tuple[F64, NDArray[np.bool_]]:
        """:meth:`Lens.undistorted` of (2, L, N) points: as many of them, and (L, N) whether each was found."""
        far = np.hypot(*wanted)
        guess = np.stack(
            [np.interp(*each) for each in zip(far, *zip(*map(self._curve, range(len(far))), strict=True), strict=True)]
        )
        points = wanted * (guess / np.maximum(far, 1e-12))
        for _ in range(_STEPS):
            here = self._terms.bent(points)
            missing = here - wanted
            # A point that is there stays, so that its digits do not depend on the other lenses.
            moving = ~(np.abs(missing).max(axis=0) <= _EXACT)
            if not moving.any():
                break
            (a, c), (b, d) = self._slopes(points, here)
            determinant = a * d - b * c
            x, y = missing
            points -= np.where(moving, np.stack([d * x - b * y, a * y - c * x]) / determinant, 0.0)
        left = np.abs(self._terms.bent(points) - wanted).max(axis=0)
        return points, (left < _CONTENT) & (np.hypot(*points) <= self.widest * 1.001)

    def undistorted_sides(self) -> tuple[F64, NDArray[np.bool_]]:
        """(2, L, 4, points) of the sides on the image plane, the widest field where they lie beyond; whether found."""
        sides = self._sides()
        points, found = self._undistorted(sides)
        return np.where(found, points, sides / np.hypot(*sides) * self.widest[..., None]), found

    def _bounds(self) -> tuple[F64, F64, NDArray[np.bool_]]:
        """(2, L) least and greatest x and y of the sides on the image plane, and (L,) whether all of them are found."""
        every = self._sides()
        bounds, plain = np.empty((2, 2, len(self._lenses))), np.ones(len(self._lenses), bool)
        # Where few points leave no doubt about where on its side an extreme lies, only those near it are looked at.
        points, found = self._undistorted(every[..., ::_COARSE])
        for greatest, axis, side in ((False, 0, 3), (False, 1, 0), (True, 0, 1), (True, 1, 2)):
            values = -points[axis] if greatest else points[axis]
            at = values[:, side].argmin(axis=1)
            plain &= found.all(axis=(1, 2)) & (values[:, side].min(axis=1) <= values.min(axis=(1, 2)))
            near = np.clip(_COARSE * at[:, None] + np.arange(1 - _COARSE, _COARSE), 0, _SIDE_POINTS - 1)
            fine, there = self._undistorted(np.take_along_axis(every[:, :, side], near[None], axis=2))
            plain &= there.all(axis=1)
            bounds[int(greatest), axis] = (fine[axis].max if greatest else fine[axis].min)(axis=1)
        whole = plain.copy()
        if len(rest := np.flatnonzero(~plain).tolist()):
            sides, found = _Together([self._lenses[place] for place in rest]).undistorted_sides()
            bounds[0][:, rest], bounds[1][:, rest] = sides.min(axis=(2, 3)), sides.max(axis=(2, 3))
            whole[rest] = found.all(axis=(1, 2))
        return bounds[0], bounds[1], whole

    def _undistorted(self, wanted: F64) -> tuple[F64, NDArray[np.bool_]]:
        """:meth:`undistorted` of (2, L, …) points."""
        points, found = self.undistorted(wanted.reshape(2, len(self._lenses), -1))
        return points.reshape(wanted.shape), found.reshape(wanted.shape[1:])

    def unfolded(self) -> NDArray[np.bool_]:
        """(L,) whether nowhere up to halfway from the principal point to the border a picture is turned inside out."""
        middle = 0.5 * self._sides()[..., ::_COARSE].reshape(2, len(self._lenses), -1)
        points, found = self._undistorted(middle)
        way = (points[..., None, :] * _WAY[:, None]).reshape(2, len(self._lenses), -1)
        (a, c), (b, d) = self._slopes(way, self._terms.bent(way))
        found = found & (a * d > b * c).reshape(len(found), len(_WAY), -1).all(axis=1)
        # What lies beyond the widest field need not be found.
        found = found | (self._ends[:, None] == len(_RADII)) & (np.hypot(*middle) > self._radii[:, -1:])
        unfolded: NDArray[np.bool_] = found.all(axis=1)
        return unfolded

    def _curve(self, place: int) -> tuple[F64, F64]:
        """Radii in the photograph and on the image plane, as far as both grow."""
        end = self._ends[place]
        return self._radii[place, :end], _RADII[:end]

    def _slopes(self, points: F64, here: F64) -> tuple[F64, F64]:
        """How the bent points, (2, L, N), which are ``here``, move with x and with y."""
        x, y = points
        right = self._terms.bent(np.stack([x + _DIFFERENCE, y]))
        down = self._terms.bent(np.stack([x, y + _DIFFERENCE]))
        return (right - here) / _DIFFERENCE, (down - here) / _DIFFERENCE

    def _sides(self) -> F64:
        """(2, L, 4, points) of top, right, bottom and left of the photographs, in focal lengths from their middle."""
        width, height, fx, fy, cx, cy = (
            np.array([getattr(lens, name) for lens in self._lenses], np.float64)[:, None, None]
            for name in ("width", "height", "fx", "fy", "cx", "cy")
        )
        along = np.linspace(0, 1, _SIDE_POINTS)
        none, all_of_it = np.zeros(_SIDE_POINTS), np.ones(_SIDE_POINTS)
        across, down = np.stack([along, all_of_it, along, none]), np.stack([none, along, all_of_it, along])
        return np.stack([(across * width - cx) / fx, (down * height - cy) / fy])


def _polynomial(coefficients: tuple[Any, ...], square: F64) -> Any:
    """1 + c1 s + c2 s² + …"""
    value: Any = 0.0
    for coefficient in reversed(coefficients):
        value = (value + coefficient) * square
    return value + 1
