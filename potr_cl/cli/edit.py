"""The commands that change a scene and write it as a PLY again: prune, compact, refit."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import math

import numpy as np

from potr_cl.cli.guard import ReadFile, ReadPhotographs, WrittenFile
from potr_cl.cli.options import Commands, add_device_options, add_memory_option, as_bytes
from potr_cl.cli.parser import whole_number
from potr_cl.cli.progress import Progress
from potr_cl.cli.scenes import add_antialiased_option, add_trust_option, read_scene
from potr_cl.cli.stage_flags import add_stage_flags, stage_choices
from potr_cl.cli.terminal import note, say
from potr_cl.cli.views import add_cameras_options, given_cameras, virtual_cameras
from potr_cl.codec.quantize import ac_sparsity
from potr_cl.errors import UsageError
from potr_cl.formats.images import parse_colour
from potr_cl.formats.scenes import ply
from potr_cl.host.atomic_write import replacing
from potr_cl.model.camera import Camera, test_views, train_views
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import Run, Stopwatch
from potr_cl.pipeline.fallback import on_device
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.quality.evaluator import EvaluationViews, Evaluator
from potr_cl.quality.ground_truth import GroundTruth
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.stages.compact import Compact
from potr_cl.stages.prune import Prune
from potr_cl.stages.pruning.schedule import Pruned
from potr_cl.stages.refitting.refit import RefitOptions, Refitted, active_coefficients, refit_colours
from potr_cl.stages.refitting.targets import GroundTruthTargets, RenderedTargets
from potr_cl.stages.stage import Stage, State

#: Coefficients that round to 0 at so many steps a unit are 0, but for what storing R, G and B leaves of them.
_ZERO_SF = 1e5


def _prune(args: argparse.Namespace) -> None:
    options = _options(args, Prune)
    cameras = given_cameras(args)
    scene = read_scene(args, args.scene)
    with contextlib.ExitStack() as stack:
        order = stack.enter_context(replacing(args.order)) if args.order is not None else None
        state, device = _run(args, scene, cameras, options, Prune)
        pruned: Pruned = state.learnt["prune"]
        ply.save(args.output, state.scene)
        if order is not None:
            np.save(order, pruned.order)
    say(
        f"{args.output}: kept {pruned.kept} of {len(scene)} splats "
        f"({100 * pruned.kept / len(scene):.1f} %) in {pruned.iterations} iterations on {device.info}"
    )


def _options(args: argparse.Namespace, kind: type[Stage]) -> EncodeOptions:
    """Those of ``encode`` with one stage alone."""
    options = EncodeOptions(q=args.quality, background=parse_colour(args.background), memory=as_bytes(args.memory))
    options = options.changed(**{stage.name: isinstance(stage, kind) for stage in options.stages if stage.needs_views})
    options = options.changed(**stage_choices(args))
    _ = options.parameters  # a wrong option is told before a gigabyte is read
    return options


def _run(
    args: argparse.Namespace, scene: Scene, cameras: list[Camera] | None, options: EncodeOptions, kind: type[Stage]
) -> tuple[State, Device]:
    """What a stage alone makes of a scene, and the device that it was done on."""
    device = Device(args.device)
    with contextlib.closing(Progress()) as progress:
        watch = Stopwatch(progress)
        cameras = cameras or virtual_cameras(args, scene, watch)
        run = Run(options, watch, device)
        state = run.stages(State.of(scene, train_views(cameras)), [kind])
    return state, run.device or device


def add_prune(commands: Commands) -> None:
    p = commands.add_parser("prune", help="remove the splats that no view misses; nothing else changes")
    p.add_argument("scene", type=ReadFile, metavar="SCENE", help=".ply or .potr")
    add_cameras_options(p)
    p.add_argument("-o", "--output", type=WrittenFile, required=True, metavar="OUT.ply")
    p.add_argument("-q", "--quality", type=float, default=0.5, metavar="Q", help="0 (fewest splats) to 1; default 0.5")
    p.add_argument(
        "--order",
        type=WrittenFile,
        metavar="FILE.npy",
        help="also write the order of removal: the scene's splat numbers, first removed first, kept ones last",
    )
    add_stage_flags(p, [Prune], without=["on"])
    add_trust_option(p)
    add_antialiased_option(p)
    add_memory_option(p)
    add_device_options(p)
    p.set_defaults(run=_prune)


def _compact(args: argparse.Namespace) -> None:
    options = _options(args, Compact)
    if args.sf_sh is not None:
        options = options.with_parameters(sf_sh=args.sf_sh)
        _ = options.parameters
    cameras = given_cameras(args)
    scene = read_scene(args, args.scene)
    compacted = _run(args, scene, cameras, options, Compact)[0].scene
    ply.save(args.output, compacted)
    before, after = (100 * ac_sparsity(s.sh, options.parameters.sf_sh) for s in (scene, compacted))
    say(
        f"{args.output}: {len(scene)} splats, {after:.1f} % of the AC coefficients quantise to 0, {before:.1f} % before"
    )


def add_compact(commands: Commands) -> None:
    p = commands.add_parser("compact", help="make the colours' coefficients sparse; nothing else changes")
    p.add_argument("scene", type=ReadFile, metavar="SCENE", help=".ply or .potr")
    add_cameras_options(p)
    p.add_argument("-o", "--output", type=WrittenFile, required=True, metavar="OUT.ply")
    p.add_argument("-q", "--quality", type=float, default=0.5, metavar="Q", help="0 (sparsest) to 1; default 0.5")
    add_stage_flags(p, [Compact], without=["on", "at"])
    p.add_argument("--sf-sh", type=float, metavar="SF", help="steps a unit of the quantiser to expect")
    add_trust_option(p)
    add_antialiased_option(p)
    add_memory_option(p)
    add_device_options(p)
    p.set_defaults(run=_compact)


def _refit(args: argparse.Namespace) -> None:
    background = parse_colour(args.background)
    options = RefitOptions(steps=args.steps, drop=args.drop, lam=args.lam, prior=args.prior)
    if args.photos is not None and args.cameras is None:
        raise UsageError("--photos needs --cameras, the views that the photographs show")
    cameras = given_cameras(args)
    ground_truth = None
    if args.photos is not None:
        assert cameras is not None
        ground_truth = GroundTruth(args.photos, cameras, background)
    scene, reference = read_scene(args, args.scene), read_scene(args, args.reference)
    if scene.antialiased != reference.antialiased:
        names = (args.scene, args.reference) if scene.antialiased else (args.reference, args.scene)
        raise UsageError(
            f"'{names[0]}' says that it is antialiased and '{names[1]}' does not, so their pictures cannot be alike: "
            "give --antialiased yes or no for both"
        )
    device = Device(args.device)
    with contextlib.closing(Progress()) as progress:
        cameras = cameras or virtual_cameras(args, reference, progress)
        views = train_views(cameras)

        def work(device: Device, memory: int | None) -> Refitted:
            how = dataclasses.replace(options, memory=memory)
            with contextlib.ExitStack() as stack:
                targets: RenderedTargets | GroundTruthTargets
                if ground_truth is None:
                    rasterizer = stack.enter_context(Rasterizer(device, reference, background=background))
                    targets = RenderedTargets(rasterizer, views)
                else:
                    targets = GroundTruthTargets(device, ground_truth, views)
                active = active_coefficients(scene.sh, _ZERO_SF)
                return refit_colours(
                    device, scene, views, targets, how, active, background,
                    lambda done, steps: progress("refit", done / steps),
                )  # fmt: skip

        progress("refit", 0.0)
        refitted, device = on_device(device, as_bytes(args.memory), work)
        progress("refit", 1.0)
        result = dataclasses.replace(scene, sh=refitted.sh)
        ply.save(args.output, result)
        say(f"{args.output}: {len(scene)} splats re-fitted in {refitted.steps} steps on {device.info}")
        before, after = refitted.errors
        say(
            f"{len(views)} training views: mean squared error {before:.3g} before, {after:.3g} after, "
            f"PSNR {_decibels(before)} before, {_decibels(after)} after"
        )
        held_out = test_views(cameras)
        if ground_truth is not None:
            _tell_of_ground_truth(device, (reference, scene, result), held_out, ground_truth, background)
        elif held_out:
            with Evaluator(device, reference, EvaluationViews.of(held_out), background) as evaluator:
                psnrs = [evaluator.psnr(candidate) for candidate in (scene, result)]
            say(f"{evaluator.views}: PSNR {psnrs[0]:.2f} dB before, {psnrs[1]:.2f} dB after, mean over views")


def _decibels(error: float) -> str:
    return f"{-10 * math.log10(error):.2f} dB" if error > 0 else "infinite"


def _tell_of_ground_truth(
    device: Device,
    scenes: tuple[Scene, Scene, Scene],
    held_out: list[Camera],
    ground_truth: GroundTruth,
    background: tuple[float, float, float],
) -> None:
    """What the reference, the scene before and the scene after come to on photographs that the re-fit did not see."""
    if not held_out:
        note("warning: no view is held out, so nobody knows whether the colours fit the photographs too closely")
        return
    psnrs = []
    for scene in scenes:
        with Rasterizer(device, scene, background=background) as rasterizer:
            psnrs.append(ground_truth.psnr(rasterizer, held_out))
    reference, before, after = psnrs
    say(
        f"{len(held_out)} held-out photographs: PSNR {before:.2f} dB before, {after:.2f} dB after, "
        f"{reference:.2f} dB of the reference, mean over views"
    )
    if after < reference:
        note(
            f"warning: on held-out photographs the result is {reference - after:.2f} dB worse than the reference: "
            "the training photographs are fitted too closely (more --prior, fewer --steps), or too much is gone",
        )


def add_refit(commands: Commands) -> None:
    p = commands.add_parser(
        "refit",
        help="re-fit the colours of a reduced scene to the pictures of the uncompressed one, or to photographs",
        description="Solve for the colours of all splats together, so that the training views look as those of the "
        "reference (or as the photographs) do; nothing else changes. Coefficients that are 0 stay 0.",
    )
    p.add_argument("scene", type=ReadFile, metavar="PRUNED", help=".ply or .potr")
    p.add_argument("--reference", type=ReadFile, required=True, metavar="ORIGINAL", help="the uncompressed scene")
    add_cameras_options(p)
    p.add_argument(
        "--photos", type=ReadPhotographs, metavar="DIR", help="photographs, named after the views, to fit instead"
    )
    p.add_argument("-o", "--output", type=WrittenFile, required=True, metavar="OUT.ply")
    p.add_argument(
        "--steps",
        type=whole_number,
        default=RefitOptions.steps,
        metavar="N",
        help=f"at the most; default {RefitOptions.steps}",
    )
    p.add_argument(
        "--prior",
        type=float,
        default=RefitOptions.prior,
        metavar="X",
        help=f"how strongly coefficients are held where they were; default {RefitOptions.prior:g}",
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
        help="give up an AC coefficient where the mean squared error grows by less; default: none",
    )
    add_trust_option(p)
    add_antialiased_option(p)
    add_memory_option(p)
    add_device_options(p)
    p.set_defaults(run=_refit)
