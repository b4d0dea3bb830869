/* The way back from pixels to splats, for GPUs, all views of a set in one launch: one work-group a tile;
   GROUP_ID(1) is the view's number. See derivatives_cpu.cl, its twin, for the method, and subtile_lists.clh for how
   a tile's work is shared out.

   On the way back each work-item finds w and e of its own pixels for ROUND splats at a time, and leaves them in local
   memory. Then the SHARE work-items of a sub-tile take a splat each, and sum over the sub-tile's pixels. The sums change
   hands once more before they are added to the totals: neighbours add what lies side by side then. That they did not
   took 45 % of the kernel's time on plush.

   Macros:
       ALPHA_CAP, TRANSMITTANCE_THRESHOLD, NATIVE_EXP2  see subtile_lists.clh;
       LARGEST_VALUE, LARGEST_GAP                       see sums.clh;
       INT64_ATOMICS                                    see totals.clh.

   On GPUs: ALPHA_CAP=0.99f TRANSMITTANCE_THRESHOLD=1e-4f NATIVE_EXP2=0,1 LARGEST_VALUE=64.0f LARGEST_GAP=1.0f
       INT64_ATOMICS=0,1. */

#include "include/group.clh"
#include "include/registers.clh"
#include "include/subtile_lists.clh"
#include "fit/sums.clh"

/* Splats that are summed at a time, one a work-item. */
#define ROUND SHARE
/* Pixels of a sub-tile. */
#define AREA (SHARE * PIXELS)
/* Where a pair of the round's splat j and pixel i lies. Rows are turned against each other, so that the work-items of
   four sub-tiles, each at another splat, read from different banks. */
#define PAIR(subtile, j, i) (((subtile) * ROUND + (j)) * AREA + (((i) + 2 * (j) + (subtile)) & (AREA - 1)))

kernel NARROW __attribute__((reqd_work_group_size(ITEMS, 1, 1)))
void derivatives(
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
    ulong first_pixel,
    int given,
    float unit,
    float scale,
    volatile global uint *totals)
{
    local State state;
    local Batch batch;
    local float behind[TILE * TILE];
    local float pair_w[SUBTILES * ROUND * AREA], pair_e[SUBTILES * ROUND * AREA];
    local uint splats[ITEMS];
    local int ends[SUBTILES], most_rounds[2], unfinished[2];

    const int lid = get_local_id(0), share = lid % SHARE, group = lid / SHARE;
    const uint tile = GROUP_ID(0), number = GROUP_ID(1);
    views += number;
    const int2 picture = (int2)(views->view.width, views->view.height);
    const int columns = views->view.columns;
    if (tile >= (uint)(columns * views->view.rows))
        return;
    target += 3 * (first_pixel + views->first_pixel);
    shapes += 2 * (size_t)stride * number;
    colours += (size_t)stride * number;
    totals += 2 * SUMS * (size_t)stride * number;
    offsets += views->first_offset + tile;
    const uint length = offsets[1] - offsets[0];
    intersections += views->first_intersection + offsets[0];
    subtiles += views->first_intersection + offsets[0];

    for (int subtile = lid; subtile < SUBTILES; subtile += ITEMS)
        ends[subtile] = 0;
    if (lid == 0)
        most_rounds[0] = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    const int2 origin = (int2)(tile % columns, tile / columns) * TILE;
    uint first; /* of the intersections of the batch */
    const uint swept = forward(
        &state, &batch, unfinished, origin, picture, shapes, colours, intersections, subtiles, length,
        ALL_SUBTILES, lid, &first);

    /* From here on r, g, b are the pixels' numbers v. */
    Mine mine = pixels_of(group, origin, lid);
    float error = 0.0f;
    const int end = pixel_values(
        &state, mine, picture, red, green, blue, target, 1, given, unit, LARGEST_VALUE, &error);
    for (int p = 0; p < PIXELS; ++p) {
        const int i = mine.first + p * SHARE;
        state.t[i] = fabs(state.t[i]);
        behind[i] = MAD(state.r[i], red, MAD(state.g[i], green, state.b[i] * blue));
    }
    atomic_max(&ends[mine.subtile], end);
    if (swept == 0)
        return;
    barrier(CLK_LOCAL_MEM_FENCE);

    /* Back, from the last splat to the first. */
    int turn = 0;
    for (;;) {
        mine = pixels_of(batch.dealt[group], origin, lid);
        local const uchar *list = batch.lists + mine.subtile * LIST_ROOM;
        const int count = batch.counts[mine.subtile];
        const int place = batch.places[mine.subtile] - places(count);
        int left = clamp(ends[mine.subtile] - place, 0, count);
        if (share == 0)
            atomic_max(&most_rounds[turn], (left + ROUND - 1) / ROUND);
        float t[PIXELS], r[PIXELS], g[PIXELS], b[PIXELS], h[PIXELS];
        int last[PIXELS];
        for (int p = 0; p < PIXELS; ++p) {
            const int i = mine.first + p * SHARE;
            t[p] = state.t[i];
            r[p] = state.r[i];
            g[p] = state.g[i];
            b[p] = state.b[i];
            last[p] = state.last[i];
            h[p] = behind[i];
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        const int rounds = most_rounds[turn];
        turn ^= 1;
        if (lid == 0)
            most_rounds[turn] = 0;
        if (share == 0)
            batch.places[mine.subtile] = place;
        for (int round = 0; round < rounds; ++round, left -= ROUND) {
            const int now = min(left, ROUND);
            for (int j = 0; j < now; ++j) {
                const int i = left - 1 - j;
                local const float4 *splat = batch.shapes + 3 * list[i];
                const float4 s0 = splat[0], s1 = splat[1];
                const float blue_k = splat[2].x;
                const float u0 = s0.z * (mine.x - s0.x);
#pragma unroll
                for (int p = 0; p < PIXELS; ++p) {
                    const float power = power_at(mine, p, u0, s0, s1);
                    const int takes = power >= LOG2_ALPHA_MIN && place + i <= last[p];
                    const float most = fmin(EXP2(power), ALPHA_CAP);
                    const float alpha = takes ? most : 0.0f;
                    const float front = t[p] / (1.0f - alpha);
                    t[p] = takes ? front : t[p];
                    const float weight = t[p] * alpha;
                    const float gap = MAD(r[p], s1.z, MAD(g[p], s1.w, b[p] * blue_k)) - h[p];
                    const float e = weight * clamp(gap, -LARGEST_GAP, LARGEST_GAP);
                    h[p] = MAD(alpha, gap, h[p]);
                    const int pair = PAIR(group, j, share + p * SHARE);
                    pair_w[pair] = weight;
                    pair_e[pair] = alpha < ALPHA_CAP ? e : 0.0f;
                }
            }
            barrier(CLK_LOCAL_MEM_FENCE);
            float sums[SUMS];
            for (int s = 0; s < SUMS; ++s)
                sums[s] = 0.0f;
            uint splat_number = 0;
            if (share < now) {
                const int k = list[left - 1 - share];
                local const float4 *splat = batch.shapes + 3 * k;
                const float4 s0 = splat[0];
                const float c = splat[1].x;
                const float x = mine.x - share % SUBTILE_WIDTH - s0.x;
                const float y = mine.y - share / SUBTILE_WIDTH * PIXELS - s0.y;
                const int pixels = mine.subtile * AREA;
                for (int i = 0; i < AREA; ++i) {
                    const int pair = PAIR(group, share, i);
                    const float w = pair_w[pair], e = pair_e[pair];
                    const float dx = x + i % SUBTILE_WIDTH;
                    const float dy = y + (i % SHARE / SUBTILE_WIDTH * PIXELS + i / SHARE);
                    const float u = MAD(s0.z, dx, s0.w * dy), v = c * dy;
                    const float eu = e * u, ev = e * v;
                    sums[0] = MAD(w, state.r[pixels + i], sums[0]);
                    sums[1] = MAD(w, state.g[pixels + i], sums[1]);
                    sums[2] = MAD(w, state.b[pixels + i], sums[2]);
                    sums[3] += e;
                    sums[4] += eu;
                    sums[5] += ev;
                    sums[6] = MAD(eu, u, sums[6]);
                    sums[7] = MAD(eu, v, sums[7]);
                    sums[8] = MAD(ev, v, sums[8]);
                }
                splat_number = batch.splats[k];
            }
            barrier(CLK_LOCAL_MEM_FENCE);
            for (int s = 0; s < SUMS; ++s)
                pair_w[lid * SUMS + s] = sums[s];
            splats[lid] = splat_number;
            barrier(CLK_LOCAL_MEM_FENCE);
            for (int i = lid; i < ITEMS * SUMS; i += ITEMS)
                add_sum(totals, splats[i / SUMS], i % SUMS, pair_w[i], scale);
            barrier(CLK_LOCAL_MEM_FENCE);
        }
        for (int p = 0; p < PIXELS; ++p) {
            const int i = mine.first + p * SHARE;
            state.t[i] = t[p];
            behind[i] = h[p];
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        if (first == 0)
            break;
        first -= BATCH;
        fetch(&batch, shapes, colours, intersections + first, subtiles + first, BATCH, ALL_SUBTILES, lid);
        barrier(CLK_LOCAL_MEM_FENCE);
        make_lists(&batch, lid);
    }
}
