"""A file is read again before it is written under its name: :func:`proved`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

from potr_cl.errors import DataError, PotrError
from potr_cl.opencl.device import Device
from potr_cl.outputs.coded_scene import CodedScene
from potr_cl.pipeline.encoded import Encoded
from potr_cl.raster.scene_buffers import Drawable


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
