"""Scenes in levels of detail judged by what is shown of them for a budget of splats: :func:`compare_budgets`."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.api.inputs import (
    CamerasSource,
    ColourSource,
    SceneSource,
    bytes_of_source,
    colour_of,
    encoded_bytes,
    holds_potr,
    name_of,
    rules_of,
    scene_of,
)
from potr_cl.api.views import ViewChoices, Viewpoints, describe_views, warn_of_frame
from potr_cl.codec.decoder import decode, open_file
from potr_cl.codec.levels import splats_of_levels
from potr_cl.errors import UsageError
from potr_cl.formats.images import write_png
from potr_cl.formats.scenes import sog_levels
from potr_cl.formats.scenes.scene_files import file_in_folder
from potr_cl.host.atomic_write import replacing
from potr_cl.levels.budgets import CHOICES, Levelled, Levels
from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.plain_text import plain
from potr_cl.quality.compare import mean_view
from potr_cl.quality.figures import ViewFigures
from potr_cl.quality.judging import Judging, Looks
from potr_cl.raster.rules import RULES, RasterRules
from potr_cl.report.budgets import budgets_page
from potr_cl.report.labels import U8, comparison_picture
from potr_cl.workers.host import DevicesSource, open_workers

if TYPE_CHECKING:
    from typing_extensions import Unpack

_AGAINST = "b_against_a"


@dataclass(frozen=True)
class LevelledFile:
    """What there is to say of a scene in levels of detail.

    Attributes:
        path: of the scene.
        nbytes: of all its files.
        counts: splats of each level, the finest first.
        leaves: parts that have levels of their own.
    """

    path: Path
    nbytes: int
    counts: tuple[int, ...]
    leaves: int


@dataclass(frozen=True)
class Shown:
    """What is shown of a scene for a budget.

    Attributes:
        file: number of the scene.
        budget: splats.
        by: how levels are chosen, "distance" or "errors".
        views: figures of each view.
        splats: shown in each view.
    """

    file: int
    budget: int
    by: str
    views: list[ViewFigures]
    splats: list[int]

    @property
    def psnr(self) -> float:
        """Mean over the views, see :func:`potr_cl.quality.compare.mean_view`."""
        return mean_view(self.views).figures[_AGAINST].psnr

    @property
    def worst(self) -> float:
        """The lowest PSNR of a view."""
        return min(view.figures[_AGAINST].psnr for view in self.views)


@dataclass(frozen=True, repr=False)
class BudgetComparison:
    """What scenes in levels of detail are worth for budgets of splats.

    Attributes:
        a: the reference.
        files: the scenes.
        shown: for each budget, scene and choice.
        picture: (H, W, 3) uint8, the worst view of all: A, what is shown, and the difference, labelled.
        settings: device, rules and background.
        notes: what else there is to say, a line each.
    """

    a: Path
    files: list[LevelledFile]
    shown: list[Shown]
    picture: U8
    caption: str
    settings: dict[str, Any]
    notes: list[str] = field(default_factory=list)

    def report(self) -> dict[str, Any]:
        """All figures, ready for JSON; a PSNR of null means that pictures are identical."""

        def number(value: float) -> float | None:
            return value if math.isfinite(value) else None

        def entry(shown: Shown) -> dict[str, Any]:
            return {
                "budget": shown.budget,
                "file": str(self.files[shown.file].path),
                "levels_by": shown.by,
                "splats": float(np.mean(shown.splats)),
                "psnr": number(shown.psnr),
                "ssim": mean_view(shown.views).figures[_AGAINST].ssim,
                "worst_psnr": number(shown.worst),
                "views": [
                    {"name": view.name, "splats": splats, "psnr": number(view.figures[_AGAINST].psnr)}
                    for view, splats in zip(shown.views, shown.splats, strict=True)
                ],
            }

        files = [
            {"file": str(file.path), "bytes": file.nbytes, "splats": list(file.counts), "leaves": file.leaves}
            for file in self.files
        ]
        shown = [entry(each) for each in self.shown]
        return {"a": str(self.a), "files": files, "budgets": shown, **self.settings, "notes": self.notes}

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the picture of the worst view as PNG.

        Raises:
            UsageError: it cannot be written there.
        """
        with replacing(path) as file:
            self.write_picture(file)

    def write_picture(self, file: Any) -> None:
        """Write the picture of the worst view as PNG to an open binary file."""
        write_png(file, self.picture, plain(self.caption))

    def write_page(self, file: Any) -> None:
        """Write a web page with the curves of PSNR by splats shown to an open binary file."""
        file.write(budgets_page(self.report(), self.picture, plain(self.caption)).encode())

    def __repr__(self) -> str:
        budgets = sorted({each.budget for each in self.shown})
        return f"BudgetComparison({len(self.files)} scenes, budgets of {', '.join(f'{n:,}' for n in budgets)} splats)"

    def __str__(self) -> str:
        """The tables that the command ``compare`` prints."""
        width = max(len(str(file.path)) for file in self.files)
        lines = [f"{'':{width}}{'bytes':>15}{'leaves':>8}  splats of each level"]
        for file in self.files:
            counts = ", ".join(f"{count:,}" for count in file.counts)
            lines.append(f"{file.path!s:{width}}{file.nbytes:>15,}{file.leaves:>8,}  {counts}")
        head = f"{'budget':>12}  {'':{width}}  {'levels by':<9}{'splats shown':>14}{'PSNR dB':>11}{'worst':>11}"
        lines += ["", head]
        for each in self.shown:
            figures = "".join(f"{_decibels(value):>11}" for value in (each.psnr, each.worst))
            name, splats = self.files[each.file].path, round(float(np.mean(each.splats)))
            lines.append(f"{each.budget:>12,}  {name!s:{width}}  {each.by:<9}{splats:>14,}{figures}")
        return "\n".join([*lines, *(["", *self.notes] if self.notes else [])])


def _decibels(value: float) -> str:
    return f"{value:.2f}" if math.isfinite(value) else "identical"


def compare_budgets(
    a: SceneSource,
    scenes: SceneSource | Sequence[SceneSource],
    budgets: int | Sequence[int],
    cameras: CamerasSource | None = None,
    *,
    output: str | os.PathLike[str] | None = None,
    device: DevicesSource = None,
    rules: RasterRules | str = "inria",
    background: ColourSource = "black",
    trust: bool = False,
    antialiased: bool | None = None,
    progress: Callable[[str, float], None] | None = None,
    **views: Unpack[ViewChoices],
) -> BudgetComparison:
    """Compare what a viewer would show of scenes in levels of detail, as the command ``compare --budget`` does.

    Args:
        a: the uncompressed scene, or its file.
        scenes: to judge, one or several: streamed SOG, whose leaves have levels of their own; .potr files, of which a
            view shows one level; or scenes of a single level.
        budgets: how many splats may be shown.
        cameras, device, rules, background, trust, antialiased, views: as of :func:`potr_cl.compare`.
        output: a PNG file to write: the worst view of A, of what is shown, and their difference, labelled.
        progress: called with what is done and the part of it that is done.

    Raises:
        As :func:`potr_cl.compare`.
    """
    files: list[Any] = list(scenes) if isinstance(scenes, (list, tuple)) else [scenes]
    wanted = sorted({budgets} if isinstance(budgets, int) else set(budgets), reverse=True)
    if not files or not wanted or wanted[-1] < 1:
        raise UsageError("--budget compares one scene or more, for numbers of splats of 1 or more")
    points = Viewpoints(**views)
    given = points.given(cameras)
    looks = Looks(colour_of(background), rules_of(rules), remember=True)
    levels, scene = [levelled(file, trust) for file in files], scene_of(a, trust, antialiased)
    with open_workers(device) as workers:
        there = given or points.judging(scene, workers.device)
        chosen = points.chosen(there)
        if given is not None:
            warn_of_frame(a, scene, chosen)
        with Judging(workers.device, scene, chosen, looks, workers.pool, anyway=True) as judging:
            result = _Budgets(levels, wanted, chosen, antialiased).judged(
                judging, progress or (lambda what, done: None)
            )
            (number, rows, view), shown = result
            ((before, after),) = judging.pictures(levels[number].shown(rows).rendered(antialiased), [view])
        name = workers.device.info.name
    psnr = min(each.worst for each in shown)
    names = name_of(a).name, name_of(files[number]).name
    labelled = chosen[view].name, psnr if math.isfinite(psnr) else None
    picture, factor = comparison_picture(before, after, *labelled, names)
    called = next((name for name, known in RULES.items() if known == looks.rules), "own")
    comparison = BudgetComparison(
        name_of(a),
        [_described(file, each) for file, each in zip(files, levels, strict=True)],
        shown,
        picture,
        f"view {chosen[view].name}: {names[0]}, {names[1]} and their difference times {factor}",
        {"device": name, "rules": called, "background": looks.background},
        [] if given else [f"no --cameras given: {describe_views(there)}"],
    )
    if output is not None:
        comparison.save(output)
    return comparison


@dataclass(frozen=True)
class _Budgets:
    """What is shown of some scenes, for some budgets, in some views."""

    scenes: Sequence[Levelled]
    budgets: Sequence[int]
    views: Sequence[Camera]
    antialiased: bool | None

    def judged(
        self, judging: Judging, tell: Callable[[str, float], None]
    ) -> tuple[tuple[int, Levels, int], list[Shown]]:
        """Scene, levels and view of the worst picture; and the figures."""
        plan = [
            (number, budget, by, [choose(scene, view, budget) for view in self.views])
            for budget in self.budgets
            for number, scene in enumerate(self.scenes)
            for by, choose in CHOICES.items()
            if by != "errors" or scene.errors is not None
        ]
        # Many views, and budgets, show the same.
        unique: dict[tuple[int, bytes], tuple[Levels, set[int]]] = {}
        for number, _, _, chosen in plan:
            for view, levels in enumerate(chosen):
                unique.setdefault((number, levels.tobytes()), (levels, set()))[1].add(view)
        total, stage = sum(len(views) for _, views in unique.values()), "comparing levels"
        tell(stage, 0.0)
        found: dict[tuple[int, bytes, int], tuple[ViewFigures, int]] = {}
        for (number, key), (levels, some) in unique.items():
            scene, views = self.scenes[number].shown(levels).rendered(self.antialiased), sorted(some)
            for view, figures in zip(views, judging.figures(scene, views), strict=True):
                found[number, key, view] = figures, len(scene)
            tell(stage, len(found) / total)
        shown = []
        for number, budget, by, chosen in plan:
            own = [found[number, levels.tobytes(), view] for view, levels in enumerate(chosen)]
            shown.append(Shown(number, budget, by, [each for each, _ in own], [count for _, count in own]))
        number, key, view = min(found, key=lambda which: found[which][0].figures[_AGAINST].psnr)
        return (number, unique[number, key][0], view), shown


def _described(source: SceneSource, scene: Levelled) -> LevelledFile:
    counts = tuple(scene.counts.sum(axis=0).tolist())
    return LevelledFile(name_of(source), bytes_of_source(source) or 0, counts, len(scene.counts))


def levelled(source: SceneSource, trust: bool = False) -> Levelled:
    """The levels of detail that a source has; a scene of one level otherwise.

    Raises:
        As :func:`potr_cl.load_scene`.
    """
    path = source if isinstance(source, (str, os.PathLike)) else None
    if path is not None and file_in_folder(path, sog_levels.DESCRIPTION) is not None:
        return sog_levels.StreamedScene(path, trust)
    data: Any = encoded_bytes(source)
    if data is None and path is not None and holds_potr(Path(path)):
        data = path
    if data is not None:
        counts = splats_of_levels(open_file(data, trust))
        return _Whole(counts, lambda level: decode(data, trust, level=level))
    scene = scene_of(source, trust)
    return _Whole([len(scene)], lambda level: scene)


class _Whole:
    """A :class:`potr_cl.levels.budgets.Levelled` of a single leaf, and so wherever that is."""

    errors: NDArray[np.float64] | None = None

    def __init__(self, counts: Sequence[int], load: Callable[[int], Scene]) -> None:
        self.boxes, self.counts = np.zeros((1, 6)), np.array([counts], np.int64)
        self._load = load

    def shown(self, levels: Levels) -> Scene:
        return self._load(int(levels[0]))
