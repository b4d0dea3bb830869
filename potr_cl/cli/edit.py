"""The commands that change a scene and write it as a PLY again: prune, compact, refit."""

from __future__ import annotations

import argparse
import contextlib
from typing import Any

import numpy as np

from potr_cl.api.editing import RefittedScene, check_rendered_alike, compact, decibels_of, prune, refit, stage_options
from potr_cl.cli.batch import add_to_option
from potr_cl.cli.forecasts import tell_what_is_ahead
from potr_cl.cli.guard import ReadPhotographs, read_file
from potr_cl.cli.options import Commands, add_device_options, add_memory_option
from potr_cl.cli.outputs import WrittenNumbers, scene_output
from potr_cl.cli.parser import whole_number
from potr_cl.cli.progress import Progress
from potr_cl.cli.scenes import add_antialiased_option, add_from_option, add_trust_option, read_scene, write_result
from potr_cl.cli.stage_flags import add_stage_flags, stage_choices
from potr_cl.cli.terminal import note, say_done
from potr_cl.cli.views import add_cameras_options, given_cameras, virtual_cameras
from potr_cl.errors import UsageError
from potr_cl.formats.images import parse_colour
from potr_cl.formats.registry import suffixes_read, suffixes_written
from potr_cl.host.atomic_write import replacing
from potr_cl.model.camera import Camera, within_photographs
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.pipeline.amounts import as_bytes
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.quality.ground_truth import GroundTruth
from potr_cl.stages.compact import Compact
from potr_cl.stages.prune import Prune
from potr_cl.stages.refitting.refit_options import RefitOptions


def _prune(args: argparse.Namespace) -> None:
    choices: dict[str, Any] = {**stage_choices(args)}
    options = stage_options(
        Prune, args.quality, args.background, args.memory, choices
    )  # told before a gigabyte is read
    scene, cameras, device = _inputs(args)
    with contextlib.ExitStack() as stack:
        order = stack.enter_context(replacing(args.order)) if args.order is not None else None
        progress = stack.enter_context(Progress())
        cameras = cameras or virtual_cameras(args, scene, progress, device)
        tell_what_is_ahead(device, scene, cameras, options)
        result = prune(
            scene, cameras, q=args.quality, memory=args.memory, background=args.background,
            device=device, progress=progress, cameras_anyway=args.cameras_anyway, **choices,
        )  # fmt: skip
        write_result(args.output, result.scene, args.to)
        if order is not None:
            np.save(order, result.pruned.order)
    say_done(f"{args.output}: {result.said} on {result.device.info}")
    if result.unseen.splats:
        say_done(result.unseen)


def _inputs(args: argparse.Namespace) -> tuple[Scene, list[Camera] | None, Device]:
    cameras = given_cameras(args)
    return read_scene(args, args.scene), cameras, Device(args.device)


def add_output_options(p: argparse.ArgumentParser) -> None:
    p.add_argument(
        "-o",
        "--output",
        type=scene_output,
        required=True,
        metavar="OUT.ply",
        help=f'{suffixes_written()}, or "-" for standard output',
    )
    add_to_option(p)
    add_from_option(p)


def add_reduced_and_reference(p: argparse.ArgumentParser) -> None:
    """The scenes and cameras of a command that brings one scene closer to another."""
    p.add_argument("scene", type=read_file, metavar="PRUNED", help=f'{suffixes_read()}, or "-" for standard input')
    p.add_argument("--reference", type=read_file, required=True, metavar="ORIGINAL", help="the uncompressed scene")
    add_cameras_options(p)


def add_usual_options(p: argparse.ArgumentParser) -> None:
    """How scenes are read, and what computes with how much memory."""
    add_trust_option(p)
    add_antialiased_option(p)
    add_memory_option(p)
    add_device_options(p)


def add_prune(commands: Commands) -> None:
    p = commands.add_parser("prune", help="remove the splats that no view misses; nothing else changes")
    p.add_argument("scene", type=read_file, metavar="SCENE", help=f'{suffixes_read()}, or "-" for standard input')
    add_cameras_options(p)
    add_output_options(p)
    p.add_argument("-q", "--quality", type=float, default=0.5, metavar="Q", help="0 (fewest splats) to 1; default 0.5")
    p.add_argument(
        "--order",
        type=WrittenNumbers,
        metavar="FILE.npy",
        help="also write the order of removal: indices into the scene, first removed first, kept ones last",
    )
    add_stage_flags(p, [Prune], without=["on"])
    add_usual_options(p)
    p.set_defaults(run=_prune)


def _compact(args: argparse.Namespace) -> None:
    choices: dict[str, Any] = {**stage_choices(args)}
    options = stage_options(Compact, args.quality, args.background, args.memory, choices, args.sf_sh)
    scene, cameras, device = _inputs(args)
    with Progress() as progress:
        cameras = cameras or virtual_cameras(args, scene, progress, device)
        tell_what_is_ahead(device, scene, cameras, options)
        result = compact(
            scene, cameras, q=args.quality, sf_sh=args.sf_sh, memory=args.memory, background=args.background,
            device=device, progress=progress, cameras_anyway=args.cameras_anyway, **choices,
        )  # fmt: skip
    write_result(args.output, result.scene, args.to)
    say_done(f"{args.output}: {result.said}")


def add_compact(commands: Commands) -> None:
    p = commands.add_parser("compact", help="make the colours' coefficients sparse; nothing else changes")
    p.add_argument("scene", type=read_file, metavar="SCENE", help=f'{suffixes_read()}, or "-" for standard input')
    add_cameras_options(p)
    add_output_options(p)
    p.add_argument("-q", "--quality", type=float, default=0.5, metavar="Q", help="0 (sparsest) to 1; default 0.5")
    add_stage_flags(p, [Compact], without=["on", "at"])
    p.add_argument("--sf-sh", type=float, metavar="SF", help="levels per unit of the expected quantiser")
    add_usual_options(p)
    p.set_defaults(run=_compact)


def _refit(args: argparse.Namespace) -> None:
    # What is wrong with the options is told before anything is read.
    background = parse_colour(args.background)
    _ = RefitOptions(steps=args.steps, drop=args.drop, lam=args.lam, prior=args.prior)
    if args.photos is not None and args.cameras is None:
        raise UsageError("--photos needs --cameras, the views that the photographs show")
    cameras = given_cameras(args)
    if args.photos is not None and cameras is not None:
        missing = GroundTruth(args.photos, within_photographs(cameras), background).missing
        if missing is not None:
            note(f"warning: {missing}", "warning")
    scene, reference = read_scene(args, args.scene), read_scene(args, args.reference)
    check_rendered_alike((str(args.scene), scene), (str(args.reference), reference))
    device = Device(args.device)
    with Progress() as progress:
        cameras = cameras or virtual_cameras(args, reference, progress, device)
        # An encode that does nothing else which takes long.
        alone = EncodeOptions(memory=as_bytes(args.memory)).changed(prune=False, refit={"steps": args.steps})
        tell_what_is_ahead(device, scene, cameras, alone)
        result = refit(
            scene, reference, cameras,
            photos=args.photos, steps=args.steps, prior=args.prior, lambda_=args.lam,
            drop=args.drop, memory=args.memory, background=background, device=device, progress=progress,
            cameras_anyway=args.cameras_anyway,
        )  # fmt: skip
    write_result(args.output, result.scene, args.to)
    say_done(f"{args.output}: {len(scene):,} splats re-fitted in {result.refitted.steps} steps on {result.device.info}")
    before, after = result.refitted.errors
    say_done(
        f"{result.views} training views: mean squared error {before:.3g} before, {after:.3g} after, "
        f"PSNR {decibels_of(before)} before, {decibels_of(after)} after"
    )
    if result.psnr is not None:
        _tell_of_held_out(result, result.psnr)
    elif args.photos is not None:
        note(
            "warning: no view is held out, so nobody knows whether the colours fit the photographs too closely",
            "warning",
        )


def _tell_of_held_out(result: RefittedScene, psnr: tuple[float, float]) -> None:
    """What the scene before and after, and the reference, come to on views that the re-fit did not see."""
    before, after = psnr
    reference = result.reference_psnr
    own = "" if reference is None else f"{reference:.2f} dB of the reference, "
    end = f"{own}mean over views"
    say_done(f"{result.held_out}: PSNR {before:.2f} dB before, {after:.2f} dB after, {end}")
    if reference is not None and after < reference:
        note(
            f"warning: on held-out photographs the result is {reference - after:.2f} dB worse than the reference: "
            "the training photographs are fitted too closely (more --prior, fewer --steps), or too much is gone",
            "warning",
        )


def add_refit(commands: Commands) -> None:
    p = commands.add_parser(
        "refit",
        help="re-fit the colours of a reduced scene to the pictures of the uncompressed one, or to photographs",
        description="Solve for the colours of all splats together, so that the training views look as those of the "
        "reference (or as the photographs) do; nothing else changes. Coefficients that are 0 stay 0.",
    )
    add_reduced_and_reference(p)
    p.add_argument(
        "--photos", type=ReadPhotographs, metavar="DIR", help="photographs, named after the views, to fit instead"
    )
    add_output_options(p)
    p.add_argument(
        "--steps",
        type=whole_number,
        default=RefitOptions.steps,
        metavar="N",
        help=f"at most so many steps; default {RefitOptions.steps}",
    )
    p.add_argument(
        "--prior",
        type=float,
        default=RefitOptions.prior,
        metavar="X",
        help=f"how strongly coefficients are held at their old values; default {RefitOptions.prior:g}",
    )
    p.add_argument(
        "--lambda",
        dest="lam",
        type=float,
        default=RefitOptions.lam,
        metavar="X",
        help=f"how strongly AC coefficients are pulled to 0; default {RefitOptions.lam:g}",
    )
    p.add_argument(
        "--drop",
        type=float,
        default=RefitOptions.drop,
        metavar="X",
        help="zero an AC coefficient if that raises the mean squared error by less than this; default: none",
    )
    add_usual_options(p)
    p.set_defaults(run=_refit)
