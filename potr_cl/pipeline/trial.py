"""Encodes of a tiny scene that build and run every kernel of encodes: python -m potr_cl.pipeline.trial INDEX

It runs in a process of its own (:mod:`potr_cl.opencl.verdict`): a driver that crashes takes that one with it.
"""

from __future__ import annotations

import sys

import numpy as np

from potr_cl.errors import DeviceError, PotrError
from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import list_devices
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.presets import PRESETS

_SPLATS, _VIEWS, _SIDE = 400, 6, 48


def try_encodes(device: Device) -> None:
    """Check the device, and encode with each preset and with a fit.

    Raises:
        DeviceError: something fails, or the encodes lose the scene.
    """
    device.self_check()
    scene, cameras = _scene(), _cameras()
    for preset in PRESETS:
        few = {"prune": {"iterations": 4}, "fit": {"on": True, "steps": 40}, "cameras_anyway": True}
        encoded = encode(scene, cameras, EncodeOptions.for_preset(preset, q=0.9, **few), device=device)
        if encoded.device is not device:
            raise DeviceError(f"device {device.info} fails the self-check: an encode went on elsewhere")
        if not 0 < encoded.nbytes < 300 * _SPLATS:
            raise DeviceError(f"device {device.info} fails the self-check: an encode has {encoded.nbytes} bytes")


def _scene() -> Scene:
    rng = np.random.default_rng(0)
    sh = rng.normal(0, 0.1, (_SPLATS, 16, 3))
    sh[:, 0] = rng.normal(0, 1, (_SPLATS, 3))
    return Scene(
        means=rng.normal(0, 0.5, (_SPLATS, 3)).astype(np.float32),
        log_scales=rng.normal(-3, 0.5, (_SPLATS, 3)).astype(np.float32),
        quaternions=rng.normal(0, 1, (_SPLATS, 4)).astype(np.float32),
        opacity_logits=rng.normal(1, 2, _SPLATS).astype(np.float32),
        sh=sh.astype(np.float32),
    )


def _cameras() -> list[Camera]:
    cameras = []
    for angle in np.linspace(0, 2 * np.pi, _VIEWS, endpoint=False):
        back, up = np.array([np.cos(angle), 0, np.sin(angle)]), np.array([0.0, 1.0, 0.0])
        rotation = np.stack([np.cross(back, up), up, -back])
        cameras.append(
            Camera(
                f"{angle:.1f}", _SIDE, _SIDE, _SIDE, _SIDE, _SIDE / 2, _SIDE / 2, rotation, np.array([0.0, 0.0, 3.0])
            )
        )
    return cameras


def main() -> None:
    """Command line."""
    try:
        try_encodes(Device(list_devices()[int(sys.argv[1])]))
    except PotrError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main()
