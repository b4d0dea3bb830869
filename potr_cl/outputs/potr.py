"""The package's own files as an output: the usual one, with steps that q sets, and entropy coders."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, fields
from typing import ClassVar

from potr_cl.codec.blocks.encoder import code_blocks
from potr_cl.codec.blocks.file import BlockedFile
from potr_cl.codec.blocks.geometry import AnyGeometry, GeometryOfBlocks, in_blocks, quantise
from potr_cl.codec.decoder import AnyFile, decode, open_file, scene_of_file
from potr_cl.codec.encoder import Coded, code_scene
from potr_cl.codec.geometry import Geometry
from potr_cl.codec.quantize import HyperParameters
from potr_cl.codec.sections import Property
from potr_cl.codec.versions import VERSIONS
from potr_cl.errors import DeviceError
from potr_cl.formats.declaration import SceneFormat
from potr_cl.formats.scenes.potr import FORMAT
from potr_cl.host.mapped import bounded
from potr_cl.host.threads import thread_pool
from potr_cl.model.scene import SH_COEFFICIENTS, FloatArray, Scene
from potr_cl.ondevice.decode import decode_to_device
from potr_cl.opencl.device import Device
from potr_cl.outputs.colour_grid import ColourGrid
from potr_cl.outputs.output import Output, Request, Rounded
from potr_cl.raster.kept_scene import large_for
from potr_cl.raster.scene_buffers import Drawable

_NAMES = {
    Property.OCCUPANCY: "position",
    Property.SEVERAL: "position",
    Property.MULTIPLICITY: "position",
    Property.TAIL_LENGTH: "position",
    Property.TAIL: "position",
    Property.SCALE: "scale",
    Property.ROTATION: "rotation",
    Property.OPACITY: "opacity",
    Property.STEPS: "colour: steps",
}


@dataclass(frozen=True)
class Potr(Output):
    """A .potr file: :mod:`potr_cl.codec`. AC coefficients are rounded to steps finer than one sees."""

    format: ClassVar[SceneFormat] = FORMAT
    choices: ClassVar[frozenset[str]] = frozenset(
        {"entropy", "zstd_level"} | {each.name for each in fields(HyperParameters)}
    )
    steps: ClassVar[bool] = True
    fixes_ac: ClassVar[bool] = True

    def geometry(self, scene: Scene, request: Request) -> AnyGeometry:
        """See :func:`potr_cl.codec.blocks.geometry.quantise`."""
        with thread_pool(request.threads) as pool:
            return quantise(scene, request.parameters, request.views, pool.map)

    def on_grid(self, request: Request) -> bool:
        """In the versions of the format that have steps of each splat."""
        return VERSIONS[request.parameters.version].colour_steps

    def colour_grid(self, rounded: Rounded, effects: FloatArray, request: Request) -> tuple[Rounded, ColourGrid]:
        """Fit the steps of colours to each splat."""
        assert isinstance(rounded, (Geometry, GeometryOfBlocks))
        geometry = rounded.with_steps(effects)
        return geometry, ColourGrid.of(geometry)

    def file(self, scene: Scene, rounded: Rounded | None, request: Request) -> Coded:
        """See :func:`potr_cl.codec.encoder.code_scene`, and :func:`potr_cl.codec.blocks.encoder.code_blocks`."""
        if rounded is None and in_blocks(len(scene), request.parameters):
            rounded = self.geometry(scene, request)
        if isinstance(rounded, GeometryOfBlocks):
            return code_blocks(scene, rounded, request.metadata, request.entropy, request.threads, request.progress)
        assert rounded is None or isinstance(rounded, Geometry)
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
            of_host = device.info.kind == "cpu" or device.info.integrated
            if memory is None or not (of_host and large_for(device, _decoded_bytes(file), memory)):
                with suppress(DeviceError):
                    scene = stack.enter_context(decode_to_device(file, device))
            if scene is None:
                with bounded(memory):
                    scene = scene_of_file(file)
            yield scene

    def properties(self, data: bytes) -> dict[str, int]:
        """Bytes by attribute; the header and the metadata are "other"."""
        names = ("position", "scale", "rotation", "opacity", "colour: DC", "colour: AC", "colour: steps", "other")
        sums = dict.fromkeys(names, 0)
        file = open_file(data, trust=True)
        headers = [file.header(k) for k in file.numbers()] if isinstance(file, BlockedFile) else [file.header]
        for section in (section for header in headers for section in header.sections):
            if section.kind == Property.SH:
                name = "colour: DC" if section.index < 3 else "colour: AC"
            else:
                name = _NAMES.get(section.kind, "other")
            sums[name] += section.stored_bytes
        sums["other"] += len(data) - sum(sums.values())
        return {name: nbytes for name, nbytes in sums.items() if nbytes}


def _decoded_bytes(file: AnyFile) -> int:
    """Of the scene that a file holds."""
    of = file.table if isinstance(file, BlockedFile) else file.header
    return 4 * of.splats * (11 + 3 * SH_COEFFICIENTS[of.sh_degree])
