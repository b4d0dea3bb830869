"""What is said before long work: on which device it is done, and the memory that it will take."""

from __future__ import annotations

from collections.abc import Sequence

from potr_cl.cli.terminal import is_quiet, note
from potr_cl.errors import DeviceError
from potr_cl.model.camera import Camera, train_views
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.pipeline.forecast import memory_needed
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.raster.kept_scene import KeptScene

#: Splats times views from which on the work may take long enough to be worth a forecast.
_LONG = 2_000_000


def tell_what_is_ahead(
    device: Device,
    scene: Scene,
    cameras: Sequence[Camera],
    options: EncodeOptions,
    kept: KeptScene | None = None,
) -> None:
    """A line with the device and its kernels; and where the work may take long, one with roughly its memory.

    Args:
        cameras: of which the training views are looked at.
        kept: the scene on the device, if it lies there already.

    Raises:
        UsageError: there is no training view.
    """
    if is_quiet():
        return
    views = train_views(cameras)
    note(f"driver: {device.info.platform}, {device.info.version}", "detail")
    width, height = max((view.width, view.height) for view in views)
    work = f"{len(scene):,} splats, {len(views)} views of {width} x {height}"
    note(f"on {device.info}, kernels for {device.family.upper()}s: {work}")  # at once: to measure takes seconds
    if len(scene) * len(views) >= _LONG:
        try:
            memory = memory_needed(scene, views, options, device, kept)
        except DeviceError as error:
            note(f"no forecast: {error}", "detail")  # the encode goes on with less memory, or elsewhere
        else:
            note(f"about {_size(memory)} of memory{'' if device.info.kind == 'cpu' else ' of the device'}")


def _size(nbytes: float) -> str:
    return f"{nbytes / 1e9:.1f} GB" if nbytes >= 1e9 else f"{max(nbytes / 1e6, 1):.0f} MB"
