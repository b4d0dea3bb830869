"""What one device does of the judging: :class:`Judging`, and the same as a part of a pool's work, :class:`JudgingPart`.

A view's figures are found on one device, from sums over parts of its pictures that are the same on every device of a
kind. So it makes no difference who judges which view.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeAlias

from potr_cl.formats.images import Colour
from potr_cl.host.threads import Ahead
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.model.splat_groups import SplatGroups
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner
from potr_cl.quality.figures import Against, ViewFigures
from potr_cl.quality.ground_truth import GroundTruth
from potr_cl.quality.metrics import Lpips, psnr
from potr_cl.quality.pictures import Picture, rendered
from potr_cl.raster.carried import Carried
from potr_cl.raster.kept_scene import KeptScene, lying_on
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import INRIA, RasterRules
from potr_cl.raster.scene_buffers import Drawable
from potr_cl.views.pictures import SeenRasterizer, rasterizer_of
from potr_cl.workers.pool import Part

#: Bytes of the uncompressed scene's pictures that are kept from one candidate to the next; others are rendered again.
CACHED_PICTURES = 1 << 30


@dataclass(frozen=True)
class Looks:
    """How pictures are made, and what besides they are compared with.

    Attributes:
        background: behind all scenes.
        rules: of the rasterizer.
        ground_truth, lpips: as of :class:`potr_cl.quality.figures.Against`.
        remember: whether the uncompressed scene's pictures are kept for the next candidate.
    """

    background: Colour = (0.0, 0.0, 0.0)
    rules: RasterRules = INRIA
    ground_truth: Mapping[str, Path] | None = None
    lpips: Lpips | None = None
    remember: bool = False


class Judging(Owner):
    """Compares candidates with one uncompressed scene, on one device.

    Args:
        device: to render on.
        reference: the uncompressed scene; it goes to the device when its pictures are first wanted.
        looks: how pictures are made.
        groups: of the reference's splats, where views see little of it.

    Raises:
        DeviceError: the kernels cannot be built.
    """

    def __init__(self, device: Device, reference: Drawable, looks: Looks, groups: SplatGroups | None = None) -> None:
        self._device, self._scene, self._looks, self._groups = device, reference, looks, groups
        self._against = Against(device, looks.background, looks.ground_truth, looks.lpips)
        self._reference: Rasterizer | SeenRasterizer | None = None
        self._candidate: Rasterizer | SeenRasterizer | None = None
        self._pictures: dict[_Seen, Picture] = {}
        self._kept = ExitStack()
        self._room = min(CACHED_PICTURES, device.info.memory // 16) if looks.remember else 0

    def take(self, candidate: Drawable, groups: SplatGroups | None = None) -> None:
        """Judge a candidate from now on, until :meth:`forget`.

        Args:
            candidate: to judge.
            groups: of its splats, where it is better drawn by what views see of it.

        Raises:
            DeviceError: it does not fit the device.
        """
        self.forget()
        self._candidate = rasterizer_of(self._device, candidate, self._looks.rules, self._looks.background, groups)

    def forget(self) -> None:
        """Give the candidate's memory back, and the reference's where its pictures may be all that is needed of it."""
        if self._candidate is not None:
            self._candidate.close()
            self._candidate = None
        if self._looks.remember:
            self._close_reference()

    def figures(self, cameras: Sequence[Camera]) -> Iterator[ViewFigures]:
        """The figures of some views, in their order.

        Raises:
            As :meth:`potr_cl.quality.figures.Against.figures`.
        """
        yield from self._against.figures(self._references, partial(rendered, self._taken), cameras)

    def by_photographs(self, cameras: Sequence[Camera], photographs: GroundTruth) -> Iterator[tuple[float, float]]:
        """PSNR in decibels of both scenes' pictures against the photograph of each view, the reference's first.

        Raises:
            UsageError, DataError: a photograph cannot be read.
            DeviceError: a view does not fit the device.
        """
        with Ahead(photographs.picture, cameras) as read:
            for camera, photograph in read:
                reference, candidate = self.pictures(camera)
                yield psnr(reference, photograph), psnr(candidate, photograph)

    def pictures(self, camera: Camera) -> tuple[FloatArray, FloatArray]:
        """(H, W, 3) float32 pictures of both scenes from a view."""
        return self._original.render(camera)[0], self._taken.render(camera)[0]

    @property
    def _taken(self) -> Rasterizer | SeenRasterizer:
        assert self._candidate is not None, "there is no candidate"
        return self._candidate

    @property
    def _original(self) -> Rasterizer | SeenRasterizer:
        if self._reference is None:
            looks = self._looks
            self._reference = rasterizer_of(self._device, self._scene, looks.rules, looks.background, self._groups)
        return self._reference

    @contextmanager
    def _references(self, cameras: Sequence[Camera]) -> Iterator[list[Picture]]:
        """The uncompressed scene's pictures; kept from one candidate to the next while there is room."""
        missing = [camera for camera in cameras if _seen(camera) not in self._pictures]
        with ExitStack() as stack:
            new: list[Picture] = []
            if missing:
                nbytes = sum(12 * camera.width * camera.height for camera in missing)
                keep = nbytes <= self._room
                new = (self._kept if keep else stack).enter_context(rendered(self._original, missing))
                if keep:
                    self._room -= nbytes
                    self._pictures |= {_seen(camera): picture for camera, picture in zip(missing, new, strict=True)}
            rest = iter(new)
            yield [self._pictures.get(_seen(camera)) or next(rest) for camera in cameras]

    def _close_reference(self) -> None:
        if self._reference is not None:
            self._reference.close()
            self._reference = None

    def close(self) -> None:
        self.forget()
        self._close_reference()
        self._kept.close()
        self._pictures = {}


#: What a view's picture depends on. From Python, several views may have the same name.
_Seen: TypeAlias = "tuple[float | bytes, ...]"


def _seen(camera: Camera) -> _Seen:
    intrinsics = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    return *intrinsics, camera.rotation.tobytes(), camera.translation.tobytes()


class JudgingPart(Part):
    """Some views; see :class:`Judging`.

    Args:
        device: to render on.
        memory: of no account: pictures come and go.
        reference: the uncompressed scene.
        looks, groups: as of :class:`Judging`.
    """

    def __init__(
        self,
        device: Device,
        memory: int | None,
        reference: Scene | KeptScene | Carried,
        looks: Looks,
        groups: SplatGroups | None = None,
    ) -> None:
        self._device = device
        self._candidate = ExitStack()
        with ExitStack() as owned:
            drawable = owned.enter_context(lying_on(device, reference))
            self._judging = owned.enter_context(Judging(device, drawable, looks, groups))
            self._owned = owned.pop_all()

    def take(self, candidate: Carried) -> None:
        """See :meth:`Judging.take`."""
        self.forget()
        with ExitStack() as stack:
            self._judging.take(stack.enter_context(candidate.on(self._device)))
            stack.callback(self._judging.forget)
            self._candidate = stack.pop_all()

    def forget(self) -> None:
        """Give the candidate's memory back."""
        self._candidate.close()

    def figures(self, cameras: Sequence[Camera]) -> list[ViewFigures]:
        """See :meth:`Judging.figures`."""
        return list(self._judging.figures(cameras))

    def by_photographs(self, cameras: Sequence[Camera], photographs: GroundTruth) -> list[tuple[float, float]]:
        """See :meth:`Judging.by_photographs`."""
        return list(self._judging.by_photographs(cameras, photographs))

    def close(self) -> None:
        self._candidate.close()
        self._owned.close()
