"""The views to look at a scene from: cameras that are given, or views placed for it."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypedDict

import numpy as np

from potr_cl.api.inputs import CamerasSource, SceneSource, cameras_of, chosen_views, name_of, placed_beside_cameras
from potr_cl.errors import UsageError
from potr_cl.formats.registry import cameras_beside
from potr_cl.model.agreement import judge_cameras
from potr_cl.model.camera import Camera, camera_centres, focus
from potr_cl.model.scene import Scene
from potr_cl.model.virtual_cameras import describe
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import DEVICE_VARIABLE as DEVICE_VARIABLE
from potr_cl.placement.upright import AXES as AXES
from potr_cl.placement.viewpoints import SIZE as SIZE
from potr_cl.placement.viewpoints import VIEWS as VIEWS
from potr_cl.placement.viewpoints import look_around, turntable
from potr_cl.placement.virtual import place_cameras
from potr_cl.quality.evidence import evidence_of
from potr_cl.raster.rules import RULES as RULES
from potr_cl.stages.stage import Progress

_log = logging.getLogger("potr_cl")


class ViewChoices(TypedDict, total=False):
    """Keywords that say which views of a scene to look at: attributes of :class:`Viewpoints`."""

    views: Sequence[str | int] | str | int | None
    split: str | None
    virtual_views: int | None
    turntable: int | None
    up: str | Sequence[float] | None
    size: int | None


@dataclass(frozen=True)
class Viewpoints:
    """Which views of a scene to look at, and how to look at one that comes without cameras.

    Attributes:
        views: names or indices of those to take, see :func:`potr_cl.api.inputs.chosen_views`.
        split: "train", "test" or "all" of them.
        virtual_views: how many views to place; None: 8.
        turntable: how many views from a circle around the scene to take instead.
        up: which way is up: x, y, z, -x, -y, -z, three numbers, or auto, a guess.
        size: pixels along a side of the square pictures; None: 800.

    Raises:
        UsageError: these are no directions, or both kinds of views are asked for.
    """

    views: Sequence[str | int] | str | int | None = None
    split: str | None = None
    virtual_views: int | None = None
    turntable: int | None = None
    up: str | Sequence[float] | None = None
    size: int | None = None

    def __post_init__(self) -> None:
        if self.virtual_views is not None and self.turntable is not None:
            raise UsageError("give either --virtual-views or --turntable: each says how many views to place")
        _ = self.direction

    @property
    def asked_for(self) -> list[str]:
        """What has been said of views to place, as the command line calls it: it contradicts cameras."""
        given = {
            "--virtual-views": self.virtual_views,
            "--turntable": self.turntable,
            "--up": self.up,
            "--size": self.size,
        }
        return [name for name, value in given.items() if value is not None]

    @property
    def direction(self) -> tuple[float, ...] | None:
        """(3,) what is up; None for a guess.

        Raises:
            UsageError: the text is not a direction.
        """
        if self.up is None or self.up == "auto":
            return None
        if not isinstance(self.up, str):
            return tuple(float(part) for part in self.up)
        if self.up in AXES:
            return AXES[self.up]
        try:
            parts = tuple(float(part) for part in self.up.split(","))
        except ValueError:
            parts = ()
        if len(parts) != 3 or not np.isfinite(parts).all() or not any(parts):
            raise UsageError(f"'{self.up}' is not a direction: give --up={'|'.join(AXES)}, X,Y,Z or auto")
        return parts

    def placed(self, scene: Scene, device: Device | None = None) -> list[Camera]:
        """The views.

        Raises:
            UsageError: too few or too many are asked for.
        """
        size = SIZE if self.size is None else self.size
        if self.turntable is not None:
            return turntable(scene, self.turntable, size, self.direction, device)
        count = VIEWS if self.virtual_views is None else self.virtual_views
        return look_around(scene, count, size, self.direction, device)

    def judging(self, scene: Scene, device: Device | None = None) -> list[Camera]:
        """The views to judge by: those of an encode without cameras, so many and so large, unless others are wanted."""
        if self.turntable is not None:
            return self.placed(scene, device)
        return look_around(scene, self.virtual_views, self.size, self.direction, device)

    def chosen(self, cameras: Sequence[Camera], split: str | None = None) -> list[Camera]:
        """Those of all views that are asked for; if none are, those of ``split``.

        Raises:
            UsageError: there is no such view, or none is asked for.
        """
        return chosen_views(cameras, self.views, self.split or (split if self.views is None else None))

    def given(self, cameras: CamerasSource | None) -> list[Camera] | None:
        """Cameras that stand for views to be placed, if there are any.

        Raises:
            UsageError: views are to be placed as well.
        """
        given = cameras_of(cameras)
        if given is not None:
            self.refuse_with_cameras()
        return given

    def refuse_with_cameras(self) -> None:
        """Say that cameras are given and that views are to be placed contradict each other.

        Raises:
            UsageError: views are to be placed.
        """
        if self.asked_for:
            raise placed_beside_cameras(self.asked_for[0])


def views_or_placed(
    source: SceneSource,
    scene: Scene,
    cameras: Sequence[Camera] | None,
    count: int | None = None,
    device: Device | None = None,
    progress: Progress = lambda what, done: None,
) -> Sequence[Camera]:
    """The cameras; or virtual ones for a scene that comes from ``source``, which the log is told."""
    if cameras is None:
        progress("place cameras", 0.0)
        cameras = place_cameras(scene, count, device=device)
        progress("place cameras", 1.0)
        log_placed(source, cameras)
    return cameras


def log_placed(source: SceneSource, cameras: Sequence[Camera]) -> None:
    """Report that virtual cameras stand in for those that a user may have."""
    folder = cameras_beside(Path(source)) if isinstance(source, (str, os.PathLike)) else None
    better = "with the real cameras the file would be smaller"
    better = better if folder is None else f"--cameras beside takes those in '{folder}'"
    _log.info("no --cameras given: %s; %s", describe(cameras), better)


def warn_of_frame(source: SceneSource, scene: Scene, views: Sequence[Camera]) -> None:
    """Log a warning if views that were given do not seem to be in a scene's frame; where nothing is thrown away."""
    judged = judge_cameras(scene, views, evidence_of(scene, views))
    finding = judged.finding if judged.suspicious else judged.doubt
    if finding is not None:
        _log.warning("%s: %s", name_of(source), finding)


def describe_views(cameras: Sequence[Camera]) -> str:
    """One line about views that were placed: what they are, where, and which way is up in them."""
    centres, middle = camera_centres(cameras), focus(cameras)
    distance = float(np.median(np.linalg.norm(centres - middle, axis=1)))
    turning = cameras[0].name.startswith("turntable_")
    kind = "views of a turntable" if turning else "virtual views"
    # Of level cameras, what is up in the scene is what is up in each picture, but for their tilt.
    right = np.stack([camera.rotation[0] for camera in cameras])
    up = np.linalg.svd(np.concatenate([right, np.zeros((2, 3))]))[2][-1]
    up = up * np.sign(-up @ np.mean([camera.rotation[1] for camera in cameras], axis=0) or 1)
    return (
        f"{len(cameras)} {kind if len(cameras) > 1 else kind.replace('views', 'view')} of {cameras[0].width} x "
        f"{cameras[0].height} pixels, {distance:.3g} units from ({_listed(middle)}), up is ({_listed(up)})"
    )


def _listed(numbers: Sequence[float] | np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> str:
    return ", ".join(f"{round(float(x), 3) + 0.0:.3g}" for x in numbers)
