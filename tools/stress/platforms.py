"""The rasterizer on every OpenCL runtime of this machine.

    python -m tools.stress.platforms [--scenes FOLDER]

Each device and kernel family runs in a process of its own, so that a runtime that crashes is one row of the table. What
is checked: the device's self-check; small random scenes of every SH degree and both rules against the float64
definition; the same bytes twice; SSIM, the re-fit's maps and its solution, and the derivatives of pictures against
float64; and, where FOLDER holds scenes with reference renders, PSNR against them.

Oclgrind, where installed, simulates all kernels under its checks (tools.stress.simulated). pip's PoCL, Debian's
PoCL (pocl-opencl-icd), Intel's (intel-opencl-rt) and Mesa's rusticl (mesa-opencl-icd) are found if they are there.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from potr_cl.errors import DeviceError
from potr_cl.formats import load_cameras, load_scene
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import DeviceInfo, list_devices
from potr_cl.opencl.memory import Memory
from potr_cl.quality.metrics import ssim
from potr_cl.quality.metrics_device import Similarity
from potr_cl.quality.pictures import Picture
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import GSPLAT, INRIA
from potr_cl.stages.compaction.view_weights import REFERENCE_PIXELS
from potr_cl.stages.fitting.derivatives import PictureDerivatives
from potr_cl.stages.refitting.refit_options import RefitOptions
from tests.reference import raster as reference
from tests.reference.derivatives import gradient
from tests.reference.refit import Array, to_ycocg
from tests.reference.refit_cases import Case, Linearised, Pictures
from tests.reference.scenes import (
    random_splats,
    ring_of_cameras,
    tilted_camera,
    visible_scene,
)

#: As in the tests: pixels that come no nearer, relatively, to 1/255 and 1e-4 cannot flip.
CLEAR = 1e-4
TOLERANCE = 2e-5


def check_definition(device: Device, sizes: tuple[int, ...] = (30, 400)) -> dict[str, Any]:
    """Largest error clear of thresholds, and the pixels that flipped, over random scenes."""
    worst, flips, pixels, same = 0.0, 0, 0, True
    for degree in range(4):
        for rules in (INRIA, GSPLAT):
            for size in sizes:
                scene, view = random_splats(size, degree, seed=degree), tilted_camera(degree, 83, 61)
                with Rasterizer(device, scene, rules) as rasterizer:
                    image, transmittance = rasterizer.render(view)
                    same &= image.tobytes() == rasterizer.render(view)[0].tobytes()
                wanted = reference.render(scene, view, rules)
                error = np.abs(image - wanted.image).max(axis=2)
                error = np.maximum(error, np.abs(transmittance - wanted.transmittance))
                worst = max(worst, float(error[wanted.margin > CLEAR].max()))
                flips += int((error > TOLERANCE).sum())
                pixels += error.size
    return {"error": worst, "flips": flips, "pixels": pixels, "same_bytes": same}


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


def check_refit(device: Device) -> dict[str, Any]:
    """The re-fit's float32 against float64, relative errors: the worst of SH degrees 0 to 3.

    Returns:
        ``transposed``, of random pictures; ``normal``, of random coefficients through the map and back; ``blocks``,
        the preconditioner's; ``adjoint``, <A d, r> - <d, Aᵀ r>; ``solution``, of the coefficients' change; and
        whether two solves gave the same bytes.
    """
    worst = dict.fromkeys(("transposed", "normal", "blocks", "adjoint", "solution"), 0.0)
    same = True
    for degree in range(4):
        rng = np.random.default_rng(degree)
        with Case(device, visible_scene(40, degree), visible_scene(60, 2, seed=7), ring_of_cameras(3, size=40)) as case:
            lam, prior = 30.0, 10.0
            wanted = case.reference(lam=lam, prior=prior)
            rendered = [p.reshape(*t.shape) for p, t in zip(wanted.pictures(wanted.start), case.pictures, strict=True)]
            targets = [(p - rng.uniform(-1, 1, size=p.shape)).astype(np.float32) for p in rendered]
            images = [(p - t).reshape(-1, 3) for p, t in zip(rendered, targets, strict=True)]
            direction = rng.normal(size=case.scene.sh.shape)
            with Pictures(device, targets) as pictures, Linearised(case, pictures) as linear:
                transposed, normal, blocks = linear.gradient, linear.normal(direction), linear.blocks
            forward, back, gram = wanted.forward(direction), wanted.transposed(images), wanted.gram()
            weights = [view.weight for view in wanted.views]
            product = sum(w * float(np.sum(a * b)) for w, a, b in zip(weights, forward, images, strict=True))
            lengths = [
                np.sqrt(sum(w * float(np.sum(a * a)) for w, a in zip(weights, vectors, strict=True)))
                for vectors in (forward, images)
            ]
            options = RefitOptions(steps=300, gain=0, lam=lam, prior=prior)
            solved = case.solve(options).sh
            same &= solved.tobytes() == case.solve(options).sh.tobytes()
            solution = wanted.solution()
            errors = {
                "transposed": _relative(transposed, back),
                "normal": _relative(normal, wanted.transposed(forward)),
                "blocks": float(np.abs(blocks - gram).max() / gram.max()),
                "adjoint": abs(float(np.sum(direction * transposed)) - product) / (lengths[0] * lengths[1]),
                "solution": _relative(to_ycocg(solved) - wanted.start, solution - wanted.start),
            }
            worst = {name: max(worst[name], error) for name, error in errors.items()}
    return {**worst, "same_bytes": same}


def _relative(value: Array, wanted: Array) -> float:
    return float(np.linalg.norm(value - wanted) / np.linalg.norm(wanted))


def check_derivatives(device: Device) -> dict[str, float]:
    """The derivatives of pictures in float32 against float64, relative errors by kind of parameter: the worst of SH
    degrees 0 to 3, with and without antialiasing."""
    worst: dict[str, float] = {}
    cameras = ring_of_cameras(3, size=40)
    for degree, antialiased in itertools.product(range(4), (False, True)):
        scene = dataclasses.replace(visible_scene(60, degree, seed=degree), antialiased=antialiased)
        values = [np.random.default_rng(degree).normal(size=(c.height, c.width, 3)) for c in cameras]
        with PictureDerivatives(device, scene) as derivatives, Memory(device) as memory:
            rows = np.concatenate([v.reshape(-1, 3) for v in values]).astype(np.float32)
            derivatives.add(cameras, memory.upload(rows, "the values"), given=True)
            columns = derivatives.read().astype(np.float64) * 40 * 40 / REFERENCE_PIXELS
        wanted = [gradient(scene, camera, INRIA, v) for camera, v in zip(cameras, values, strict=True)]
        parts = np.split(columns, [3, 6, 10, 11], axis=1)
        for name, found in zip(("means", "log_scales", "quaternions", "opacity_logits", "sh"), parts, strict=True):
            exact = sum(getattr(each, name) for each in wanted).reshape(len(scene), -1)
            error = float(np.linalg.norm(found - exact) / np.linalg.norm(exact))
            worst[name] = max(worst.get(name, 0.0), error)
    return worst


def check_scene(device: Device, folder: Path) -> dict[str, float]:
    """Lowest PSNR against the reference renders, largest difference, and seconds a frame."""
    with Rasterizer(device, load_scene(folder / "point_cloud.ply"), GSPLAT) as rasterizer:
        cameras = {c.name: c for c in load_cameras(folder / "cameras.json")}
        psnr, largest, times = np.inf, 0.0, []
        for path in sorted((folder / "reference").glob("*.npz")):
            image, _ = rasterizer.render(cameras[path.stem])
            with np.load(path) as theirs:
                error = image - theirs["rgb"]
            psnr = min(psnr, float(-10 * np.log10(np.mean(np.square(error)))))
            largest = max(largest, float(np.abs(error).max()))
            for _ in range(5):
                started = time.perf_counter()
                rasterizer.render_device(cameras[path.stem])
                times.append(time.perf_counter() - started)
    return {"psnr": psnr, "largest": largest, "seconds": min(times)}


def check_device(index: int, family: str, scenes: Path | None) -> dict[str, Any]:
    """Everything about one device and family."""
    device = Device(list_devices()[index], family=family)  # type: ignore[arg-type]
    device.self_check()
    check_similarity(device)
    result = {"vector_width": device.vector_width, **check_definition(device), "refit": check_refit(device)}
    result["derivatives"] = check_derivatives(device)
    for name in ("lego", "plush"):
        if scenes and (scenes / name / "reference").exists():
            result[name] = check_scene(device, scenes / name)
    return result


def row(info: DeviceInfo, family: str, scenes: Path | None) -> str:
    """One line of the table."""
    command = [sys.executable, "-m", "tools.stress.platforms", "--device", str(info.index), "--family", family]
    run = subprocess.run(
        [*command, *(["--scenes", str(scenes)] if scenes else [])], capture_output=True, text=True, check=False
    )
    head = f"| {info.name} | {info.platform}, {info.version} | {family}"
    if run.returncode:
        message = run.stderr.strip().splitlines()[-1] if run.stderr.strip() else f"exit code {run.returncode}"
        return f"{head} | failed: {message}" + " |" * 12
    r = json.loads(run.stdout.splitlines()[-1])
    real = [
        f"{r[n]['psnr']:.1f} dB, {r[n]['largest']:.1e}, {1e3 * r[n]['seconds']:.1f} ms" if n in r else ""
        for n in ("lego", "plush")
    ]
    same = r["same_bytes"] and r["refit"]["same_bytes"]
    derivatives = max(r["derivatives"].values())
    refit = " | ".join(f"{r['refit'][n]:.0e}" for n in ("adjoint", "transposed", "normal", "blocks", "solution"))
    return (
        f"{head} | {r['vector_width'] if family == 'cpu' else ''} | {r['error']:.1e} | "
        f"{r['flips']} of {r['pixels']:,} | {'yes' if same else 'NO'} | {refit} | {derivatives:.0e} | "
        f"{real[0]} | {real[1]} |"
    )


def main() -> None:
    """Command line."""
    os.environ.setdefault("RUSTICL_ENABLE", "llvmpipe")
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, help="folder with lego and plush")
    parser.add_argument("--device", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--family", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.device is not None:
        print(json.dumps(check_device(arguments.device, arguments.family, arguments.scenes)))
        return
    print(
        "| device | runtime | family | vector | largest error | flipped pixels | same bytes twice | re-fit: "
        "<A d, r> − <d, Aᵀ r> | Aᵀ r | Aᵀ A d | blocks | solution | derivatives | lego | plush |\n" + "|---" * 15 + "|"
    )
    for info in list_devices():
        for family in ("gpu", "cpu") if info.family == "cpu" else ("gpu",):
            print(row(info, family, arguments.scenes), flush=True)


if __name__ == "__main__":
    main()
