"""From the bytes of a .potr file to a scene on a device: :func:`decode_to_device`.

The host undoes the entropy coding. Of files whose splats come in bundles it makes values too, while they are in a
cache, and uploads them without the AC coefficients that are 0 (:mod:`potr_cl.ondevice.staged_bundles`). Of others the
integers go to the device as they are, in one or two bytes each where they fit, and become values there.
"""

from __future__ import annotations

from collections.abc import Callable

from potr_cl.codec.blocks.file import BlockedFile
from potr_cl.codec.decoder import AnyFile, PotrFile
from potr_cl.codec.destination import Destination
from potr_cl.codec.sampled import Both
from potr_cl.errors import DataError
from potr_cl.model.scene import LOW_PASS, most_coefficients
from potr_cl.ondevice.dequantiser import DeviceDequantiser
from potr_cl.opencl.device import Device
from potr_cl.raster.scene_buffers import SceneBuffers

#: Makes what takes the same splats of a file, or of a block of one, from the number of the first of them.
Beside = Callable[[PotrFile, int], Destination]


def decode_to_device(
    file: AnyFile,
    device: Device,
    sh_degree: int | None = None,
    antialiased: bool | None = None,
    threads: int = 0,
    beside: Beside | None = None,
) -> SceneBuffers:
    """Decode a file into a device's memory: the same bits there as of its scene that was decoded and uploaded.

    Args:
        file: opened. Blocks are decoded one after the other, each into buffers of its own first.
        device: to hold the scene.
        sh_degree: leave out SH coefficients of higher degrees; None: none.
        antialiased: whether to take it as an antialiased scene; None: as the file says.
        threads: on the host; 0: one a processor.
        beside: makes what takes the same splats, or what it wants of them.

    Returns:
        The scene, finished; the caller closes it.

    Raises:
        UsageError: there is no such degree.
        DataError: damaged.
        DeviceError: the scene does not fit the device, or the device failed.
    """
    if not isinstance(file, BlockedFile):
        return _decoded(file, device, sh_degree, antialiased, threads, beside, 0)
    table = file.table
    _ = [file.header(number) for number in file.numbers()]  # before memory is taken on the table's word
    as_told = antialiased is None or antialiased == table.antialiased
    buffers = SceneBuffers(
        device,
        table.splats,
        most_coefficients(table.sh_degree, sh_degree),
        table.antialiased if antialiased is None else antialiased,
        table.low_pass if as_told else LOW_PASS,
    )
    try:
        for number, block in enumerate(table.blocks):
            body = file.checked(number)
            with _decoded(body, device, sh_degree, antialiased, threads, beside, block.first) as part:
                buffers.write_part(part, block.first)
    except BaseException:
        buffers.close()
        raise
    return buffers


def _decoded(
    file: PotrFile,
    device: Device,
    sh_degree: int | None,
    antialiased: bool | None,
    threads: int,
    beside: Beside | None,
    first: int,
) -> SceneBuffers:
    header = file.header
    count = file.sh_count(sh_degree)
    as_told = antialiased is None or antialiased == header.antialiased
    buffers = SceneBuffers(
        device,
        header.splats,
        count,
        header.antialiased if antialiased is None else antialiased,
        header.low_pass if as_told else LOW_PASS,
    )
    try:
        destination = DeviceDequantiser(header, file.rules, buffers)
        try:
            also = None if beside is None else beside(file, first)
            file.decode_into(destination if also is None else Both(destination, also), threads, sh_degree)
        finally:
            destination.finish()
    except MemoryError:
        buffers.close()
        raise DataError(f"{header.splats} splats need more memory than the host has, to be decoded") from None
    except BaseException:
        buffers.close()
        raise
    return buffers
