"""potr_cl: post-training compression of 3D Gaussian Splatting scenes with OpenCL.

The public interface in short; everything else has its module. What the command line does, functions of the same names
do with the same options (docs/python.md has examples):

- :func:`encode`, :func:`decode`: to a .potr file and back; :class:`EncodeOptions`, all options of an encode at once;
- :func:`decode_to_device`: a .potr file in the memory of an OpenCL device, for a renderer that runs there;
- :func:`prune`, :func:`compact`, :func:`refit`: one stage alone, from a scene to a scene;
- :func:`render`, :func:`compare`: pictures of a scene, and one scene judged by another's; :func:`compare_budgets`,
  levels of detail;
- :func:`read_scene`, :func:`read_cameras`, :func:`save`, :func:`convert`, :func:`info`: files, of all formats;
- :func:`place_cameras`, :func:`look_around`, :func:`turntable`: views for a scene that comes without any;
- :func:`encode_ladder`, a scene at several qualities; :func:`view`, a page in the browser that shows scenes;
- :func:`encode_to_target` with a :class:`Target`: what a search for a size or a PSNR has tried;
- :class:`Scene`, :class:`Camera`: what they work on;
- :class:`PotrError` and its subclasses: what they raise.
"""

from __future__ import annotations

import sys
from importlib import import_module

# As typing has it, which takes long to import: until the program handles signals, Ctrl-C ends in a traceback.
TYPE_CHECKING = False

if TYPE_CHECKING:
    from typing import Any

    from potr_cl.api.budgets import BudgetComparison, compare_budgets
    from potr_cl.api.choices import EncodeChoices
    from potr_cl.api.comparing import SceneComparison, compare
    from potr_cl.api.describing import SceneInfo, info
    from potr_cl.api.editing import (
        CompactedScene,
        EditChoices,
        FittedScene,
        PrunedScene,
        RefittedScene,
        compact,
        fit,
        prune,
        refit,
    )
    from potr_cl.api.effects import RemovalEffects, removal_effects
    from potr_cl.api.encoding import encode, encode_ladder
    from potr_cl.api.files import convert, decode, decode_to_device, save
    from potr_cl.api.pictures import Rendering, Renderings, preview, render
    from potr_cl.api.viewing import view
    from potr_cl.errors import (
        DataError,
        DeviceError,
        DeviceMemoryError,
        PotrError,
        UnreachableError,
        UsageError,
        WriteError,
    )
    from potr_cl.formats import load_cameras, load_scene, read_cameras, read_scene
    from potr_cl.model.camera import Camera
    from potr_cl.model.scene import Scene
    from potr_cl.pipeline.encoded import Encoded
    from potr_cl.pipeline.options import EncodeOptions
    from potr_cl.pipeline.search import encode_to_target
    from potr_cl.pipeline.target import Target
    from potr_cl.placement.viewpoints import look_around, turntable
    from potr_cl.placement.virtual import place_cameras

__version__ = "0.1.0"

__all__ = [
    "BudgetComparison",
    "Camera",
    "CompactedScene",
    "DataError",
    "DeviceError",
    "DeviceMemoryError",
    "EditChoices",
    "EncodeChoices",
    "EncodeOptions",
    "Encoded",
    "FittedScene",
    "PotrError",
    "PrunedScene",
    "RefittedScene",
    "RemovalEffects",
    "Rendering",
    "Renderings",
    "Scene",
    "SceneComparison",
    "SceneInfo",
    "Target",
    "UnreachableError",
    "UsageError",
    "WriteError",
    "__version__",
    "compact",
    "compare",
    "compare_budgets",
    "convert",
    "decode",
    "decode_to_device",
    "encode",
    "encode_ladder",
    "encode_to_target",
    "fit",
    "info",
    "load_cameras",
    "load_scene",
    "look_around",
    "place_cameras",
    "preview",
    "prune",
    "read_cameras",
    "read_scene",
    "refit",
    "removal_effects",
    "render",
    "save",
    "turntable",
    "view",
]

#: Imported on first use: the OpenCL loader and NumPy are not everybody's who asks for the version.
_NAMES = {
    "api.budgets": "BudgetComparison compare_budgets",
    "api.choices": "EncodeChoices",
    "api.comparing": "SceneComparison compare",
    "api.describing": "SceneInfo info",
    "api.editing": "CompactedScene EditChoices FittedScene PrunedScene RefittedScene compact fit prune refit",
    "api.effects": "RemovalEffects removal_effects",
    "api.encoding": "encode encode_ladder",
    "api.files": "convert decode decode_to_device save",
    "api.pictures": "Rendering Renderings preview render",
    "api.viewing": "view",
    "errors": "DataError DeviceError DeviceMemoryError PotrError UnreachableError UsageError WriteError",
    "formats": "load_cameras load_scene read_cameras read_scene",
    "model.camera": "Camera",
    "model.scene": "Scene",
    "pipeline.encoded": "Encoded",
    "pipeline.options": "EncodeOptions",
    "pipeline.search": "encode_to_target",
    "pipeline.target": "Target",
    "placement.viewpoints": "look_around turntable",
    "placement.virtual": "place_cameras",
}
_HOMES = {name: module for module, names in _NAMES.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'potr_cl' has no attribute '{name}'")
    value = getattr(import_module(f"potr_cl.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__


def _show_scenes_in_notebooks() -> None:
    """Have a notebook show scenes as pictures: arrays themselves know nothing of rendering."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    if shell is not None:
        pictures = shell.display_formatter.formatters["image/png"]
        pictures.for_type_by_name("potr_cl.model.scene", "Scene", lambda scene: __getattr__("preview")(scene))


_show_scenes_in_notebooks()
