"""Device memory that views may fill."""

from __future__ import annotations

from potr_cl.opencl.device import Device

#: Part of the device's memory that the views may take unless the caller sets a budget. A CPU's is that of the host: the
#: scene, its new colours and all other programs live there too.
_SHARE, _SHARE_OF_HOST = 0.5, 0.3


def default_memory(device: Device) -> int:
    """Bytes that the views may take: half of a GPU's memory, 0.3 of a CPU's, which is the host's memory."""
    return int(device.info.memory * (_SHARE_OF_HOST if device.info.shares_host_memory else _SHARE))
