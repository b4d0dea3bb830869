/* How a picture changes when the splats change along a direction, for GPUs, all views of a set in one launch: one
   work-group a tile; get_group_id(1) is the view's number. See tangents_cpu.cl, its twin, for the method, and
   subtile_lists.clh for how a tile's work is shared out.

   Macros: ALPHA_CAP, TRANSMITTANCE_THRESHOLD, NATIVE_EXP2 (see subtile_lists.clh). */

#include "include/subtile_lists.clh"

kernel __attribute__((reqd_work_group_size(ITEMS, 1, 1)))
void tangents(
    global const SetView *views,
    uint stride,
    global const float4 *shapes,
    global const float4 *colours,
    global const float4 *changes,
    global const uint *offsets,
    global const uint *intersections,
    global const ushort *subtiles,
    float red,
    float green,
    float blue,
    ulong first_pixel,
    global float *result)
{
    local Batch batch;
    local float4 batch_changes[3 * (BATCH + 1)];
    /* By pixel: transmittance, its change, and those of the three channels. */
    local float state_t[TILE * TILE], state_through[TILE * TILE];
    local float state_r[TILE * TILE], state_g[TILE * TILE], state_b[TILE * TILE];
    local int unfinished[2];

    const int lid = get_local_id(0);
    const uint tile = get_group_id(0), number = get_group_id(1);
    views += number;
    const int2 picture = (int2)(views->view.width, views->view.height);
    const int columns = views->view.columns;
    if (tile >= (uint)(columns * views->view.rows))
        return;
    result += 3 * (first_pixel + views->first_pixel);
    shapes += 2 * (size_t)stride * number;
    colours += (size_t)stride * number;
    changes += 3 * (size_t)stride * number;
    offsets += views->first_offset + tile;
    const uint length = offsets[1] - offsets[0];
    intersections += views->first_intersection + offsets[0];
    subtiles += views->first_intersection + offsets[0];
    const int2 origin = (int2)(tile % columns, tile / columns) * TILE;

    Mine mine = pixels_of(lid / SHARE, origin, lid);
    for (int p = 0; p < PIXELS; ++p) {
        const int i = mine.first + p * SHARE;
        state_t[i] = inside(mine, p, picture) ? 1.0f : -1.0f;
        state_through[i] = state_r[i] = state_g[i] = state_b[i] = 0.0f;
    }
    if (lid == 0) {
        batch.shapes[3 * NOTHING] = (float4)(0.0f);
        batch.shapes[3 * NOTHING + 1] = (float4)(0.0f, -1e30f, 0.0f, 0.0f);
        batch.shapes[3 * NOTHING + 2] = (float4)(0.0f);
        for (int i = 0; i < 3; ++i)
            batch_changes[3 * NOTHING + i] = (float4)(0.0f);
    }
    uint swept = 0;
    int parity = 0;
    while (swept < length) {
        const int size = min(length - swept, (uint)BATCH);
        fetch(&batch, shapes, colours, intersections + swept, subtiles + swept, size, lid);
        for (int i = lid; i < 3 * size; i += ITEMS)
            batch_changes[i] = changes[3 * (size_t)intersections[swept + i / 3] + i % 3];
        if (lid == 0)
            unfinished[parity] = 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        make_lists(&batch, lid);
        mine = pixels_of(batch.dealt[lid / SHARE], origin, lid);
        local const uchar *list = batch.lists + mine.subtile * LIST_ROOM;
        const int count = batch.counts[mine.subtile];
        float t[PIXELS], through[PIXELS], r[PIXELS], g[PIXELS], b[PIXELS];
        int goes_on = 0;
        for (int p = 0; p < PIXELS; ++p) {
            const int i = mine.first + p * SHARE;
            t[p] = state_t[i];
            through[p] = state_through[i];
            r[p] = state_r[i];
            g[p] = state_g[i];
            b[p] = state_b[i];
            goes_on |= t[p] > 0.0f;
        }
        for (int i = 0; i < count && goes_on; i += LIST_STEP) {
#pragma unroll
            for (int j = 0; j < LIST_STEP; ++j) {
                const int k = list[i + j];
                local const float4 *splat = batch.shapes + 3 * k, *change = batch_changes + 3 * k;
                const float4 s0 = splat[0], s1 = splat[1], c0 = change[0], c1 = change[1];
                const float blue_k = splat[2].x, c2 = change[2].x;
                const float u0 = s0.z * (mine.x - s0.x);
#pragma unroll
                for (int p = 0; p < PIXELS; ++p) {
                    const float power = power_at(mine, p, u0, s0, s1);
                    const float dy = mine.y + p - s0.y;
                    const float u = MAD(s0.w, dy, u0), v = s1.x * dy;
                    const float most = fmin(EXP2(power), ALPHA_CAP);
                    const float alpha = power >= LOG2_ALPHA_MIN ? most : 0.0f;
                    const float after = MAD(-alpha, t[p], t[p]);
                    const int takes = after >= TRANSMITTANCE_THRESHOLD;
                    const float taken = takes ? alpha : 0.0f;
                    const float weight = taken * t[p];
                    const float factor =
                        MAD(u, MAD(u, c1.z, MAD(v, c1.w, c1.x)), MAD(v, MAD(v, c2, c1.y), c0.w));
                    const float change_here = alpha < ALPHA_CAP ? weight * factor : 0.0f;
                    const float shown = MAD(through[p], taken, change_here);
                    through[p] -= shown;
                    t[p] = takes ? after : -fabs(t[p]);
                    r[p] += MAD(weight, c0.x, shown * s1.z);
                    g[p] += MAD(weight, c0.y, shown * s1.w);
                    b[p] += MAD(weight, c0.z, shown * blue_k);
                }
            }
            goes_on = 0;
            for (int p = 0; p < PIXELS; ++p)
                goes_on |= t[p] > 0.0f;
        }
        if (goes_on)
            unfinished[parity] = 1;
        for (int p = 0; p < PIXELS; ++p) {
            const int i = mine.first + p * SHARE;
            state_t[i] = t[p];
            state_through[i] = through[p];
            state_r[i] = r[p];
            state_g[i] = g[p];
            state_b[i] = b[p];
        }
        swept += size;
        barrier(CLK_LOCAL_MEM_FENCE);
        if (!unfinished[parity])
            break;
        parity ^= 1;
    }
    mine = pixels_of(lid / SHARE, origin, lid);
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int p = 0; p < PIXELS; ++p)
        if (inside(mine, p, picture)) {
            const int i = mine.first + p * SHARE;
            const size_t pixel = pixel_number(mine, p, picture);
            result[3 * pixel] = MAD(state_through[i], red, state_r[i]);
            result[3 * pixel + 1] = MAD(state_through[i], green, state_g[i]);
            result[3 * pixel + 2] = MAD(state_through[i], blue, state_b[i]);
        }
}
