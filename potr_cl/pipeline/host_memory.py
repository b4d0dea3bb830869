"""What is left for views of memory that the host's own arrays are in, too (:func:`for_views`)."""

from __future__ import annotations

from potr_cl.opencl.device import Device
from potr_cl.views.visibility import LEAST_SPLATS

#: Bytes of the host's memory for each splat: what is not mapped of the scene (44), and what pruning knows of the splats
#: while it chooses among them, as measured with 2.5 and 10 million. And what the interpreter and compilers take.
_SPLAT, _PROCESS = 220, 1 << 28
#: Views get this part of the memory in any case.
_LEAST = 1 / 4


def for_views(device: Device, memory: int | None, splats: int) -> int | None:
    """How many bytes of a device's memory views may fill, of those that a whole encode may take.

    Args:
        device: where its memory is the host's, a large scene's arrays share it. A GPU's memory is its own.
        memory: bytes that are allowed; None: nothing was said.
        splats: of the scene. Of small ones the views take nearly all.
    """
    of_host = device.info.shares_host_memory
    if memory is None or not of_host or splats < LEAST_SPLATS:
        return memory
    return max(memory - _PROCESS - _SPLAT * splats, int(_LEAST * memory))
