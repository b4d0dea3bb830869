/* Sums of transmittances T over a tile's pixels, one for each intersection of the tile's list: one work-group a tile on
   GPUs (LANES 1), one work-item on CPUs. A GPU's work-group adds up in fixed point, of which 256 ones just fit 32 bits:
   the sums are the same on every run.

   Macros: LANES, ALPHA_CAP, TRANSMITTANCE_THRESHOLD. */

#include "include/lanes.clh"
#include "include/splat.clh"

kernel void transmittance_sums(
    global const float4 *shapes,
    global const uint *offsets,
    global const uint *intersections,
    View view,
    global float *sums)
{
#if LANES == 1
    local float4 near_s0[TILE * TILE];
    local float2 near_s1[TILE * TILE];
    local uint parts[TILE * TILE];
    const int lid = get_local_id(0), tile = get_group_id(0);
    const int column = tile % view.columns * TILE + lid % TILE;
    const int row = tile / view.columns * TILE + lid / TILE;
    const uint begin = offsets[tile], end = offsets[tile + 1];
    int alive = column < view.width && row < view.height;
    float t = 1.0f;
    for (uint batch = begin; batch < end; batch += TILE * TILE) {
        const int size = min(end - batch, (uint)(TILE * TILE));
        if (lid < size) {
            const uint splat = intersections[batch + lid];
            near_s0[lid] = shapes[2 * splat];
            near_s1[lid] = shapes[2 * splat + 1].xy;
        }
        parts[lid] = 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int k = 0; k < size && alive; ++k) {
            const float4 s0 = near_s0[k];
            const float2 s1 = near_s1[k];
            const float dy = row + 0.5f - s0.y;
            const float u = s0.z * (column + 0.5f - s0.x) + s0.w * dy;
            const float v = s1.x * dy;
            const float power = s1.y - u * u - v * v;
            if (power >= LOG2_ALPHA_MIN) {
                const float after = t - t * fmin(exp2_polynomial(power), ALPHA_CAP);
                if (after < TRANSMITTANCE_THRESHOLD) {
                    alive = 0;
                } else {
                    atomic_add(&parts[k], convert_uint_rte(t * 8388608.0f));
                    t = after;
                }
            }
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        if (lid < size)
            sums[batch + lid] = parts[lid] * (1.0f / 8388608.0f);
        barrier(CLK_LOCAL_MEM_FENCE);
    }
#else
    const int tile = get_global_id(0);
    const int2 origin = (int2)(tile % view.columns, tile / view.columns) * TILE;
    const int pixel_rows = min(TILE, view.height - origin.y);
    vfloat t[TILE * TILE / LANES]; /* of a pixel that has ended: negative */
    for (int i = 0; i < TILE * TILE / LANES; ++i) {
        const vfloat column = LANE_NUMBERS + (float)(origin.x + i % (TILE / LANES) * LANES);
        t[i] = column < (float)view.width ? (vfloat)(1.0f) : (vfloat)(-1.0f);
    }
    const uint end = offsets[tile + 1];
    for (uint intersection = offsets[tile]; intersection < end; ++intersection) {
        const uint splat = intersections[intersection];
        const float4 s0 = shapes[2 * splat];
        const float2 s1 = shapes[2 * splat + 1].xy;
        const float reach = sqrt(fmax(s1.y - LOG2_ALPHA_MIN + LEVEL_SLACK, 0.0f)) / s1.x + 1.0f;
        const float centre = s0.y - origin.y - 0.5f;
        const int first = (int)fmin(fmax(centre - reach, 0.0f), (float)TILE);
        const int last = (int)fmin(fmax(centre + reach + 1.0f, 0.0f), (float)pixel_rows);
        vfloat sum = 0.0f;
        for (int row = first; row < last; ++row) {
            const float dy = origin.y + row + 0.5f - s0.y;
            const float v = s1.x * dy;
            for (int part = 0; part < TILE / LANES; ++part) {
                const int i = row * (TILE / LANES) + part;
                const vfloat x = LANE_NUMBERS + (origin.x + part * LANES + 0.5f);
                const vfloat u = s0.z * (x - s0.x) + s0.w * dy;
                const vfloat power = s1.y - u * u - v * v;
                const vfloat before = t[i];
                const vint touched = (power >= LOG2_ALPHA_MIN) & (before > 0.0f);
                const vfloat after = before - before * fmin(exp2_polynomial(power), (vfloat)(ALPHA_CAP));
                const vint goes_on = touched & (after >= TRANSMITTANCE_THRESHOLD);
                sum += goes_on ? before : (vfloat)(0.0f);
                t[i] = touched ? (goes_on ? after : -before) : before;
            }
        }
        float lanes[LANES], total = 0.0f;
        VSTORE(sum, 0, lanes);
        for (int lane = 0; lane < LANES; ++lane)
            total += lanes[lane];
        sums[intersection] = total;
    }
#endif
}
