"""Judge a scene by pictures: :func:`compare`, and its result, which shows the worst view in notebooks."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from potr_cl.api.inputs import (
    CamerasSource,
    ColourSource,
    SceneSource,
    bytes_of_source,
    coded_scene,
    colour_of,
    drawable_of,
    drawable_to_judge,
    name_of,
    rules_of,
    scene_of,
)
from potr_cl.api.pictures import png_bytes
from potr_cl.api.views import ViewChoices, Viewpoints, describe_views, warn_of_frame
from potr_cl.errors import UsageError
from potr_cl.formats.images import Colour, write_png
from potr_cl.host.atomic_write import replacing
from potr_cl.model.camera import Camera, within_photographs
from potr_cl.opencl.discovery import list_devices
from potr_cl.plain_text import plain
from potr_cl.quality.compare import (
    Comparison,
    SceneFile,
    comparing,
    comparison_of,
    comparison_report,
    format_comparison,
    format_sizes,
    mean_view,
    size_report,
)
from potr_cl.quality.figures import ViewFigures
from potr_cl.quality.judging import Judging, Looks
from potr_cl.quality.metrics import Lpips
from potr_cl.quality.photographs import find_ground_truth, missing_photographs
from potr_cl.raster.rules import RULES, RasterRules
from potr_cl.raster.scene_buffers import Drawable
from potr_cl.report.labels import U8, comparison_picture, shrunk
from potr_cl.workers.host import ClusterSource, DevicesSource, Workers, open_workers

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from potr_cl.outputs.output import CodedScene
    from potr_cl.viewer.server import Viewer

#: Pixels that a notebook's picture is wide at most: it is kept in the notebook.
_SHOWN = 960


@dataclass(frozen=True, repr=False)
class SceneComparison:
    """What one scene's pictures are worth against another's.

    Attributes:
        a, b: the reference and the candidate.
        figures: of all views.
        picture: (H, W, 3) uint8, the worst view: A, B and their difference, labelled.
        factor: by which the difference is amplified in it.
        settings: device, rules and background.
        notes: what else there is to say, a line each.
        compared: what :meth:`show` shows, keywords of :func:`potr_cl.view`.
    """

    a: SceneFile
    b: SceneFile
    figures: Comparison
    picture: U8
    factor: int
    settings: dict[str, Any]
    notes: list[str]
    compared: dict[str, Any] = field(default_factory=dict)

    @property
    def mean(self) -> ViewFigures:
        """Means over the views, see :func:`potr_cl.quality.compare.mean_view`."""
        return mean_view(self.figures.views)

    @property
    def psnr(self) -> float:
        """Mean over the views of the PSNR of B against A in decibels; infinite if all pictures are identical."""
        return self.mean.figures["b_against_a"].psnr

    @property
    def ssim(self) -> float:
        """Mean over the views of the SSIM of B against A."""
        return self.mean.figures["b_against_a"].ssim

    @property
    def worst(self) -> ViewFigures:
        """The view with the lowest PSNR of B against A."""
        return self.figures.views[self.figures.worst]

    @property
    def caption(self) -> str:
        """What the picture shows, in words."""
        return f"view {self.worst.name}: A, B and their difference times {self.factor}"

    def report(self) -> dict[str, Any]:
        """All figures, ready for JSON."""
        return {
            **size_report(self.a, self.b),
            **self.settings,
            **comparison_report(self.figures),
            "notes": self.notes,
        }

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the picture of the worst view as PNG.

        Raises:
            UsageError: it cannot be written there.
        """
        with replacing(path) as file:
            self.write_picture(file)

    def write_picture(self, file: Any) -> None:
        """Write the picture of the worst view as PNG to an open binary file."""
        names = f"A is {self.a.path.name}, B is {self.b.path.name}"
        write_png(file, self.picture, plain(f"{self.caption}; {names}"))

    def show(self, **choices: Any) -> Viewer:
        """Show both scenes in the browser, in a notebook below the cell, as :func:`potr_cl.view` does.

        Args:
            choices: keywords of :func:`potr_cl.view`.

        Raises:
            As :func:`potr_cl.view`.
        """
        from potr_cl.api.viewing import view

        return view(**{**self.compared, **choices})

    def __repr__(self) -> str:
        views = f"{len(self.figures.views)} view{'s' if len(self.figures.views) > 1 else ''}"
        ratio = f"{self.a.nbytes / self.b.nbytes:.3g} times smaller"
        worst = f"worst {self.worst.figures['b_against_a'].psnr:.2f} dB in '{self.worst.name}'"
        return f"SceneComparison({views}, PSNR {self.psnr:.2f} dB, SSIM {self.ssim:.4f}, {worst}, {ratio})"

    def __str__(self) -> str:
        """The tables that the command ``compare`` prints."""
        return "\n\n".join([format_sizes(self.a, self.b), format_comparison(self.figures), "\n".join(self.notes)])

    def _repr_png_(self) -> bytes:
        return png_bytes(shrunk(self.picture, _SHOWN))


def compare(
    a: SceneSource,
    b: SceneSource,
    cameras: CamerasSource | None = None,
    *,
    truth: str | os.PathLike[str] | None = None,
    lpips: bool = False,
    output: str | os.PathLike[str] | None = None,
    device: DevicesSource = None,
    cluster: ClusterSource = None,
    rules: RasterRules | str = "inria",
    background: ColourSource = "black",
    trust: bool = False,
    antialiased: bool | None = None,
    progress: Callable[[str, float], None] | None = None,
    **views: Unpack[ViewChoices],
) -> SceneComparison:
    """Render two scenes from the same views and compare, as the command ``compare`` does.

    Args:
        a: the uncompressed scene, or its file.
        b: the one to judge: a scene, a file, or the result of :func:`potr_cl.encode`.
        cameras: or their file; None: views are placed around A.
        truth: a folder of photographs named after the views: A and B are judged by them too.
        lpips: whether to tell LPIPS too, which needs the extra ``lpips``.
        output: a PNG file to write: the worst view of A, of B, and their difference, labelled.
        device: to render on, or what it is called. Several share the views out: a list, "all", or "0,1".
        cluster: a Dask cluster whose workers share the views out: its scheduler's address, or a client. With
            photographs, or with LPIPS, the device of this computer does all.
        rules: of the rasterizer to follow: inria or gsplat.
        background: R, G, B from 0 to 1, or a colour's name.
        trust, antialiased: as of :func:`potr_cl.load_scene`.
        progress: called with what is done and the part of it that is done.
        views: ``views``, names or indices of views; ``split``, "train", "test" or "all", by default the test views, or
            all if there are none; ``virtual_views``, ``turntable``, ``up`` and ``size`` of the views that are placed,
            see :func:`potr_cl.render`.

    Raises:
        UsageError: an option is out of range or contradicts another, or a photograph is missing.
        DataError: a file is damaged.
        DeviceError: a view does not fit the device, or the device failed.
    """
    colour, wanted = colour_of(background), rules_of(rules)
    points = Viewpoints(**views)
    given = points.given(cameras)
    if given is None and truth is not None:
        raise UsageError("--truth needs --cameras, the views that the photographs show")
    # Views are placed in a scene that the host has.
    source_a = a if given is not None else scene_of(a, trust, antialiased)
    with contextlib.ExitStack() as stack:
        workers = stack.enter_context(open_workers(device, cluster))
        there = given or points.judging(scene_of(source_a), workers.device)
        chosen = points.chosen(there)
        coded = [coded_for(workers, each, trust) if antialiased is None else None for each in (source_a, b)]
        drawables = []
        for source, shown, read in zip((a, b), (source_a, b), coded, strict=True):
            how = shown, workers.device, trust, antialiased, read
            if given is None:
                drawables.append(stack.enter_context(drawable_of(*how)))
            else:
                drawable, judged = stack.enter_context(drawable_to_judge(*how))
                warn_of_frame(source, judged, chosen)
                drawables.append(drawable)
        scene_a, scene_b = drawables
        comparison = compare_scenes(
            (named(a, scene_a), scene_a),
            (named(b, scene_b), scene_b),
            chosen,
            workers=workers,
            rules=wanted,
            background=colour,
            truth=None if truth is None else Path(truth),
            lpips=lpips,
            progress=progress,
            notes=[]
            if given
            else [f"no --cameras given: {describe_views(there)}; files encoded with cameras look best from those"],
            coded=coded,
        )
    if output is not None:
        comparison.save(output)
    return comparison


def compare_sizes(
    a: SceneSource, b: SceneSource, trust: bool = False, antialiased: bool | None = None
) -> tuple[dict[str, Any], str] | None:
    """Facts and a table of two scenes where there is no OpenCL device; None where there is one."""
    if list_devices():
        return None
    files = [named(each, scene_of(each, trust, antialiased)) for each in (a, b)]
    return size_report(*files), format_sizes(*files)


def named(source: SceneSource, scene: Drawable) -> SceneFile:
    """The facts of a scene; one that comes from no file counts with the bytes of its arrays."""
    nbytes = bytes_of_source(source)
    nbytes = scene.nbytes if nbytes is None else nbytes
    return SceneFile(name_of(source), nbytes, len(scene), scene.sh_degree, scene.antialiased)


def coded_for(workers: Workers, source: SceneSource, trust: bool = False) -> CodedScene | None:
    """The .potr file that a source stands for, where other computers need it, who decode it for themselves.

    None for anything else.

    Raises:
        As :func:`potr_cl.api.inputs.coded_scene`.
    """
    far = workers.pool is not None and not workers.pool.in_process
    return coded_scene(source, trust) if far else None


def compare_scenes(
    a: tuple[SceneFile, Drawable],
    b: tuple[SceneFile, Drawable],
    views: Sequence[Camera],
    *,
    workers: Workers,
    rules: RasterRules,
    background: Colour,
    truth: Path | None = None,
    lpips: bool = False,
    progress: Callable[[str, float], None] | None = None,
    notes: Sequence[str] = (),
    coded: Sequence[CodedScene | None] = (None, None),
) -> SceneComparison:
    """The same for scenes that have been read and views that have been chosen.

    Args:
        workers: that do it.
        coded: the files of both scenes, see :func:`coded_for`; None: they are sent themselves.

    Raises:
        As :func:`compare`.
    """
    metric = Lpips() if lpips else None  # what is missing is reported before the work
    views = within_photographs(views) if truth is not None else views
    ground_truth = find_ground_truth(truth, views) if truth is not None else None
    told_of = list(notes)
    if ground_truth is not None:
        told_of += filter(None, [missing_photographs(ground_truth, views)])
        views = [view for view in views if view.name in ground_truth]
    if a[1].antialiased != b[1].antialiased:
        ways = " and ".join(
            f"{name} is rendered {'with' if scene.antialiased else 'without'} antialiasing"
            for name, scene in (("A", a[1]), ("B", b[1]))
        )
        told_of.append(f"warning: {ways}, as the files say: give --antialiased yes or no to render both alike")
    opened, tell, stage = workers.device, progress or (lambda _stage, _done: None), comparing(len(views))
    looks = Looks(background, rules, ground_truth, metric)
    tell(stage, 0.0)
    with Judging(opened, a[1], views, looks, workers.pool, anyway=True, coded=coded[0]) as judging:
        found = judging.figures(b[1], None, coded[1], lambda done: tell(stage, done))
        figures = comparison_of(found)
        worst = figures.views[figures.worst]
        ((picture_a, picture_b),) = judging.pictures(b[1], [figures.worst])
    psnr = None if worst.identical else worst.figures["b_against_a"].psnr
    picture, factor = comparison_picture(picture_a, picture_b, worst.name, psnr, (a[0].path.name, b[0].path.name))
    called = next((name for name, known in RULES.items() if known == rules), "own")
    settings = {"device": opened.info.name, "rules": called, "background": background}
    shown = {
        "a": a[1],
        "b": b[1],
        "cameras": list(views),
        "truth": truth,
        "device": opened,
        "rules": rules,
        "background": background,
    }
    return SceneComparison(a[0], b[0], figures, picture, factor, settings, told_of, shown)
