/* Small kernels by which opencl/device.py finds out what a device does right.

   Macros: LANES (see lanes.clh). With 1 there are more kernels, which have no vectors.

   On GPUs: LANES=1,4,8,16 NATIVE_EXP2=-,1. */

#include "include/lanes.clh"
#include "include/registers.clh"

kernel void probe_rows(global const float *values, global float *result)
{
    const size_t i = get_global_id(0);
    VSTORE(exp2_polynomial(VLOAD(i, values)), i, result);
}

/* Digits by which devices can be told apart that round differently: of what the kernels compute, all bits are mixed. */
kernel void probe_digits(global const float *values, global int *result)
{
    const size_t i = get_global_id(0);
    const vfloat v = VLOAD(i, values), power = EXP2(v);
    vfloat sum = power;
    for (int k = 0; k < 8; ++k)
        sum = MAD(sum, v, power);
    const vint bits = AS_VINT(sum) * 31 ^ AS_VINT(sqrt(power) / (1.0f - v));
    VSTORE(bits * 31 ^ AS_VINT((vfloat)(sum_lanes(power))) ^ AS_VINT(log2(1.0f - v)), i, result);
}

#if LANES == 1
kernel NARROW void probe_native_exp2(global const float *values, global float *result)
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
