"""What the benchmarks of compression share: a trained scene with its test views, and what a candidate loses to it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from potr_cl.errors import DataError, UsageError
from potr_cl.formats import load_cameras, load_scene
from potr_cl.model.camera import test_views, train_views
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Owner
from potr_cl.quality.compare import mean_view
from potr_cl.quality.judging import Judging, Looks
from potr_cl.quality.photographs import find_ground_truth
from tools.workloads import scaled


class EvaluatedScene(Owner):
    """An uncompressed scene on the device, ready to be compared with others.

    Args:
        folder: holds point_cloud.ply, cameras.json with test views, and photographs in ``images`` if there are any.
        device: to render on.
        every: judge by each so many-th test view only.
        few: do without all views but each so many-th, of either kind.
        scale: of the pictures' width and height; photographs do not fit others than 1.

    Attributes:
        source: the uncompressed scene.
        cameras: all of them that are left.
        views: the test views among them; every comparison is over these.
        source_bytes: of the PLY file.

    Raises:
        UsageError: ``few`` or ``scale`` leaves nothing to look at.
        DataError: there are no test views.
    """

    def __init__(self, folder: Path, device: Device, every: int = 1, few: int = 1, scale: float = 1.0) -> None:
        if few < 1 or not 0 < scale <= 1:
            raise UsageError(f"each {few}-th view at {scale:g} of its size: give at least 1, and more than 0 up to 1")
        path = folder / "point_cloud.ply"
        self.name = folder.resolve().name
        self.source: Scene = load_scene(path)
        self.source_bytes = path.stat().st_size
        cameras = load_cameras(folder / "cameras.json")
        if few > 1:
            cameras = [*train_views(cameras)[::few], *test_views(cameras)[::few]]
        self.cameras = cameras if scale == 1 else [scaled(camera, scale) for camera in cameras]
        self.views = test_views(self.cameras)[::every]
        if not self.views:
            raise DataError(f"'{folder / 'cameras.json'}' has no test views")
        images = folder / "images"
        photographed = images.is_dir() and scale == 1
        self._ground_truth = find_ground_truth(images, self.views) if photographed else None
        self._judging = Judging(device, self.source, self.views, Looks(ground_truth=self._ground_truth))

    def __call__(self, candidate: Scene) -> dict[str, float | None]:
        """Means over the test views.

        Returns:
            ``psnr`` and ``ssim`` against the uncompressed scene's renders; with photographs also ``truth_psnr`` and
            ``truth_ssim`` against those, and ``psnr_loss`` and ``ssim_loss``, what the uncompressed scene has more.
            A PSNR of None means identical pictures.
        """
        mean = mean_view(self._judging.figures(candidate)).figures
        names = {"b_against_a": ("psnr", "ssim")}
        if self._ground_truth is not None:
            names["b_against_truth"] = ("truth_psnr", "truth_ssim")
            names["loss"] = ("psnr_loss", "ssim_loss")
        figures: dict[str, float | None] = {}
        for pair, (psnr, ssim) in names.items():
            figures[psnr] = mean[pair].psnr if math.isfinite(mean[pair].psnr) else None
            figures[ssim] = mean[pair].ssim
        return figures

    def mean_and_worst(self, candidate: Scene) -> tuple[float, float]:
        """PSNR against the uncompressed scene's renders, the mean over the test views and that of the worst, dB."""
        found = [view.figures["b_against_a"].psnr for view in self._judging.figures(candidate)]
        return math.fsum(found) / len(found), min(found)

    def facts(self) -> dict[str, Any]:
        """The uncompressed scene, for JSON."""
        return {
            "scene": self.name,
            "source_bytes": self.source_bytes,
            "source_splats": len(self.source),
            "test_views": len(self.views),
            "uncompressed": self(self.source),
        }

    def close(self) -> None:
        """Give the device's memory back."""
        self._judging.close()
