"""What is looked at, on a device (:class:`Session`): one scene or two, and pictures of them."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal

from potr_cl.errors import DeviceError, DeviceMemoryError
from potr_cl.formats.images import Colour
from potr_cl.formats.scenes.page import potr_of
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.quality.metrics_device import Similarity, rendered
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import RasterRules

Which = Literal["A", "B"]
#: How finely a scene is rounded that the page draws.
_FINE = {"q": 1.0, "sf_dc": 512.0, "sf_sh": 256.0, "sf_opacity": 32.0, "sf_rotation": 64.0, "sf_scale": 64.0}


@dataclass(frozen=True, eq=False)
class Exhibit:
    """A scene to look at.

    Attributes:
        scene: it.
        name: what people call it; chosen by whoever named the file.
        nbytes: of its file, or of its arrays where it comes from none.
        source: its file, if that may be read again.
        number: that no other has.
    """

    scene: Scene
    name: str
    nbytes: int
    source: Path | None = None
    number: int = field(default_factory=itertools.count(1).__next__)

    @cached_property
    def potr(self) -> bytes:
        """The scene as a .potr file for the page to draw: its own, or one rounded more finely than screens show.

        Raises:
            DataError, UsageError, OSError: it cannot be made or read.
        """
        return potr_of(self.scene, self.source, **_FINE)


@dataclass(frozen=True, eq=False)
class Look:
    """Pictures of one view.

    Attributes:
        camera: the view.
        a, b: (H, W, 3) float32; None where the scene is not there or was not asked for.
        psnr: of B against A in decibels, infinite for identical pictures; None where it was not asked for.
        ssim: likewise.
    """

    camera: Camera
    a: FloatArray | None
    b: FloatArray | None
    psnr: float | None = None
    ssim: float | None = None


class Session:
    """One scene or two on one device. All but :meth:`exhibit` is for one thread, the same one every time.

    After an error the device's memory is given back, and the next picture begins anew; if the error was not for want of
    memory, with a new context too, because drivers end a context with the first kernel that fails.

    Args:
        open_device: opens the device; called when the first picture is wanted.
        rules, background: of the rasterizer.
    """

    def __init__(self, open_device: Callable[[], Device], rules: RasterRules, background: Colour) -> None:
        self._open_device = open_device
        self._rules = rules
        self.background = background
        self._device: Device | None = None
        self._similarity: Similarity | None = None
        self._exhibits: dict[Which, Exhibit] = {}
        self._rasterizers: dict[Which, Rasterizer] = {}

    def exhibit(self, which: Which) -> Exhibit | None:
        """The scene that is shown as A or as B."""
        return self._exhibits.get(which)

    @property
    def is_pair(self) -> bool:
        """Whether there are two scenes to compare."""
        return len(self._exhibits) == 2

    def show(self, which: Which, exhibit: Exhibit | None) -> None:
        """Put a scene in the place of the one that was there; None: nothing."""
        old = self._rasterizers.pop(which, None)
        if old is not None:
            old.close()
        if exhibit is None:
            self._exhibits.pop(which, None)
        else:
            self._exhibits[which] = exhibit

    def look(self, camera: Camera, scenes: tuple[Which, ...] = ("A", "B"), figures: bool = False) -> Look:
        """Render a view.

        Args:
            camera: the view.
            scenes: to render, where they are there.
            figures: whether to compare them too.

        Raises:
            DeviceError: the view does not fit the device, or the device failed.
        """
        try:
            return self._look(camera, scenes, figures)
        except DeviceError as error:
            self._let_go(entirely=not isinstance(error, DeviceMemoryError))
            raise

    def _look(self, camera: Camera, scenes: tuple[Which, ...], figures: bool) -> Look:
        there = [which for which in scenes if which in self._exhibits]
        rasterizers = {which: self._rasterizer(which) for which in there}
        device = self._device
        if device is None:  # there is no scene
            return Look(camera, None, None)
        images: dict[Which, FloatArray] = {}
        psnr = ssim = None
        with contextlib.ExitStack() as stack:
            pictures = {
                which: stack.enter_context(rendered(rasterizer, [camera]))[0]
                for which, rasterizer in rasterizers.items()
            }
            if figures and len(pictures) == 2:
                if self._similarity is None:
                    self._similarity = Similarity(device)
                ((psnr, ssim),) = self._similarity([(pictures["B"], pictures["A"])])
            for which, picture in pictures.items():
                images[which] = picture.download(device)
        return Look(camera, images.get("A"), images.get("B"), psnr, ssim)

    def _rasterizer(self, which: Which) -> Rasterizer:
        if self._device is None:
            self._device = self._open_device()
        if which not in self._rasterizers:
            scene = self._exhibits[which].scene
            self._rasterizers[which] = Rasterizer(self._device, scene, self._rules, self.background)
        return self._rasterizers[which]

    def _let_go(self, entirely: bool) -> None:
        for rasterizer in self._rasterizers.values():
            with contextlib.suppress(Exception):  # of a context that is lost nothing can be given back
                rasterizer.close()
        self._rasterizers.clear()
        if entirely:
            self._similarity = self._device = None

    def close(self) -> None:
        """Give the device's memory back; the scenes stay."""
        self._let_go(entirely=True)
