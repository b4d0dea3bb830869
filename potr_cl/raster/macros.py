"""Macros of the kernels that depend on what a device can do."""

from __future__ import annotations

from potr_cl.opencl.device import Device


def gpu_limits(device: Device) -> dict[str, int]:
    """Of the GPU kernels that composite (cl/include/subtile_lists.clh)."""
    return {"NATIVE_EXP2": int(device.native_exp2)} | totals_limits(device)


def totals_limits(device: Device) -> dict[str, int]:
    """Of kernels with exact totals (cl/include/totals.clh)."""
    extensions = device.info.handle.extensions.split()
    # Elsewhere than in the low word first, the two words of a total would be swapped.
    int64 = "cl_khr_int64_base_atomics" in extensions and device.info.handle.endian_little
    return {"INT64_ATOMICS": int(int64)}
