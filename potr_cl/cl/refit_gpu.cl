/* The picture's dependence on the splats' colours, for GPUs: one work-group of 64 a tile, four pixels a work-item. See
   refit_cpu.cl for the method.

   The sums over a tile's pixels are made for GROUP_ENTRIES splats at a time: each work-item leaves the sum of its own
   pixels in local memory, then four work-items a splat add them up.

   Macros: ALPHA_CAP, STOP, WEIGHTS, NATIVE_EXP2. */

#define LANES 1
#include "lanes.clh"
#include "splat.clh"
#include "refit.clh"

#define ITEMS 64
#define PIXELS 4
#define GROUP_ENTRIES 16

#if NATIVE_EXP2
#define EXP2 native_exp2
#else
#define EXP2 exp2_polynomial
#endif

kernel __attribute__((reqd_work_group_size(ITEMS, 1, 1)))
void refit_sweep(
    global const float4 *shapes,
    global const float4 *colours,
    global const uint *offsets,
    global const uint *entries,
    View view,
    float red,
    float green,
    float blue,
    global const float *target,
    int has_target,
    float scale,
    global float *errors,
    volatile global uint *totals)
{
    local float4 near_s0[ITEMS], near_s1[ITEMS];
    local float near_blue[ITEMS];
    local uint near_splat[ITEMS];
    local int unfinished[2];
    local float4 parts[GROUP_ENTRIES * ITEMS];
    local float item_errors[ITEMS];

    const int lid = get_local_id(0);
    const int tile = get_group_id(0);
    const int column = tile % view.columns * TILE + lid % TILE;
    const int first_row = tile / view.columns * TILE + lid / TILE * PIXELS;
    const float x = column + 0.5f;
    const uint begin = offsets[tile], end = offsets[tile + 1];

    float t[PIXELS], r[PIXELS], g[PIXELS], b[PIXELS];
    for (int p = 0; p < PIXELS; ++p) {
        t[p] = column < view.width && first_row + p < view.height ? 1.0f : -1.0f;
        r[p] = g[p] = b[p] = 0.0f;
    }

    uint swept = begin;
    int parity = 0, tile_alive = 1;
    while (swept < end && tile_alive) {
        const uint size = min(end - swept, (uint)ITEMS);
        if (lid < size) {
            uint splat = entries[swept + lid];
            float4 s1 = shapes[2 * splat + 1];
            float4 colour = colours[splat];
            near_s0[lid] = shapes[2 * splat];
            near_s1[lid] = (float4)(s1.x, s1.y, colour.x, colour.y);
            near_blue[lid] = colour.z;
        }
        if (lid == 0)
            unfinished[parity] = 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        for (uint k = 0; k < size; ++k) {
            float4 s0 = near_s0[k], s1 = near_s1[k];
            float u0 = s0.z * (x - s0.x);
            for (int p = 0; p < PIXELS; ++p) {
                float dy = first_row + p + 0.5f - s0.y;
                float u = mad(s0.w, dy, u0);
                float v = s1.x * dy;
                float power = s1.y - u * u - v * v;
                if (power >= LOG2_ALPHA_MIN && t[p] > 0.0f) {
                    float alpha = fmin(EXP2(power), ALPHA_CAP);
                    float after = mad(-alpha, t[p], t[p]);
                    if (after >= STOP) {
                        float weight = alpha * t[p];
                        t[p] = after;
                        r[p] = mad(weight, s1.z, r[p]);
                        g[p] = mad(weight, s1.w, g[p]);
                        b[p] = mad(weight, near_blue[k], b[p]);
                    } else {
                        t[p] = -t[p];
                    }
                }
            }
        }
        swept += size;
        if (t[0] > 0.0f || t[1] > 0.0f || t[2] > 0.0f || t[3] > 0.0f)
            unfinished[parity] = 1;
        barrier(CLK_LOCAL_MEM_FENCE);
        tile_alive = unfinished[parity];
        parity = 1 - parity;
    }

    float error = 0.0f;
    for (int p = 0; p < PIXELS; ++p) {
        const int row = first_row + p;
        const int inside = column < view.width && row < view.height;
        const float through = fabs(t[p]);
        const size_t pixel = 3 * ((size_t)row * view.width + column);
        r[p] = inside ? mad(through, red, r[p]) : 0.0f;
        g[p] = inside ? mad(through, green, g[p]) : 0.0f;
        b[p] = inside ? mad(through, blue, b[p]) : 0.0f;
        if (has_target && inside) {
            r[p] -= target[pixel];
            g[p] -= target[pixel + 1];
            b[p] -= target[pixel + 2];
        }
        r[p] = clamp(r[p], -LARGEST_VALUE, LARGEST_VALUE);
        g[p] = clamp(g[p], -LARGEST_VALUE, LARGEST_VALUE);
        b[p] = clamp(b[p], -LARGEST_VALUE, LARGEST_VALUE);
        error += r[p] * r[p] + g[p] * g[p] + b[p] * b[p];
        t[p] = inside ? 1.0f : -1.0f;
    }
    item_errors[lid] = error;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (lid == 0) {
        for (int item = 1; item < ITEMS; ++item)
            error += item_errors[item];
        errors[tile] = error;
    }

    /* The same way again, now with the pixels' values known. */
    for (uint batch = begin; batch < swept; batch += ITEMS) {
        const uint size = min(swept - batch, (uint)ITEMS);
        barrier(CLK_LOCAL_MEM_FENCE);
        if (lid < size) {
            uint splat = entries[batch + lid];
            float4 s1 = shapes[2 * splat + 1];
            near_splat[lid] = splat;
            near_s0[lid] = shapes[2 * splat];
            near_s1[lid] = (float4)(s1.x, s1.y, 0.0f, 0.0f);
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        for (uint group = 0; group < size; group += GROUP_ENTRIES) {
            const uint group_end = min(group + GROUP_ENTRIES, size);
            for (uint k = group; k < group_end; ++k) {
                float4 s0 = near_s0[k], s1 = near_s1[k];
                float u0 = s0.z * (x - s0.x);
                float4 sum = (float4)(0.0f);
                for (int p = 0; p < PIXELS; ++p) {
                    float dy = first_row + p + 0.5f - s0.y;
                    float u = mad(s0.w, dy, u0);
                    float v = s1.x * dy;
                    float power = s1.y - u * u - v * v;
                    if (power >= LOG2_ALPHA_MIN && t[p] > 0.0f) {
                        float alpha = fmin(EXP2(power), ALPHA_CAP);
                        float after = mad(-alpha, t[p], t[p]);
                        if (after >= STOP) {
                            float weight = alpha * t[p];
                            t[p] = after;
                            sum.x = mad(weight, r[p], sum.x);
                            sum.y = mad(weight, g[p], sum.y);
                            sum.z = mad(weight, b[p], sum.z);
                            sum.w = mad(weight, weight, sum.w);
                        } else {
                            t[p] = -t[p];
                        }
                    }
                }
                parts[(k - group) * ITEMS + lid] = sum;
            }
            barrier(CLK_LOCAL_MEM_FENCE);
            float4 sum = (float4)(0.0f);
            if (group + lid / 4 < group_end)
                for (int j = 0; j < ITEMS / 4; ++j)
                    /* Turned by the work-item's number, so that neighbours read from different banks. */
                    sum += parts[lid * (ITEMS / 4) + ((j + lid) & (ITEMS / 4 - 1))];
            barrier(CLK_LOCAL_MEM_FENCE);
            parts[lid] = sum;
            barrier(CLK_LOCAL_MEM_FENCE);
            if (lid < group_end - group) {
                sum = (parts[4 * lid] + parts[4 * lid + 1]) + (parts[4 * lid + 2] + parts[4 * lid + 3]);
                add_sums(totals, near_splat[group + lid], sum, scale);
            }
            barrier(CLK_LOCAL_MEM_FENCE);
        }
    }
}
