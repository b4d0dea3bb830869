"""Do these cameras belong to this scene? :func:`judge_cameras` says; :func:`require_agreement` refuses what does not.

A scene that was turned, shifted or scaled after training, or cameras of another scene: whoever removes what no such
camera misses removes the scene. So both are looked at before anything is thrown away:

Photographs or points of a reconstruction beside the cameras decide (:mod:`potr_cl.quality.evidence`). Where there are
none, little can be told:

- what part of the splats a view shows, and what part of its picture is not background;
- how large a splat is in the picture, as a part of it: far from usual where units differ;
- how much the colours vary towards the view (:mod:`potr_cl.model.sightings`): little, if they were never trained from
  there.

None of these is wrong in itself: a view may see a corner only, an excerpt fills few pixels, and a scene of degree 0
remembers nothing. So what counts is whether the cameras fit *much better* if the scene is moved in one of the ways in
which scenes are moved (:mod:`potr_cl.model.motions`). Cameras for which no such way is better are taken as they are,
unless they see nothing at all, and that is said. docs/benchmarks/frames.md has what this finds, and by which margin.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from potr_cl.errors import UsageError
from potr_cl.model.camera import Camera
from potr_cl.model.motions import LIKELY_MOTIONS, LOOKING_BACK, WRONG_WAY_ROUND, Motion
from potr_cl.model.scene import Scene
from potr_cl.model.sightings import Poses, Sample, ViewStatistics, look, poses, sample, show_nothing

_log = logging.getLogger("potr_cl")

#: Views that are looked at; those of them by which motions are chosen, and how many of these (once by how well they
#: fit, once by how usual they are) are then looked at in all.
_VIEWS, _FEW, _CHOSEN = 16, 4, 3
#: A fit of this or more cannot be surpassed by much: nothing else is tried.
_FINE = -0.9
#: A motion must fit at least so well to be believed in. (Poses written the wrong way round must fit as well as if
#: nothing was wrong: views that look all around from within a scene fit many a reading half as well.)
_PLAUSIBLE = -2.1
#: By how much a motion must fit better with many views, and poses in another convention; and what one view needs on
#: top, which falls with this power of their number. (One view may look at a bare wall.)
_BETTER, _BETTER_MISREAD = 0.42, 1.2
_ALONE, _FALL = 5.0, 1.5
#: Cameras that see no more of the splats may look the wrong way. In rooms they see as much behind them: none can tell.
_TURNED_AWAY = 0.05
#: Of several motions that fit as well but for this, the most usual one is told.
_AS_WELL = 0.35
#: Part of a scene's splats that views must see at least, whatever the rest.
_LEAST_SEEN = 0.005
#: Part of a picture below which it is background and nothing else.
_EMPTY = 1e-4
#: Cameras that see so much of the splats look at the scene, whatever else fits better, if the colours know so many of
#: the views, or if the scene is so small in the pictures that it may be a part of what was photographed.
_WHOLE, _WELL_KNOWN, _SMALL_PART = 0.95, 0.9, 0.05
#: The least that a view can count for: it sees nothing.
_NOTHING = 1e-3
#: From which :attr:`~potr_cl.model.sightings.ViewStatistics.remembered` on the colours know a view, and how much that
#: counts.
_KNOWN, _MEMORY = 0.6, 4.0
#: A typical splat's size, as a part of the picture's, and the factor that is a standard deviation from it.
_USUAL_SIZE, _SIZE_SPREAD = 0.005, 4.0


@dataclass(frozen=True)
class CameraFit:
    """How well cameras suit a scene.

    Attributes:
        total: about 0 at best; a logarithm: 0.7 less is half as plausible in every view.
        seen: part of the scene's splats that any of the views sees.
        covered: part of the pictures that shows the scene and not the background; mean over views.
        known: part of the views that the colours know, of those of which they can tell; None if they tell of none.
        size: of a typical splat, as a part of a picture's size; None where none is seen.
    """

    total: float
    seen: float
    covered: float
    known: float | None
    size: float | None


@dataclass(frozen=True)
class Evidence:
    """What photographs or points of a reconstruction say (:mod:`potr_cl.quality.evidence`).

    Attributes:
        agrees: whether the cameras are in the scene's frame; None if that remains open.
        measured: what that was decided by: the higher, the more speaks for them.
        text: what speaks against it, in a clause; empty if nothing does.
    """

    agrees: bool | None
    measured: float
    text: str = ""


@dataclass(frozen=True)
class Judgement:
    """Whether cameras belong to a scene.

    Attributes:
        evidence: what lies beside the cameras and decides, if it does; None if there is nothing.
        views: that were looked at.
        fit: of the cameras as they are.
        motion: what was done to the scene, most likely, if the cameras are not in its frame; None if no motion that was
            tried fits plausibly, or none had to be tried.
        moved: the fit if that is undone.
        needed: by how much the motion had to fit better to be believed.
        empty: names of those of the views that show nothing of the scene.
    """

    views: int
    fit: CameraFit
    motion: Motion | None = None
    moved: CameraFit | None = None
    needed: float = math.inf
    empty: tuple[str, ...] = ()
    evidence: Evidence | None = None

    @property
    def gain(self) -> float:
        """By how much the motion fits better."""
        return -math.inf if self.moved is None else self.moved.total - self.fit.total

    @property
    def blind(self) -> bool:
        """Whether the views see nothing to speak of."""
        return self.fit.seen < _LEAST_SEEN

    @property
    def suspicious(self) -> bool:
        """Whether the cameras are probably not in the scene's frame."""
        if self.evidence is not None and self.evidence.agrees is not None:
            return not self.evidence.agrees
        return self.blind or self.gain >= self.needed

    @property
    def taken_as_they_are(self) -> bool:
        """Whether there is nothing that could confirm the cameras, and nothing that speaks against them."""
        return self.evidence is None and not self.suspicious

    @property
    def finding(self) -> str:
        """What was found, in a sentence without a full stop; for cameras that are suspicious."""
        fit = self.fit
        facts = [f"{self.views} views see {_percent(fit.seen)} of the splats, {_percent(fit.covered)} of the pictures"]
        if fit.known is not None and fit.known < 1:
            facts.append(f"the colours know {_percent(fit.known)} of the views")
        if self.evidence is not None and self.evidence.agrees is False:
            facts = [self.evidence.text]
        text = f"the cameras do not seem to be in the scene's frame: {', '.join(facts)}"
        if self.motion is None or self.moved is None or self.gain < self.needed:
            return text
        moved = self.moved
        then = f"{_percent(moved.seen)} and {_percent(moved.covered)}"
        if moved.known is not None:
            then += f", {_percent(moved.known)} known"
        return f"{text}; they fit if {self.motion.condition} ({then})"

    @property
    def doubt(self) -> str | None:
        """What is odd about cameras that are taken, in a sentence without a full stop; None if nothing is."""
        if self.suspicious:
            return None
        if self.evidence is not None and self.evidence.agrees is None and self.evidence.text:
            return f"the cameras may not be in the scene's frame: {self.evidence.text}"
        if not self.empty:
            return None
        which = f"'{self.empty[0]}'" if len(self.empty) == 1 else f"'{self.empty[0]}' and others"
        return (
            f"{len(self.empty)} of {self.views} views that were looked at show nothing of the scene ({which}): if "
            "their poses are wrong, leave such views out, for they count as matched without loss"
        )

    @property
    def remedy(self) -> str:
        """What bring both together again, in a few words."""
        undone = "" if self.motion is None or self.gain < self.needed else self.motion.undone
        if undone:
            return f"bring the scene back ({undone})"
        if self.motion is not None and self.gain >= self.needed:
            if self.motion.misread is not None:
                return self.motion.misread.remedy
            return "give the cameras of this scene, or undo what moved it"
        if self.evidence is not None and self.evidence.agrees is False:
            return "undo what moved the scene, or give its own cameras"
        return "give the cameras of this scene"


def judge_cameras(scene: Scene, cameras: Sequence[Camera], evidence: Evidence | None = None) -> Judgement:
    """Judge whether cameras and scene belong together.

    It looks at a sample of the scene through some of the views, on the processor: a tenth of a second, or one where
    there is doubt. The same scene and cameras are judged the same everywhere.

    Args:
        scene: clean, at least one splat.
        cameras: at least one; the training views if only these will be looked at.
        evidence: of what lies beside the cameras. It has the last word: motions only explain it.

    Raises:
        UsageError: there is no camera.
    """
    if not cameras:
        raise UsageError("there is no camera to judge")
    at = sample(scene)
    world = poses(cameras)
    numbers = _spread(len(cameras), _VIEWS)
    some = world.some(numbers)
    sights = look(at, some)
    fit = _fit(sights)
    if fit.seen < _LEAST_SEEN and len(cameras) > len(some.centres):
        # Few of many views may be those that see it: all are asked before it is said that none does.
        more = look(at, world.some(_spread(len(cameras), 6 * _VIEWS)))
        fit = CameraFit(fit.total, float(more.seen.any(axis=0).mean()), fit.covered, fit.known, fit.size)
    views = len(some.centres)
    blank = _empty(scene, some, sights)
    empty = tuple(cameras[number].name for number in numbers[blank])
    # A few stray views among good ones are no sign that the scene was moved.
    others = np.setdiff1d(np.arange(views), blank)
    fine = fit.total >= _FINE or (bool(empty) and len(others) > 0 and _fit(sights.some(others)).total >= _FINE)
    agreed = evidence is not None and evidence.agrees is True
    found = None if fine or agreed else _best_motion(at, some, fit)
    if found is None or (_looked_at(fit) and found[0].scale == 1):
        return Judgement(views, fit, empty=empty, evidence=evidence)
    motion, moved = found
    return Judgement(views, fit, motion, moved, _needed(motion, views), empty, evidence)


def require_agreement(scene: Scene, cameras: Sequence[Camera], evidence: Evidence | None = None) -> None:
    """Refuse cameras that are probably not in the scene's frame.

    What is odd about others, or could not be found out, is told to the logger "potr_cl".

    Args:
        scene: clean, at least one splat.
        cameras: at least one.
        evidence: as of :func:`judge_cameras`.

    Raises:
        UsageError: they are not, with what was found and what can be done.
    """
    judged = judge_cameras(scene, cameras, evidence)
    if judged.suspicious:
        raise UsageError(
            f"{judged.finding}: {judged.remedy}, leave --cameras out (virtual ones are placed), or, if they are right, "
            "--cameras-anyway"
        )
    if judged.doubt is not None:
        _log.warning("%s", judged.doubt)
    elif judged.taken_as_they_are:
        _log.info(
            "no photographs or reconstruction points were found to check the cameras against: the cameras were taken "
            "as they are"
        )


def _fit(sights: ViewStatistics) -> CameraFit:
    share = np.sqrt(sights.seen.mean(axis=1) * sights.covered)
    tells = np.isfinite(sights.remembered)
    memory = np.log(np.clip(np.where(tells, sights.remembered, 1) / _KNOWN, 0.05, 1))
    sizes = sights.sizes[np.isfinite(sights.sizes)]
    size = float(np.median(sizes)) if len(sizes) else None
    odd = 3.0 if size is None else 0.5 * (math.log(max(size, 1e-30) / _USUAL_SIZE) / math.log(_SIZE_SPREAD)) ** 2
    known = float(np.mean(sights.remembered[tells] >= _KNOWN)) if tells.any() else None
    return CameraFit(
        total=float(np.log(np.maximum(share, _NOTHING)).mean() + _MEMORY * memory.mean() - odd),
        seen=float(sights.seen.any(axis=0).mean()),
        covered=float(sights.covered.mean()),
        known=known,
        size=size,
    )


def _empty(scene: Scene, cameras: Poses, sights: ViewStatistics) -> NDArray[np.int64]:
    """Numbers of the views that show nothing of the scene."""
    empty = np.flatnonzero(~sights.seen.any(axis=1) & (sights.covered < _EMPTY))
    return empty[show_nothing(scene, cameras.some(empty))] if len(empty) else empty


def _looked_at(fit: CameraFit) -> bool:
    """Whether the cameras see the whole scene and nothing speaks against them: other axes prove nothing then.

    So it is with a part that was cut out of a scene: seen from the middle it would fill more of the pictures.
    """
    known = fit.known is not None and fit.known >= _WELL_KNOWN
    return fit.seen >= _WHOLE and (known or fit.covered < _SMALL_PART)


def _best_motion(at: Sample, cameras: Poses, fit: CameraFit) -> tuple[Motion, CameraFit] | None:
    """The motion after which the cameras fit best, and how well; None if it is not plausible."""
    views = len(cameras.centres)
    motions = [*LIKELY_MOTIONS, *WRONG_WAY_ROUND]
    if fit.seen < _TURNED_AWAY:
        motions.append(LOOKING_BACK)
    rough = cameras.some(_spread(views, _FEW))
    totals = np.array([_fit(look(at, motion.of(rough))).total for motion in motions])
    # The best ones are looked at closely, and the most usual of those that are as good.
    best = np.argsort(-totals, kind="stable")[:_CHOSEN]
    numbers = np.union1d(best, np.flatnonzero(totals >= totals.max() - _AS_WELL)[:_CHOSEN])
    tried = [(motions[number], _fit(look(at, motions[number].of(cameras)))) for number in numbers]
    gains = [(each.total - fit.total - _needed(motion, views), motion, each) for motion, each in tried]
    gains = [gain for gain in gains if gain[2].total >= (_FINE if gain[1] in WRONG_WAY_ROUND else _PLAUSIBLE)]
    if not gains:
        return None
    gains = [gain for gain in gains if gain[0] >= 0] or gains
    most = max(gains, key=lambda gain: gain[2].total)
    as_well = [gain for gain in gains if gain[1].misread is None and gain[2].total >= most[2].total - _AS_WELL]
    _, motion, moved = as_well[0] if as_well else most
    return motion, moved


def _needed(motion: Motion, views: int) -> float:
    return (_BETTER if motion.misread is None else _BETTER_MISREAD) + _ALONE * math.exp(-_FALL * math.log(views))


def _spread(count: int, wanted: int) -> NDArray[np.int64]:
    """Numbers of so many of ``count`` things, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, wanted)).round().astype(np.int64))


def _percent(part: float) -> str:
    percent = 100 * part
    return f"{percent:.0f} %" if percent >= 9.5 or percent == 0 else f"{percent:.2g} %"
