/* Compositing for GPUs: one work-group a tile, one pixel a work-item, splats fetched into local memory in batches.

   Macros: ALPHA_CAP, STOP (a pixel ends before its transmittance would fall below it), NATIVE_EXP2. */

#define LANES 1
#include "lanes.clh"
#include "splat.clh"

#define BATCH (TILE * TILE)

#if NATIVE_EXP2
#define EXP2 native_exp2
#else
#define EXP2 exp2_polynomial
#endif

kernel __attribute__((reqd_work_group_size(TILE, TILE, 1)))
void composite(
    global const float4 *shapes,
    global const float4 *colours,
    global const uint *offsets,
    global const uint *entries,
    uint capacity,
    View view,
    float red,
    float green,
    float blue,
    global float *image,
    global float *transmittance)
{
    local float4 near_s0[BATCH], near_s1[BATCH];
    local float near_blue[BATCH];
    local int alive_count[2];

    const int lid = get_local_id(1) * TILE + get_local_id(0);
    const int tile = get_group_id(1) * view.columns + get_group_id(0);
    const int column = get_global_id(0), row = get_global_id(1);
    const int inside = column < view.width && row < view.height;
    const float x = column + 0.5f, y = row + 0.5f;
    const uint end = min(offsets[tile + 1], capacity);

    float t = 1.0f, r = 0.0f, g = 0.0f, b = 0.0f;
    int alive = inside;
    int parity = 0;
    int tile_alive = 1;
    for (uint batch = min(offsets[tile], capacity); batch < end && tile_alive; batch += BATCH) {
        const int size = min((uint)BATCH, end - batch);
        barrier(CLK_LOCAL_MEM_FENCE);
        if (lid < size) {
            uint splat = entries[batch + lid];
            float4 s1 = shapes[2 * splat + 1];
            float4 colour = colours[splat];
            near_s0[lid] = shapes[2 * splat];
            near_s1[lid] = (float4)(s1.x, s1.y, colour.x, colour.y);
            near_blue[lid] = colour.z;
        }
        if (lid == 0)
            alive_count[parity] = 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int k = 0; k < size && alive; ++k) {
            float4 s0 = near_s0[k], s1 = near_s1[k];
            float dy = y - s0.y;
            float u = mad(s0.z, x - s0.x, s0.w * dy);
            float v = s1.x * dy;
            float power = mad(-u, u, mad(-v, v, s1.y));
            if (power >= LOG2_ALPHA_MIN) {
                float alpha = fmin(EXP2(power), ALPHA_CAP);
                float after = mad(-alpha, t, t);
                if (after < STOP) {
                    alive = 0;
                } else {
                    float weight = alpha * t;
                    r = mad(weight, s1.z, r);
                    g = mad(weight, s1.w, g);
                    b = mad(weight, near_blue[k], b);
                    t = after;
                }
            }
        }
        if (alive)
            atomic_inc(&alive_count[parity]);
        barrier(CLK_LOCAL_MEM_FENCE);
        tile_alive = alive_count[parity];
        parity ^= 1;
    }
    if (inside) {
        size_t pixel = (size_t)row * view.width + column;
        image[3 * pixel] = mad(t, red, r);
        image[3 * pixel + 1] = mad(t, green, g);
        image[3 * pixel + 2] = mad(t, blue, b);
        transmittance[pixel] = t;
    }
}
