"""Options that several commands share."""

from __future__ import annotations

import argparse
import contextlib
import re
from typing import Any, TypeAlias, get_args

from potr_cl.errors import UsageError
from potr_cl.opencl.discovery import DEVICE_VARIABLE
from potr_cl.raster.rules import GSPLAT, INRIA
from potr_cl.stages.compaction.ridge import ColourModel, CompactionOptions, Weighting
from potr_cl.stages.pruning.removal import SweepOptions
from potr_cl.stages.pruning.schedule import PruningOptions

Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"

RULES = {"inria": INRIA, "gsplat": GSPLAT}
CAMERAS_HELP = "cameras.json, transforms.json, or a COLMAP model's folder"


def count(args: argparse.Namespace, splats: int) -> int | None:
    """The number of splats that ``--keep`` or ``--count`` ask for."""
    if args.keep is None:
        return None if args.count is None else int(args.count)
    if not 0 < args.keep <= 1:
        raise UsageError(f"--keep is {args.keep:g}, it must be above 0 and at most 1")
    return max(round(float(args.keep) * splats), 1)


def sweep_options(args: argparse.Namespace) -> SweepOptions:
    return SweepOptions(args.tolerance, args.turns, as_bytes(args.memory))


def pruning_choices(args: argparse.Namespace) -> dict[str, Any]:
    """What :func:`add_pruning_options` added of the schedule, as keywords of EncodeOptions."""
    return {"mapping_a": args.mapping_a, "decay": args.decay}


def as_bytes(gigabytes: float | None) -> int | None:
    return None if gigabytes is None else int(gigabytes * 2**30)


def size_in_bytes(text: str) -> int:
    """Bytes of a size as people write it: 8MB (10⁶), 8 MiB (2²⁰), 800k, 1.5e6.

    Raises:
        UsageError: it is none.
    """
    match = re.fullmatch(r"\s*([0-9][0-9._]*(?:e[0-9]+)?)\s*(?:([kmg])(i?))?b?\s*", text, re.IGNORECASE)
    if match is not None:
        with contextlib.suppress(ValueError):
            power = " kmg".index((match[2] or " ").lower())
            return int(float(match[1]) * (1024 if match[3] else 1000) ** power)
    raise UsageError(f"'{text}' is no size: give bytes, or a number with k, MB, GB, KiB, MiB or GiB")


def add_pruning_options(p: argparse.ArgumentParser) -> None:
    """What every command that prunes understands."""
    group = p.add_argument_group("pruning")
    how_many = group.add_mutually_exclusive_group()
    how_many.add_argument("--keep", type=float, metavar="FRACTION", help="of the splats, exactly, instead of -q's")
    how_many.add_argument("--count", type=int, metavar="N", help="splats to keep, exactly, instead of -q's")
    how_many.add_argument(
        "--delta-mse-max", type=float, metavar="X", help="remove a splat if the mean squared error grows by less"
    )
    group.add_argument("--iterations", type=int, default=48, metavar="N", help="default 48")
    group.add_argument(
        "--tolerance",
        type=float,
        default=SweepOptions.tolerance,
        metavar="X",
        help="part of a tile that must have been removed before it is looked at again; 0: any; default "
        f"{SweepOptions.tolerance:g}",
    )
    group.add_argument(
        "--turns",
        type=int,
        default=SweepOptions.turns,
        metavar="N",
        help=f"look at a view again in every N-th iteration only; default {SweepOptions.turns}",
    )
    group.add_argument(
        "--damping",
        dest="decay",
        type=float,
        default=PruningOptions.decay,
        metavar="X",
        help="what a splat's effect in one iteration counts against the next iteration's; 0: only the newest "
        f"counts, as in the paper; default {PruningOptions.decay:g}",
    )
    group.add_argument(
        "--mapping-a",
        type=float,
        default=PruningOptions.a,
        metavar="X",
        help="the smaller, the later go splats whose removal improves the match; default "
        f"{PruningOptions.a:g}, the paper's",
    )
    add_memory_option(group)
    add_device_options(group)


def add_memory_option(p: argparse._ActionsContainer) -> None:
    p.add_argument(
        "--memory",
        type=float,
        metavar="GB",
        help="GiB of device memory to keep views in; default: half of it, 0.3 of a CPU's",
    )


def add_compaction_options(p: argparse._ActionsContainer) -> None:
    p.add_argument("--lambda", dest="lam", type=float, metavar="X", help="how strongly AC coefficients are pulled to 0")
    p.add_argument(
        "--alpha", type=float, metavar="X", help="cosine above which two coefficients count as one; 1: never"
    )
    p.add_argument(
        "--colour-model",
        choices=get_args(ColourModel),
        default=CompactionOptions.colour_model,
        help="channels to make sparse, each on its own; ycocg pulls Co and Cg three times as hard; "
        f"default {CompactionOptions.colour_model}",
    )
    p.add_argument(
        "--weighting",
        choices=get_args(Weighting),
        default=CompactionOptions.weighting,
        help="a view counts as much as it shows of the splat (importance), or as any other that sees it (visibility); "
        f"default {CompactionOptions.weighting}",
    )
    p.add_argument(
        "--one-pass",
        action="store_true",
        help="do not solve again without the coefficients that would be quantised to 0",
    )


def compaction_choices(args: argparse.Namespace) -> dict[str, Any]:
    """What :func:`add_compaction_options` added, as keywords of EncodeOptions."""
    return {
        "lam": args.lam,
        "alpha": args.alpha,
        "colour_model": args.colour_model,
        "weighting": args.weighting,
        "two_pass": not args.one_pass,
    }


def add_device_options(p: argparse._ActionsContainer) -> None:
    p.add_argument(
        "--background",
        default="black",
        metavar="COLOUR",
        help="R,G,B from 0 to 1, a name, or #rrggbb; default black",
    )
    p.add_argument(
        "--device",
        metavar="DEVICE",
        help="index, part of a name, cpu or gpu, as the command devices lists them; "
        f"default: ${DEVICE_VARIABLE}, else the one that should be fastest",
    )


def add_rendering_options(p: argparse.ArgumentParser) -> None:
    """What every command that renders understands."""
    add_device_options(p)
    p.add_argument(
        "--rules",
        choices=tuple(RULES),
        default="inria",
        help="whose rasterizer to follow; default inria, the original",
    )


def add_view_options(p: argparse.ArgumentParser, default: str) -> None:
    which = p.add_mutually_exclusive_group()
    which.add_argument("--views", nargs="+", metavar="VIEW", help="names, or indices from 0 in the cameras' order")
    which.add_argument("--split", choices=("train", "test", "all"), help=f"default: {default}")
