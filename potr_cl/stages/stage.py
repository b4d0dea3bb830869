"""The seam between stages: what a stage is, what it is given, and what it hands on.

A stage is a frozen dataclass whose fields are its options, with one method, :meth:`Stage.run`, from a :class:`State` to
the next. The order of the stages, and which options they have in which preset, is one table,
:data:`potr_cl.pipeline.presets.PRESETS`; the flags of the command line are made from the fields (:func:`option`).
docs/architecture.md tells how to add one.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.container import EntropyCoder
from potr_cl.codec.quantize import HyperParameters
from potr_cl.errors import UsageError
from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.outputs.output import Output, Request, Rounded
from potr_cl.outputs.potr import Potr
from potr_cl.raster.resident import ResidentScene, ResidentSubset
from potr_cl.raster.scene_buffers import Drawable
from potr_cl.views.shares import ViewShares
from potr_cl.views.targets import PicturesInPassing, Targets
from potr_cl.views.visibility import Visibility, visibility_of_large
from potr_cl.workers.pool import Pool, Shared

if TYPE_CHECKING:
    from typing_extensions import Self

    from potr_cl.codec.encoder import Coded
    from potr_cl.codec.quantize import HyperParameters
    from potr_cl.model.given_views import GivenViews
    from potr_cl.stages.fit import Sought
    from potr_cl.stages.fitting.fitted import Fitted, LeftOut
    from potr_cl.stages.held_out import PhotographChoice
    from potr_cl.stages.pruning.schedule import Pruned
    from potr_cl.stages.refitting.refit_options import Refitted
    from potr_cl.stages.unseen import Unresolved, Unseen
    from potr_cl.stages.views_between import Added
    from potr_cl.views.shares import ViewShares


T = TypeVar("T")


@dataclass(frozen=True)
class Results:
    """What stages have found out; None where nobody has.

    Attributes:
        unresolved: splats that no view shows from near enough, which all stages leave alone.
        known: what the given views show.
        between: the views that were added.
        sought: views that a fit will look at besides, while they are sought.
        shown: which part of the views shows a splat, on the average, where that is known.
        unseen: splats that no view sees, or that stay though none resolves them.
        price: ΔMSE below which a splat has gone.
        shares: who of the workers elsewhere does which views, with what these see.
        pictures: of the source in the state's views, drawn in passing.
        pruned: the order in which splats went.
        importance: (N,) float32, I_k of each splat of the source before any went, in the finest level's views.
        fitted: the fit, or why there is none.
        chosen: the parameters that a fit chose coefficients with.
        compacted: whether colours are sparse already.
        refitted: the re-fit of the colours.
        photographs: the choice between re-fits to photographs.
        coded: the file.
    """

    unresolved: Unresolved | None = None
    known: GivenViews | None = None
    between: Added | None = None
    sought: Sought | None = None
    shown: float = 1.0
    unseen: Unseen | Unresolved | None = None
    price: float | None = None
    shares: ViewShares | None = None
    pictures: PicturesInPassing | None = None
    pruned: Pruned | None = None
    importance: NDArray[np.float32] | None = None
    fitted: Fitted | LeftOut | None = None
    chosen: HyperParameters | None = None
    compacted: bool = False
    refitted: Refitted | None = None
    photographs: PhotographChoice | None = None
    coded: Coded | None = None


#: The number of a view, the numbers of the splats that it sees, ascending, and the mean of T α of each over its pixels.
Importances: TypeAlias = Iterator[tuple[int, NDArray[np.int64], NDArray[np.float64]]]
#: Called with the name of what is being done and the part of it that is done, 0 to 1.
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class State:
    """A scene on its way to a file.

    Attributes:
        source: the uncompressed scene.
        scene: what is left of it.
        survivors: (n,) int64, ascending: the number in ``source`` of each splat of ``scene``.
        views: the training views; empty if there are no cameras.
        added: how many of them, the last ones, a stage has put between those that were given.
        truth: what a stage has fitted to photographs, where it did; it may have fewer splats than ``source``.
        visibility: what each view may draw of ``source``, where a stage has found that this is little.
        cut: a scene that is these survivors of ``source`` as they are there; None: none is known to be.
        geometry: of ``scene`` as the file's readers will see it, once a stage has had it rounded. A stage that then
            changes anything but colours makes it None again.
        importances: of the splats in each view, for stages that work while splats are being removed; else None.
        results: what stages have found out.
    """

    source: Scene
    scene: Scene
    survivors: NDArray[np.int64]
    views: tuple[Camera, ...]
    geometry: Rounded | None = None
    importances: Importances | None = None
    results: Results = field(default_factory=Results)
    added: int = 0
    cut: Scene | None = None
    truth: Scene | None = None
    visibility: Visibility | None = None

    @property
    def given(self) -> tuple[Camera, ...]:
        """The views that no stage has added."""
        return self.views[: len(self.views) - self.added]

    @property
    def goal(self) -> Scene:
        """Whose pictures colours are re-fitted to: the uncompressed scene's, or those of what is nearer to truth."""
        return self.source if self.truth is None else self.truth

    @staticmethod
    def of(scene: Scene, views: Sequence[Camera] = ()) -> State:
        """The state before the first stage."""
        return State(scene, scene, np.arange(len(scene)), tuple(views))

    def recoloured(self, sh: NDArray[np.float32]) -> State:
        """This state with other SH coefficients, (n, M, 3)."""
        return dataclasses.replace(self, scene=dataclasses.replace(self.scene, sh=sh), cut=None)

    def keeping(self, left: NDArray[np.int64]) -> State:
        """This state without the splats of ``scene`` whose numbers are not in ``left``: (n,) int64, ascending."""
        scene, survivors = self.scene.subset(left), self.survivors[left]
        cut = scene if self.is_cut else None
        return dataclasses.replace(self, scene=scene, survivors=survivors, geometry=None, cut=cut)

    @property
    def is_cut(self) -> bool:
        """Whether ``scene`` is known to be some splats of ``source`` as they are there."""
        return self.scene is self.source or self.scene is self.cut

    def with_results(self, **found: Any) -> State:
        """This state with what a stage has found out, by the fields of :class:`Results`."""
        return dataclasses.replace(self, results=dataclasses.replace(self.results, **found))


@dataclass(frozen=True)
class Workbench:
    """What a stage works with. Only the hyper-parameters say what is done to the scene.

    Attributes:
        parameters: the hyper-parameters that q and the options give.
        device: the stage computes on it; None if the stage needs no views.
        memory: how many bytes of device memory may be filled with views; None: the stage's own default.
        background: R, G, B behind the scene.
        threads: number of threads for work on the host; results do not depend on it. 0: one for each processor.
        interludes: what other stages want done while splats are being removed.
        metadata: makes the file's metadata from the last state.
        output: the kind of file that is made in the end.
        progress: called to say how far the work is.
        tell: called with a line about the work that progress has no place for.
        photographs: folder of the given views' photographs, where truth is wanted rather than fidelity.
        kept: the uncompressed scene, where it stays on the device from one stage to the next.
        pool: workers that views are shared out to; None: the device does all of them.
        shown_again: whether later stages look at the source's pictures in the views.
    """

    parameters: HyperParameters
    device: Device | None = None
    memory: int | None = None
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    threads: int = 0
    interludes: tuple[Interlude, ...] = ()
    metadata: Callable[[State], bytes] = lambda state: b""
    progress: Progress = lambda what, done: None
    tell: Callable[[str], None] = lambda line: None
    output: Output = field(default_factory=Potr)
    kept: ResidentScene | None = None
    photographs: Path | None = None
    pool: Pool | None = None
    shown_again: bool = False

    def drawable(self, scene: Scene) -> Drawable:
        """What to give to a rasterizer for a scene: it may lie on the device already."""
        return scene if self.kept is None else self.kept.drawable(self.opened, scene)

    def scene_of(self, state: State, some: NDArray[np.int64] | None = None) -> Scene | ResidentScene | ResidentSubset:
        """A state's scene, or where devices have it, for :func:`potr_cl.raster.resident.scene_on`.

        Args:
            state: whose scene.
            some: (n,) numbers there of the splats that are wanted, ascending; None: all.
        """
        kept = self.kept
        if kept is None or not state.is_cut or kept.drawable(self.opened, state.source) is state.source:
            return state.scene if some is None else state.scene.subset(some)
        if state.scene is state.source:
            return kept if some is None else ResidentSubset(kept, some)
        return ResidentSubset(kept, state.survivors if some is None else state.survivors[some])

    @contextmanager
    def shared(self, pool: Pool, state: State, some: NDArray[np.int64] | None = None) -> Iterator[Shared]:
        """The same for workers of other processes, as long as the context lasts.

        They are sent the source, which later stages need too, and numbers.
        """
        numbers = some
        if state.is_cut and state.scene is not state.source:
            numbers = state.survivors if some is None else state.survivors[some]
        with pool.shared(state.source if state.is_cut else state.scene) as whole:
            yield whole if numbers is None else Shared(whole.handle, numbers.astype(np.uint32))

    def rendered_before(self, state: State, targets: Targets, views: Sequence[Camera]) -> Targets:
        """Pictures of the source in some views: what was drawn in passing first, the others by ``targets``."""
        pictures = state.results.pictures
        if pictures is None:
            return targets
        if self.memory is not None:  # there is no room for them any more
            pictures.close()
        return pictures.before(targets, views)

    @property
    def all_here(self) -> bool:
        """Whether nobody of another process works on it."""
        return self.pool is None or self.pool.in_process

    def shared_source(self, state: State) -> Scene | ResidentScene | ViewShares:
        """A state's source for the pool's workers; where they have what their views see already, that."""
        dealt = state.results.shares
        if dealt is not None and dealt.views is state.views and not self.all_here:
            return dealt
        return self.as_shared(state.source)

    def as_shared(self, scene: Scene) -> Scene | ResidentScene:
        """A scene for the pool's workers, or where they have it already."""
        return self.kept if self.kept is not None and self.all_here and self.kept.is_of(scene) else scene

    def visibility_of_source(self, state: State, views: Sequence[Camera]) -> Visibility | None:
        """What views may draw of a state's source, where others were found to see little of it; else None."""
        groups = self.kept.groups if self.kept is not None and self.kept.is_of(state.source) else None
        return None if groups is None else visibility_of_large(state.source, views, groups)

    def request(self, state: State, metadata: bytes = b"", entropy: EntropyCoder | None = None) -> Request:
        """What the output is told besides the scene."""
        return Request(
            self.parameters, state.views, self.device, self.memory, self.threads, metadata, entropy or EntropyCoder(),
            self.progress,
        )  # fmt: skip

    @property
    def opened(self) -> Device:
        """The device, for stages that look at views."""
        assert self.device is not None
        return self.device


@dataclass(frozen=True)
class Stage(ABC):
    """One step from a scene to a file; its fields are its options.

    Attributes:
        on: whether the stage is done at all.
        name: what options and results call it.
        title: heads its options in the help of the command line.
        needs_views: whether it computes on a device, from views. Such a stage is left out if there are no views.
        serves_others: whether it only prepares what other stages look at, the same for every q. It is left out if none
            of them does. Such stages come first.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    needs_views: ClassVar[bool] = True
    serves_others: ClassVar[bool] = False

    on: bool = True

    @abstractmethod
    def run(self, state: State, bench: Workbench) -> State:
        """Do the stage's work.

        Args:
            state: the result of the stage before. It is not changed, so that the stage can be run from it again with
                other options.
            bench: what to work with.

        Returns:
            The state for the next stage.

        Raises:
            DeviceMemoryError: the device has too little memory; the stage is run again with less, or on a CPU.
            PotrError: the work cannot be done.
        """

    def begun(self, state: State, bench: Workbench) -> State:
        """Begin in the background what the stage will need and what depends on no stage still to come.

        Args:
            state: before the first stage that does not only serve others.
            bench: as of :meth:`run`, of the device that will most likely do the work.

        Returns:
            The state that knows of it.
        """
        return state

    @property
    def asked_for(self) -> bool:
        """Whether the options leave the stage anything to do, whatever the scene."""
        return self.on

    def looks_at(self, scene: Scene) -> bool:
        """Whether there is anything in this scene for which the stage has to look at views."""
        return self.asked_for and self.needs_views

    def quality(self, q: float) -> float:
        """The q whose hyper-parameters stages take where a user asks for this q, if this stage is done.

        But the threshold of the pruning is that of the q that is asked for.
        """
        return q

    @property
    def removes_in(self) -> int | None:
        """In how many iterations the stage removes splats; None: there are none for other stages to come between."""
        return None

    def interludes(self, iterations: int) -> Sequence[Interlude]:
        """What the stage wants done while splats are being removed in so many iterations."""
        return ()

    def changed(self, **changes: Any) -> Self:
        """The same stage with other options.

        Raises:
            UsageError: it has no such option, or a value is out of range.
        """
        known = {each.name for each in dataclasses.fields(self)}
        for name in changes:
            if name not in known:
                raise UsageError(f"stage '{self.name}' has no option '{name}': it has {', '.join(sorted(known))}")
        return dataclasses.replace(self, **changes)

    @classmethod
    def from_flags(cls, given: dict[str, Any]) -> dict[str, Any]:
        """Options by field, from those that a user typed; overridden by stages in which a flag sets several fields."""
        return given


@dataclass(frozen=True)
class Interlude:
    """Something to be done while splats are being removed, so that later iterations see its effect.

    Attributes:
        after: after how many iterations.
        stage: the stage that does it, on the splats that are left then.
        always: whether it is done in any case: at the end, if the iterations end before its time.
        afresh: whether it gets the colours that the splats had before the first iteration, instead of those that other
            interludes have given them since.
    """

    after: int
    stage: Stage
    always: bool = False
    afresh: bool = False


@dataclass(frozen=True)
class Flag:
    """How a field of a stage is given on the command line.

    Attributes:
        flag: as a user types it. For the field ``on``: ``--no-x`` switches the stage off, ``--x`` switches it on (then
            ``--no-x`` is understood too).
        help: says what the value means; the default is added to it.
        metavar: stands for the value in the help.
        kind: makes the value from the text that was typed.
        choices: the values that are allowed; none: any.
        group: of several flags with the same group, only one may be given.
        many: whether several values may follow the flag.
        default: what the help calls the default; None: the field's own value.
    """

    flag: str
    help: str
    metavar: str | None = None
    kind: Callable[[str], Any] = str
    choices: tuple[str, ...] = ()
    group: str | None = None
    many: bool = False
    default: str | None = None


def option(default: T, flag: Flag | None = None, parameter: bool = False) -> T:
    """A field of a stage.

    Args:
        default: its value unless a preset has another one.
        flag: how it is given on the command line; None: it can only be given from Python.
        parameter: whether a value other than None replaces the hyper-parameter of the same name, which q sets
            otherwise (:class:`potr_cl.codec.quantize.HyperParameters`).
    """
    made: T = field(default=default, metadata={"flag": flag, "parameter": parameter})
    return made


def flags(stage: type[Stage]) -> dict[str, Flag]:
    """The flags of a stage by the fields that they set."""
    return {each.name: each.metadata["flag"] for each in dataclasses.fields(stage) if each.metadata.get("flag")}


def parameters(stage: type[Stage]) -> list[str]:
    """The fields of a stage that replace hyper-parameters."""
    return [each.name for each in dataclasses.fields(stage) if each.metadata.get("parameter")]
