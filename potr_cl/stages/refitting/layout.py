"""Where a scene's SH coefficients lie (:class:`Layout`), and the penalty on them (:class:`Ridge`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

#: Y, Co and Cg.
CHANNELS = 3
#: Splats of a work-group.
_GROUP = 64


@dataclass(frozen=True)
class Layout:
    """Where the coefficients of a scene's splats lie on the device (cl/refit/coefficients.clh).

    Attributes:
        splats: N. stride: N padded; a column has so many values.
        sh_count: M, coefficients of a channel.
        lanes: splats a work-item.
    """

    splats: int
    stride: int
    sh_count: int
    lanes: int

    @property
    def columns(self) -> int:
        """Coefficients of a splat; coefficient m, channel c of Y, Co, Cg is in column 3 m + c."""
        return 3 * self.sh_count

    @property
    def triangle(self) -> int:
        """Values of a splat's own block of the normal equations, M (M + 1) / 2: its upper triangle, row by row."""
        return self.sh_count * (self.sh_count + 1) // 2

    @property
    def macros(self) -> dict[str, int]:
        """What the kernels must know of it when they are built."""
        return {"LANES": self.lanes, "SH_COUNT": self.sh_count}

    def some(self, constant: bool) -> dict[str, int]:
        """The same for kernels that look at all coefficients, or at the constant ones, whose columns come first."""
        return {**self.macros, "SH_COUNT": 1} if constant else self.macros

    def items(self, stride: int, *others: int, group: int = _GROUP) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Work-items, and those of a group, for so many splats, and in the second dimension for ``others``."""
        return (stride // self.lanes, *others), (max(group // self.lanes, 1), *(1 for _ in others))


@dataclass(frozen=True)
class Ridge:
    """The penalty beside the pictures' error: lam |x_AC|^2 + prior |x - start|^2, with a larger lam on chroma.

    Attributes:
        lam: on the AC coefficients of Y, in pixels of an image of ``REFERENCE_PIXELS``.
        chroma_factor: lambda of Co and Cg over that of Y.
        prior: on every coefficient's distance to its start, in the same unit.
    """

    lam: float
    chroma_factor: float
    prior: float

    @property
    def scalars(self) -> dict[str, np.float32]:
        """The arguments of that name of the kernels."""
        return {
            "lambda_luma": np.float32(self.lam),
            "lambda_chroma": np.float32(self.lam * self.chroma_factor),
            "prior": np.float32(self.prior),
        }
