"""The seam between the stages and the kinds of files that an encode ends in: :class:`Output`.

The stages are the same for every kind. The last two ask the output: the re-fit solves for the colours on the geometry
that the file's readers will see (:meth:`Output.geometry`), has the output choose its AC coefficients
(:meth:`Output.fix_ac`) and solves again for the constant ones, which make up for what that choice has lost; the stage
"code" has the bytes made (:meth:`Output.file`). docs/architecture.md tells how to add an output.
"""

from __future__ import annotations

import os
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.blocks import AnyGeometry
from potr_cl.codec.container import EntropyCoder
from potr_cl.codec.encoder import Coded
from potr_cl.codec.quantize import HyperParameters
from potr_cl.codec.steps.rule import factors
from potr_cl.formats.declaration import SceneFormat
from potr_cl.host.mapped import bounded
from potr_cl.host.threads import Run
from potr_cl.model.camera import Camera
from potr_cl.model.scene import FloatArray, Scene
from potr_cl.opencl.device import Device
from potr_cl.raster.resident import SceneHandle
from potr_cl.raster.scene_buffers import Drawable


@dataclass(frozen=True)
class Request:
    """What an output is told besides the scene.

    Attributes:
        parameters: the hyper-parameters: how large errors of geometry and of colours may be.
        views: the training views; empty if there are none.
        device: computes, if there is one: without views there is none.
        memory: how many bytes of the device's memory may be filled; None: the callee's own default.
        threads: for work on the host; the bytes do not depend on it. 0: one for each processor.
        metadata: how the file was made, for formats that hold it.
        entropy: the entropy coder, for formats that leave a choice.
        progress: called with what is being done and the part of it that is done.
        blocks: for :meth:`Output.fix_ac` after a re-fit: returns (M (M + 1) / 2, N) float32, the upper triangles, row
            by row, of what errors of a splat's coefficients cost together; ``worth`` are their diagonals.
    """

    parameters: HyperParameters
    views: Sequence[Camera] = ()
    device: Device | None = None
    memory: int | None = None
    threads: int = 0
    metadata: bytes = b""
    entropy: EntropyCoder = field(default_factory=EntropyCoder)
    progress: Callable[[str, float], None] = lambda what, done: None
    blocks: Callable[[], FloatArray] | None = None


class Leaves(NamedTuple):
    """Parts of space that viewers show at a level of their own.

    Attributes:
        of_splats: (N,) in which leaf each splat of the finest level lies; as many as there are leaves: in none.
        boxes: (leaves, 6) x0, y0, z0, x1, y1, z1 of each, world units.
    """

    of_splats: NDArray[np.int64]
    boxes: NDArray[np.float64]


class LevelErrors(Protocol):
    """What coarser levels of detail lose; each is measured when it is asked for."""

    def of_level(self, level: int) -> float:
        """By how far, world units, the splats of a level may be off those of the finest one; 0 of that itself."""
        ...

    def far(self, scene: Scene) -> NDArray[np.bool_]:
        """(N,) which of a level's splats look the same from wherever somebody stands; of these there is one level."""
        ...

    def of_leaves(
        self, scenes: Callable[[int], Scene], levels: int, leaves: Callable[[], Leaves]
    ) -> NDArray[np.float64]:
        """What each part of space loses in each level.

        Args:
            scenes: gives a level's scene, as readers see it.
            levels: how many there are.
            leaves: gives the parts; asked for only once pictures have been rendered.

        Returns:
            (leaves, levels) float64 from 0 up, never falling from level to level; the finest has 0. Times the part of a
            picture that a leaf covers, this is what its splats of that level add to the picture's mean squared error.
        """
        ...


class Rounded(Protocol):
    """A scene's geometry and opacities as a file holds them.

    Attributes:
        asked: the parameters that it was rounded with.
        order: (N,) int64, the number in the scene of each splat of the file.
    """

    @property
    def asked(self) -> HyperParameters: ...

    @property
    def order(self) -> NDArray[np.int64]: ...

    def decoded(self, sh: FloatArray, run: Run = map) -> Scene:
        """What a reader makes of it, in the order of the scene, with colours (N, M, 3) of that order.

        ``run`` works with several threads.
        """
        ...


@dataclass(frozen=True)
class RoundedScene:
    """:class:`Rounded` for outputs that keep what their readers will see, value by value.

    Attributes:
        asked, order: as of :class:`Rounded`.
        scene: geometry and opacities as readers see them, in the order of the scene; its colours are of no account.
        ac: what :meth:`Output.fix_ac` has chosen, if the output needs it again to make the file (as a palette).
    """

    asked: HyperParameters
    order: NDArray[np.int64]
    scene: Scene
    ac: Any = None

    def decoded(self, sh: FloatArray, run: Run = map) -> Scene:
        """See :meth:`Rounded.decoded`."""
        return replace(self.scene, sh=sh)


@dataclass(frozen=True)
class Output(ABC):
    """A kind of file that an encode can end in; its fields are its own options.

    Attributes:
        format: reads and names such files.
        choices: options of the stage "code" that mean something here; others are refused when a user gives them.
        steps: whether the steps of colours follow ``sf_dc`` and ``sf_sh`` freely, as a search for a size tries them.
        fixes_ac: whether :meth:`fix_ac` does anything.
        replaces: hyper-parameters that q does not set here: as ``drop``, where a coefficient of 0 saves no byte.
        levels: of detail that a file has unless others are asked for, a number or "auto"; None: it has only one.
        bytes_a_splat: of its files, as a multiple of those of a .potr file of the same q, roughly: where a search for a
            size begins.
    """

    format: ClassVar[SceneFormat]
    choices: ClassVar[frozenset[str]] = frozenset()
    steps: ClassVar[bool] = False
    fixes_ac: ClassVar[bool] = False
    replaces: ClassVar[Mapping[str, float]] = {}
    bytes_a_splat: ClassVar[float] = 1.0
    levels: ClassVar[int | str | None] = None

    @classmethod
    def suffixes(cls) -> tuple[str, ...]:
        """Of the names that ask for it, the usual one first."""
        return cls.format.suffixes

    @property
    def suffix(self) -> str:
        """That its files usually have."""
        return self.suffixes()[0]

    def losses(self, scene: Scene) -> list[str]:
        """What of a scene such a file cannot hold, a clause each; told once, before the work."""
        return []

    def to_meet_a_target(self) -> Output:
        """The output where a size or a PSNR is asked for: what is not worth its bytes may go, whatever the loss."""
        return self

    @abstractmethod
    def geometry(self, scene: Scene, request: Request) -> Rounded:
        """Round geometry and opacities as the file does; colours are of no account.

        Args:
            scene: clean, at least one splat.
            request: parameters and views count.

        Raises:
            DataError: the format cannot hold a value.
        """

    def fix_ac(
        self, rounded: Rounded, sh: FloatArray, worth: FloatArray | None, request: Request
    ) -> tuple[Rounded, FloatArray]:
        """Choose the AC coefficients that the file will hold: levels, bits or a palette.

        It is called once, after the re-fit, or by :meth:`file` where there was none. The re-fit then solves for the
        constant coefficients again, with the others as they are returned here.

        Args:
            rounded: what :meth:`geometry` has returned.
            sh: (N, M, 3) R, G, B in the order of the scene; not to be changed.
            worth: (N, M) float32: by how much the mean squared error of the views grows for an error of 1 in this
                coefficient of one channel; None if there are no views.
            request: its parameters tell what an error is worth in bytes: ``delta_mse_max`` those of a splat.

        Returns:
            What :meth:`file` is given, and the coefficients as readers will see them. ``sh`` itself where nothing is
            rounded that anybody could see.
        """
        return rounded, sh

    def on_grid(self, request: Request) -> bool:
        """Whether colours are rounded to the steps of :meth:`colour_grid`, and :meth:`fix_ac` does nothing."""
        return False

    def colour_grid(self, rounded: Rounded, effects: FloatArray, request: Request) -> tuple[Rounded, ColourGrid]:
        """The steps of colours, where they follow from the geometry and ``effects`` alone.

        So the re-fit can ask while it solves, and round in rounds. Only for outputs that are :meth:`on_grid`.

        Args:
            rounded, request: as of :meth:`fix_ac`.
            effects: (N,) float32, ``worth`` of the constant coefficients.

        Returns:
            What :meth:`file` is given, and the steps.
        """
        raise NotImplementedError

    @abstractmethod
    def file(self, scene: Scene, rounded: Rounded | None, request: Request) -> Coded:
        """Make the bytes of the file.

        Args:
            scene: what is left of the scene, its geometry not rounded yet, with the colours of the re-fit.
            rounded: of :meth:`fix_ac`; None if there was no re-fit (see :meth:`prepared`).
            request: what to write.

        Raises:
            DataError: the format cannot hold a value.
            UsageError: an extra is missing, or the format cannot hold what the options ask for.
        """

    def prepared(self, scene: Scene, rounded: Rounded | None, request: Request) -> tuple[Rounded, FloatArray]:
        """Rounded geometry and fixed AC coefficients, where :meth:`file` gets none from a re-fit."""
        if rounded is not None:
            return rounded, scene.sh
        return self.fix_ac(self.geometry(scene, request), scene.sh, None, request)

    def of_level(self) -> Output:
        """The kind of file that each level of detail is encoded to, before :meth:`levelled`."""
        return self

    def levelled(self, files: Sequence[bytes], errors: LevelErrors, read: Callable[[int], Scene]) -> list[bytes]:
        """The pieces of one file of several levels of detail.

        Args:
            files: of :meth:`of_level`'s kind, the finest level first.
            errors: what the coarser ones lose.
            read: what readers see of a level.
        """
        raise NotImplementedError

    def place(self, path: str | os.PathLike[str]) -> Path:
        """The file to be written; a folder that is made with it exists then.

        Raises:
            UsageError: that cannot be made.
        """
        return Path(path)

    def size(self, pieces: Sequence[bytes]) -> int:
        """Bytes that they take once they are written."""
        return sum(map(len, pieces))

    def write(self, pieces: Sequence[bytes], file: BinaryIO, path: Path) -> None:
        """Write what was encoded.

        Args:
            pieces: of the file.
            file: open under another name; it gets its own once this is done.
            path: of the file, for others beside it.

        Raises:
            UsageError: one of these cannot be written.
        """
        for piece in pieces:
            file.write(piece)

    def read(self, data: bytes, trust: bool = False) -> Scene:
        """The scene that a file's readers will see.

        Raises:
            DataError: nobody can read it.
        """
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"scene{self.suffix}"
            path.write_bytes(data)
            return self.format.load(path, trust)

    @contextmanager
    def seen(self, data: bytes, device: Device, trust: bool = False, memory: int | None = None) -> Iterator[Drawable]:
        """The same, to be rendered on a device as long as the context lasts; it may lie there already.

        Args:
            data: the file.
            device: to render on.
            trust: as of :meth:`read`.
            memory: bytes that the user would have taken; None: as much as there is.

        Raises:
            DataError: nobody can read it.
        """
        with bounded(memory):
            scene = self.read(data, trust)
        yield scene

    def properties(self, data: bytes) -> dict[str, int]:
        """Bytes of the file by what they are for, as far as the format tells them apart."""
        return {}

    def __str__(self) -> str:
        return self.suffix


@dataclass(frozen=True)
class ColourGrid:
    """Coefficients of Y, Co and Cg that are whole multiples of the splats' steps.

    Attributes:
        constant: (N,) float32, steps of the constant coefficients, in the order of the scene.
        others: (N,) float32, of all other coefficients.
        order: (N,) int64, the number in the scene of each splat of the file, in which neighbours follow each other.
    """

    constant: NDArray[np.float32]
    others: NDArray[np.float32]
    order: NDArray[np.int64]

    @staticmethod
    def of(geometry: AnyGeometry) -> ColourGrid:
        """That of a .potr file."""
        dc, ac = geometry.colour_classes()
        steps = np.empty((2, len(geometry.order)), np.float32)
        steps[0, geometry.order] = 1 / factors(geometry.parameters.sf_dc, dc)
        steps[1, geometry.order] = 1 / factors(geometry.parameters.sf_sh, ac)
        return ColourGrid(steps[0], steps[1], geometry.order)


@dataclass(frozen=True)
class CodedScene(SceneHandle):
    """Each device decodes it for itself, to the same bits: a file is many times smaller than what it decodes to.

    Attributes:
        output: the kind of file.
        data: its bytes.
        trust: as of :meth:`potr_cl.outputs.output.Output.read`.
    """

    output: Output
    data: bytes
    trust: bool = False

    @property
    def nbytes(self) -> int:
        return len(self.data)

    def on(self, device: Device) -> AbstractContextManager[Drawable]:
        """See :meth:`potr_cl.raster.resident.SceneHandle.on`.

        Raises:
            DataError: nobody can read it.
        """
        return self.output.seen(self.data, device, self.trust)
