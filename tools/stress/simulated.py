"""Every kernel inside Oclgrind, which sees races, accesses out of bounds and uninitialised reads.

    python -m tools.stress.simulated [--family gpu|cpu] [--step NAME …]

Needs Oclgrind (Debian: oclgrind). It is hundreds of times as slow as a device, so the scenes are as small as they can
be while every kernel has all its ways to go: lists longer than local memory, several batches, vectors of every width.
Each family and vector width runs in a process of its own. A line of the table names the step, what Oclgrind found in
it, and how many of the package's kernels were run in all; those that no step runs are named.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TypeVar
from unittest.mock import patch

import numpy as np
import pyopencl as cl

import potr_cl
from potr_cl.clustering.kmeans import cluster
from potr_cl.codec.bundles import encoder
from potr_cl.codec.decoder import open_file
from potr_cl.codec.encoder import code_scene
from potr_cl.codec.quantize import HyperParameters
from potr_cl.model import splat_groups
from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.native.library import VARIABLE
from potr_cl.ondevice.decode import decode_to_device
from potr_cl.opencl import device as opencl_device
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import DeviceInfo, list_devices
from potr_cl.opencl.kernel import Kernel
from potr_cl.opencl.memory import Memory
from potr_cl.outputs.output import ColourGrid
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.raster import launcher as raster_launcher
from potr_cl.raster import preparing_memory as long_lists_module
from potr_cl.raster import resident
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import INRIA
from potr_cl.raster.scene_buffers import Drawable, uploaded
from potr_cl.stages.merging.merged import merged
from potr_cl.stages.pruning.buffers import Survivors
from potr_cl.stages.pruning.controller import prune_scene
from potr_cl.stages.pruning.exchange import AddedChanges, AlivePacking, ChangedTotals
from potr_cl.stages.pruning.removal import Wanted, planned_sweep
from potr_cl.stages.pruning.schedule import PruningOptions
from potr_cl.stages.pruning.sweep import SweepOptions
from potr_cl.stages.refitting import coefficients, sliced_arrays
from potr_cl.stages.refitting.coefficients import Coefficients
from potr_cl.stages.refitting.exchange import Exchange
from potr_cl.stages.refitting.refit import refit_colours
from potr_cl.stages.refitting.refit_options import RefitOptions
from potr_cl.stages.refitting.sliced_arrays import Layout
from potr_cl.views import reached
from potr_cl.views import targets as target_pictures
from potr_cl.views.targets import RenderedTargets
from potr_cl.views.visibility import Visibility
from tests.reference.scenes import plain_splats, random_splats, straight_camera, tilted_camera
from tools.results import Results
from tools.stress.cases import Case
from tools.stress.fits import check_derivatives
from tools.stress.measures import limit
from tools.stress.platforms import check_similarity
from tools.stress.views import check_rasterizer
from tools.workloads import plain_parser

#: Kernel families and vector widths.
KINDS = (("gpu", 1), ("cpu", 4), ("cpu", 8), ("cpu", 16))
#: Work-items of a dot product: few of those that devices have, most of which would have nothing to do.
_DOT_ITEMS = 1024

Step = Callable[[Device], None]
T = TypeVar("T")


# ------------------------------------------------------------------------------------------ what is run


def _views(count: int = 2) -> list[Camera]:
    return [tilted_camera(seed, 24, 16) for seed in range(count)]


def views(device: Device) -> None:
    """All that a view needs, removal and the fit's derivatives, against float64: of short lists; and of a tile whose
    list GPU kernels take in three batches, whose pixels go on to the end, with its re-fit."""
    centres = np.random.default_rng(1).uniform((-0.1, -0.1, 1), (0.1, 0.1, 3), (300, 3))
    scene, view = plain_splats(centres, sigma=0.03, logit=-4), straight_camera(16, 16)
    for case in (
        Case("short lists", random_splats(60, 3, seed=1), tilted_camera(1, 40, 24), INRIA),
        Case("batches", scene, view),
    ):
        found, clear = check_rasterizer(device, case)
        found |= check_derivatives(device, case, clear)
        wrong = {m: pair for m, pair in found.items() if not pair[0] <= limit(m) * pair[1]}
        assert not wrong, f"{case.name}: {wrong}"
    with Rasterizer(device, scene) as rasterizer:
        targets = RenderedTargets(rasterizer, [view])
        refit_colours(device, scene, [view], targets, RefitOptions(steps=1, gain=0, drop=1e-9))


def long_lists(device: Device) -> None:
    """A list longer than local memory."""
    centres = np.random.default_rng(0).uniform((-0.1, -0.1, 1), (0.1, 0.1, 3), (5000, 3))
    with Rasterizer(device, plain_splats(centres, sigma=1e-3, logit=1)) as rasterizer:
        rasterizer.render(straight_camera(16, 16))


def all_stages(device: Device) -> None:
    """Whole encodes: pruning that a GPU steers, the fit with its roundings, compaction and judging."""
    changes = {"prune": {"iterations": 3}, "fit": {"steps": 3}, "compact": True, "refit": False}
    options = EncodeOptions.for_preset("smallest", between=False, cameras_anyway=True, **changes)
    for degree, in_memory in ((1, False), (2, True), (3, False)):
        with patch.object(DeviceInfo, "indexes_in_memory", in_memory):
            encode(random_splats(60, degree, seed=2), _views(5), options, device=device)


def view_by_view(device: Device) -> None:
    """Pruning of a scene of which views see little: in parts; on GPUs view by view, too, with named splats, with
    resident views and with streamed ones."""
    scene, views = _apart()
    with patch.object(splat_groups, "LARGEST", 8), uploaded(device, scene) as whole:
        visibility = Visibility.of(scene, views, INRIA.near)
        given: list[tuple[Drawable, int | None, float]] = [(scene, None, 0.0)]
        given += [(whole, None, 0.0), (whole, 0, 0.05)] if device.family == "gpu" else []
        for source, memory, tolerance in given:
            options = SweepOptions(tolerance, memory=memory)
            with planned_sweep(device, source, Wanted(views, options, visibility=visibility)) as removal:
                removal.measure()
                removal.remove(np.arange(0, len(scene), 5))
                removal.measure()
                prune_scene(removal, PruningOptions(1e-2, 3))


def _apart() -> tuple[Scene, list[Camera]]:
    """Three heaps, each with a view that sees no other."""
    rng = np.random.default_rng(4)
    heaps = np.repeat(np.arange(3) * 50.0, 40)
    means = rng.normal(0, 0.3, (120, 3)) + np.stack([heaps, np.zeros(120), np.full(120, 3.0)], axis=1)
    views = [
        dataclasses.replace(straight_camera(24, 24), translation=np.array([-50.0 * k, 0, 0]), name=f"view {k}")
        for k in range(3)
    ]
    return plain_splats(means, 0.1, -1, rng.uniform(0, 1, (120, 3))), views


def refits(device: Device) -> None:
    """With AC coefficients rounded in rounds, to the same: the vectors on the device, and on the host in slices; on a
    GPU also of views with the splats that they reach, in pieces of lists that many work-groups sort."""
    # Two slices: of 256 splats, and of the rest.
    scene, views = random_splats(270, 1, seed=2), _views()
    rng = np.random.default_rng(0)
    steps = (0.1 * 2.0 ** rng.uniform(-1, 1, (2, len(scene)))).astype(np.float32)
    grid = ColourGrid(steps[0], steps[1], rng.permutation(len(scene)))
    found = []
    with Rasterizer(device, scene) as rasterizer:
        targets = RenderedTargets(rasterizer, views)
        for slices, least, longest in ((None, 1 << 30, 1 << 30), (256, 1 << 30, 1 << 30), (None, 1, 100)):
            with (
                patch.object(reached, "LEAST_SPLATS", least),
                patch.object(reached, "WORTH_IT", 1.0),
                patch.object(raster_launcher, "LONGEST", longest),
                patch.object(long_lists_module, "LONGEST", longest),
                patch.object(long_lists_module, "PIECE", 64),
            ):
                options = RefitOptions(steps=2, gain=0, drop=1e-9, slices=slices)
                found.append(refit_colours(device, scene, views, targets, options, colour_grid=lambda _: grid).sh)
    assert all(np.array_equal(found[0], other) for other in found[1:])


def packing(device: Device) -> None:
    """What travels between devices that share a re-fit."""
    scene = random_splats(300, 2, seed=5)
    layout = Layout(300, 320, scene.sh.shape[1], 1)
    with Memory(device) as memory, Coefficients(device, layout) as vectors, Exchange(vectors) as packs:
        vectors.activate(np.random.default_rng(1).random(scene.sh.shape) < 0.5)
        packs.settle()
        packs.take_flags(packs.flags())
        x = vectors.vector()
        vectors.write(x, scene.sh.transpose(1, 2, 0).reshape(layout.columns, -1))
        packs.take_floats(x, packs.send_floats(x))
        packs.take_vector(x, packs.send_vector(x))
        sums = memory.upload(np.ones((layout.columns, layout.stride), np.int64), "sums")
        packs.add_sums(sums, packs.send_sums(sums))
        packs.add_rows(sums, 1, packs.rows(sums, 0, 1))


def marks(device: Device) -> None:
    """The bits of splats that go, and back; totals of those that are left, and their changes, packed, and back."""
    with Survivors(device, 61, 64, device.queue.finish) as survivors, Memory(device) as memory:
        survivors.mark(np.packbits(np.arange(61) % 3 == 0, bitorder="little"))
        survivors.mark(survivors.just_marked())
        totals = memory.upload(np.ones((64, 2), np.int64), "totals")
        with AlivePacking(device, 61, survivors.buffer) as packing:
            packing.note()
            lent = packing.lend(totals)
            assert packing.are_packed(lent)
            packing.unpack(lent.buffer, totals, add=True)
        with ChangedTotals(device, 61, survivors.buffer) as changed, AddedChanges(device) as added:
            changes = changed.take(totals)
            added.add(totals, changes, 61)
            added.add(totals, changes, 61, memory.upload(np.arange(61, dtype=np.uint32), "numbers"))


def decoding(device: Device) -> None:
    """Files to the device's memory: bundles, packed or not, and look-up tables."""
    scene = random_splats(300, 3, seed=8)
    for preset, by_c in (("best", "1"), ("best", "0"), ("paper", "0")):
        with patch.object(encoder, "_FEW", 0), patch.dict(os.environ, {VARIABLE: by_c}):
            data = b"".join(code_scene(scene, HyperParameters.from_quality(0.5, preset)).pieces)  # type: ignore[arg-type]
            with decode_to_device(open_file(data), device) as buffers, Rasterizer(device, buffers) as rasterizer:
                rasterizer.render(tilted_camera(1, 24, 24))


def clusters(device: Device) -> None:
    """k-means of a palette."""
    generator = np.random.default_rng(1)
    points = generator.normal(size=(150, 3, 3)).astype(np.float32)
    cluster(device, points, generator.uniform(0.1, 2, (150, 3)).astype(np.float32), 40)


def merging(device: Device) -> None:
    """Groups of many sizes, some of which stay as they are."""
    scene = random_splats(300, 1, seed=4)
    importance = np.random.default_rng(5).random(len(scene)).astype(np.float32) ** 4
    merged(device, scene, np.arange(0, len(scene), 6), importance)


def filling(device: Device) -> None:
    """A buffer that a kernel fills, as large ones are."""
    with patch.object(opencl_device, "_FILLED", 0), Memory(device) as memory:
        for value, count in ((np.uint8(3), 1001), (np.float32(2), 77), (np.int64(1 << 40), 33)):
            buffer = memory.allocate(count * value.nbytes, "values")
            device.fill(buffer, value, count * value.nbytes)
            assert (device.download(buffer, (count,), value.dtype) == value).all()


STEPS: tuple[Step, ...] = (
    views, long_lists, all_stages, view_by_view, refits, packing, marks, decoding, clusters, merging, check_similarity,
    filling,
)  # fmt: skip


# ------------------------------------------------------------------------------------------ in the simulator


def simulate(family: str, width: int, names: list[str], told: Path) -> None:
    """Inside Oclgrind: run steps, and keep in a file which kernels were run.

    Nothing is freed: Oclgrind mistakes a new buffer in an old one's place for memory that no one has written. Nor does
    it know that a filled buffer has been written, or a part of one that does not lie at its beginning, or a rectangle:
    all of such a buffer is written again.
    """
    enqueue_copy = cl.enqueue_copy

    def copy(queue: cl.CommandQueue, to: Any, source: Any, **more: Any) -> Any:
        done = enqueue_copy(queue, to, source, **more)
        if isinstance(to, cl.Buffer) and ("region" in more or more.get("dst_offset") or more.get("src_offset")):
            whole = np.empty(to.size, np.uint8)
            enqueue_copy(queue, whole, to, is_blocking=True)
            return enqueue_copy(queue, to, whole, is_blocking=True)
        return done

    def fill(queue: cl.CommandQueue, buffer: cl.Buffer, pattern: Any, offset: int, size: int) -> None:
        enqueue_copy(queue, buffer, np.full(size // pattern.itemsize, pattern), dst_offset=offset)

    run: set[str] = set()
    sources: dict[int, str] = {}
    freed: list[cl.Buffer] = []
    info = next(d for d in list_devices() if "oclgrind" in d.platform.lower())
    simulated = dataclasses.replace(info, vector_width=width)
    make, launch = Device.kernel, Kernel.launch
    kept: list[Kernel] = []

    def made(device: Device, source: str, name: str, **defines: str | int | float) -> Kernel:
        kept.append(make(device, source, name, **defines))
        sources[id(kept[-1])] = source
        return kept[-1]

    def launched(kernel: Kernel, *given: Any, **more: Any) -> None:
        run.add(f"{sources[id(kernel)]}: {kernel.name}")
        launch(kernel, *given, **more)

    with ExitStack() as patches:
        patches.enter_context(patch.object(cl, "enqueue_fill_buffer", fill))
        patches.enter_context(patch.object(cl, "enqueue_copy", copy))
        patches.enter_context(patch.object(Device, "kernel", made))
        patches.enter_context(patch.object(Kernel, "launch", launched))
        patches.enter_context(patch.object(Device, "free", lambda _, buffer: freed.append(buffer)))
        # Oclgrind crashes where another thread than the first one asks for memory.
        for module in (resident, target_pictures):
            patches.enter_context(patch.object(module, "in_background", _at_once))
        for module in (coefficients, sliced_arrays):
            patches.enter_context(patch.object(module, "DOT_ITEMS", _DOT_ITEMS))
        print("STEP probes", file=sys.stderr, flush=True)
        device = Device(simulated, family=family, build_options=["-DNO_PREFETCH"])  # type: ignore[arg-type]
        device.self_check()
        for step in STEPS:
            if step.__name__ in names:
                # On the error stream, where Oclgrind writes too: what it says comes after the name of the step.
                print(f"STEP {step.__name__}", file=sys.stderr, flush=True)
                step(device)
    told.write_text(json.dumps(sorted(run)))


def _at_once(work: Callable[..., T], *args: Any) -> Future[T]:
    """In place of :func:`potr_cl.host.threads.in_background`."""
    future = Future[T]()
    try:
        future.set_result(work(*args))
    except Exception as error:
        future.set_exception(error)
    return future


# ------------------------------------------------------------------------------------------ outside of it


def simulated(family: str, width: int, steps: list[str], api: bool = False) -> tuple[list[str], set[str]]:
    """Run steps in Oclgrind, in a process of its own.

    Returns:
        What was found, a line each: the step, what Oclgrind said, and the kernel; or how the run failed. And the
        kernels that were run, as "file: name".
    """
    # Looking for uninitialised values it crashes where vectors are loaded from a work-item's own array, and where a
    # vector is made of shorter ones.
    checks = ["--data-races", *(["--uninitialized"] if family == "gpu" else []), *(["--check-api"] if api else [])]
    with tempfile.TemporaryDirectory() as folder:
        told = Path(folder) / "kernels.json"
        # Its optimiser breaks stores of vectors; programs from pyopencl's cache lose their sources.
        command = ["oclgrind", "--build-options", "-cl-opt-disable", *checks]
        command += [sys.executable, "-m", "tools.stress.simulated", "--inside", family, str(width), str(told)]
        done = subprocess.run(
            [*command, *(word for step in steps for word in ("--step", step))],
            env=os.environ | {"PYOPENCL_NO_CACHE": "1"}, capture_output=True, text=True, check=False,
        )  # fmt: skip
        kernels = set(json.loads(told.read_text())) if told.exists() else set()
    findings: dict[str, None] = {}  # in their order, each once
    step = "before the first step"
    for line, after in itertools.pairwise([*done.stderr.splitlines(), ""]):
        if line.startswith("STEP "):
            step = line.removeprefix("STEP ")
        elif after.startswith("\tKernel: "):
            findings[f"{step}: {line.strip()} in {after.removeprefix(chr(9) + 'Kernel: ')}"] = None
    if done.returncode:
        last = [f"exit code {done.returncode}", *done.stderr.strip().splitlines()][-1]
        findings[f"{step}: the run failed: {last}"] = None
    return list(findings), kernels


def all_kernels() -> set[str]:
    """ "file: name" of every kernel of the package."""
    folder = Path(potr_cl.__file__).parent / "cl"
    pattern = re.compile(r"^kernel\b[^{;]*?\bvoid\s+(\w+)\s*\(", re.MULTILINE)
    return {
        f"{path.relative_to(folder).as_posix()}: {name}"
        for path in sorted(folder.rglob("*.cl"))
        for name in pattern.findall(path.read_text())
    }


def main() -> None:
    parser = plain_parser(__doc__)
    parser.add_argument("--family", choices=("gpu", "cpu"), help="default: both")
    names = [step.__name__ for step in STEPS]
    parser.add_argument("--step", action="append", dest="steps", choices=names, help="default: all")
    parser.add_argument("--check-api", action="store_true", help="have Oclgrind check calls of OpenCL, too")
    parser.add_argument("--inside", nargs=3, help=argparse.SUPPRESS)
    args = parser.parse_args()
    steps = args.steps or names
    if args.inside is not None:
        family, width, told = args.inside
        simulate(family, int(width), steps, Path(told))
        return
    if shutil.which("oclgrind") is None:
        sys.exit("Oclgrind is not installed (Debian: apt-get install oclgrind)")
    columns = "kernels; vector; steps; found; kernels run; time|s|.0f"
    table = Results(None, args.json).table("simulated", "Kernels in Oclgrind", columns)
    run: set[str] = set()
    findings: list[str] = []
    for family, width in KINDS:
        if args.family in (None, family):
            began = time.perf_counter()
            found, kernels = simulated(family, width, steps, args.check_api)
            seconds = time.perf_counter() - began
            run |= kernels
            findings += found
            table.add(family, width, len(steps), "; ".join(found) or "nothing", len(kernels), seconds)
    if args.family is None and args.steps is None and (left := sorted(all_kernels() - run)):
        findings.append(f"no step runs {', '.join(left)}")
        print(f"\n{findings[-1]}")
    sys.exit(1 if findings else 0)


if __name__ == "__main__":
    main()
