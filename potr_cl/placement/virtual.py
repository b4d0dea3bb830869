"""Virtual cameras for scenes that come with none (:func:`place_cameras`): where would someone stand to look at this?"""

from __future__ import annotations

import heapq
import math
from collections import deque
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from potr_cl.model.camera import Camera, resized
from potr_cl.model.sampling import F64
from potr_cl.model.scene import Scene
from potr_cl.model.virtual_cameras import FIELD, PREFIX, Plan, plan
from potr_cl.opencl.device import Device
from potr_cl.placement.candidates import AIMS, BINS, Candidates, SurfacePoints, ViewMemory, candidates_of, resolution
from potr_cl.placement.space import Space
from potr_cl.placement.upright import guess_up, level_rotation, levelled

#: A target that so many views show well is worth half of what it is at first.
_ENOUGH = 4.0
#: What a view counts from inside a room: it shows less than one from outside, and people stand there.
_INDOORS = 1.5
#: Where there are rooms, this part of the views judge from there.
_JUDGE_ROOMS = 0.75
#: A view that shows less than this part of what the median one shows judges nothing.
_PLAIN = 0.5


def pick(candidates: Candidates, count: int) -> list[int]:
    """Greedily, by what each view adds: what few views have shown, and what none has shown from there."""
    targets = int(candidates.shown.max(initial=-1)) + 1
    from_there, at_all = np.zeros(BINS * targets, np.float32), np.zeros(targets, np.float32)
    places = candidates.shown * BINS + candidates.bins

    def gain(view: int) -> float:
        part = candidates.parts[view]
        had = (1 + from_there[places[part]]) * (1 + at_all[candidates.shown[part]] / _ENOUGH)
        worth = float((candidates.worth[part] / had).sum(dtype=np.float64))
        return worth * _INDOORS if candidates.enclosed[view] else worth

    # Gains only fall, so an old one bounds the new one from above.
    heap = [(-gain(view), view) for view in range(len(candidates.parts))]
    heapq.heapify(heap)
    picked: list[int] = []
    while heap and len(picked) < count:
        _, view = heapq.heappop(heap)
        now = gain(view)
        if heap and now < -heap[0][0]:
            heapq.heappush(heap, (-now, view))
            continue
        picked.append(view)
        part = candidates.parts[view]
        from_there[places[part]] += candidates.worth[part]
        at_all[candidates.shown[part]] += candidates.worth[part]
    return picked


def drawn(candidates: Candidates, count: int) -> list[int]:
    """Views that judge, one at a place: wherever somebody could stand, not where most is to be seen, but for those that
    show little. Where there are rooms, most of them stand in rooms."""
    worth = np.array([candidates.worth[part].sum() for part in candidates.parts])
    seen = worth[worth > 0]
    plain = (worth >= _PLAIN * np.median(seen) if len(seen) else np.ones(len(worth), bool)).reshape(AIMS, -1)
    places = plain.shape[1]
    rooms = candidates.has_rooms
    waiting: dict[bool, deque[int]] = {True: deque(), False: deque()}
    for place in range(places):
        good = [aim for aim in ((place + turn) % AIMS for turn in range(AIMS)) if plain[aim, place]]
        if good:
            waiting[rooms and bool(candidates.enclosed[place])].append(good[0] * places + place)
    found: list[int] = []
    indoors = 0
    while len(found) < count and (waiting[True] or waiting[False]):
        inside = indoors < _JUDGE_ROOMS * (len(found) + 1)
        inside = inside if waiting[inside] else not inside
        found.append(waiting[inside].popleft())
        indoors += inside
    return found


#: Targets for each view that is placed, and at least; places to stand for each view, and for each that judges.
_TARGETS, _LEAST_TARGETS, _PLACES, _JUDGED = 32, 2000, 6, 16
#: So many at most, for the memory that all pairs of them take.
_MOST_TARGETS, _MOST_PLACES, _MOST_JUDGED = 20_000, 6000, 1024
#: Pixels that the larger standard deviation of a splat of median size needs: where it has fewer from as far as
#: photographs were taken, larger pictures of fewer views come nearer to these.
_SHARP = 3.7
#: Views that tell where a scene was looked at from, and so which way is up in it.
_STANDPOINTS = 32
#: Where in the sequence of places those begin that judge: far behind those that are tried to place views.
_OTHERS = 1 << 16


def place_cameras(
    scene: Scene, count: int | None = None, size: int | None = None, field: float = FIELD, device: Device | None = None
) -> list[Camera]:
    """Views that cover what someone would look at, and others to judge by.

    Args:
        scene: clean, at least one splat.
        count: training views; by default 120 to 1600, the more the more splats there are. An eighth as many test views,
            32 at most, come on top (:func:`judging_views`).
        size: of their square images, in pixels; by default 480 to 600 on a CPU, 600 on a GPU.
        field: of view from side to side, in degrees; less where the renderer's near plane would cut a small scene off.
        device: finds what is seen from where; by default the one that should be fastest.

    Returns:
        Cameras: the training views "virtual_000" and so on in the order in which they were picked, then the test views
        "virtual_test_000" and so on, which are called so wherever they are looked from. All are level.

    Raises:
        UsageError: ``count`` or ``size`` below 1, or above what can be placed and rendered.
        DeviceError: the device has no room, or failed.
    """
    ground = Ground.of(scene, count, size, field, device)
    return [*ground.training(), *ground.judges(ground.planned.test)]


def judging_views(
    scene: Scene,
    count: int | None = None,
    size: int | None = None,
    device: Device | None = None,
    up: F64 | None = None,
) -> list[Camera]:
    """The test views that :func:`place_cameras` places, or another number of them: near and far, wherever somebody
    could stand, drawn without regard to what the training views show. Fewer are the first of more.

    Args:
        scene, device: as :func:`place_cameras` takes them.
        count: of the views; None: as many as :func:`place_cameras` places.
        size: of their square images, in pixels; where they stand does not depend on it. None: the usual one.
        up: (3,) of length 1, what is up in their pictures; None: :func:`potr_cl.placement.upright.guess_up`.
    """
    ground = Ground.of(scene, None, None, FIELD, device)
    judges = ground.judges(ground.planned.test if count is None else count, up)
    return judges if size is None else [resized(camera, size, size) for camera in judges]


@dataclass(frozen=True)
class Ground:
    """What is known of a scene before views are placed in it.

    Attributes:
        planned: how many views, and how large.
    """

    scene: Scene
    device: Device
    planned: Plan
    space: Space
    targets: SurfacePoints
    half_view: float
    pixels: float
    memory: ViewMemory | None

    @staticmethod
    def of(
        scene: Scene, count: int | None = None, size: int | None = None, field: float = FIELD,
        device: Device | None = None,
    ) -> Ground:  # fmt: skip
        """Arguments as of :func:`place_cameras`."""
        opened = device or Device()
        planned = plan(len(scene), count, size, opened.info.kind == "cpu")
        half_view = math.tan(math.radians(field / 2))
        space = Space.of(scene)
        wanted = min(_TARGETS * plan(len(scene)).training, max(len(scene) // 10, _LEAST_TARGETS), _MOST_TARGETS)
        targets = SurfacePoints.of(scene, space, wanted)
        found = resolution(opened, scene, space, targets, planned.size / 2 / half_view)
        pixels = found.pixels
        if size is None and found.limited and pixels < _SHARP:
            sharper = planned.sharper(_SHARP / pixels)
            pixels *= sharper.size / planned.size
            planned = sharper if count is None else replace(planned, size=sharper.size)
        return Ground(scene, opened, planned, space, targets, half_view, pixels, found.memory)

    @cached_property
    def up(self) -> F64:
        """(3,) what is probably up."""
        return guess_up(self.scene, self._usual)

    def training(self) -> list[Camera]:
        """The training views that are planned."""
        count = self.planned.in_rooms
        candidates = self._candidates(max(min(_PLACES * count, _MOST_PLACES), 2 * count), 0)
        count = count if candidates.has_rooms else self.planned.training
        views = [self._camera(candidates, view, "train") for view in pick(candidates, count)]
        return [replace(levelled(view, self.up), name=f"{PREFIX}{number:03d}") for number, view in enumerate(views)]

    def judges(self, count: int, up: F64 | None = None) -> list[Camera]:
        """So many test views; see :func:`judging_views`."""
        if not count:
            return []
        up = self.up if up is None else up
        return [
            replace(levelled(view, up), name=f"{PREFIX}test_{number:03d}")
            for number, view in enumerate(self._standpoints(count))
        ]

    def _candidates(self, places: int, first: int) -> Candidates:
        focal = self.planned.size / 2 / self.half_view
        return candidates_of(
            self.device, self.space, self.targets, places, focal, self.half_view, self.pixels, self.memory, first
        )

    @cached_property
    def _usual(self) -> list[Camera]:
        return self._judging(_STANDPOINTS)

    def _standpoints(self, count: int) -> list[Camera]:
        return self._usual[:count] if count <= _STANDPOINTS else self._judging(count)

    def _judging(self, count: int) -> list[Camera]:
        judges = self._candidates(max(min(_JUDGED * count, _MOST_JUDGED), 3 * count), _OTHERS)
        return [self._camera(judges, view, "test") for view in drawn(judges, count)]

    def _camera(self, candidates: Candidates, view: int, split: str) -> Camera:
        """One that is not held level yet."""
        forward, size = candidates.forward[view], self.planned.size
        rotation = level_rotation(forward, np.eye(3)[2])
        focal = size / 2 / candidates.tangent[view]
        translation = -rotation @ candidates.centres[view]
        return Camera(PREFIX, size, size, focal, focal, size / 2, size / 2, rotation, translation, split)
