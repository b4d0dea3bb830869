"""How close the pictures of two scenes are, view by view: :class:`Against` finds the figures on a device."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from potr_cl.formats.images import Colour
from potr_cl.host.threads import thread_pool
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray
from potr_cl.opencl.device import Device
from potr_cl.quality.metrics import Lpips
from potr_cl.quality.metrics_device import Picture, Similarity, in_batches, place_pictures
from potr_cl.quality.photographs import read_photograph
from potr_cl.views.targets import TargetPictures

#: Photographs read before they are needed.
_READ_AHEAD = 32


class Against:
    """Finds the figures of pictures that lie on one device.

    Args:
        device: that they lie on.
        background: behind photographs with alpha.
        ground_truth: photographs by view name (:func:`potr_cl.quality.photographs.find_ground_truth`); cameras with a
            lens must then look within them (:func:`potr_cl.model.camera.within_photographs`).
        lpips: the metric, where it is installed.
    """

    def __init__(
        self,
        device: Device,
        background: Colour = (0.0, 0.0, 0.0),
        ground_truth: Mapping[str, Path] | None = None,
        lpips: Lpips | None = None,
    ) -> None:
        self._device, self._background = device, background
        self._ground_truth, self._lpips = ground_truth, lpips
        self._similarity = Similarity(device)

    def figures(
        self, a: TargetPictures, b: TargetPictures, views: Sequence[Camera], numbers: Sequence[int]
    ) -> Iterator[ViewFigures]:
        """The figures of some views, in their order.

        Args:
            a, b: the pictures of the reference and of the candidate.
            views: all that these know.
            numbers: of those that are meant.

        Raises:
            UsageError: a photograph cannot be opened.
            DataError: a photograph is damaged.
            DeviceError: a view does not fit the device.
        """
        truth, cameras = self._ground_truth, [views[number] for number in numbers]
        photographs = [] if truth is None else [(truth[camera.name], camera) for camera in cameras]
        first = 0
        with thread_pool() as pool:
            read = _ground_truth(pool, photographs, self._background)
            for some in in_batches(self._device, cameras):
                now = numbers[first : first + len(some)]
                of_a, of_b = (place_pictures(of.of(now), some) for of in (a, b))
                yield from self._compared(some, of_a, of_b, None if truth is None else read)
                first += len(some)

    def _compared(
        self,
        some: Sequence[Camera],
        of_a: list[Picture],
        of_b: list[Picture],
        read: Iterator[FloatArray] | None,
    ) -> Iterator[ViewFigures]:
        found = [self._pairs(of_b, of_a)]
        names = ["b_against_a"]
        if read is not None:
            device = self._device
            buffer = device.upload(np.concatenate([next(read).reshape(-1) for _ in some]), "the photographs")
            try:
                truths = place_pictures(buffer, some)
                found += [self._pairs(of, truths) for of in (of_a, of_b)]
            finally:
                device.free(buffer)
            found.append([_loss(*losses) for losses in zip(*found[1:], strict=True)])
            names += ["a_against_truth", "b_against_truth", "loss"]
        for camera, of_view in zip(some, zip(*found, strict=True), strict=True):
            yield ViewFigures(camera.name, dict(zip(names, of_view, strict=True)))

    def _pairs(self, pictures: list[Picture], references: list[Picture]) -> list[Figures]:
        pairs, lpips = list(zip(pictures, references, strict=True)), self._lpips
        distances = [lpips(*(each.download(self._device) for each in pair)) if lpips else None for pair in pairs]
        return [Figures(*found, distance) for found, distance in zip(self._similarity(pairs), distances, strict=True)]


@dataclass(frozen=True)
class Figures:
    """How close two pictures are; ``psnr`` is infinite for identical ones, ``lpips`` None where it was not computed."""

    psnr: float
    ssim: float
    lpips: float | None


@dataclass(frozen=True)
class ViewFigures:
    """The figures of one view, or their means.

    Attributes:
        name: of the view.
        figures: by what was compared: "b_against_a" always; with photographs also "a_against_truth",
            "b_against_truth" and "loss", what B loses to A against the photograph (A's PSNR and SSIM minus B's,
            B's LPIPS minus A's: positive where B is worse).
    """

    name: str
    figures: dict[str, Figures]

    @property
    def identical(self) -> bool:
        """Whether A's and B's pictures are the same in every pixel."""
        return math.isinf(self.figures["b_against_a"].psnr)


def _ground_truth(
    pool: ThreadPoolExecutor, photographs: Sequence[tuple[Path, Camera]], background: Colour
) -> Iterator[FloatArray]:
    """The photographs in order, some read ahead."""
    pending: deque[Future[FloatArray]] = deque()
    for path, camera in photographs:
        pending.append(pool.submit(read_photograph, path, camera, background))
        if len(pending) > _READ_AHEAD:
            yield pending.popleft().result()
    while pending:
        yield pending.popleft().result()


def _loss(a: Figures, b: Figures) -> Figures:
    lpips = b.lpips - a.lpips if a.lpips is not None and b.lpips is not None else None
    return Figures(0.0 if a.psnr == b.psnr else a.psnr - b.psnr, a.ssim - b.ssim, lpips)
