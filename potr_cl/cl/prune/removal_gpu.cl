/* Removal effects for GPUs, all views of a set in one launch: one work-group a tile. See removal_cpu.cl, its twin, for
   the method, subtile_lists.clh for how a tile's work is shared out, and subtile_batches.clh for the walk back.

   Macros:
       ALPHA_CAP, TRANSMITTANCE_THRESHOLD, NATIVE_EXP2  see subtile_lists.clh;
       INT64_ATOMICS                                    see totals.clh;
       PICKED                                           1: splats have other numbers in totals and states, which
                                                        `numbers` has.

   On GPUs: ALPHA_CAP=0.99f TRANSMITTANCE_THRESHOLD=1e-4f NATIVE_EXP2=0,1 INT64_ATOMICS=0,1 PICKED=0,1. */

#if PICKED
#define SCENE_NUMBER(splat) ((size_t)numbers[splat])
#else
#define SCENE_NUMBER(splat) ((size_t)(splat))
#endif

/* A splat's effect and importance, of eight splats at a time; with the padding, sub-tiles lie in different banks. */
#define SUMS 2
#define PART float2
#define ROUND 8
#define PADDING SHARE
#include "include/group.clh"
#include "include/registers.clh"
#include "include/subtile_batches.clh"
#include "prune/removal.clh"
#include "prune/staleness_gpu.clh"

/* As first_time: store the target, and measure nothing. */
#define ONLY_TARGET 2

kernel NARROW __attribute__((reqd_work_group_size(ITEMS, 1, 1)))
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
    const uint set_tile = tiles[start + GROUP_ID(0)];
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
        &state, &batch, unfinished, origin, picture, shapes, colours, intersections, subtiles, length,
        ALL_SUBTILES, lid, &first);
    /* What lies behind the last pixel's end has no effect any more. */
    for (uint e = swept + lid; e < length; e += ITEMS) {
        replace_sums(
            totals + TOTAL_WORDS * SCENE_NUMBER(intersections[e]), sums[e], (float2)(0.0f), view_scale, view_bound);
        sums[e] = (float2)(0.0f);
    }

    /* From here on r, g, b are twice the difference of the colour to the target. */
    Mine mine = pixels_of(lid / SHARE, origin, lid);
    int end = 0;
    for (int p = 0; p < PIXELS; ++p) {
        const int i = mine.first + p * SHARE;
        const float t = fabs(state.t[i]);
        if (inside(mine, p, picture)) {
            global float *pixel = target + 3 * (views->first_pixel + pixel_number(mine, p, picture));
            const float r = MAD(t, red, state.r[i]), g = MAD(t, green, state.g[i]), b = MAD(t, blue, state.b[i]);
            if (first_time) {
                pixel[0] = r;
                pixel[1] = g;
                pixel[2] = b;
            }
            state.r[i] = 2.0f * (r - pixel[0]);
            state.g[i] = 2.0f * (g - pixel[1]);
            state.b[i] = 2.0f * (b - pixel[2]);
        }
        state.t[i] = t;
        behind_r[i] = red;
        behind_g[i] = green;
        behind_b[i] = blue;
        end = max(end, state.last[i] + 1);
    }
    if (swept == 0 || first_time == ONLY_TARGET)
        return;
    end_subtile(&walk, mine.subtile, end);
    barrier(CLK_LOCAL_MEM_FENCE);

    /* Back, from the last splat to the first. */
    local PART *parts = walk.parts + lid / SHARE * SUBTILE_PARTS;
    int turn = 0;
    for (;;) {
        const int size = min(swept - first, (uint)BATCH);
        mine = pixels_of(batch.dealt[lid / SHARE], origin, lid);
        local const uchar *list = batch.lists + mine.subtile * LIST_ROOM;
        const int count = batch.counts[mine.subtile];
        const int place = batch.places[mine.subtile] - places(count);
        int left = intersections_left(&walk, mine.subtile, place, count, turn, lid);
        float t[PIXELS], r[PIXELS], g[PIXELS], b[PIXELS], br[PIXELS], bg[PIXELS], bb[PIXELS];
        int last[PIXELS];
        for (int p = 0; p < PIXELS; ++p) {
            const int i = mine.first + p * SHARE;
            t[p] = state.t[i];
            r[p] = state.r[i];
            g[p] = state.g[i];
            b[p] = state.b[i];
            last[p] = state.last[i];
            br[p] = behind_r[i];
            bg[p] = behind_g[i];
            bb[p] = behind_b[i];
        }
        clear_sums(&walk, lid);
        barrier(CLK_LOCAL_MEM_FENCE);
        const int rounds = agree_on_rounds(&walk, &turn, lid);
        if (share == 0)
            batch.places[mine.subtile] = place;
        for (int round = 0; round < rounds; ++round, left -= ROUND) {
            const int now = min(left, ROUND);
#pragma unroll 2
            for (int j = 0; j < now; ++j) {
                const int i = left - 1 - j;
                const int k = list[i];
                local const float4 *splat = batch.shapes + 3 * k;
                const float4 s0 = splat[0], s1 = splat[1];
                const float blue_k = splat[2].x;
                const float u0 = s0.z * (mine.x - s0.x);
                float effect = 0.0f, importance = 0.0f;
#pragma unroll
                for (int p = 0; p < PIXELS; ++p) {
                    const float power = power_at(mine, p, u0, s0, s1);
                    const int takes = power >= LOG2_ALPHA_MIN && place + i <= last[p];
                    const float most = fmin(EXP2(power), ALPHA_CAP);
                    const float alpha = takes ? most : 0.0f;
                    const float front = t[p] / (1.0f - alpha);
                    t[p] = takes ? front : t[p];
                    const float weight_k = t[p] * alpha;
                    const float gap_r = br[p] - s1.z, gap_g = bg[p] - s1.w, gap_b = bb[p] - blue_k;
                    const float squares = MAD(gap_r, gap_r, MAD(gap_g, gap_g, gap_b * gap_b));
                    const float products = MAD(gap_r, r[p], MAD(gap_g, g[p], gap_b * b[p]));
                    effect = MAD(weight_k, MAD(weight_k, squares, products), effect);
                    importance += weight_k;
                    br[p] = MAD(-alpha, gap_r, br[p]);
                    bg[p] = MAD(-alpha, gap_g, bg[p]);
                    bb[p] = MAD(-alpha, gap_b, bb[p]);
                }
                parts[j * SHARE + share] = (float2)(effect, importance);
            }
            barrier(CLK_LOCAL_MEM_FENCE);
            const int summed = summed_splat(share);
            if (summed < now) {
                const float2 sum = clamp(sum_parts(parts, share), -view_bound / SUBTILES, view_bound / SUBTILES);
                add_to_sums(&walk, list[left - 1 - summed], sum);
            }
            barrier(CLK_LOCAL_MEM_FENCE);
        }
        for (int p = 0; p < PIXELS; ++p) {
            const int i = mine.first + p * SHARE;
            state.t[i] = t[p];
            behind_r[i] = br[p];
            behind_g[i] = bg[p];
            behind_b[i] = bb[p];
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int i = lid; i < size; i += ITEMS) {
            const float2 before = sums[first + i], after = sums_of(&walk, i);
            replace_sums(
                totals + TOTAL_WORDS * SCENE_NUMBER(batch.splats[i]), before, after, view_scale, view_bound);
            sums[first + i] = after;
        }
        if (first == 0)
            break;
        first -= BATCH;
        fetch(&batch, shapes, colours, intersections + first, subtiles + first, BATCH, ALL_SUBTILES, lid);
        barrier(CLK_LOCAL_MEM_FENCE);
        make_lists(&batch, lid);
    }
}
