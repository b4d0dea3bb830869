"""Where the views of a group get their splats from: :class:`WholeScene`, :class:`NamedSplats`, :class:`ListedSplats`,
:class:`CopiedSplats`.

Pictures and sums are the same bits with any of them: splats that are left out reach no pixel of the group's views, and
the others keep their order.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from potr_cl.model.scene import FloatArray, Scene
from potr_cl.model.splat_groups import Indices
from potr_cl.opencl.device import Device
from potr_cl.opencl.memory import Memory, Owner, Reused
from potr_cl.raster.picked_splats import NO_SPLAT, IndexSubset, IndexSubsets, Picker
from potr_cl.raster.preparing_memory import PreparingMemory
from potr_cl.raster.rasterizer import Rasterizer
from potr_cl.raster.rules import INRIA, RasterRules
from potr_cl.raster.scene_buffers import SPLAT_GROUP, Drawable, SceneBuffers, stride_of
from potr_cl.raster.view_set import ViewSet
from potr_cl.views.reached import Reach
from potr_cl.views.visibility import ViewGroup


@dataclass(frozen=True)
class Left:
    """The splats that are left.

    Attributes:
        states: (N,) uint8 on the device, and alive: the state of those that are left.
        mask: (N,) the same on the host; asked for only where splats are copied.
    """

    states: cl.Buffer
    alive: int
    mask: NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class Subset:
    """The splats of a group, on the device.

    Attributes:
        numbers: (count,) uint32 in the device's memory, their numbers in the scene, ascending; None: they are all. With
            splats of each view's own, (views, count).
        splats: the same on the host, where they are copied.
    """

    rasterizer: Rasterizer
    count: int
    numbers: cl.Buffer | None = None
    splats: NDArray[np.uint32] | None = None
    scene: SceneBuffers | None = None


class SplatSource(Owner, ABC):
    """Gives groups their splats, in the colours that they have by now.

    Attributes:
        splats: N, of the scene. stride: N padded.
        selects: whether a group that is opened for those that are left has no others.
        copies: whether it wants to know on the host which splats are left.
    """

    device: Device
    splats: int
    stride: int
    selects = True
    copies = False
    #: Coefficients on the device that a subset's rasterizer has not.
    _other_sh: cl.Buffer | None = None

    def streams_in(self) -> Memory:
        """Memory for one streamed group after the other."""
        return Memory(self.device)

    def room(self, number: int) -> int:
        """How many splats of a view there is room for, where each is looked at by itself."""
        return self.stride

    @abstractmethod
    def open(self, stack: ExitStack, memory: Memory, group: ViewGroup, left: Left | None = None) -> Subset | None:
        """The splats of a group, as long as the stack lasts; None: there are none.

        Args:
            stack, memory: own what is taken.
            left: take only these; None: all.
        """

    @abstractmethod
    def replace_sh(self, sh: FloatArray) -> None:
        """Give the scene other SH coefficients, (N, M, 3) float32 of the same degree."""

    def project(
        self, subset: Subset, views: ViewSet, shapes: cl.Buffer | None = None, colours: cl.Buffer | None = None
    ) -> None:
        """Enqueue the projection of prepared views, in the colours of now."""
        self.wake(subset)
        subset.rasterizer.project(views, self._other_sh, shapes, colours)

    @contextmanager
    def foreseen(self, groups: Sequence[ViewGroup]) -> Iterator[None]:
        """Inside the block, these groups are opened without waiting for the device each time."""
        yield

    def recolour(self, subset: Subset) -> None:
        """Have a copy follow :meth:`replace_sh`."""

    def wake(self, subset: Subset) -> None:
        """Make sure that a copy is there."""

    def rest(self, subset: Subset) -> None:
        """Give a copy's memory back, of which only projections need anything."""

    def forget(self, numbers: Sequence[int]) -> None:
        """These views stay as they are: nobody opens their splats again."""

    def forget_scratch(self) -> None:
        """Give back what preparing views takes besides, if others want it more than the next views."""

    def close(self) -> None:
        """Give all device memory back that is its own."""


class NoSplats(SplatSource):
    """Of a device that looks at no view itself."""

    def __init__(self, device: Device, splats: int) -> None:
        self.device, self.splats, self.stride = device, splats, stride_of(splats)

    def open(self, stack: ExitStack, memory: Memory, group: ViewGroup, left: Left | None = None) -> None:
        return None

    def replace_sh(self, sh: FloatArray) -> None:
        """There is nothing to colour."""


class WholeScene(SplatSource):
    """All splats for all groups.

    Args:
        rasterizer: of the scene; the caller's.
        reused: whether streamed groups take turns in the same memory.
    """

    selects = False

    def __init__(self, rasterizer: Rasterizer, reused: bool = False) -> None:
        self._reused = reused
        self.device, self.splats, self.stride = rasterizer.device, rasterizer.splats, rasterizer.stride
        self._subset = Subset(rasterizer, rasterizer.splats)

    def streams_in(self) -> Memory:
        return Reused(self.device) if self._reused else super().streams_in()

    def open(self, stack: ExitStack, memory: Memory, group: ViewGroup, left: Left | None = None) -> Subset:
        return self._subset

    def replace_sh(self, sh: FloatArray) -> None:
        former = self._subset.rasterizer.replace_sh(sh)
        if former is not None:
            self.device.free(former)


class _Parted(SplatSource):
    """What the sources share whose groups have rasterizers of their own."""

    def __init__(
        self, device: Device, scene: Drawable, stride: int, background: tuple[float, float, float],
        rules: RasterRules = INRIA,
    ) -> None:  # fmt: skip
        self.device, self.stride = device, stride
        self.splats = scene.splats if isinstance(scene, SceneBuffers) else len(scene)
        self._preparing = PreparingMemory(device)
        self._rasterizer = partial(
            Rasterizer, device, rules=rules, background=background, preparing=self._preparing
        )  # fmt: skip

    def streams_in(self) -> Memory:
        return Reused(self.device)

    def close(self) -> None:
        self._preparing.close()


class NamedSplats(_Parted):
    """Splats of a scene that lies whole on a GPU, by their numbers.

    Args:
        group_of: (N,) the cell of each splat.
    """

    def __init__(
        self, whole: SceneBuffers, group_of: NDArray[np.uint32], background: tuple[float, float, float]
    ) -> None:
        super().__init__(whole.device, whole, whole.stride, background)
        self._whole, self._memory = whole, Memory(whole.device)
        self._picker = Picker(whole.device, group_of)
        self._foreseen: tuple[IndexSubsets, dict[ViewGroup, int]] | None = None

    def open(self, stack: ExitStack, memory: Memory, group: ViewGroup, left: Left | None = None) -> Subset | None:
        assert group.cells is not None
        if left is None and self._foreseen is not None and group in self._foreseen[1]:
            picks, places = self._foreseen
            numbers, count = picks.numbers(memory, places[group]), picks.counts[places[group]]
        else:
            given = () if left is None else (left.states, left.alive)
            numbers, count = self._picker.pick(memory, group.cells, *given)
        if not count:
            return None
        picked = IndexSubset(self._whole, numbers, count)
        if self._other_sh is not None:
            picked.sh = self._other_sh
        return Subset(stack.enter_context(self._rasterizer(picked)), count, numbers)

    @contextmanager
    def foreseen(self, groups: Sequence[ViewGroup]) -> Iterator[None]:
        with Memory(self.device) as memory:
            wanted = np.stack([group.cells for group in groups if group.cells is not None])
            picks = IndexSubsets(memory, self._picker, wanted)
            self._foreseen = picks, {group: place for place, group in enumerate(groups)}
            try:
                yield
                self.device.finish()
            finally:
                self._foreseen = None

    def replace_sh(self, sh: FloatArray) -> None:
        former, self._other_sh = self._other_sh, self._whole.other_sh(self._memory, sh)
        if former is not None:
            self.device.finish()
            self._memory.free(former)

    def close(self) -> None:
        for owner in (self._picker, self._memory, self._preparing):
            owner.close()


class ListedSplats(_Parted):
    """Splats of a scene that lies whole on a device, each view's own, by numbers that the host knows.

    Views of a group have room for as many as the one of them that has most. The scene's colours are not looked at.

    Args:
        rasterizer: of the scene; the caller's.
        reach: of the views.
    """

    def __init__(self, rasterizer: Rasterizer, reach: Reach) -> None:
        self._whole = rasterizer.parameters
        super().__init__(rasterizer.device, self._whole, rasterizer.stride, rasterizer.background, rasterizer.rules)
        self._listed = dict(reach.of)

    def room(self, number: int) -> int:
        return max(-(-len(self._listed[number]) // SPLAT_GROUP), 1) * SPLAT_GROUP

    def open(self, stack: ExitStack, memory: Memory, group: ViewGroup, left: Left | None = None) -> Subset:
        stride = max(map(self.room, group.numbers))
        padded = np.full((len(group.numbers), stride), NO_SPLAT, np.uint32)
        for row, number in zip(padded, group.numbers, strict=True):
            row[: len(self._listed[number])] = self._listed[number]
        numbers = memory.upload(padded, "the numbers of views' splats")
        rasterizer = stack.enter_context(self._rasterizer(IndexSubset(self._whole, numbers, stride, apart=stride)))
        return Subset(rasterizer, stride, numbers)

    def replace_sh(self, sh: FloatArray) -> None:
        """Nobody looks at its colours."""

    def forget(self, numbers: Sequence[int]) -> None:
        for number in numbers:
            del self._listed[number]

    def forget_scratch(self) -> None:
        self._preparing.rest()


class CopiedSplats(_Parted):
    """Copies of splats, from the host or from a scene on the device.

    Args:
        scene: the scene on the host.
        whole: the same to be drawn, perhaps on the device already.
    """

    copies = True

    def __init__(self, device: Device, scene: Scene, whole: Drawable, background: tuple[float, float, float]) -> None:
        super().__init__(device, scene, stride_of(len(scene)), background)
        self._scene, self._whole = scene, whole
        self._other: FloatArray | None = None

    def empty(self, count: int, memory: Memory | None = None) -> SceneBuffers:
        """Room for so many splats."""
        scene = self._scene
        return SceneBuffers(self.device, count, scene.sh.shape[1], scene.antialiased, scene.low_pass, memory)

    def fill(self, part: SceneBuffers, splats: Indices) -> None:
        """Write splats of these numbers there."""
        if isinstance(self._whole, SceneBuffers):
            part.gather(self._whole, splats)
        else:
            part.write_some(self._scene, splats)
        if self._other is not None:
            part.write_sh_of(self._other, splats)

    def open(self, stack: ExitStack, memory: Memory, group: ViewGroup, left: Left | None = None) -> Subset | None:
        splats = group.splats
        if left is not None:
            assert left.mask is not None
            splats = splats[left.mask[splats]]
        if not len(splats):
            return None
        # What stays rests and wakes by itself; streamed splats lie where those before them lay.
        own = stack.enter_context(self.empty(len(splats), memory if isinstance(memory, Reused) else None))
        self.fill(own, splats)
        rasterizer = stack.enter_context(self._rasterizer(own))
        named = splats.astype(np.uint32)
        return Subset(rasterizer, len(splats), memory.upload(named, "the numbers of a view's splats"), named, own)

    def replace_sh(self, sh: FloatArray) -> None:
        self._other = sh

    def recolour(self, subset: Subset) -> None:
        if self._other is not None and subset.scene is not None and not subset.scene.rests:
            assert subset.splats is not None
            subset.scene.write_sh_of(self._other, subset.splats.astype(np.int64))

    def wake(self, subset: Subset) -> None:
        if subset.scene is not None and subset.splats is not None and subset.scene.rests:
            subset.scene.wake()
            self.fill(subset.scene, subset.splats.astype(np.int64))

    def forget_scratch(self) -> None:
        self._preparing.close()

    def rest(self, subset: Subset) -> None:
        if subset.scene is not None:
            self.device.finish()
            subset.scene.rest()
