"""How close a compressed scene comes to the uncompressed one, in pictures from views that it is judged by."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Literal

import numpy as np

from potr_cl.errors import UsageError
from potr_cl.formats.images import Colour
from potr_cl.model.camera import Camera, test_views, train_views
from potr_cl.model.scene import FloatArray
from potr_cl.model.virtual_cameras import is_virtual
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner
from potr_cl.quality.compare import Comparison, compare
from potr_cl.quality.metrics_device import Similarity, in_batches
from potr_cl.quality.pictures import Picture, rendered
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.scene_buffers import Drawable

#: So many training views, spread evenly, stand for all of them where there are no test views.
_MOST_TRAINING_VIEWS = 32
#: Beside held-out views so many training views are judged, as a part of them, and at least, and at most.
_BESIDE, _LEAST_BESIDE, _MOST_BESIDE = 1 / 8, 4, 16
#: Bytes of the uncompressed scene's pictures that are kept from one candidate to the next; others are rendered again.
CACHED_PICTURES = 1 << 30


@dataclass(frozen=True)
class EvaluationViews:
    """The views that a scene is judged by.

    Attributes:
        views: at least one.
        kind: "test", held out of encoding, or "train", which encoding has looked at.
        available: how many of that kind the cameras hold.
        beside: a few training views, which tell whether held-out ones are matched worse; none if there are none, or if
            training views judge anyway.
    """

    views: list[Camera]
    kind: Literal["test", "train"]
    available: int
    beside: tuple[Camera, ...] = ()

    @staticmethod
    def of(cameras: Sequence[Camera]) -> EvaluationViews:
        """All test views; without any, up to 32 training views spread evenly.

        Raises:
            UsageError: there is no camera.
        """
        views = test_views(cameras)
        if views:
            training = [camera for camera in cameras if camera.split == "train"]
            beside = min(max(round(_BESIDE * len(views)), _LEAST_BESIDE), _MOST_BESIDE)
            return EvaluationViews(views, "test", len(views), tuple(_evenly(training, beside)))
        training = train_views(cameras)
        return EvaluationViews(_evenly(training, _MOST_TRAINING_VIEWS), "train", len(training))

    def named(self, name: str) -> Camera:
        """The view of a name.

        Raises:
            UsageError: there is none.
        """
        for camera in self.views:
            if camera.name == name:
                return camera
        raise UsageError(f"there is no view '{name}' among the {self}: '{self.views[0].name}' is the first of them")

    def __str__(self) -> str:
        if self.kind == "test":
            what = "virtual view" if is_virtual(self.views) else "test view"
            return f"{len(self.views)} held-out {what}{'s' if len(self.views) > 1 else ''}"
        which = "all" if len(self.views) == self.available else f"{len(self.views)} of"
        return f"{which} {self.available} training views, for the cameras name no test views"


def _evenly(views: Sequence[Camera], most: int) -> list[Camera]:
    """So many of some views at most, from the first to the last."""
    return [views[k] for k in np.linspace(0, len(views) - 1, min(len(views), most)).round().astype(int)]


class Evaluator(Owner):
    """Compares candidates with one uncompressed scene.

    Args:
        device: to render on.
        scene: the uncompressed one.
        views: to judge by.
        background: behind both.

    Attributes:
        device: as given.

    Raises:
        DeviceError: the scene does not fit the device.
    """

    def __init__(self, device: Device, scene: Drawable, views: EvaluationViews, background: Colour) -> None:
        self.views = views
        self.device = device
        self._background = background
        self._reference = Rasterizer(device, scene, background=background)
        self._similarity = Similarity(device)
        self._pictures: dict[str, Picture] = {}
        self._kept = ExitStack()
        self._room = min(CACHED_PICTURES, device.info.memory // 16)

    def psnr(self, candidate: Drawable, most: int | None = None) -> float:
        """:meth:`psnr_of` the views, or of so many of them, spread evenly."""
        views = self.views.views
        return self.psnr_of(views if most is None else _evenly(views, most), candidate)

    def psnr_of(self, views: Sequence[Camera], candidate: Drawable) -> float:
        """Mean over some views of the PSNR against the uncompressed scene's pictures, in decibels.

        Identical pictures are left out of the mean; it is infinite if all are identical.

        Args:
            views: any.
            candidate: to judge; where it is on a device, that is the evaluator's.
        """
        values: list[float] = []
        with Rasterizer(self.device, candidate, background=self._background) as rasterizer:
            for some in in_batches(self.device, views):
                with self._references(some) as references, rendered(rasterizer, some) as pictures:
                    values += [psnr for psnr, _ in self._similarity(list(zip(pictures, references, strict=True)))]
        finite = [value for value in values if math.isfinite(value)]
        return sum(finite) / len(finite) if finite else math.inf

    @contextmanager
    def _references(self, cameras: Sequence[Camera]) -> Iterator[list[Picture]]:
        """The uncompressed scene's pictures; kept from one candidate to the next while there is room."""
        missing = [camera for camera in cameras if camera.name not in self._pictures]
        with ExitStack() as stack:
            new: list[Picture] = []
            if missing:
                nbytes = sum(12 * camera.width * camera.height for camera in missing)
                keep = nbytes <= self._room
                new = (self._kept if keep else stack).enter_context(rendered(self._reference, missing))
                if keep:
                    self._room -= nbytes
                    self._pictures |= {camera.name: picture for camera, picture in zip(missing, new, strict=True)}
            rest = iter(new)
            yield [self._pictures.get(camera.name) or next(rest) for camera in cameras]

    def compare(self, candidate: Drawable, progress: Callable[[str, float], None]) -> Comparison:
        """PSNR and SSIM from every view; see :func:`potr_cl.quality.compare.compare`."""
        with Rasterizer(self.device, candidate, background=self._background) as rasterizer:
            return compare(self._reference, rasterizer, self.views.views, progress=progress)

    def pictures(self, candidate: Drawable, names: Sequence[str]) -> list[tuple[FloatArray, FloatArray]]:
        """(H, W, 3) float32 pictures of both scenes from the named views.

        Raises:
            UsageError: there is no such view.
        """
        cameras = [self.views.named(name) for name in names]
        with Rasterizer(self.device, candidate, background=self._background) as rasterizer:
            return [(self._reference.render(camera)[0], rasterizer.render(camera)[0]) for camera in cameras]

    def close(self) -> None:
        """Give all device memory back."""
        self._kept.close()
        self._pictures = {}
        self._reference.close()
