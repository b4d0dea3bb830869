"""The library gsply, which packs and unpacks compressed PLY: the module itself, and its arrays."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from potr_cl.errors import PotrError, UsageError
from potr_cl.formats.scenes.scene_files import arranged, cleaned, first_line
from potr_cl.host.libraries import install_command
from potr_cl.model.scene import Scene

#: Of this package, which brings the library.
EXTRA = "convert"


def library(path: str | os.PathLike[str]) -> Any:
    """The module gsply, which ``path`` needs.

    Raises:
        UsageError: it is not installed.
        PotrError: it does not start.
    """
    try:
        import gsply
    except ImportError as error:
        raise UsageError(
            f"'{path}': this kind of file needs the library gsply, which cannot be loaded ({first_line(error)}): "
            f"{install_command(EXTRA)}"
        ) from None
    except Exception as error:  # compilers that do not fit the memory: OSError, SystemError, RuntimeError
        raise PotrError(
            f"'{path}': this kind of file needs the library gsply, which does not start here, perhaps for want of "
            f"memory ({first_line(error)})"
        ) from None
    return gsply


def to_scene(path: str | os.PathLike[str], data: Any) -> Scene:
    """gsply's arrays, in its PLY convention, as a clean scene.

    Args:
        path: for messages.
        data: a ``GSData``: logarithmic scales, logits, quaternions w first, ``shN`` (N, K, 3) or None.

    Raises:
        DataError: no splat is left.
    """

    def single(array: Any) -> Any:
        return np.ascontiguousarray(array, dtype=np.float32)

    count = len(data.means)
    sh = np.empty((count, 1 + (0 if data.shN is None else data.shN.shape[1]), 3), np.float32)
    sh[:, 0] = data.sh0
    if sh.shape[1] > 1:
        sh[:, 1:] = data.shN
    scene = Scene(
        single(data.means), single(data.scales), single(data.quats), single(data.opacities).reshape(count), sh
    )
    return cleaned(path, scene)


def from_scene(gsply: Any, scene: Scene) -> Any:
    """A scene as gsply's arrays."""
    scene = arranged(scene)
    return gsply.GSData.from_arrays(
        means=np.ascontiguousarray(scene.means),
        scales=np.ascontiguousarray(scene.log_scales),
        quats=scene.quaternions,
        opacities=scene.opacity_logits,
        sh0=np.ascontiguousarray(scene.sh[:, 0]),
        shN=np.ascontiguousarray(scene.sh[:, 1:]) if scene.sh_degree else None,
        format="ply",
    )
