"""A scene at several qualities in one call (:func:`encode_ladder`): files for a user to choose from by eye."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from potr_cl.api.choices import EncodeChoices, with_choices
from potr_cl.api.encoding import Judge, encode_options, output_choice, photographs_of, views_or_placed
from potr_cl.api.inputs import (
    CamerasSource,
    ColourSource,
    SceneSource,
    bytes_of_source,
    cameras_of,
    name_of,
    scene_of,
)
from potr_cl.codec.quantize import Preset
from potr_cl.errors import UsageError
from potr_cl.formats.ladder import DESCRIPTION, Ladder, Rung, qualities
from potr_cl.formats.registry import stem_of_scene
from potr_cl.host.atomic_write import replacing
from potr_cl.host.mapped import bounded
from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.pipeline.encode import encode as run_stages
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.pipeline.proof import proved
from potr_cl.pipeline.stopwatch import Stopwatch
from potr_cl.quality.evaluator import EvaluationViews
from potr_cl.raster.kept_scene import KeptScene
from potr_cl.report.summary import decibels
from potr_cl.stages.stage import Progress
from potr_cl.workers.opening import ClusterSource, DevicesSource, open_workers
from potr_cl.workers.pool import Pool

if TYPE_CHECKING:
    from typing_extensions import Unpack


@with_choices(EncodeChoices)
def encode_ladder(
    scene: SceneSource,
    output: str | os.PathLike[str],
    ladder: str | Sequence[float],
    cameras: CamerasSource | None = None,
    options: EncodeOptions | None = None,
    progress: Progress | None = None,
    device: DevicesSource = None,
    *,
    cluster: ClusterSource = None,
    preset: Preset | None = None,
    virtual_views: int | None = None,
    to: str | None = None,
    spz_version: int | None = None,
    title: str | None = None,
    author: str | None = None,
    background: ColourSource | None = None,
    memory: float | None = None,
    threads: int | None = None,
    trust: bool = False,
    antialiased: bool | None = None,
    cameras_anyway: bool | None = None,
    tell: Callable[[str], None] | None = None,
    **choices: Unpack[EncodeChoices],
) -> Ladder:
    """Encode a scene at several qualities, and judge each, as the command ``encode --ladder`` does.

    Each file has the bytes that :func:`potr_cl.encode` makes at its q. The result is what ``potr_cl.view(scene,
    result)`` shows with a slider.

    Args:
        scene: to encode, or its file.
        output: a folder for the files and their ladder.json; it is made if need be.
        ladder: the qualities, 0 to 1: a list, or a text such as "0.1,0.3,0.5".
        cameras, options, progress, device, cluster, preset, virtual_views, background, memory, threads, trust,
            antialiased, cameras_anyway, choices: as of :func:`potr_cl.encode`.
        to, spz_version, title, author: the kind of files, as of :func:`potr_cl.encode`.
        tell: told a line about each file that is written.

    Raises:
        UsageError: an option is out of range or contradicts another, or the folder cannot be written to.
        DataError, DeviceError: as of :func:`potr_cl.encode`.
    """
    steps = qualities(ladder)
    settings = encode_options(
        options, preset, choices, output=output_choice(None, to, version=spz_version, title=title, author=author),
        background=background, memory=memory, threads=threads,
        source_bytes=bytes_of_source(scene), cameras_anyway=cameras_anyway,
    )  # fmt: skip
    given = cameras_of(cameras, virtual_views)
    photographs_of(settings, given)
    with bounded(settings.memory):
        what = scene_of(scene, trust, antialiased)
    looks = settings.look_at_views(what)
    views = views_or_placed(what, given, virtual_views) if looks else given
    name = name_of(scene)
    if not looks and given is None:
        return make_ladder(what, name, views, settings, steps, Path(output), None, progress, tell, trust)
    with open_workers(device, cluster) as workers:
        return make_ladder(
            what, name, views, settings, steps, Path(output), workers.device, progress, tell, trust, pool=workers.pool
        )


def ladder_files(folder: Path, scene: Path, steps: Sequence[float], suffix: str) -> list[Path]:
    """The files that a ladder consists of: those of the qualities, then the description.

    Args:
        folder: that they are in.
        scene: the uncompressed scene's file, which the others are named after.
        steps: the qualities.
        suffix: of the kind of file that is encoded to.

    Raises:
        UsageError: two qualities would have one file.
    """
    stem = stem_of_scene(scene) if scene.suffix or scene.is_dir() else "scene"
    # The description names them, and a name in a file must be printable: this one need not even be UTF-8.
    stem = "".join(each if each.isprintable() else "_" for each in stem)
    names = [f"{stem}_q{q:g}{suffix}" for q in steps]
    if len(set(names)) < len(names):
        raise UsageError("--ladder names qualities that are the same to six digits")
    return [folder / name for name in [*names, DESCRIPTION]]


def make_ladder(
    scene: Scene,
    name: Path,
    cameras: Sequence[Camera] | None,
    options: EncodeOptions,
    steps: Sequence[float],
    folder: Path,
    device: Device | None,
    progress: Progress | None = None,
    tell: Callable[[str], None] | None = None,
    trust: bool = False,
    judged: bool = True,
    pool: Pool | None = None,
) -> Ladder:
    """The same for a scene that has been read and views that have been chosen.

    Args:
        name: of the scene's file.
        steps: the qualities, rising.
        device: None if nothing is to be rendered.
        judged: whether to judge each file.
        pool: workers that views are shared out to, of which the device is the first.

    Raises:
        As :func:`encode_ladder`.
    """
    files = ladder_files(folder, name, steps, options.output.suffix)
    for file in files:
        if file.is_dir():
            raise UsageError(f"cannot write '{file}': it is a directory; write the ladder elsewhere")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"cannot make the folder '{folder}': {error.strerror}") from None
    views = EvaluationViews.of(list(cameras)) if cameras is not None and device is not None and judged else None
    rungs = []
    # The uncompressed scene stays on the device from one quality to the next, where there is room.
    with (
        replacing(files[-1]) as description,  # a folder that takes no file is told before the work
        nullcontext() if device is None else KeptScene(device, scene, options.memory) as kept,
    ):
        for q, file in zip(steps, files[:-1], strict=True):
            encoded = run_stages(scene, cameras, options.changed(q=q), progress, device, kept=kept, pool=pool)
            psnr = ssim = None
            judged_on = None if views is None else encoded.device or device
            with proved(encoded, trust, judged_on) as written:
                nbytes, splats = len(written.data), len(written.scene)
                with replacing(file) as target:
                    target.write(written.data)
                if views is not None and judged_on is not None:
                    judge = Judge(views, judged_on, options.background, kept=kept, pool=pool)
                    quality, _ = judge(scene, written, Stopwatch(progress))
                    psnr, ssim = quality["psnr"], quality["ssim"]
            rungs.append(Rung(q, file.name, nbytes, splats, psnr, ssim))
            if tell is not None:
                figure = "" if views is None else f", {decibels(psnr)}"
                tell(f"{file}: q {q:g}, {nbytes:,} bytes, {splats:,} splats{figure}")
        judged_by = "" if views is None else str(views)
        ladder = Ladder(files[-1], name.name, options.source_bytes, judged_by, tuple(rungs))
        description.write(ladder.encoded())
    return ladder
