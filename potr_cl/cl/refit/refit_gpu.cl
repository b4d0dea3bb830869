/* The picture as a function of the splats' colours, and the way back, for GPUs, all views of a set in one launch: one
   work-group a tile; GROUP_ID(1) is the view's number. See refit_cpu.cl, its twin, for the method,
   subtile_lists.clh for how a tile's work is shared out, and subtile_batches.clh for the second walk.

   Macros:
       ALPHA_CAP, TRANSMITTANCE_THRESHOLD, NATIVE_EXP2  see subtile_lists.clh;
       INT64_ATOMICS                                    see totals.clh;
       WEIGHTS, LARGEST_VALUE                           see refit.clh.

   On GPUs: ALPHA_CAP=0.99f TRANSMITTANCE_THRESHOLD=1e-4f NATIVE_EXP2=0,1 INT64_ATOMICS=0,1 WEIGHTS=0,1
       LARGEST_VALUE=64.0f. */

/* A splat's sums of w times the pixel's three channels, and of w^2; of four splats at a time. */
#define SUMS (3 + WEIGHTS)
#define PART float4
#define ROUND 4
#include "include/group.clh"
#include "include/registers.clh"
#include "include/subtile_batches.clh"
#include "refit/refit.clh"
#include "refit/samples.clh"

kernel NARROW __attribute__((reqd_work_group_size(ITEMS, 1, 1)))
void refit_sweep(
    global const SetView *views,
    uint stride,
    global const float4 *shapes,
    global const float4 *colours,
    global const uint *offsets,
    global const uint *intersections,
    global const ushort *subtiles,
    float red,
    float green,
    float blue,
    global const float *target,
    int has_target,
    float scale,
    global const uint *numbers,
    uint first_number,
    uint every,
    int back,
    global float *errors,
    volatile global uint *totals)
{
    local State state;
    local Batch batch;
    local Walk walk;
    local int unfinished[2];
    local float item_errors[ITEMS];

    const int lid = get_local_id(0), share = lid % SHARE;
    const uint tile = GROUP_ID(0), number = GROUP_ID(1);
    views += number;
    const int2 picture = (int2)(views->view.width, views->view.height);
    const int columns = views->view.columns;
    if (tile >= (uint)(columns * views->view.rows))
        return;
    shapes += 2 * (size_t)stride * number;
    colours += (size_t)stride * number;
    totals += 2 * TOTALS * (size_t)stride * number;
    offsets += views->first_offset + tile;
    const uint length = offsets[1] - offsets[0];
    intersections += views->first_intersection + offsets[0];
    subtiles += views->first_intersection + offsets[0];

    const uint some = sampled_subtiles(every, numbers[first_number + number]);

    start_walk(&walk, lid);
    const int2 origin = (int2)(tile % columns, tile / columns) * TILE;
    uint last_batch;
    const uint swept = forward(
        &state, &batch, unfinished, origin, picture, shapes, colours, intersections, subtiles, length, some,
        lid, &last_batch);

    /* From here on r, g, b are the pixels' values to multiply by. */
    Mine mine = pixels_of(lid / SHARE, origin, lid);
    float error = 0.0f;
    const int end = pixel_values(
        &state, mine, picture, red, green, blue, target + 3 * (size_t)views->first_pixel, has_target, 0, 1.0f,
        LARGEST_VALUE, &error);
    for (int p = 0; p < PIXELS; ++p)
        state.t[mine.first + p * SHARE] = 1.0f;
    item_errors[lid] = error;
    if (swept > 0)
        end_subtile(&walk, mine.subtile, end);
    if (last_batch > 0 && lid < SUBTILES)
        batch.places[lid] = 0;
    for (int step = ITEMS / 2; step > 0; step /= 2) {
        barrier(CLK_LOCAL_MEM_FENCE);
        if (lid < step)
            item_errors[lid] += item_errors[lid + step];
    }
    if (lid == 0)
        errors[views->first_tile + tile] = item_errors[0];
    if (swept == 0 || !back)
        return;

    /* The same way again, now with the pixels' values known. A single batch is still there. */
    local PART *parts = walk.parts + lid / SHARE * SUBTILE_PARTS;
    int turn = 0;
    for (uint first = 0; first < swept; first += BATCH) {
        const int size = min(swept - first, (uint)BATCH);
        if (last_batch > 0) {
            fetch(&batch, shapes, colours, intersections + first, subtiles + first, size, some, lid);
            barrier(CLK_LOCAL_MEM_FENCE);
            make_lists(&batch, lid);
        }
        mine = pixels_of(batch.dealt[lid / SHARE], origin, lid);
        local const uchar *list = batch.lists + mine.subtile * LIST_ROOM;
        const int count = batch.counts[mine.subtile];
        const int place = last_batch > 0 ? batch.places[mine.subtile] : 0;
        const int left = intersections_left(&walk, mine.subtile, place, count, turn, lid);
        float t[PIXELS], r[PIXELS], g[PIXELS], b[PIXELS];
        int last[PIXELS];
        for (int p = 0; p < PIXELS; ++p) {
            const int i = mine.first + p * SHARE;
            t[p] = state.t[i];
            r[p] = state.r[i];
            g[p] = state.g[i];
            b[p] = state.b[i];
            last[p] = state.last[i];
        }
        clear_sums(&walk, lid);
        barrier(CLK_LOCAL_MEM_FENCE);
        const int rounds = agree_on_rounds(&walk, &turn, lid);
        if (share == 0)
            batch.places[mine.subtile] = place + places(count);
        for (int done = 0; done < rounds * ROUND; done += ROUND) {
            const int now = min(left - done, ROUND);
#pragma unroll 2
            for (int j = 0; j < now; ++j) {
                const int i = done + j;
                local const float4 *splat = batch.shapes + 3 * list[i];
                const float4 s0 = splat[0], s1 = splat[1];
                const float u0 = s0.z * (mine.x - s0.x);
                float4 sum = (float4)(0.0f);
#pragma unroll
                for (int p = 0; p < PIXELS; ++p) {
                    const float power = power_at(mine, p, u0, s0, s1);
                    const int takes = power >= LOG2_ALPHA_MIN && place + i <= last[p];
                    const float most = fmin(EXP2(power), ALPHA_CAP);
                    const float alpha = takes ? most : 0.0f;
                    const float weight = alpha * t[p];
                    t[p] = MAD(-alpha, t[p], t[p]);
                    sum.x = MAD(weight, r[p], sum.x);
                    sum.y = MAD(weight, g[p], sum.y);
                    sum.z = MAD(weight, b[p], sum.z);
#if WEIGHTS
                    sum.w = MAD(weight, weight, sum.w);
#endif
                }
                parts[j * SHARE + share] = sum;
            }
            barrier(CLK_LOCAL_MEM_FENCE);
            const int summed = summed_splat(share);
            if (summed < now)
                add_to_sums(&walk, list[done + summed], sum_parts(parts, share));
            barrier(CLK_LOCAL_MEM_FENCE);
        }
        for (int p = 0; p < PIXELS; ++p)
            state.t[mine.first + p * SHARE] = t[p];
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int i = lid; i < size; i += ITEMS)
            add_sums(totals, batch.splats[i], sums_of(&walk, i), scale);
    }
}
