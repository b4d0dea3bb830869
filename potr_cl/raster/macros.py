"""Macros of the kernels that depend on what a device can do."""

from __future__ import annotations

from potr_cl.opencl.device import Device


def gpu_limits(device: Device) -> dict[str, int]:
    """Macros of the GPU kernels that composite (cl/include/subtile_lists.clh)."""
    return {"NATIVE_EXP2": int(device.native_exp2)} | totals_limits(device)


def sweep_limits(device: Device) -> dict[str, int]:
    """Macros of a sweep over tiles that adds exact totals, of the device's family."""
    if device.family == "gpu":
        return gpu_limits(device)
    return {"LANES": max(device.vector_width, 8)} | totals_limits(device)


def totals_limits(device: Device) -> dict[str, int]:
    """Macros of the kernels with exact totals (cl/include/totals.clh)."""
    extensions = device.info.handle.extensions.split()
    # totals.clh has the low word first: where the device has the high one first, 64-bit additions would mix them up.
    int64 = "cl_khr_int64_base_atomics" in extensions and device.info.handle.endian_little
    return {"INT64_ATOMICS": int(int64)}
