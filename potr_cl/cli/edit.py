"""The commands that change a scene and write it as a PLY again: prune, compact."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
from pathlib import Path

import numpy as np

from potr_cl.atomic_write import replacing
from potr_cl.cli.options import (
    Commands,
    add_compaction_options,
    add_device_options,
    add_memory_option,
    add_pruning_options,
    as_bytes,
    compaction_choices,
    count,
    sweep_options,
)
from potr_cl.cli.progress import Progress
from potr_cl.cli.views import add_cameras_options, given_cameras, virtual_cameras
from potr_cl.device import Device
from potr_cl.errors import UsageError
from potr_cl.formats import load_scene, ply
from potr_cl.images import parse_colour
from potr_cl.options import EncodeOptions
from potr_cl.quantize import ac_sparsity
from potr_cl.reduction import reduce_scene
from potr_cl.removal import SweepOptions


def _prune(args: argparse.Namespace) -> None:
    if args.order is not None and args.order.resolve() == args.output.resolve():
        raise UsageError("--order and --output name the same file")
    options = EncodeOptions(
        q=args.quality,
        delta_mse_max=args.delta_mse_max,
        iterations=args.iterations,
        compact=False,
        sweep=sweep_options(args),
        background=parse_colour(args.background),
    )
    _ = options.parameters  # a wrong option is told before a gigabyte is read
    cameras = given_cameras(args)
    scene = load_scene(args.scene)
    options = dataclasses.replace(options, count=count(args, len(scene)))
    device = Device(args.device)
    with contextlib.ExitStack() as stack:
        order = stack.enter_context(replacing(args.order)) if args.order is not None else None
        progress = stack.enter_context(contextlib.closing(Progress()))
        cameras = cameras or virtual_cameras(args, scene, progress)
        kept, pruned = reduce_scene(scene, cameras, options, progress, device)
        assert pruned is not None
        ply.save(args.output, kept)
        if order is not None:
            np.save(order, pruned.order)
    print(
        f"{args.output}: kept {pruned.kept} of {len(scene)} splats "
        f"({100 * pruned.kept / len(scene):.1f} %) in {pruned.iterations} iterations on {device.info}"
    )


def add_prune(commands: Commands) -> None:
    p = commands.add_parser("prune", help="remove the splats that no view misses; nothing else changes")
    p.add_argument("scene", type=Path, metavar="SCENE", help=".ply or .potr")
    add_cameras_options(p)
    p.add_argument("-o", "--output", type=Path, required=True, metavar="OUT.ply")
    p.add_argument("-q", "--quality", type=float, default=0.5, metavar="Q", help="0 (fewest splats) to 1; default 0.5")
    p.add_argument(
        "--order",
        type=Path,
        metavar="FILE.npy",
        help="also write the order of removal: the scene's splat numbers, first removed first, kept ones last",
    )
    add_pruning_options(p)
    p.set_defaults(run=_prune)


def _compact(args: argparse.Namespace) -> None:
    options = EncodeOptions(
        q=args.quality,
        **compaction_choices(args),
        sf_sh=args.sf_sh,
        prune=False,
        sweep=SweepOptions(memory=as_bytes(args.memory)),
        background=parse_colour(args.background),
    )
    _ = options.parameters
    cameras = given_cameras(args)
    scene = load_scene(args.scene)
    device = Device(args.device)
    with contextlib.closing(Progress()) as progress:
        cameras = cameras or virtual_cameras(args, scene, progress)
        compacted, _ = reduce_scene(scene, cameras, options, progress, device)
    ply.save(args.output, compacted)
    before, after = (100 * ac_sparsity(s.sh, options.parameters.sf_sh) for s in (scene, compacted))
    print(
        f"{args.output}: {len(scene)} splats, {after:.1f} % of the AC coefficients quantise to 0, {before:.1f} % before"
    )


def add_compact(commands: Commands) -> None:
    p = commands.add_parser("compact", help="make the colours' coefficients sparse; nothing else changes")
    p.add_argument("scene", type=Path, metavar="SCENE", help=".ply or .potr")
    add_cameras_options(p)
    p.add_argument("-o", "--output", type=Path, required=True, metavar="OUT.ply")
    p.add_argument("-q", "--quality", type=float, default=0.5, metavar="Q", help="0 (sparsest) to 1; default 0.5")
    add_compaction_options(p)
    p.add_argument("--sf-sh", type=float, metavar="SF", help="steps a unit of the quantiser to expect")
    add_memory_option(p)
    add_device_options(p)
    p.set_defaults(run=_compact)
