/* Composites one view alone, for GPUs: one work-group a tile, one pixel a work-item (32 in a row make a block of 8 x 4
   pixels). Splats are fetched into local memory in batches.

   A frame that nothing runs beside takes as long as its longest tile list, which one work-group walks. This kernel is
   the faster one there, and needs no sub-tiles. composite_gpu.cl does less work in all, and is for many views at a
   time. Both do the same to a pixel in the same order, so that their pictures have the same bits.

   Macros:
       ALPHA_CAP                largest alpha of a splat in a pixel;
       TRANSMITTANCE_THRESHOLD  a pixel ends before its transmittance would fall below it;
       NATIVE_EXP2              see lanes.clh;
       AT_ONCE                  splats whose exponents are computed before the first of them is composited: a divisor of
                                BATCH, 8 by default.

   On GPUs: ALPHA_CAP=0.99f TRANSMITTANCE_THRESHOLD=1e-4f NATIVE_EXP2=0,1. */

#define LANES 1
#include "include/group.clh"
#include "include/lanes.clh"
#include "include/splat.clh"
#include "include/view_set.clh"

#define BATCH (TILE * TILE)
/* The exponents do not depend on each other, which hides latency. */
#ifndef AT_ONCE
#define AT_ONCE 8
#endif

/* Takes one splat of the next batch into registers, long before it is needed. Past the end it is one that touches
   nothing. */
#define FETCH                                              \
    if (next < end) {                                      \
        const uint splat = intersections[next];            \
        s0 = shapes[2 * (size_t)splat];                    \
        s1 = shapes[2 * (size_t)splat + 1];                \
        colour = colours[splat];                           \
    } else {                                               \
        s0 = (float4)(0.0f);                               \
        s1 = (float4)(0.0f, -1e30f, 0.0f, 0.0f);           \
        colour = (float4)(0.0f);                           \
    }                                                      \
    next += BATCH;

kernel __attribute__((reqd_work_group_size(BATCH, 1, 1)))
void composite_frame(
    global const SetView *views,
    global const float4 *shapes,
    global const float4 *colours,
    global const uint *offsets,
    global const uint *intersections,
    uint capacity,
    float red,
    float green,
    float blue,
    global float *image,
    global float *transmittance)
{
    local float4 batch_s0[BATCH], batch_s1[BATCH];
    local float batch_blue[BATCH];
    local int living[2];

    const int lid = get_local_id(0);
    const int tile = GROUP_ID(0);
    const int columns = views->view.columns, width = views->view.width;
    const int column = tile % columns * TILE + (lid & 7) + (lid >> 2 & 8);
    const int row = tile / columns * TILE + (lid >> 3 & 3) + (lid >> 6 << 2);
    const int inside = column < width && row < views->view.height;
    const float x = column + 0.5f, y = row + 0.5f;
    const uint begin = min(offsets[tile], capacity), end = min(offsets[tile + 1], capacity);
    uint next = begin + lid;

    float t = 1.0f, r = 0.0f, g = 0.0f, b = 0.0f;
    int alive = inside;
    int parity = 0;
    int tile_alive = 1;
    float4 s0, s1, colour;
    FETCH
    for (uint batch = begin; batch < end && tile_alive; batch += BATCH) {
        const int size = min((uint)BATCH, end - batch);
        barrier(CLK_LOCAL_MEM_FENCE);
        batch_s0[lid] = s0;
        batch_s1[lid] = (float4)(s1.x, s1.y, colour.x, colour.y);
        batch_blue[lid] = colour.z;
        if (lid == 0)
            living[parity] = 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        FETCH
        for (int k = 0; k < size && alive; k += AT_ONCE) {
            float powers[AT_ONCE];
            float most = LOG2_ALPHA_MIN - 1.0f;
            for (int j = 0; j < AT_ONCE; ++j) {
                const float4 n0 = batch_s0[k + j];
                const float2 n1 = batch_s1[k + j].xy;
                const float dy = y - n0.y;
                const float u = MAD(n0.w, dy, n0.z * (x - n0.x)), v = n1.x * dy;
                powers[j] = MAD(-u, u, MAD(-v, v, n1.y));
                most = fmax(most, powers[j]);
            }
            if (most < LOG2_ALPHA_MIN)
                continue;
            /* There are no branches from here on: a pixel that has ended, or that the splat misses, adds nothing. */
            float alphas[AT_ONCE];
            for (int j = 0; j < AT_ONCE; ++j)
                alphas[j] = powers[j] >= LOG2_ALPHA_MIN ? fmin(EXP2(powers[j]), ALPHA_CAP) : 0.0f;
            for (int j = 0; j < AT_ONCE; ++j) {
                const float after = MAD(-alphas[j], t, t);
                alive = alive && after >= TRANSMITTANCE_THRESHOLD;
                const float weight = alive ? alphas[j] * t : 0.0f;
                r = MAD(weight, batch_s1[k + j].z, r);
                g = MAD(weight, batch_s1[k + j].w, g);
                b = MAD(weight, batch_blue[k + j], b);
                t = alive ? after : t;
            }
        }
        if (alive)
            atomic_inc(&living[parity]);
        barrier(CLK_LOCAL_MEM_FENCE);
        tile_alive = living[parity];
        parity ^= 1;
    }
    if (inside) {
        const size_t pixel = (size_t)row * width + column;
        image[3 * pixel] = MAD(t, red, r);
        image[3 * pixel + 1] = MAD(t, green, g);
        image[3 * pixel + 2] = MAD(t, blue, b);
        transmittance[pixel] = t;
    }
}
