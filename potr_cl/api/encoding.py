"""A whole encode in one call, with the options of the command line: :func:`encode`, :func:`encode_ladder`."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from potr_cl.api.choices import EncodeChoices, encode_options, encode_target, output_choice
from potr_cl.api.encoder import Encoder
from potr_cl.api.inputs import CamerasSource, SceneSource
from potr_cl.codec.quantize import Preset
from potr_cl.formats.ladder import Ladder, qualities
from potr_cl.outputs.output import Output
from potr_cl.pipeline.encoded import Encoded
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.target import Target
from potr_cl.stages.stage import Progress
from potr_cl.workers.host import DevicesSource

if TYPE_CHECKING:
    from typing_extensions import Unpack


def encode(
    scene: SceneSource,
    cameras: CamerasSource | None = None,
    options: EncodeOptions | None = None,
    progress: Progress | None = None,
    device: DevicesSource = None,
    *,
    q: float | None = None,
    max_size: int | str | None = None,
    min_psnr: float | None = None,
    preset: Preset | None = None,
    output: str | os.PathLike[str] | None = None,
    report: str | os.PathLike[str] | None = None,
    report_view: str | None = None,
    judge: bool | None = None,
    **choices: Unpack[EncodeChoices],
) -> Encoded:
    """Compress a scene. ``print(result.report)`` shows what the command ``encode`` prints.

    Args:
        scene: to encode, or its file.
        cameras: the training cameras, or their file; without them virtual ones are placed.
        q: quality, 0 (smallest) to 1 (best); 0.5 by default.
        max_size: find the quality that fills this size: bytes, or a text such as "8MB".
        min_psnr: find the quality that just reaches this PSNR in decibels against the uncompressed scene.
        preset: best (default), smallest, fast or paper.
        output: the file to write; its suffix tells the format: .potr, .spz, .sog, .ply …
        report: a page of HTML to write: sizes, quality by view, pictures before and after.
        report_view: an additional view to show there.
        judge: measure PSNR and SSIM of the result; by default if there is a report to write.
        device: an index, part of a name, "cpu" or "gpu"; several share the views: "all", "0,1", or a list.
        progress: called with what is done and the part of it that is done.
        options: all options as one object, instead of keywords or to be changed by them.
        choices: options of stages by the names of their flags (``keep=0.5`` is ``--keep 0.5``, ``prune=False`` is
            ``--no-prune``, ``lambda_`` is ``--lambda``), or all of a stage: ``prune={"iterations": 16}``.
            help(potr_cl.EncodeChoices) lists them with those that are seldom needed: to, virtual_views, memory,
            background, threads, trust, antialiased, cluster, cameras_anyway.

    Raises:
        UsageError: an option is unknown or out of range, or contradicts another; no camera is a training view.
        UnreachableError: no quality meets ``max_size`` or ``min_psnr``.
        DataError: a file is damaged, or a value is too large to quantise.
        DeviceError: no device does the work.
    """
    kind = _kind(output, choices)
    judge = report is not None if judge is None else judge
    target = encode_target(q, max_size, min_psnr)
    with _encoder(options, preset, choices, target, cameras, device, judge, q=q, output=kind) as encoder:
        return encoder(scene, output, report=report, report_view=report_view, progress=progress)


def encode_ladder(
    scene: SceneSource,
    output: str | os.PathLike[str],
    ladder: str | Sequence[float],
    cameras: CamerasSource | None = None,
    options: EncodeOptions | None = None,
    progress: Progress | None = None,
    device: DevicesSource = None,
    *,
    preset: Preset | None = None,
    judge: bool = True,
    **choices: Unpack[EncodeChoices],
) -> Ladder:
    """Encode a scene at several qualities, and judge each, as the command ``encode --ladder`` does.

    Each file has the bytes that :func:`potr_cl.encode` makes at its q. ``potr_cl.view(scene, result)`` shows the result
    with a slider.

    Args:
        scene: to encode, or its file.
        output: a folder for the files and their ladder.json; it is made if need be.
        ladder: the qualities, 0 to 1: a list, or a text such as "0.1,0.3,0.5".
        cameras, options, progress, device, preset, judge, choices: as of :func:`potr_cl.encode`.

    Raises:
        UsageError: an option is out of range or contradicts another, or the folder cannot be written to.
        DataError, DeviceError: as of :func:`potr_cl.encode`.
    """
    steps = qualities(ladder)
    kind = _kind(None, choices)
    with _encoder(options, preset, choices, None, cameras, device, judge, output=kind) as encoder:
        return encoder.ladder(scene, steps, Path(output), progress=progress)


def _kind(path: str | os.PathLike[str] | None, choices: EncodeChoices) -> Output | None:
    version, title = choices.pop("spz_version", None), choices.pop("title", None)
    return output_choice(
        path, choices.pop("to", None), version=version, title=title, author=choices.pop("author", None)
    )


def _encoder(
    options: EncodeOptions | None,
    preset: Preset | None,
    choices: EncodeChoices,
    target: Target | None,
    cameras: CamerasSource | None,
    device: DevicesSource,
    judge: bool,
    **own: Any,
) -> Encoder:
    left: dict[str, Any] = {**choices}
    own |= {name: left.pop(name, None) for name in ("background", "memory", "threads", "cameras_anyway")}
    others = {name: left.pop(name) for name in ("virtual_views", "cluster", "trust", "antialiased") if name in left}
    settings = encode_options(options, preset, left, **own)
    return Encoder(settings, target, cameras, device=device, judge=judge, **others)
