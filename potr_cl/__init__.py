"""potr_cl: post-training compression of 3D Gaussian Splatting scenes with OpenCL.

The public interface in short; everything else has its module:

- :func:`load_scene`, :func:`load_cameras`: from the files of :mod:`potr_cl.formats`;
- :func:`encode` with :class:`EncodeOptions`, or :func:`encode_to_target` with a :class:`Target`, a size or a PSNR;
- :func:`place_cameras`: views for a scene that comes without any; the two above place them themselves;
- :func:`decode`: back from a .potr file;
- :func:`render`: a picture of a scene;
- :class:`Scene`, :class:`Camera`: what they work on;
- :class:`PotrError` and its subclasses: what they raise.
"""

from __future__ import annotations

from importlib import import_module

# As typing has it, which takes long to import: until the program handles signals, Ctrl-C ends in a traceback.
TYPE_CHECKING = False

if TYPE_CHECKING:
    from typing import Any

    from potr_cl.codec.decoder import decode
    from potr_cl.errors import DataError, DeviceError, DeviceMemoryError, PotrError, UnreachableError, UsageError
    from potr_cl.formats import load_cameras, load_scene
    from potr_cl.model.camera import Camera
    from potr_cl.model.scene import Scene
    from potr_cl.model.virtual_cameras import place_cameras
    from potr_cl.pipeline.encode import Encoded, encode
    from potr_cl.pipeline.options import EncodeOptions
    from potr_cl.pipeline.search import Target, encode_to_target
    from potr_cl.raster.rasterizer import render

__version__ = "0.1.0"

__all__ = [
    "Camera",
    "DataError",
    "DeviceError",
    "DeviceMemoryError",
    "EncodeOptions",
    "Encoded",
    "PotrError",
    "Scene",
    "Target",
    "UnreachableError",
    "UsageError",
    "__version__",
    "decode",
    "encode",
    "encode_to_target",
    "load_cameras",
    "load_scene",
    "place_cameras",
    "render",
]

#: Imported on first use: the OpenCL loader and NumPy are not everybody's who asks for the version.
_HOMES = {
    "Camera": "model.camera",
    "DataError": "errors",
    "DeviceError": "errors",
    "DeviceMemoryError": "errors",
    "EncodeOptions": "pipeline.options",
    "Encoded": "pipeline.encode",
    "PotrError": "errors",
    "Scene": "model.scene",
    "Target": "pipeline.search",
    "UnreachableError": "errors",
    "UsageError": "errors",
    "decode": "codec.decoder",
    "encode": "pipeline.encode",
    "encode_to_target": "pipeline.search",
    "load_cameras": "formats",
    "load_scene": "formats",
    "place_cameras": "model.virtual_cameras",
    "render": "raster.rasterizer",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'potr_cl' has no attribute '{name}'")
    value = getattr(import_module(f"potr_cl.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
