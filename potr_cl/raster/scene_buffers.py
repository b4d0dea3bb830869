"""A scene's splats on a device, as the projection takes them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.errors import DeviceError
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner

#: Splats are padded to a multiple of this and handled in work-groups of it. CPUs are told the work-group too: left to
#: itself, PoCL makes one of thousands and overflows its stack with their private memory.
SPLAT_GROUP = 256

#: Splats whose parameters are uploaded at a time.
_UPLOADED = 1 << 18

#: Larger standard deviations, in world units, are replaced by this. Nobody can see a difference, and nothing overflows.
LARGEST_SCALE = 1e12


class SceneBuffers(Owner):
    """A scene's parameters, activated: standard deviations, unit quaternions, log2 of the opacities.

    Every parameter is an array of columns, each padded to the stride: cl/raster/project.cl says how they are used.

    Args:
        device: to hold them.
        scene: of N splats; copied, later changes of its arrays are not seen.

    Attributes:
        splats: N.
        stride: N rounded up; buffers that hold one value for each splat have this length.
        sh: (3 M, stride) float32, the SH coefficients of M = ``sh_count`` basis functions.
        sh_count: M.
        geometry: all other parameters and the stride, by the names that the projection's arguments have.

    Raises:
        DeviceError: the scene does not fit the device.
    """

    def __init__(self, device: Device, scene: Scene) -> None:
        if len(scene) > 0xFFFFFF00:
            raise DeviceError(f"{len(scene)} splats are more than the kernels can number")
        self._device = device
        self._memory = Memory(device)
        self.splats = len(scene)
        self.stride = max(-(-len(scene) // SPLAT_GROUP), 1) * SPLAT_GROUP
        self.sh_count = scene.sh.shape[1]
        try:
            self.geometry: dict[str, Any] = {"stride": self.stride, **self._upload_geometry(scene)}
            self.sh = self._upload_sh(scene.sh)
        except BaseException:
            self.close()
            raise

    def replace_sh(self, sh: FloatArray) -> cl.Buffer:
        """Replace the SH coefficients by others, (N, M, 3) float32 of the same degree.

        Returns:
            The buffer of the former ones, which is the caller's to free.
        """
        former, self.sh = self.sh, self._upload_sh(sh)
        return self._memory.release(former)

    def _upload_geometry(self, scene: Scene) -> dict[str, cl.Buffer]:
        quaternions = scene.quaternions.astype(np.float64)
        length = np.sqrt(np.einsum("ij,ij->i", quaternions, quaternions))[:, None]
        nothing = np.flatnonzero(length == 0)
        length[nothing] = 1
        quaternions /= length
        quaternions[nothing] = (1.0, 0.0, 0.0, 0.0)
        scales = np.minimum(np.exp(np.minimum(scene.log_scales.astype(np.float64), 100)), LARGEST_SCALE)
        logits = scene.opacity_logits.astype(np.float64)
        # log(sigmoid(logit)): logaddexp says the same, and takes eight times as long.
        log2_opacities = (np.minimum(logits, 0) - np.log1p(np.exp(-np.abs(logits)))) / np.log(2)
        return {
            "means": self._upload(scene.means, 0, "the centres"),
            "scales": self._upload(scales, 0, "the scales"),
            "quaternions": self._upload(quaternions, 0, "the rotations"),
            # The padding has an opacity of 0: it is not drawn.
            "log2_opacities": self._upload(log2_opacities[:, None], -np.inf, "the opacities"),
        }

    def _upload_sh(self, sh: FloatArray) -> cl.Buffer:
        return self._upload(sh.reshape(self.splats, -1), 0, "the SH coefficients")

    def _upload(self, rows: NDArray[Any], padding: float, what: str) -> cl.Buffer:
        """Upload rows, one for each splat, and transpose them to columns on the device, some rows at a time."""
        device, width = self._device, rows.shape[1]
        result = self._memory.allocate(4 * width * self.stride, what)
        cl.enqueue_fill_buffer(device.queue, result, np.float32(padding), 0, 4 * width * self.stride)
        turn = device.shared_kernel("raster/columns.cl", "columns")
        for first in range(0, self.splats, _UPLOADED):
            some = np.ascontiguousarray(rows[first : first + _UPLOADED], np.float32)
            with Memory(device) as memory:
                turn.bind(rows=memory.upload(some, what), first=first, width=width, stride=self.stride, result=result)
                turn.launch((len(some),))
        return result

    def close(self) -> None:
        self._memory.close()
