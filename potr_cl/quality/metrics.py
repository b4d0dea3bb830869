"""PSNR, SSIM and LPIPS of two pictures, as the papers of the field compute them: the definitions in double precision.

:mod:`potr_cl.quality.metrics_device` finds PSNR and SSIM of pictures that lie on a device.

All take (H, W, 3) arrays of colours, clamp them to [0, 1] and do not round them to 8 bits.
"""

from __future__ import annotations

import importlib
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import UsageError
from potr_cl.host.libraries import install_command, without_warnings

#: SSIM's Gaussian window: 11 x 11 pixels, sigma 1.5; the weights from its centre outwards along one axis.
_RADIUS = 5
WINDOW = np.exp(-np.square(np.arange(_RADIUS + 1)) / (2 * 1.5**2))
WINDOW /= WINDOW[0] + 2 * WINDOW[1:].sum()
#: The constants that keep its fractions finite: (0.01 L)² and (0.03 L)² for colours up to L = 1.
C1, C2 = 0.01**2, 0.03**2
#: Rows of a picture worked on at a time: their temporaries fit a second-level cache.
_BAND = 32

#: VGG halves the picture four times before its last feature layer.
_LPIPS_SMALLEST_SIDE = 16


def _clamped(image: NDArray[Any]) -> NDArray[np.float64]:
    return np.clip(np.asarray(image, dtype=np.float64), 0, 1)


def psnr(image: NDArray[Any], reference: NDArray[Any]) -> float:
    """Peak signal-to-noise ratio in decibels, of the squared error's mean over pixels and channels.

    Args:
        image, reference: (H, W, 3), from 0 to 1; what lies beyond is clamped.

    Returns:
        Infinity where the pictures are identical.
    """
    error = float(np.mean((_clamped(image) - _clamped(reference)) ** 2))
    return math.inf if error == 0 else -10 * math.log10(error)


def ssim(image: NDArray[Any], reference: NDArray[Any]) -> float:
    """Structural similarity (Wang et al. 2004) of pictures (H, W, 3), averaged over all pixels and channels.

    The window is a Gaussian of 11 x 11 pixels with sigma 1.5 and the pictures are continued with zeros beyond their
    borders, as the original 3DGS implementation does. Statistics are taken in float64.
    """
    border = ((_RADIUS,) * 2, (_RADIUS,) * 2, (0, 0))
    a, b = (np.pad(_clamped(picture), border) for picture in (image, reference))
    total = 0.0
    for start in range(0, len(image), _BAND):
        rows = slice(start, start + _BAND + 2 * _RADIUS)
        x, y = a[rows], b[rows]
        # Only the sum of the two variances counts.
        mean_x, mean_y, squares, products = (_blurred(v) for v in (x, y, x * x + y * y, x * y))
        mean_product, mean_squares = mean_x * mean_y, mean_x * mean_x + mean_y * mean_y
        similarity = (2 * mean_product + C1) * (2 * (products - mean_product) + C2)
        similarity /= (mean_squares + C1) * (squares - mean_squares + C2)
        total += float(similarity.sum())
    return total / image.size


def _blurred(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Means under the window at every place (H, W, C) where it fits."""
    for axis in (0, 1):
        length = values.shape[axis] - 2 * _RADIUS
        shifted = [values[(slice(None),) * axis + (slice(s, s + length),)] for s in range(2 * _RADIUS + 1)]
        blurred = shifted[_RADIUS] * WINDOW[0]
        pair = np.empty_like(blurred)
        for distance in range(1, _RADIUS + 1):
            np.add(shifted[_RADIUS - distance], shifted[_RADIUS + distance], out=pair)
            pair *= WINDOW[distance]
            blurred += pair
        values = blurred
    return values


class Lpips:
    """Learned perceptual similarity (Zhang et al. 2018), version 0.1 on VGG-16, as 3DGS papers report it.

    Nothing is ever downloaded: the network's weights must be where torchvision looks for them.

    Raises:
        UsageError: the extra ``lpips`` or the weights are not installed; the message says how to get them.
    """

    def __init__(self) -> None:
        try:
            import lpips
            import torch

            torchvision = importlib.import_module("torchvision")
        except (ImportError, OSError):  # OSError: a library of torch's is missing
            raise UsageError(f"LPIPS needs {install_command('lpips')}") from None
        folder = Path(torch.hub.get_dir()) / "checkpoints"
        weights = folder / torchvision.models.VGG16_Weights.IMAGENET1K_V1.url.rsplit("/", 1)[-1]
        if not weights.is_file():
            raise UsageError(f"LPIPS needs its weights: put torchvision's weights '{weights.name}' into '{folder}'")
        self._torch = torch
        with without_warnings():  # lpips calls torchvision in a deprecated way
            try:
                self._network = lpips.LPIPS(net="vgg", verbose=False)
            except Exception as error:
                reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
                raise UsageError(f"LPIPS needs its weights: '{weights}' cannot be loaded: {reason}") from None

    def __call__(self, image: NDArray[Any], reference: NDArray[Any]) -> float | None:
        """The distance, 0 for identical pictures; None if they are smaller than 16 pixels on a side."""
        if min(image.shape[:2]) < _LPIPS_SMALLEST_SIDE:
            return None
        torch = self._torch
        with torch.no_grad():
            planes = [
                torch.from_numpy(_clamped(picture).astype(np.float32).transpose(2, 0, 1)[None])
                for picture in (image, reference)
            ]
            return float(self._network(*planes, normalize=True))
