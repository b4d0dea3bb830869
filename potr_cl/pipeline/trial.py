"""Encodes of a tiny scene that build and run every kernel of encodes: python -m potr_cl.pipeline.trial INDEX

It runs in a process of its own (:mod:`potr_cl.opencl.verdict`): a driver that crashes takes that one with it. With
``--measure`` behind it, it also times kernels on a larger scene, and prints what it found as JSON.
"""

from __future__ import annotations

import json
import sys
import time
from collections import Counter
from typing import Any

import numpy as np

from potr_cl.codec.quantize import Preset
from potr_cl.errors import DeviceError, PotrError
from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import DeviceInfo, list_devices
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.presets import PRESETS

_VIEWS, _SPLATS, _SIDE = 6, 400, 48
#: What is measured.
_MANY_SPLATS, _LARGE_SIDE = 6_000, 128
_MEASURED: tuple[Preset, ...] = ("best", "paper")


def try_encodes(device: Device) -> None:
    """Check the device, and encode with each preset and with a fit.

    Raises:
        DeviceError: something fails, or the encodes lose the scene.
    """
    device.self_check()
    for preset in PRESETS:
        _encode(device, preset, _SPLATS, _SIDE)


def measured(info: DeviceInfo) -> dict[str, Any]:
    """Check a device, and time the kernels of encodes with the presets best and paper and with a fit.

    Returns:
        "compiler", what the device's compiler has warned of; "seconds" that the encodes take by the clock, once
        all is built; and "times", each kernel's "launches" and "seconds", of devices that measure times.

    Raises:
        DeviceError: as :func:`try_encodes`.
    """
    # No cache has programs with a macro that is new each time, and compilers speak when they compile.
    device = Device(info, profiling=info.profiling, build_options=[f"-DCOMPILED_AT={time.time_ns()}"])
    try_encodes(device)
    for _ in range(2):
        device.timings.clear()
        began = time.perf_counter()
        for preset in _MEASURED:
            _encode(device, preset, _MANY_SPLATS, _LARGE_SIDE)
        seconds = time.perf_counter() - began
    launches = Counter(name for name, _ in device.timings)
    times = {name: {"launches": launches[name], "seconds": took} for name, took in device.stage_times().items()}
    return {"compiler": device.compiler_log(), "seconds": seconds, "times": times}


def _encode(device: Device, preset: Preset, splats: int, side: int) -> None:
    few = {"prune": {"iterations": 4}, "fit": {"on": True, "steps": 40}, "cameras_anyway": True}
    options = EncodeOptions.for_preset(preset, q=0.9, **few)
    encoded = encode(_scene(splats), _cameras(side), options, device=device)
    if encoded.device is not device:
        raise DeviceError(f"device {device.info} fails the self-check: an encode went on elsewhere")
    if not 0 < encoded.nbytes < 300 * splats:
        raise DeviceError(f"device {device.info} fails the self-check: an encode has {encoded.nbytes} bytes")


def _scene(splats: int) -> Scene:
    rng = np.random.default_rng(0)
    sh = rng.normal(0, 0.1, (splats, 16, 3))
    sh[:, 0] = rng.normal(0, 1, (splats, 3))
    return Scene(
        means=rng.normal(0, 0.5, (splats, 3)).astype(np.float32),
        log_scales=rng.normal(-3, 0.5, (splats, 3)).astype(np.float32),
        quaternions=rng.normal(0, 1, (splats, 4)).astype(np.float32),
        opacity_logits=rng.normal(1, 2, splats).astype(np.float32),
        sh=sh.astype(np.float32),
    )


def _cameras(side: int) -> list[Camera]:
    cameras = []
    for angle in np.linspace(0, 2 * np.pi, _VIEWS, endpoint=False):
        back, up = np.array([np.cos(angle), 0, np.sin(angle)]), np.array([0.0, 1.0, 0.0])
        rotation = np.stack([np.cross(back, up), up, -back])
        cameras.append(
            Camera(f"{angle:.1f}", side, side, side, side, side / 2, side / 2, rotation, np.array([0.0, 0.0, 3.0]))
        )
    return cameras


def main() -> None:
    """Command line."""
    try:
        info = list_devices()[int(sys.argv[1])]
        if "--measure" in sys.argv:
            print(json.dumps(measured(info)))
        else:
            try_encodes(Device(info))
    except PotrError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main()
