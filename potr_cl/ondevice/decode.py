"""From the bytes of a .potr file to a scene on a device: :func:`decode_to_device`.

The host undoes the entropy coding and makes values while they are in a cache, and uploads them without the AC
coefficients that are 0 (:mod:`potr_cl.ondevice.staged_bundles`).
"""

from __future__ import annotations

from potr_cl.codec.body import Body
from potr_cl.codec.decoder import PotrFile
from potr_cl.errors import DataError
from potr_cl.model.scene import LOW_PASS, most_coefficients
from potr_cl.ondevice.dequantiser import DeviceBundles
from potr_cl.opencl.device import Device
from potr_cl.raster.scene_buffers import SceneBuffers


def decode_to_device(
    file: PotrFile,
    device: Device,
    sh_degree: int | None = None,
    antialiased: bool | None = None,
    threads: int = 0,
) -> SceneBuffers:
    """Decode a file into a device's memory: the same bits there as of its scene that was decoded and uploaded.

    Args:
        file: opened. Of several blocks one after the other is decoded, each into buffers of its own first.
        device: to hold the scene.
        sh_degree: leave out SH coefficients of higher degrees; None: none.
        antialiased: whether to take it as an antialiased scene; None: as the file says.
        threads: on the host; 0: one a processor.

    Returns:
        The scene, finished; the caller closes it.

    Raises:
        UsageError: there is no such degree.
        DataError: damaged.
        DeviceError: the scene does not fit the device, or the device failed.
    """
    numbers, head = file.numbers(), file.blocks[0]
    asked = head.antialiased if antialiased is None else antialiased
    low_pass = head.low_pass if asked == head.antialiased else LOW_PASS
    count = most_coefficients(head.sh_degree, sh_degree)

    def decoded(number: int) -> SceneBuffers:
        buffers = SceneBuffers(device, file.blocks[number].splats, count, asked, low_pass)
        try:
            file.of(number, lambda body: _decode(body, buffers, threads, sh_degree), sh_degree)
        except BaseException:
            buffers.close()
            raise
        return buffers

    if len(numbers) == 1:
        return decoded(numbers[0])
    whole = SceneBuffers(device, file.header.splats, count, asked, low_pass)
    try:
        for number in numbers:
            with decoded(number) as part:
                whole.write_part(part, file.blocks[number].first)
    except BaseException:
        whole.close()
        raise
    return whole


def _decode(body: Body, buffers: SceneBuffers, threads: int, sh_degree: int | None) -> None:
    destination = DeviceBundles(buffers)
    try:
        body.decode_into(destination, threads, sh_degree)
    except MemoryError:
        raise DataError(f"{buffers.splats} splats need more memory than the host has, to be decoded") from None
    finally:
        destination.finish()
