"""From the bytes of a .potr file to a scene on a device: :func:`decode_to_device`.

The host undoes the entropy coding. The integers go to the device as they are, in one or two bytes each where they fit,
and become values there, where a rasterizer takes them.
"""

from __future__ import annotations

from potr_cl.codec.decoder import PotrFile
from potr_cl.codec.destination import Destination
from potr_cl.codec.sampled import Both
from potr_cl.errors import DataError
from potr_cl.model.scene import LOW_PASS
from potr_cl.ondevice.dequantiser import DeviceDequantiser
from potr_cl.opencl.device import Device
from potr_cl.raster.scene_buffers import SceneBuffers


def decode_to_device(
    file: PotrFile,
    device: Device,
    sh_degree: int | None = None,
    antialiased: bool | None = None,
    threads: int = 0,
    beside: Destination | None = None,
) -> SceneBuffers:
    """Decode a file into a device's memory: the same bits there as of its scene that was decoded and uploaded.

    Args:
        file: opened.
        device: to hold the scene.
        sh_degree: leave out SH coefficients of higher degrees; None: none.
        antialiased: whether to take it as an antialiased scene; None: as the file says.
        threads: on the host; 0: one a processor.
        beside: takes the same splats, or what it wants of them.

    Returns:
        The scene, finished; the caller closes it.

    Raises:
        UsageError: there is no such degree.
        DataError: damaged.
        DeviceError: the scene does not fit the device, or the device failed.
    """
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
            file.decode_into(destination if beside is None else Both(destination, beside), threads, sh_degree)
        finally:
            destination.finish()
    except MemoryError:
        buffers.close()
        raise DataError(f"{header.splats} splats need more memory than the host has, to be decoded") from None
    except BaseException:
        buffers.close()
        raise
    return buffers
