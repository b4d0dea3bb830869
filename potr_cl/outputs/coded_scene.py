"""A scene as the file that was made of it, for devices of other computers: :class:`CodedScene`."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass

from potr_cl.opencl.device import Device
from potr_cl.outputs.output import Output
from potr_cl.raster.resident import SceneHandle
from potr_cl.raster.scene_buffers import Drawable


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
