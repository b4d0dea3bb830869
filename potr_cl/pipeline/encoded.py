"""What an encode has made, and who did the work: :class:`Encoded`."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potr_cl.codec.quantize import HyperParameters
from potr_cl.errors import DataError, PotrError, UsageError
from potr_cl.host.atomic_write import replacing
from potr_cl.model.scene import Scene
from potr_cl.opencl.device import Device
from potr_cl.outputs.output import CodedScene
from potr_cl.outputs.registry import OUTPUTS
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.raster.scene_buffers import Drawable
from potr_cl.stages.fitting.fitted import Fitted, LeftOut
from potr_cl.stages.held_out import PhotographChoice
from potr_cl.stages.pruning.schedule import Pruned
from potr_cl.stages.refitting.refit_options import Refitted
from potr_cl.stages.unseen import Unresolved, Unseen
from potr_cl.stages.views_between import Added
from potr_cl.workers.pool import Pool, Traffic


@dataclass(frozen=True)
class LevelMade:
    """A level of detail, as it was made.

    Attributes:
        splats: that it has.
        scale: by how much smaller the pictures are in which it is shown.
        psnr: there, against the full scene, in decibels; None: not judged.
    """

    splats: int
    scale: float
    psnr: float | None = None


@dataclass(frozen=True)
class Encoded:
    """A finished encode.

    Attributes:
        pieces: the file's bytes, to be written one after another.
        nbytes: the size of the file.
        order: (N,) index in the source scene of each splat of the file.
        pruned: what pruning did; None if it was left out.
        unseen: the splats that no training view sees; None if pruning was left out.
        fitted: what the fit of all parameters did, or why it was left out; None if it was not asked for.
        refitted: what the re-fit of the colours did; None if it was left out.
        photographs: what held-out photographs say of a fit to photographs; None if none were given.
        between: the views between the training views that were looked at; None if nobody asked for any.
        device: the device that did the work; not the one that was asked for if that had too little memory. None if no
            stage needed a device.
        seconds: wall time by stage.
        options: that it was encoded with: those that were given, or that a search for a size or a PSNR has found.
        source_splats: how many splats the source scene has.
        parameters: the hyper-parameters that the stages took.
        shared: who did the work, where views were shared out.
        left_out: how many of the scene's SH degrees, the highest ones, the file's format has left out.
        importance: of the source's splats, for a coarser level (:class:`potr_cl.stages.stage.Results`).
        levels: of detail, the finest first, where there are several; splats, order and stages are of that one.
        report: of :func:`potr_cl.encode`, ready for JSON; printed, it is what the command ``encode`` prints.
    """

    pieces: list[bytes]
    nbytes: int
    order: NDArray[np.int64]
    pruned: Pruned | None
    unseen: Unseen | Unresolved | None
    fitted: Fitted | LeftOut | None
    refitted: Refitted | None
    photographs: PhotographChoice | None
    between: Added | None
    device: Device | None
    seconds: dict[str, float]
    options: EncodeOptions
    source_splats: int
    parameters: HyperParameters
    shared: SharedOut | None = None
    left_out: int = 0
    importance: NDArray[np.float32] | None = None
    levels: tuple[LevelMade, ...] = ()
    report: dict[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        q = f"q {self.options.q:.4g} of preset {self.options.preset}"
        splats = f"{len(self.order):,} of {self.source_splats:,} splats"
        return f"Encoded({self.nbytes:,} bytes, {splats}, {q}, {sum(self.seconds.values()):.1f} s)"

    @property
    def data(self) -> bytes:
        """The whole file."""
        return b"".join(self.pieces)

    @property
    def scene(self) -> Scene:
        """What the file's readers will see; it is read anew each time."""
        return self.options.output.read(self.data, trust=True)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the file, whole or not at all. Its kind is the one that was encoded to, ``options.output``.

        Raises:
            UsageError: it cannot be written there, or the name is that of another kind of file.
            PotrError: the system failed to write.
        """
        suffix, own = "".join(Path(path).suffixes[-2:]).lower(), self.options.output.suffixes()
        others = {each for kind in OUTPUTS for each in kind.suffixes()} - set(own)
        if not any(suffix.endswith(each) for each in own) and any(suffix.endswith(each) for each in others):
            raise UsageError(
                f"'{path}' is no name for a {own[0]} file: encode with to='{Path(path).suffix}', or name it *{own[0]}"
            )
        with replacing(self.options.output.place(path)) as file:
            self.options.output.write(self.pieces, file, Path(path))


@dataclass(frozen=True)
class SharedOut:
    """How views were shared out.

    Attributes:
        workers: their names.
        sent, received: bytes that went to them and came from them.
    """

    workers: tuple[str, ...]
    sent: int
    received: int

    @staticmethod
    def by(pool: Pool, before: Traffic) -> SharedOut:
        """What a pool has done since its traffic was ``before``."""
        now = pool.traffic
        return SharedOut(pool.names, now.sent - before.sent, now.received - before.received)

    def __str__(self) -> str:
        megabytes = f"{self.sent / 1e6:,.0f} MB sent, {self.received / 1e6:,.0f} MB received"
        return f"views shared out to {len(self.workers)} worker{'s' if len(self.workers) != 1 else ''}: {megabytes}"


@dataclass(frozen=True)
class Proved:
    """A file that its readers take.

    Attributes:
        data: the whole file.
        scene: what readers see; in a device's memory, where it will be looked at there.
        coded: the file, for other computers' devices to make the scene of.
    """

    data: bytes
    scene: Drawable
    coded: CodedScene


@contextmanager
def proved(encoded: Encoded, trust: bool = False, device: Device | None = None) -> Iterator[Proved]:
    """The file that was made and the scene that a reader makes of it.

    Args:
        encoded: that made it.
        trust: whether it may hold more splats a byte than a real scene has.
        device: on which the scene will be looked at, as long as the context lasts; None: it is an ordinary one.

    Raises:
        PotrError: no reader takes it.
    """
    data, output = encoded.data, encoded.options.output
    with ExitStack() as stack:
        try:
            scene: Drawable
            if device is None:
                scene = output.read(data, trust)
            else:
                scene = stack.enter_context(output.seen(data, device, trust, encoded.options.memory))
        except DataError as error:
            raise PotrError(
                f"the encoded file cannot be decoded ({error}): nothing was written. If the scene has splats that are "
                "very far away or very large, leave them out"
            ) from error
        yield Proved(data, scene, CodedScene(output, data, trust))
