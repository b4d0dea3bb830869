"""By how much pictures change with each parameter of a splat's shape by itself: :func:`curvatures`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory
from potr_cl.stages.compaction.view_weights import REFERENCE_PIXELS
from potr_cl.stages.fitting.derivatives import PictureDerivatives

#: Views that are looked at, with random signs each; fewer views are looked at several times.
_LOOKS = 32
#: Columns of the gradient that are not colours.
_COLUMNS = 11


def curvatures(
    device: Device,
    scene: Scene,
    cameras: Sequence[Camera],
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    seed: int = 0,
) -> NDArray[np.float64]:
    """The mean squared error of the views for an error of 1 in one parameter, as long as errors are small.

    That is the diagonal of Jᵀ J over the number of values. It is estimated: where v are random signs, (Jᵀ v)² is that
    diagonal on average (Bekas, Kokiopoulou and Saad, 2007).

    Args:
        device: to compute on.
        scene: of N splats.
        cameras: the views, at least one; some of them are looked at where they are many.
        background: R, G, B behind the scene.
        seed: of the signs.

    Returns:
        (11, N) in the first columns of :class:`potr_cl.stages.fitting.derivatives.Columns`: all but colours.

    Raises:
        DeviceError: the scene does not fit the device.
    """
    rng = np.random.default_rng(seed)
    looks = [cameras[round(place)] for place in np.linspace(0, len(cameras) - 1, _LOOKS)]
    found = np.zeros((_COLUMNS, len(scene)))
    with PictureDerivatives(device, scene, background=background) as derivatives, Memory(device) as memory:
        signs = rng.choice(np.array([-1, 1], np.float32), size=(max(c.width * c.height for c in looks), 3))
        values = memory.upload(signs, "random signs")
        for camera in looks:
            pixels = camera.width * camera.height
            derivatives.add([camera], values, given=True)
            shape = (_COLUMNS, derivatives.rasterizer.stride)
            gradient = device.download(derivatives.gradient, shape, np.float32)[:, : len(scene)]
            derivatives.forget()
            # Of so many pixels the gradient is, whatever the picture has.
            found += np.square(gradient * np.float32(pixels / REFERENCE_PIXELS)) / (3.0 * pixels)
    return found / len(looks)
