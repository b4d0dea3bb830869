"""potr_cl: post-training compression of 3D Gaussian Splatting scenes with OpenCL.

The public interface: scenes and cameras are loaded by :mod:`potr_cl.formats`, encoded by :mod:`potr_cl.encoder`,
decoded by :mod:`potr_cl.decoder`, rendered by :mod:`potr_cl.rasterizer`.
"""

from potr_cl.cameras import Camera
from potr_cl.errors import DataError, DeviceError, PotrError, UsageError
from potr_cl.scene import Scene

__version__ = "0.1.0"

__all__ = ["Camera", "DataError", "DeviceError", "PotrError", "Scene", "UsageError", "__version__"]
