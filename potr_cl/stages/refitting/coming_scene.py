"""A scene whose colours are known while its geometry is still being rounded: :class:`ComingScene`."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from potr_cl.host.threads import in_background
from potr_cl.model.scene import FloatArray, Scene


class ComingScene:
    """A scene that a thread of its own makes.

    Its geometry takes the host long, and much of a re-fit can be made ready without it.

    Args:
        sh: (N, M, 3) the scene's colours.
        make: returns the scene, with these colours.

    Attributes:
        sh: as given.
    """

    def __init__(self, sh: FloatArray, make: Callable[[], Scene]) -> None:
        self.sh = sh
        self._made: Future[Scene] = in_background(make)

    def __len__(self) -> int:
        return len(self.sh)

    def result(self) -> Scene:
        """The scene, once it is there.

        Raises:
            What making it raised.
        """
        return self._made.result()


#: A scene that is there or will be.
AnyScene: TypeAlias = Scene | ComingScene


def arrived(scene: AnyScene) -> Scene:
    """The scene itself, once it is there.

    Raises:
        What making it raised.
    """
    return scene.result() if isinstance(scene, ComingScene) else scene


def colourless(scene: Scene) -> Scene:
    """The same splats in black: a re-fit's rasterizer is never asked for colours."""
    return replace(scene, sh=np.broadcast_to(np.float32(0), (len(scene), 1, 3)))
