"""The commands of one stage alone, which change a scene and write it again: prune, compact, refit, fit."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from potr_cl.api.editing import (
    Compact,
    Edited,
    FitOptions,
    Prune,
    RefitOptions,
    compact,
    fit,
    prune,
    refit,
)
from potr_cl.cli.batch import add_to_option
from potr_cl.cli.guard import ReadPhotographs, StandardInput, StandardOutput, read_file
from potr_cl.cli.options import Commands, add_cameras_options, add_device_options, add_memory_option, given_cameras
from potr_cl.cli.outputs import WrittenNumbers, scene_output
from potr_cl.cli.parser import whole_number
from potr_cl.cli.progress import Progress
from potr_cl.cli.scenes import (
    ANTIALIASED,
    add_antialiased_option,
    add_from_option,
    add_trust_option,
    read_scene,
    write_result,
)
from potr_cl.cli.stage_flags import add_stage_flags, stage_choices
from potr_cl.cli.terminal import say_done
from potr_cl.formats.registry import suffixes_read, suffixes_written


def _edit(args: argparse.Namespace, function: Callable[..., Edited], *sources: Path, **own: Any) -> None:
    """Have a stage change the first of some scenes, and say what it did."""
    streamed = isinstance(args.output, StandardOutput)
    scenes = [read_scene(args, each) if isinstance(each, StandardInput) else each for each in sources]
    with Progress() as progress:
        result = function(
            *scenes, given_cameras(args), output=None if streamed else args.output, virtual_views=args.virtual_views,
            memory=args.memory, background=args.background, device=args.device, trust=args.trust,
            antialiased=ANTIALIASED[args.antialiased], cameras_anyway=args.cameras_anyway, progress=progress, **own,
        )  # fmt: skip
    if streamed:
        write_result(args.output, result.scene, args.to)
    say_done(f"{args.output}: {result}")


def _prune(args: argparse.Namespace) -> None:
    _edit(args, prune, args.scene, q=args.quality, order=args.order, **stage_choices(args, [Prune]))


def _compact(args: argparse.Namespace) -> None:
    _edit(args, compact, args.scene, q=args.quality, sf_sh=args.sf_sh, **stage_choices(args, [Compact]))


def _refit(args: argparse.Namespace) -> None:
    own = {"photos": args.photos, "steps": args.steps, "prior": args.prior, "lambda_": args.lam, "drop": args.drop}
    _edit(args, refit, args.scene, args.reference, **own)


def _fit(args: argparse.Namespace) -> None:
    _edit(args, fit, args.scene, args.reference, steps=args.steps, views_between=args.views_between)


def _add_output_options(p: argparse.ArgumentParser) -> None:
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


def _add_reduced_and_reference(p: argparse.ArgumentParser) -> None:
    """The scenes and cameras of a command that brings one scene closer to another."""
    p.add_argument("scene", type=read_file, metavar="PRUNED", help=f'{suffixes_read()}, or "-" for standard input')
    p.add_argument("--reference", type=read_file, required=True, metavar="ORIGINAL", help="the uncompressed scene")
    add_cameras_options(p)


def _add_usual_options(p: argparse.ArgumentParser) -> None:
    """How scenes are read, and what computes with how much memory."""
    add_trust_option(p)
    add_antialiased_option(p)
    add_memory_option(p)
    add_device_options(p)


def add_prune(commands: Commands) -> None:
    p = commands.add_parser("prune", help="remove the splats that no view misses; nothing else changes")
    p.add_argument("scene", type=read_file, metavar="SCENE", help=f'{suffixes_read()}, or "-" for standard input')
    add_cameras_options(p)
    _add_output_options(p)
    p.add_argument("-q", "--quality", type=float, default=0.5, metavar="Q", help="0 (fewest splats) to 1; default 0.5")
    p.add_argument(
        "--order",
        type=WrittenNumbers,
        metavar="FILE.npy",
        help="also write the order of removal: indices into the scene, first removed first, kept ones last",
    )
    add_stage_flags(p, [Prune], without=["on"])
    _add_usual_options(p)
    p.set_defaults(run=_prune)


def add_compact(commands: Commands) -> None:
    p = commands.add_parser("compact", help="make the colours' coefficients sparse; nothing else changes")
    p.add_argument("scene", type=read_file, metavar="SCENE", help=f'{suffixes_read()}, or "-" for standard input')
    add_cameras_options(p)
    _add_output_options(p)
    p.add_argument("-q", "--quality", type=float, default=0.5, metavar="Q", help="0 (sparsest) to 1; default 0.5")
    add_stage_flags(p, [Compact], without=["on", "at"])
    p.add_argument("--sf-sh", type=float, metavar="SF", help="levels per unit of the expected quantiser")
    _add_usual_options(p)
    p.set_defaults(run=_compact)


def add_refit(commands: Commands) -> None:
    p = commands.add_parser(
        "refit",
        help="re-fit the colours of a reduced scene to the pictures of the uncompressed one, or to photographs",
        description="Solve for the colours of all splats together, so that the training views look as those of the "
        "reference (or as the photographs) do; nothing else changes. Coefficients that are 0 stay 0.",
    )
    _add_reduced_and_reference(p)
    p.add_argument(
        "--photos", type=ReadPhotographs, metavar="DIR", help="photographs, named after the views, to fit instead"
    )
    _add_output_options(p)
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
    _add_usual_options(p)
    p.set_defaults(run=_refit)


def add_fit(commands: Commands) -> None:
    p = commands.add_parser(
        "fit",
        help="fit all parameters of a reduced scene to the pictures of the uncompressed one",
        description="Move, turn, scale, fade and colour the splats of a reduced scene so that the training views look "
        "as those of the reference do. Some training views are held out; the scene that matches them best is kept, at "
        "worst the one that was given.",
    )
    _add_reduced_and_reference(p)
    _add_output_options(p)
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
    _add_usual_options(p)
    p.set_defaults(run=_fit)
