"""The seam between stages: what a stage is, what it is given, and what it hands on.

A stage is a frozen dataclass whose fields are its options, with one method, :meth:`Stage.run`, from a :class:`State` to
the next. The order of the stages, and which options they have in which preset, is one table,
:data:`potr_cl.pipeline.presets.PRESETS`; the flags of the command line are made from the fields (:func:`option`).
docs/architecture.md tells how to add one.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.quantize import HyperParameters
from potr_cl.errors import UsageError
from potr_cl.model.camera import Camera
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device

if TYPE_CHECKING:
    from typing_extensions import Self

    from potr_cl.codec.geometry import Geometry
    from potr_cl.stages.pruning.measured import Measured

T = TypeVar("T")

#: Called with the name of what is being done and the part of it that is done, 0 to 1.
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class State:
    """A scene on its way to a file.

    Attributes:
        source: the uncompressed scene; its pictures are the target of every stage.
        scene: what is left of it.
        survivors: (n,) int64, ascending: the number in ``source`` of each splat of ``scene``.
        views: the training views; empty if there are no cameras.
        geometry: of ``scene`` as a decoder will see it, once a stage has quantised it.
        original_colours: whether ``scene`` has the colours that its splats have in ``source``.
        effects: importances view by view while splats are being removed, else None.
        learnt: what each stage has to tell, by its name.
    """

    source: Scene
    scene: Scene
    survivors: NDArray[np.int64]
    views: tuple[Camera, ...]
    geometry: Geometry | None = None
    original_colours: bool = True
    effects: Measured | None = None
    learnt: Mapping[str, Any] = field(default_factory=dict)

    @staticmethod
    def of(scene: Scene, views: Sequence[Camera] = ()) -> State:
        """Where every encode begins."""
        return State(scene, scene, np.arange(len(scene)), tuple(views))

    def recoloured(self, sh: NDArray[np.float32]) -> State:
        """The same with other SH coefficients, (n, M, 3)."""
        return dataclasses.replace(self, scene=dataclasses.replace(self.scene, sh=sh), original_colours=False)

    def having_learnt(self, name: str, result: Any) -> State:
        """The same, with what a stage has to tell."""
        return dataclasses.replace(self, learnt={**self.learnt, name: result})


@dataclass(frozen=True)
class Workbench:
    """What stages work with. Nothing of it says what is done to the scene but the parameters.

    Attributes:
        parameters: the hyper-parameters that q and the options give.
        device: to compute on; None where no stage looks at views.
        memory: bytes of device memory to keep views in; None: each stage's default.
        background: R, G, B behind the scene.
        threads: for work on the host; results do not depend on it. 0: one a processor.
        interludes: what other stages want done while splats are being removed.
        metadata: makes the file's metadata of the last state.
        progress: told how far things are.
    """

    parameters: HyperParameters
    device: Device | None = None
    memory: int | None = None
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    threads: int = 0
    interludes: tuple[Interlude, ...] = ()
    metadata: Callable[[State], bytes] = lambda state: b""
    progress: Progress = lambda what, done: None

    @property
    def opened(self) -> Device:
        """The device, for stages that look at views."""
        assert self.device is not None
        return self.device


@dataclass(frozen=True)
class Stage(ABC):
    """One step from a scene to a file; its fields are its options.

    Attributes:
        on: whether it is done at all.
        name: as options, results and flags call it.
        title: of its flags in the help.
        needs_views: whether it computes on a device, from views; without any it is left out.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    needs_views: ClassVar[bool] = True

    on: bool = True

    @abstractmethod
    def run(self, state: State, bench: Workbench) -> State:
        """Do it.

        Args:
            state: not changed, so that the stage may be run from it again with other options.
            bench: what to work with.

        Raises:
            DeviceMemoryError: the device has too little memory; the stage is run again with less, or on a CPU.
            PotrError: it cannot be done.
        """

    def looks_at(self, scene: Scene) -> bool:
        """Whether there is anything in this scene for which the stage has to look at views."""
        return self.on and self.needs_views

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
        """Options from what a user typed, by field; for stages in which one flag means more than one field."""
        return given


@dataclass(frozen=True)
class Interlude:
    """Something to be done while splats are being removed, so that later iterations see its effect.

    Attributes:
        after: how many iterations.
        stage: that does it, on what is left then.
        always: whether it is done too if the iterations end before; then at their end.
    """

    after: int
    stage: Stage
    always: bool = False


@dataclass(frozen=True)
class Flag:
    """How a field of a stage is given on the command line.

    Attributes:
        flag: as typed; for switches of the field ``on`` as ``--no-x`` or ``--x`` (which is also ``--no-x`` then).
        help: says what the value means; the default is added.
        metavar: stands for the value in the help.
        kind: makes a value of the text.
        choices: that there are.
        group: flags of one group exclude each other.
        many: whether it takes several values.
        default: the help says of the default; None: the field's own value.
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
        default: its value where a preset has no other.
        flag: how it is given on the command line; None: only from Python.
        parameter: whether it replaces the hyper-parameter of its name that q sets
            (:class:`potr_cl.codec.quantize.HyperParameters`) unless it is None.
    """
    made: T = field(default=default, metadata={"flag": flag, "parameter": parameter})
    return made


def flags(stage: type[Stage]) -> dict[str, Flag]:
    """The flags of a stage by the fields that they set."""
    return {each.name: each.metadata["flag"] for each in dataclasses.fields(stage) if each.metadata.get("flag")}


def parameters(stage: type[Stage]) -> list[str]:
    """The fields of a stage that replace hyper-parameters."""
    return [each.name for each in dataclasses.fields(stage) if each.metadata.get("parameter")]
