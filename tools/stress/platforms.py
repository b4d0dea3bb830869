"""The rasterizer and the metrics on every OpenCL runtime of this machine.

    python -m tools.stress.platforms [SCENE …] [--json FILE]

Each device and kernel family runs in a process of its own, so that a runtime that crashes is one row of the table. What
is checked: the device's self-check; small random scenes of every SH degree and both rules against the float64
definition; the same bytes twice; SSIM against float64; and PSNR against the reference renders of scenes that have some.
tools.stress.run measures all kernels, those of the re-fit and of the fit among them, against float64.

Oclgrind, where installed, simulates all kernels under its checks (tools.stress.simulated). pip's PoCL, Debian's
PoCL (pocl-opencl-icd), Intel's (intel-opencl-rt) and Mesa's rusticl (mesa-opencl-icd) are found if they are there.
"""

from __future__ import annotations

import itertools
import os
from pathlib import Path

import numpy as np

from potr_cl.errors import DeviceError
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import DeviceInfo, Family, list_devices
from potr_cl.quality.metrics import ssim
from potr_cl.quality.metrics_device import Picture, Similarity
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import GSPLAT, INRIA
from tests.reference import raster as reference
from tests.reference.scenes import random_splats, tilted_camera
from tools.results import Cell, Column, Results
from tools.workloads import best_of, in_process, read, scene_parser

#: As in the tests: pixels that come no nearer, relatively, to 1/255 and 1e-4 cannot flip.
CLEAR = 1e-4
TOLERANCE = 2e-5


def check_definition(device: Device, sizes: tuple[int, ...] = (30, 400)) -> list[Cell]:
    """Largest error clear of thresholds, and the pixels that flipped, over random scenes; whether bytes repeat."""
    worst, flips, pixels, same = 0.0, 0, 0, True
    for degree, rules, size in itertools.product(range(4), (INRIA, GSPLAT), sizes):
        scene, view = random_splats(size, degree, seed=degree), tilted_camera(degree, 83, 61)
        with Rasterizer(device, scene, rules) as rasterizer:
            image, transmittance = rasterizer.render(view)
            same &= image.tobytes() == rasterizer.render(view)[0].tobytes()
        wanted = reference.render(scene, view, rules)
        error = np.maximum(np.abs(image - wanted.image).max(axis=2), np.abs(transmittance - wanted.transmittance))
        worst = max(worst, float(error[wanted.margin > CLEAR].max()))
        flips += int((error > TOLERANCE).sum())
        pixels += error.size
    return [worst, f"{flips} of {pixels:,}", "yes" if same else "NO"]


def check_similarity(device: Device) -> None:
    """SSIM of noisy, flat and bright pictures against float64.

    Raises:
        DeviceError: it is more than 1e-6 away.
    """
    rng = np.random.default_rng(0)
    for level, noise in ((0.5, 0.2), (0.98, 1e-3)):
        a, b = (np.float32(level) + noise * rng.standard_normal((37, 50, 3), np.float32) for _ in range(2))
        pair = Picture(device.upload(a, "a picture"), 0, 50, 37), Picture(device.upload(b, "a picture"), 0, 50, 37)
        ((_, found),) = Similarity(device)([pair])
        if abs(found - ssim(a, b)) > 1e-6:
            raise DeviceError(f"SSIM is {found}, not {ssim(a, b)}")


def check_scene(device: Device, folder: Path) -> list[float]:
    """Lowest PSNR against the reference renders, largest difference, and milliseconds a frame."""
    scene, views = read(folder)
    cameras = {camera.name: camera for camera in views}
    psnr, largest, seconds = np.inf, 0.0, np.inf
    with Rasterizer(device, scene, GSPLAT) as rasterizer:
        for path in sorted((folder / "reference").glob("*.npz")):
            image, _ = rasterizer.render(cameras[path.stem])
            with np.load(path) as theirs:
                error = image - theirs["rgb"]
            psnr = min(psnr, float(-10 * np.log10(np.mean(np.square(error)))))
            largest = max(largest, float(np.abs(error).max()))
            seconds = min(seconds, best_of(5, lambda at=path.stem: rasterizer.render_device(cameras[at])))  # type: ignore[misc]
    return [psnr, largest, 1e3 * seconds]


def check_device(index: int, family: Family, scenes: list[Path]) -> list[Cell]:
    """Everything about one device and family, as cells of the table."""
    device = Device(list_devices()[index], family=family)
    device.self_check()
    check_similarity(device)
    return [device.vector_width, *check_definition(device), *(check_scene(device, folder) for folder in scenes)]


def families(info: DeviceInfo) -> tuple[Family, ...]:
    """The kernel families that a device can run: GPU kernels anywhere, row kernels where vectors pay."""
    return ("cpu", "gpu") if info.family == "cpu" else ("gpu",)


def main() -> None:
    """Command line."""
    os.environ.setdefault("RUSTICL_ENABLE", "llvmpipe")
    args = scene_parser(__doc__, "*").parse_args()
    scenes = [folder for folder in args.scenes if (folder / "reference").exists()]
    real = (
        Column(f"{folder.name}: PSNR, difference, time", "dB, 1, ms", "{:.1f} / {:.1e} / {:.1f}") for folder in scenes
    )
    table = Results(None, args.json).table(
        "platforms", "The rasterizer on every runtime",
        "device; family; failed; vector; largest error||.1e; flipped pixels; same bytes twice", *real,
    )  # fmt: skip
    for info in list_devices():
        for family in families(info):
            try:
                table.add(str(info), family, "", *in_process(check_device, info.index, family, scenes))
            except Exception as error:  # whatever a runtime does
                lines = str(error).splitlines() or [type(error).__name__]
                table.add(str(info), family, lines[-1], *[None] * (4 + len(scenes)))


if __name__ == "__main__":
    main()
