/* The removal kernel for GPUs with the paper's second half: see removal_prefix_sums_cpu.cl, whose names and order of
   operations these are. The first half is that of prune/removal_gpu.cl, in whose place this file is read.

   Macros: ALPHA_CAP, TRANSMITTANCE_THRESHOLD, NATIVE_EXP2, INT64_ATOMICS, and TIGHTEN for what is shared; PICKED must
   be 0. */

#define SCENE_NUMBER(splat) ((size_t)(splat))

/* As in prune/removal_gpu.cl. */
#define SUMS 2
#define PART float2
#define ROUND 8
#define PADDING SHARE
#include "include/subtile_batches.clh"
#include "prune/removal.clh"
#include "prune/staleness_gpu.clh"

kernel __attribute__((reqd_work_group_size(ITEMS, 1, 1)))
void removal(
    uint start,
    global const uint *tiles,
    global const SetView *views,
    uint view_count,
    uint stride,
    global const float4 *shapes,
    global const float4 *colours,
    global const uint *offsets,
    global const uint *lengths,
    global const uint *intersections,
    global const ushort *subtiles,
    float red,
    float green,
    float blue,
    int first_time,
    float scale,
    float most_pixels,
    float bound,
    global float *target,
    global float2 *sums,
    global const uint *numbers,
    volatile global uint *totals)
{
    local State state;
    local Batch batch;
    local Walk walk;
    local float behind_r[TILE * TILE], behind_g[TILE * TILE], behind_b[TILE * TILE];
    local int unfinished[2];

    const int lid = get_local_id(0), share = lid % SHARE;
    const uint set_tile = tiles[start + get_group_id(0)];
    const uint number = view_of_tile(views, view_count, set_tile);
    views += number;
    const int2 picture = (int2)(views->view.width, views->view.height);
    const int columns = views->view.columns;
    const uint tile = set_tile - views->first_tile;
    shapes += 2 * (size_t)stride * number;
    colours += (size_t)stride * number;
    const uint begin = views->first_intersection + offsets[views->first_offset + tile];
    const uint length = lengths[set_tile];
    intersections += begin;
    subtiles += begin;
    sums += begin;
    const float weight = most_pixels / ((float)picture.x * picture.y);
    const float view_scale = scale * weight, view_bound = bound / weight;

    start_walk(&walk, lid);
    const int2 origin = (int2)(tile % columns, tile / columns) * TILE;
    uint first; /* of the intersections of the batch */
    const uint swept = forward(
        &state, &batch, unfinished, origin, picture, shapes, colours, intersections, subtiles, length, lid, &first);
    /* What lies behind the last pixel's end has no effect any more. */
    for (uint e = swept + lid; e < length; e += ITEMS) {
        replace_sums(totals + TOTAL_WORDS * (size_t)intersections[e], sums[e], (float2)(0.0f), view_scale, view_bound);
        sums[e] = (float2)(0.0f);
    }

    /* From here on r, g, b are the final colour, and behind_r, behind_g, behind_b the colour before a splat. */
    Mine mine = pixels_of(lid / SHARE, origin, lid);
    int end = 0;
    for (int p = 0; p < PIXELS; ++p) {
        const int i = mine.first + p * SHARE;
        const float left = fabs(state.t[i]);
        state.r[i] = MAD(left, red, state.r[i]);
        state.g[i] = MAD(left, green, state.g[i]);
        state.b[i] = MAD(left, blue, state.b[i]);
        if (first_time && inside(mine, p, picture)) {
            global float *pixel = target + 3 * (views->first_pixel + pixel_number(mine, p, picture));
            pixel[0] = state.r[i];
            pixel[1] = state.g[i];
            pixel[2] = state.b[i];
        }
        state.t[i] = 1.0f;
        behind_r[i] = behind_g[i] = behind_b[i] = 0.0f;
        end = max(end, state.last[i] + 1);
    }
    if (swept == 0)
        return;
    end_subtile(&walk, mine.subtile, end);
    barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE);
    if (lid < SUBTILES)
        batch.places[lid] = 0;

    local PART *parts = walk.parts + lid / SHARE * SUBTILE_PARTS;
    int turn = 0;
    for (first = 0; first < swept; first += BATCH) {
        const int size = min(swept - first, (uint)BATCH);
        fetch(&batch, shapes, colours, intersections + first, subtiles + first, size, lid);
        barrier(CLK_LOCAL_MEM_FENCE);
        make_lists(&batch, lid);
        mine = pixels_of(batch.dealt[lid / SHARE], origin, lid);
        local const uchar *list = batch.lists + mine.subtile * LIST_ROOM;
        const int count = batch.counts[mine.subtile];
        const int place = batch.places[mine.subtile];
        const int left = intersections_left(&walk, mine.subtile, place, count, turn, lid);
        float t[PIXELS], r[PIXELS], g[PIXELS], b[PIXELS];
        float dr[PIXELS], dg[PIXELS], db[PIXELS], pr[PIXELS], pg[PIXELS], pb[PIXELS];
        int last[PIXELS];
        for (int p = 0; p < PIXELS; ++p) {
            const int i = mine.first + p * SHARE;
            t[p] = state.t[i];
            r[p] = state.r[i];
            g[p] = state.g[i];
            b[p] = state.b[i];
            last[p] = state.last[i];
            pr[p] = behind_r[i];
            pg[p] = behind_g[i];
            pb[p] = behind_b[i];
            dr[p] = dg[p] = db[p] = 0.0f;
            if (inside(mine, p, picture)) {
                global const float *pixel = target + 3 * (views->first_pixel + pixel_number(mine, p, picture));
                dr[p] = 2.0f * (r[p] - pixel[0]);
                dg[p] = 2.0f * (g[p] - pixel[1]);
                db[p] = 2.0f * (b[p] - pixel[2]);
            }
        }
        clear_sums(&walk, lid);
        barrier(CLK_LOCAL_MEM_FENCE);
        const int rounds = agree_on_rounds(&walk, &turn, lid);
        if (share == 0)
            batch.places[mine.subtile] = place + places(count);
        for (int done = 0; done < rounds * ROUND; done += ROUND) {
            const int now = min(left - done, ROUND);
            for (int j = 0; j < now; ++j) {
                const int i = done + j;
                local const float4 *splat = batch.shapes + 3 * list[i];
                const float4 s0 = splat[0], s1 = splat[1];
                const float blue_k = splat[2].x;
                const float u0 = s0.z * (mine.x - s0.x);
                float effect = 0.0f, importance = 0.0f;
                for (int p = 0; p < PIXELS; ++p) {
                    const float power = power_at(mine, p, u0, s0, s1);
                    if (power >= LOG2_ALPHA_MIN && place + i <= last[p]) {
                        const float alpha = fmin(EXP2(power), ALPHA_CAP);
                        const float weight_k = alpha * t[p];
                        const float inverse = 1.0f / (1.0f - alpha);
                        const float after_r = MAD(weight_k, s1.z, pr[p]);
                        const float after_g = MAD(weight_k, s1.w, pg[p]);
                        const float after_b = MAD(weight_k, blue_k, pb[p]);
                        const float pd_r = MAD(MAD(alpha, r[p], -after_r), inverse, pr[p]);
                        const float pd_g = MAD(MAD(alpha, g[p], -after_g), inverse, pg[p]);
                        const float pd_b = MAD(MAD(alpha, b[p], -after_b), inverse, pb[p]);
                        effect = MAD(pd_r, pd_r + dr[p], effect);
                        effect = MAD(pd_g, pd_g + dg[p], effect);
                        effect = MAD(pd_b, pd_b + db[p], effect);
                        importance += weight_k;
                        t[p] = MAD(-alpha, t[p], t[p]);
                        pr[p] = after_r;
                        pg[p] = after_g;
                        pb[p] = after_b;
                    }
                }
                parts[j * SHARE + share] = (float2)(effect, importance);
            }
            barrier(CLK_LOCAL_MEM_FENCE);
            const int summed = summed_splat(share);
            if (summed < now) {
                const float2 sum = clamp(sum_parts(parts, share), -view_bound / SUBTILES, view_bound / SUBTILES);
                add_to_sums(&walk, list[done + summed], sum);
            }
            barrier(CLK_LOCAL_MEM_FENCE);
        }
        for (int p = 0; p < PIXELS; ++p) {
            const int i = mine.first + p * SHARE;
            state.t[i] = t[p];
            behind_r[i] = pr[p];
            behind_g[i] = pg[p];
            behind_b[i] = pb[p];
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int i = lid; i < size; i += ITEMS) {
            const float2 before = sums[first + i], after = sums_of(&walk, i);
            replace_sums(totals + TOTAL_WORDS * (size_t)batch.splats[i], before, after, view_scale, view_bound);
            sums[first + i] = after;
        }
    }
}

