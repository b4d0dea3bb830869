/* The picture's dependence on the splats' colours, for GPUs, all views of a set in one launch: one work-group a tile;
   get_group_id(1) is the view's number. See refit_cpu.cl for the method, and subtile_lists.clh for how a tile's work is shared
   out.

   Macros: ALPHA_CAP, TRANSMITTANCE_THRESHOLD, WEIGHTS, NATIVE_EXP2, INT64_ATOMICS. */

#define ROUND 4
#include "include/subtile_lists.clh"
#include "refit/refit.clh"

/* Sums a splat: of w times the pixel's three channels, and of w^2. */
#define SUMS (3 + WEIGHTS)

kernel __attribute__((reqd_work_group_size(ITEMS, 1, 1)))
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
    global float *errors,
    volatile global uint *totals)
{
    local State state;
    local Batch near;
    local float4 all_parts[SUBTILES * PARTS];
    local int levels[SUMS * LEVELS * BATCH];
    local int unfinished[2], end_of_subtile[SUBTILES], rounds[2];
    local float item_errors[ITEMS];

    const int lid = get_local_id(0), share = lid % SHARE;
    const uint tile = get_group_id(0), number = get_group_id(1);
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

    for (int subtile = lid; subtile < SUBTILES; subtile += ITEMS)
        end_of_subtile[subtile] = 0;
    const int2 origin = (int2)(tile % columns, tile / columns) * TILE;
    uint last_batch;
    const uint swept = forward(
        &state, &near, unfinished, origin, picture, shapes, colours, intersections, subtiles, length, lid, &last_batch);

    /* From here on r, g, b are the pixels' values to multiply by. */
    Mine mine = pixels_of(lid / SHARE, origin, lid);
    float error = 0.0f;
    int end = 0;
    for (int p = 0; p < PIXELS; ++p) {
        const int i = mine.first + p * SHARE;
        const float through = fabs(state.t[i]);
        float r = 0.0f, g = 0.0f, b = 0.0f;
        if (inside(mine, p, picture)) {
            r = MAD(through, red, state.r[i]);
            g = MAD(through, green, state.g[i]);
            b = MAD(through, blue, state.b[i]);
            if (has_target) {
                global const float *pixel = target + 3 * (views->first_pixel + pixel_number(mine, p, picture));
                r -= pixel[0];
                g -= pixel[1];
                b -= pixel[2];
            }
        }
        r = clamp(r, -LARGEST_VALUE, LARGEST_VALUE);
        g = clamp(g, -LARGEST_VALUE, LARGEST_VALUE);
        b = clamp(b, -LARGEST_VALUE, LARGEST_VALUE);
        error += r * r + g * g + b * b;
        state.r[i] = r;
        state.g[i] = g;
        state.b[i] = b;
        state.t[i] = 1.0f;
        end = max(end, state.last[i] + 1);
    }
    item_errors[lid] = error;
    if (swept > 0)
        atomic_max(&end_of_subtile[mine.subtile], end);
    if (last_batch > 0 && lid < SUBTILES)
        near.places[lid] = 0;
    if (lid == 0)
        rounds[0] = 0;
    for (int step = ITEMS / 2; step > 0; step /= 2) {
        barrier(CLK_LOCAL_MEM_FENCE);
        if (lid < step)
            item_errors[lid] += item_errors[lid + step];
    }
    if (lid == 0)
        errors[views->first_tile + tile] = item_errors[0];
    if (swept == 0)
        return;

    /* The same way again, now with the pixels' values known. A single batch is still there. */
    local float4 *parts = all_parts + lid / SHARE * PARTS;
    int parity = 0;
    for (uint batch = 0; batch < swept; batch += BATCH) {
        const int size = min(swept - batch, (uint)BATCH);
        if (last_batch > 0) {
            fetch(&near, shapes, colours, intersections + batch, subtiles + batch, size, lid);
            barrier(CLK_LOCAL_MEM_FENCE);
            make_lists(&near, lid);
        }
        mine = pixels_of(near.dealt[lid / SHARE], origin, lid);
        local const uchar *list = near.lists + mine.subtile * LIST_ROOM;
        const int count = near.counts[mine.subtile];
        const int place = last_batch > 0 ? near.places[mine.subtile] : 0;
        const int left = clamp(end_of_subtile[mine.subtile] - place, 0, count);
        if (share == 0)
            atomic_max(&rounds[parity], (left + ROUND - 1) / ROUND);
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
        for (int i = lid; i < BATCH; i += ITEMS)
            for (int level = 0; level < SUMS * LEVELS; ++level)
                levels[level * BATCH + i] = 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        const int all_rounds = rounds[parity];
        parity ^= 1;
        if (lid == 0)
            rounds[parity] = 0;
        if (share == 0)
            near.places[mine.subtile] = place + places(count);
        for (int first = 0; first < all_rounds * ROUND; first += ROUND) {
            const int now = min(left - first, ROUND);
#pragma unroll 2
            for (int j = 0; j < now; ++j) {
                const int i = first + j;
                local const float4 *splat = near.shapes + 3 * list[i];
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
            const int summed = share / (SHARE / ROUND);
            if (summed < now) {
                float4 sum = (float4)(0.0f);
                for (int j = 0; j < ROUND; ++j)
                    /* Turned by the work-item's number, so that neighbours read from different banks. */
                    sum += parts[share * ROUND + ((j + summed) & (ROUND - 1))];
                const int k = list[first + summed];
                add_parts(levels + k, BATCH, sum.x);
                add_parts(levels + LEVELS * BATCH + k, BATCH, sum.y);
                add_parts(levels + 2 * LEVELS * BATCH + k, BATCH, sum.z);
#if WEIGHTS
                add_parts(levels + 3 * LEVELS * BATCH + k, BATCH, sum.w);
#endif
            }
            barrier(CLK_LOCAL_MEM_FENCE);
        }
        for (int p = 0; p < PIXELS; ++p)
            state.t[mine.first + p * SHARE] = t[p];
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int i = lid; i < size; i += ITEMS) {
            float4 sum = (float4)(0.0f);
            sum.x = whole_sum(levels + i, BATCH);
            sum.y = whole_sum(levels + LEVELS * BATCH + i, BATCH);
            sum.z = whole_sum(levels + 2 * LEVELS * BATCH + i, BATCH);
#if WEIGHTS
            sum.w = whole_sum(levels + 3 * LEVELS * BATCH + i, BATCH);
#endif
            add_sums(totals, near.splats[i], sum, scale);
        }
    }
}
