/* Removal effects for GPUs: one work-group of 64 a tile, four pixels a work-item. See removal_cpu.cl for the method and
   the layout of the lists.

   The sums over a tile's pixels are made for GROUP_ENTRIES splats at a time: each work-item leaves the sum of its own
   pixels in local memory, then four work-items a splat add them up, always in the same order.

   Macros: ALPHA_CAP, STOP, TIGHTEN, NATIVE_EXP2. */

#define LANES 1
#include "lanes.clh"
#include "splat.clh"
#include "removal.clh"

#define ITEMS 64
#define PIXELS 4
#define GROUP_ENTRIES 16

#if NATIVE_EXP2
#define EXP2 native_exp2
#else
#define EXP2 exp2_polynomial
#endif

kernel __attribute__((reqd_work_group_size(ITEMS, 1, 1)))
void removal(
    uint start,
    global const uint *tiles,
    global const float4 *shapes,
    global const float4 *colours,
    global const uchar *alive,
    global const uint *begins,
    global uint *lengths,
    global uint *entries,
    View view,
    float red,
    float green,
    float blue,
    int first_time,
    float scale,
    float bound,
    global float *target,
    global float2 *sums,
    volatile global uint *totals)
{
    local float4 near_s0[ITEMS], near_s1[ITEMS];
    local float near_blue[ITEMS];
    local uint near_splat[ITEMS];
    local int near_touched[ITEMS];
    local uint ranks[2][ITEMS];
    local int unfinished[2];
    local float2 parts[GROUP_ENTRIES * ITEMS];

    const int lid = get_local_id(0);
    const int tile = tiles[start + get_group_id(0)];
    const int column = tile % view.columns * TILE + lid % TILE;
    const int first_row = tile / view.columns * TILE + lid / TILE * PIXELS;
    const float x = column + 0.5f;
    const uint begin = begins[tile];
    const uint end = begin + lengths[tile];

    float t[PIXELS], r[PIXELS], g[PIXELS], b[PIXELS];
    int last[PIXELS];
    for (int p = 0; p < PIXELS; ++p) {
        t[p] = column < view.width && first_row + p < view.height ? 1.0f : -1.0f;
        r[p] = g[p] = b[p] = 0.0f;
        last[p] = -1;
    }

    /* Forward, dropping the dead from the list. */
    uint kept = 0, swept = 0;
    int parity = 0, tile_alive = 1;
    for (uint batch = begin; batch < end; batch += ITEMS) {
        uint splat = 0, stays = 0;
        float2 old = (float2)(0.0f, 0.0f);
        if (batch + lid < end) {
            splat = entries[batch + lid];
            old = sums[batch + lid];
            stays = alive[splat] != 0 && old.y >= 0.0f;
        }
        ranks[0][lid] = stays;
        int from = 0;
        barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE);
        for (int step = 1; step < ITEMS; step *= 2) {
            ranks[1 - from][lid] = ranks[from][lid] + (lid >= step ? ranks[from][lid - step] : 0);
            from = 1 - from;
            barrier(CLK_LOCAL_MEM_FENCE);
        }
        const uint size = ranks[from][ITEMS - 1];
        const uint rank = ranks[from][lid] - stays;
        if (stays) {
            entries[begin + kept + rank] = splat;
            sums[begin + kept + rank] = old;
            if (tile_alive) {
                float4 s1 = shapes[2 * splat + 1];
                float4 colour = colours[splat];
                near_s0[rank] = shapes[2 * splat];
                near_s1[rank] = (float4)(s1.x, s1.y, colour.x, colour.y);
                near_blue[rank] = colour.z;
            }
        }
        if (lid == 0)
            unfinished[parity] = 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        if (tile_alive) {
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
                            last[p] = (int)(kept + k);
                            r[p] = mad(weight, s1.z, r[p]);
                            g[p] = mad(weight, s1.w, g[p]);
                            b[p] = mad(weight, near_blue[k], b[p]);
                        } else {
                            t[p] = -t[p];
                        }
                    }
                }
            }
            kept += size;
            swept = kept;
            if (t[0] > 0.0f || t[1] > 0.0f || t[2] > 0.0f || t[3] > 0.0f)
                unfinished[parity] = 1;
        } else {
            kept += size;
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        tile_alive = tile_alive && unfinished[parity];
        parity = 1 - parity;
    }
    if (lid == 0)
        lengths[tile] = kept;
    /* What lies behind the last pixel's end has no effect any more; nor have the slots that the dead left. */
    for (uint e = begin + swept + lid; e < end; e += ITEMS) {
        if (e < begin + kept)
            replace_sums(totals + TOTAL_WORDS * entries[e], sums[e], (float2)(0.0f, 0.0f), scale, bound);
        sums[e] = (float2)(0.0f, 0.0f);
    }

    float br[PIXELS], bg[PIXELS], bb[PIXELS];
    for (int p = 0; p < PIXELS; ++p) {
        const int row = first_row + p;
        t[p] = fabs(t[p]);
        r[p] = mad(t[p], red, r[p]);
        g[p] = mad(t[p], green, g[p]);
        b[p] = mad(t[p], blue, b[p]);
        if (column < view.width && row < view.height) {
            size_t pixel = 3 * ((size_t)row * view.width + column);
            if (first_time) {
                target[pixel] = r[p];
                target[pixel + 1] = g[p];
                target[pixel + 2] = b[p];
            }
            r[p] = 2.0f * (r[p] - target[pixel]);
            g[p] = 2.0f * (g[p] - target[pixel + 1]);
            b[p] = 2.0f * (b[p] - target[pixel + 2]);
        }
        br[p] = red;
        bg[p] = green;
        bb[p] = blue;
    }

    /* Back, from the last splat to the first. */
    for (uint batch_end = swept; batch_end > 0;) {
        const uint size = batch_end < ITEMS ? batch_end : ITEMS;
        const uint batch = batch_end - size;
        barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE);
        if (lid < size) {
            uint splat = entries[begin + batch + lid];
            float4 s1 = shapes[2 * splat + 1];
            float4 colour = colours[splat];
            near_splat[lid] = splat;
            near_s0[lid] = shapes[2 * splat];
            near_s1[lid] = (float4)(s1.x, s1.y, colour.x, colour.y);
            near_blue[lid] = colour.z;
            near_touched[lid] = 0;
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int group_end = (int)size; group_end > 0; group_end -= GROUP_ENTRIES) {
            const int group = max(group_end - GROUP_ENTRIES, 0);
            for (int k = group_end - 1; k >= group; --k) {
                float4 s0 = near_s0[k], s1 = near_s1[k];
                float u0 = s0.z * (x - s0.x);
                float effect = 0.0f, importance = 0.0f;
                for (int p = 0; p < PIXELS; ++p) {
                    float dy = first_row + p + 0.5f - s0.y;
                    float u = mad(s0.w, dy, u0);
                    float v = s1.x * dy;
                    float power = s1.y - u * u - v * v;
                    if (power >= LOG2_ALPHA_MIN && TIGHTEN)
                        atomic_or(&near_touched[k], 1);
                    if (power >= LOG2_ALPHA_MIN && (int)batch + k <= last[p]) {
                        float alpha = fmin(EXP2(power), ALPHA_CAP);
                        t[p] = t[p] / (1.0f - alpha);
                        float weight = t[p] * alpha;
                        float gap_r = br[p] - s1.z, gap_g = bg[p] - s1.w, gap_b = bb[p] - near_blue[k];
                        float pd_r = weight * gap_r, pd_g = weight * gap_g, pd_b = weight * gap_b;
                        effect = mad(pd_r, pd_r + r[p], effect);
                        effect = mad(pd_g, pd_g + g[p], effect);
                        effect = mad(pd_b, pd_b + b[p], effect);
                        importance += weight;
                        br[p] = mad(-alpha, gap_r, br[p]);
                        bg[p] = mad(-alpha, gap_g, bg[p]);
                        bb[p] = mad(-alpha, gap_b, bb[p]);
                    }
                }
                parts[(k - group) * ITEMS + lid] = (float2)(effect, importance);
            }
            barrier(CLK_LOCAL_MEM_FENCE);
            const int entry = lid / 4;
            float2 sum = (float2)(0.0f, 0.0f);
            if (group + entry < group_end)
                for (int j = 0; j < ITEMS / 4; ++j)
                    /* Turned by the work-item's number, so that neighbours read from different banks. */
                    sum += parts[lid * (ITEMS / 4) + ((j + lid) & (ITEMS / 4 - 1))];
            barrier(CLK_LOCAL_MEM_FENCE);
            parts[lid] = sum;
            barrier(CLK_LOCAL_MEM_FENCE);
            if (lid < group_end - group) {
                float2 after = (parts[4 * lid] + parts[4 * lid + 1]) + (parts[4 * lid + 2] + parts[4 * lid + 3]);
                const uint slot = begin + batch + group + lid;
                replace_sums(totals + TOTAL_WORDS * near_splat[group + lid], sums[slot], after, scale, bound);
                sums[slot] = TIGHTEN && !near_touched[group + lid] ? NEVER : after;
            }
            barrier(CLK_LOCAL_MEM_FENCE);
        }
        batch_end = batch;
    }
}

/* How much of each tile's area the splats that have just gone (alive == 2) covered when the tile was last swept. */
kernel __attribute__((reqd_work_group_size(ITEMS, 1, 1)))
void staleness(
    global const uchar *alive,
    global const uint *begins,
    global const uint *lengths,
    global const uint *entries,
    global const float2 *sums,
    uint first,
    global float *stale)
{
    local float parts[ITEMS];
    const uint tile = get_group_id(0), lid = get_local_id(0);
    const uint begin = begins[tile], end = begin + lengths[tile];
    float gone = 0.0f;
    for (uint e = begin + lid; e < end; e += ITEMS)
        if (alive[entries[e]] == 2 && sums[e].y >= 0.0f)
            gone += fmax(sums[e].y, LEAST_STALENESS);
    parts[lid] = gone;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint step = ITEMS / 2; step > 0; step /= 2) {
        if (lid < step)
            parts[lid] += parts[lid + step];
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    if (lid == 0)
        stale[first + tile] = parts[0] * (1.0f / (TILE * TILE));
}
