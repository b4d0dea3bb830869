"""The command "fit": all parameters of a reduced scene, to the pictures of the uncompressed one."""

from __future__ import annotations

import argparse

from potr_cl.api.editing import check_rendered_alike
from potr_cl.api.fitting import check_fit, fit
from potr_cl.cli.edit import add_output_options, add_reduced_and_reference, add_usual_options
from potr_cl.cli.forecasts import tell_what_is_ahead
from potr_cl.cli.options import Commands
from potr_cl.cli.parser import whole_number
from potr_cl.cli.progress import Progress
from potr_cl.cli.scenes import read_scene, write_result
from potr_cl.cli.terminal import say_done
from potr_cl.cli.views import given_cameras, virtual_cameras
from potr_cl.opencl.device import Device
from potr_cl.pipeline.amounts import as_bytes
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.stages.fitting.fit import FitOptions


def _fit(args: argparse.Namespace) -> None:
    _ = check_fit(args.steps, args.views_between)  # told before anything is read
    cameras = given_cameras(args)
    scene, reference = read_scene(args, args.scene), read_scene(args, args.reference)
    check_rendered_alike((str(args.scene), scene), (str(args.reference), reference))
    device = Device(args.device)
    with Progress() as progress:
        cameras = cameras or virtual_cameras(args, reference, progress, device)
        # An encode that does nothing else which takes long.
        alone = EncodeOptions(memory=as_bytes(args.memory)).changed(
            prune=False, refit=False, fit={"steps": args.steps}, between={"views": args.views_between}
        )
        tell_what_is_ahead(device, scene, cameras, alone)
        result = fit(
            scene, reference, cameras,
            steps=args.steps, views_between=args.views_between, memory=args.memory, background=args.background,
            device=device, progress=progress, tell=progress.tell, cameras_anyway=args.cameras_anyway,
        )  # fmt: skip
    write_result(args.output, result.scene, args.to)
    between = f" and {result.added} between them" if result.added else ""
    say_done(f"{args.output}: {result.said} of {result.views} training views{between}, on {result.device.info}")
    if result.psnr is not None:
        before, after = result.psnr
        say_done(f"{result.judged_by}: PSNR {before:.2f} dB before, {after:.2f} dB after, mean over views")


def add_fit(commands: Commands) -> None:
    p = commands.add_parser(
        "fit",
        help="fit all parameters of a reduced scene to the pictures of the uncompressed one",
        description="Move, turn, scale, fade and colour the splats of a reduced scene so that the training views look "
        "as those of the reference do. Some training views are held out; the scene that matches them best is kept, at "
        "worst the one that was given.",
    )
    add_reduced_and_reference(p)
    add_output_options(p)
    p.add_argument(
        "--steps",
        type=whole_number,
        default=FitOptions.steps,
        metavar="N",
        help=f"at most so many steps; default {FitOptions.steps}",
    )
    p.add_argument(
        "--views-between",
        type=whole_number,
        default=0,
        metavar="N",
        help="extra views per training view, between it and its neighbours; default 0",
    )
    add_usual_options(p)
    p.set_defaults(run=_fit)
