/* Small kernels by which opencl/device.py finds out what a device does right.

   Macros: LANES (see lanes.clh). With 1 there are more kernels, which have no vectors. */

#include "include/lanes.clh"

kernel void probe_rows(global const float *values, global float *result)
{
    const size_t i = get_global_id(0);
    VSTORE(exp2_polynomial(VLOAD(i, values)), i, result);
}

#if LANES == 1
kernel void probe_native_exp2(global const float *values, global float *result)
{
    const size_t i = get_global_id(0);
    result[i] = native_exp2(values[i]);
}

kernel __attribute__((reqd_work_group_size(64, 1, 1)))
void probe_integers(volatile global uint *counters, global ulong *keys)
{
    local uint shared[64];
    const uint i = get_global_id(0), lid = get_local_id(0);
    shared[63 - lid] = lid;
    barrier(CLK_LOCAL_MEM_FENCE);
    atomic_inc(&counters[0]);
    if (lid == 0)
        atomic_add(&counters[1], shared[0]);
    keys[i] = ((ulong)i << 32) | 7;
}
#endif
