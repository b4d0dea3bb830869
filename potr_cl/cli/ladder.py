"""``encode --ladder``: one scene at several qualities, into a folder."""

from __future__ import annotations

import argparse
import contextlib
from pathlib import Path

from potr_cl.api.ladder import ladder_files, make_ladder
from potr_cl.cli.forecasts import tell_what_is_ahead
from potr_cl.cli.guard import StandardInput, StandardOutput, WrittenFolder, check_files
from potr_cl.cli.progress import Progress
from potr_cl.cli.scenes import read_scene, size_of_file
from potr_cl.cli.terminal import note, say_document, say_done
from potr_cl.cli.views import given_cameras, virtual_cameras
from potr_cl.errors import UsageError
from potr_cl.formats.ladder import Ladder, qualities
from potr_cl.formats.registry import extensions
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.report.summary import decibels
from potr_cl.workers.opening import open_workers


def encode_ladder(args: argparse.Namespace, options: EncodeOptions) -> None:
    """Do what the arguments of ``encode`` ask for with ``--ladder``.

    Raises:
        UsageError: they ask for what a ladder has not; and as :func:`potr_cl.encode_ladder`.
    """
    steps = qualities(args.ladder)
    if args.report is not None:
        raise UsageError("--report is about one file: leave out --ladder")
    if len(args.scenes) > 1:
        raise UsageError("--ladder is of one scene: encode one at a time")
    (source,) = args.scenes
    args.scene = source
    folder = _folder(args.output)
    name = Path("scene") if isinstance(source, StandardInput) else Path(source)
    check_files(args, ladder_files(folder, name, steps, options.output.suffix))
    options = options.changed(source_bytes=size_of_file(source))
    cameras = given_cameras(args)
    with Progress() as progress, contextlib.ExitStack() as stack:
        scene = read_scene(args, source)
        looks = options.look_at_views(scene)
        workers = None
        if looks or not (cameras is None or args.no_quality):
            workers = stack.enter_context(open_workers(args.device, args.cluster))
        device, pool = (None, None) if workers is None else (workers.device, workers.pool)
        if cameras is None and looks and device is not None:
            cameras = virtual_cameras(args, scene, progress, device)
        if device is not None and cameras is not None:
            tell_what_is_ahead(device, scene, cameras, options)
            note(f"encoding {len(steps)} qualities: about {len(steps)} times as long", "detail")
        ladder = make_ladder(
            scene, name, cameras, options, steps, folder, device, progress, progress.tell, args.trust,
            judged=not args.no_quality, pool=pool,
        )  # fmt: skip
    if args.json:
        say_document(ladder.document())
    else:
        say_done(_table(ladder))


def _folder(output: Path) -> Path:
    if isinstance(output, StandardOutput):
        raise UsageError("--ladder writes several files: give -o a folder")
    if not isinstance(output, WrittenFolder) and (output.exists() or output.suffix.lower() in extensions()):
        raise UsageError(f"--ladder writes several files: give -o a folder instead of '{output}'")
    return output


def _table(ladder: Ladder) -> str:
    """What a user may choose from."""
    rows = [f"{'q':>8}{'bytes':>14}{'splats':>12}{'PSNR':>12}{'SSIM':>9}"]
    for rung in ladder.rungs:
        judged = rung.ssim is not None
        psnr, ssim = (decibels(rung.psnr), f"{rung.ssim:.4f}") if judged else ("–", "–")
        rows.append(f"{rung.q:>8g}{rung.bytes:>14,}{rung.splats:>12,}{psnr:>12}{ssim:>9}")
    if ladder.judged_by:
        rows.append(f"judged by {ladder.judged_by}")
    return "\n".join([*rows, f"look at them: potr-cl view SCENE {ladder.path.parent}"])
