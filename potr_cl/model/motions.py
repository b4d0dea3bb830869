"""Ways in which a scene may have been moved away from its cameras: :data:`LIKELY_MOTIONS`."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.sightings import Poses

F64 = NDArray[np.float64]

#: Factors by which units are mistaken: metres, decimetres, centimetres, millimetres.
_FACTORS = (0.1, 10.0, 0.01, 100.0, 0.001, 1000.0)


@dataclass(frozen=True)
class Misreading:
    """Poses that were written in another way than they were read, each camera's by itself; the scene stayed in place.

    Attributes:
        name: of what went wrong, to stand behind "the scene was".
        condition: what must be so for it all to fit, to stand behind "they fit if".
        remedy: what to do about it.
        mended: makes the poses that were meant of those that were read.
    """

    name: str
    condition: str
    remedy: str
    mended: Callable[[Poses], Poses]


@dataclass(frozen=True, eq=False)
class Motion:
    """What may have happened to a scene after it was trained: x became ``scale · axes x``.

    Attributes:
        axes: (3, 3) of 0, 1 and -1: a rotation by right angles, or with a mirror.
        scale: a factor.
        misread: it was not the scene: the cameras' poses were meant in another way.
    """

    axes: F64
    scale: float
    misread: Misreading | None = None

    def of(self, cameras: Poses) -> Poses:
        """Cameras that are moved along with the scene, all in world units."""
        return cameras.moved(self.axes, self.scale) if self.misread is None else self.misread.mended(cameras)

    @property
    def condition(self) -> str:
        """What must be so for it all to fit, to stand behind "they fit if"."""
        return f"the scene was {self.name} after training" if self.misread is None else self.misread.condition

    @property
    def name(self) -> str:
        """What happened, to stand behind "the scene was"."""
        if self.misread is not None:
            return self.misread.name
        said = [_turn(self.axes)] if not np.array_equal(self.axes, np.eye(3)) else []
        if self.scale != 1:
            said.append(f"scaled by {self.scale:g}")
        return " and ".join(said) or "left as it was"

    @property
    def undone(self) -> str:
        """What brings it back, to stand behind "bring the scene back:"; empty if that is not known."""
        if self.misread is not None:
            return ""
        said = [_turn(self.axes.T)] if not np.array_equal(self.axes, np.eye(3)) else []
        if self.scale != 1:
            said.append(f"scaled by {1 / self.scale:g}")
        return " and ".join(said)


def _misread(misreading: Misreading) -> Motion:
    return Motion(np.eye(3), 1.0, misread=misreading)


#: What is wrong where cameras were exported with the axes of another convention: OpenGL's y up and z back.
LOOKING_BACK = _misread(
    Misreading(
        "behind its cameras",
        "each camera's y and z axes are turned round, from OpenGL's to COLMAP's",
        "write the cameras with x right, y down, z forward",
        Poses.turned_round,
    )
)
#: What is wrong where a program has written one direction of a pose for the other.
WRONG_WAY_ROUND = (
    _misread(
        Misreading(
            "seen by inverted poses",
            "each camera's pose is inverted, from world-to-camera to camera-to-world",
            "write the poses camera to world: the inverse of each matrix",
            Poses.inverted,
        )
    ),
    _misread(
        Misreading(
            "seen by transposed rotations",
            "each camera's rotation is transposed, from world-to-camera to camera-to-world",
            "write the rotations camera to world: the transpose of each",
            Poses.transposed,
        )
    ),
    _misread(
        Misreading(
            "seen from translations",
            "each camera's position is the translation t of its world-to-camera pose",
            "write the cameras' centres, which are -R^T t",
            Poses.from_translations,
        )
    ),
)


def _all_axes() -> list[F64]:
    """The 48 ways to exchange and turn round axes: the identity, other rotations from simple ones on, mirrored ones."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            axes = np.zeros((3, 3))
            axes[range(3), order] = signs
            found.append(axes)
    return sorted(
        found, key=lambda axes: (np.linalg.det(axes) < 0, _order(axes), -np.trace(axes), tuple(-axes.ravel()))
    )


def _order(axes: F64) -> int:
    """How much of the axes it takes: 0 for none, 1 for a turn about one of them, 2 for what exchanges them all."""
    if np.array_equal(axes, np.eye(3)):
        return 0
    return 1 if np.any(np.abs(np.diag(axes)) == 1) and (np.diag(axes) == 1).any() else 2


def _turn(axes: F64) -> str:
    """A signed permutation in words."""
    if np.linalg.det(axes) > 0 and (fixed := np.flatnonzero(np.diag(axes) == 1)).size:
        axis = int(fixed[0])
        after = (axis + 1) % 3
        sine, cosine = axes[(axis + 2) % 3, after], axes[after, after]
        angle = 180 if cosine == -1 else 90 * int(sine)
        return f"turned by {angle} degrees about {'xyz'[axis]}"
    diagonal = np.diag(axes)
    if np.abs(diagonal).sum() == 3:
        flipped = [name for name, sign in zip("xyz", diagonal, strict=True) if sign < 0]
        return f"mirrored along {', '.join(flipped)}"
    columns = np.abs(axes).argmax(axis=1)
    to = ", ".join(
        ("-" if axes[row, column] < 0 else "") + "xyz"[column] for row, column in enumerate(columns.tolist())
    )
    return f"given other axes, x, y, z = {to} of before"


#: What people and programs do to scenes, the usual first. Axes of OpenGL and of COLMAP differ by half a turn about x,
#: "z up" and "y up" by a quarter; units by powers of ten.
LIKELY_MOTIONS = (*(Motion(axes, 1.0) for axes in _all_axes()[1:]), *(Motion(np.eye(3), factor) for factor in _FACTORS))
