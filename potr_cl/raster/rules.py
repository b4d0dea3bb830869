"""The rules in which rasterizers of 3D Gaussian splats differ: :class:`RasterRules`, and two sets of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from potr_cl.errors import UsageError


@dataclass(frozen=True)
class RasterRules:
    """The rules in which rasterizers differ.

    What they have in common, and what a scene alone decides, is the low-pass filter: ``scene.low_pass`` square pixels
    are added to both variances of a splat's covariance Σ on screen. If the scene is antialiased, its opacity is
    multiplied by √max(det Σ / det(Σ + low_pass I), ``LEAST_COMPENSATION``²), so that a splat that gets wider gets as
    much fainter (Yu et al., Mip-Splatting, 2024). The original (``antialiasing``) and gsplat (``rasterize_mode
    "antialiased"``) define it like this, bound included; older gsplat has no bound, which only shows in alphas below
    0.005. Mip-Splatting's own code has a bound of 1e-6 under the root, and draws nothing where det Σ is at most
    1e-6 square pixels.

    Attributes:
        near: splats whose view-space depth is at or below this, in world units, are not drawn.
        alpha_cap: largest alpha of a splat in a pixel.
        square_extent: draw a splat only in the tiles that the square of half side ceil(3 sigma_max) around its centre
            touches, as the original does; if False, wherever its alpha reaches 1/255.
        threshold_included: whether a pixel ends before a splat that would bring its transmittance to exactly 1e-4; if
            False, it ends only before one that would bring it below.
    """

    near: float = 0.2
    alpha_cap: float = 0.99
    square_extent: bool = True
    threshold_included: bool = False

    def __post_init__(self) -> None:
        if not (np.isfinite(self.near) and self.near > 0):
            raise UsageError(f"the near plane must be a positive distance, not {self.near}")
        if not 1 / 255 <= self.alpha_cap < 1:
            raise UsageError(f"the alpha cap must lie in [1/255, 1), not {self.alpha_cap}")

    @property
    def transmittance_threshold(self) -> float:
        """A pixel ends before its transmittance would fall below this float32."""
        threshold = np.float32(1e-4)
        return float(np.nextafter(threshold, np.float32(1)) if self.threshold_included else threshold)


#: The least factor by which an antialiased splat's opacity is multiplied.
LEAST_COMPENSATION = 0.005

#: The original 3DGS rasterizer.
INRIA = RasterRules()
#: gsplat's rasterizer, with the original's near plane instead of its own default of 0.01.
GSPLAT = RasterRules(alpha_cap=0.999, square_extent=False, threshold_included=True)

#: By the names that people know them by.
RULES = {"inria": INRIA, "gsplat": GSPLAT}
