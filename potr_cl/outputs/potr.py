"""The package's own files as an output: the usual one, with steps that q sets, and entropy coders."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, fields
from typing import ClassVar

from potr_cl.codec.blocks import AnyGeometry, GeometryOfBlocks, quantise
from potr_cl.codec.decoder import PotrFile, decode, open_file
from potr_cl.codec.encoder import Coded, code_scene
from potr_cl.codec.geometry import Geometry
from potr_cl.codec.quantisers import QUANTISERS
from potr_cl.codec.quantize import HyperParameters
from potr_cl.codec.sections import ORDER, SH, Property
from potr_cl.errors import DeviceError
from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes.page import POTR
from potr_cl.host.mapped import bounded
from potr_cl.host.threads import thread_pool
from potr_cl.model.scene import SH_COEFFICIENTS, FloatArray, Scene
from potr_cl.ondevice.decode import decode_to_device
from potr_cl.opencl.device import Device
from potr_cl.outputs.colour_grid import ColourGrid
from potr_cl.outputs.output import Output, Request, Rounded
from potr_cl.raster.resident import large_for
from potr_cl.raster.scene_buffers import Drawable

_NAMES = {
    **dict.fromkeys(ORDER[: ORDER.index(Property.STEPS)], "position"),
    Property.SCALE: "scale",
    Property.ROTATION: "rotation",
    Property.OPACITY: "opacity",
    Property.STEPS: "colour: precision",
    Property.SH0: "colour: DC",
    **dict.fromkeys(SH[1:], "colour: AC"),
}


@dataclass(frozen=True)
class Potr(Output):
    """A .potr file: :mod:`potr_cl.codec`. AC coefficients are rounded to steps finer than one sees."""

    format: ClassVar[SceneFormat] = POTR
    choices: ClassVar[frozenset[str]] = frozenset(
        {"entropy", "zstd_level"} | {each.name for each in fields(HyperParameters)}
    )
    steps: ClassVar[bool] = True
    fixes_ac: ClassVar[bool] = True

    def geometry(self, scene: Scene, request: Request) -> AnyGeometry:
        """See :func:`potr_cl.codec.blocks.quantise`."""
        with thread_pool(request.threads) as pool:
            return quantise(scene, request.parameters, request.views, pool.map)

    def on_grid(self, request: Request) -> bool:
        """With the quantiser that has steps of each splat."""
        return QUANTISERS[request.parameters.quantiser].colour_steps

    def colour_grid(self, rounded: Rounded, effects: FloatArray, request: Request) -> tuple[Rounded, ColourGrid]:
        """Fit the steps of colours to each splat."""
        assert isinstance(rounded, (Geometry, GeometryOfBlocks))
        geometry = rounded.with_steps(effects)
        return geometry, ColourGrid.of(geometry)

    def file(self, scene: Scene, rounded: Rounded | None, request: Request) -> Coded:
        """See :func:`potr_cl.codec.encoder.code_scene`."""
        assert rounded is None or isinstance(rounded, (Geometry, GeometryOfBlocks))
        return code_scene(
            scene,
            request.parameters,
            request.views,
            request.metadata,
            request.entropy,
            request.threads,
            request.progress,
            rounded,
        )

    def read(self, data: bytes, trust: bool = False) -> Scene:
        """See :func:`potr_cl.codec.decoder.decode`."""
        return decode(data, trust)

    @contextmanager
    def seen(self, data: bytes, device: Device, trust: bool = False, memory: int | None = None) -> Iterator[Drawable]:
        """See :func:`potr_cl.ondevice.decode.decode_to_device`.

        An ordinary scene where it does not fit the device; or where this is a CPU and has little memory: views are
        drawn from what they show of it then.
        """
        file = open_file(data, trust)
        with ExitStack() as stack:
            scene: Drawable | None = None
            of_host = device.info.shares_host_memory
            if memory is None or not (of_host and large_for(device, _decoded_bytes(file), memory)):
                with suppress(DeviceError):
                    scene = stack.enter_context(decode_to_device(file, device))
            if scene is None:
                with bounded(memory):
                    scene = file.scene()
            yield scene

    def properties(self, data: bytes) -> dict[str, int]:
        """Bytes by attribute; the header and the metadata are "other"."""
        names = ("position", "scale", "rotation", "opacity", "colour: DC", "colour: AC", "colour: precision", "other")
        sums = dict.fromkeys(names, 0)
        for section in (section for block in open_file(data, trust=True).blocks for section in block.sections):
            sums[_NAMES.get(section.kind, "other") if section.kind else "other"] += section.stored_bytes
        sums["other"] += len(data) - sum(sums.values())
        return {name: nbytes for name, nbytes in sums.items() if nbytes}


def _decoded_bytes(file: PotrFile) -> int:
    """Of the scene that a file holds."""
    return 4 * file.header.splats * (11 + 3 * SH_COEFFICIENTS[file.header.sh_degree])
