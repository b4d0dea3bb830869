/* Removal effects for CPUs: one tile a work-item, one sweep forward and one back over the tile's list.

   Forward as in composite_cpu.cl, for the pixels' colours, transmittances and last splats. Then from the last splat to
   the first: B, the colour behind a splat as seen with nothing in front, is a convex sum that grows by one splat at a
   time, and the transmittance in front follows from the one behind by a division. So nothing cancels, however many
   layers hide a splat. Per splat and tile the sweep leaves the sums over the tile's pixels of

       PD^2 + 2 PD (c - c_t),  PD = T alpha (B - c_k)      and      T alpha

   (paper, section "Effect of a splat's removal"), in the slot of the splat's entry.

   Lists are compacted on the way: entries of splats that are not alive, or that the last sweep marked, are dropped, in
   place; a tile's list begins at begins[tile] and has lengths[tile] entries.

   Macros: LANES, ALPHA_CAP, STOP, TIGHTEN (whether to mark entries that touch no pixel). */

#include "lanes.clh"
#include "splat.clh"
#include "splat_block.clh"
#include "removal.clh"

#define VECTORS (TILE / LANES)

/* Work-item i handles tile tiles[start + i]. */
kernel void removal(
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
    const int tile = tiles[start + get_global_id(0)];
    const int2 origin = (int2)(tile % view.columns, tile / view.columns) * TILE;
    const int pixel_rows = min(TILE, view.height - origin.y);
    const int pixel_columns = min(TILE, view.width - origin.x);
    const uint begin = begins[tile];
    const uint end = begin + lengths[tile];

    vfloat t[TILE * VECTORS], r[TILE * VECTORS], g[TILE * VECTORS], b[TILE * VECTORS];
    vint last[TILE * VECTORS];
    for (int i = 0; i < TILE * VECTORS; ++i) {
        vfloat column = LANE_NUMBERS + (float)(origin.x + i % VECTORS * LANES);
        t[i] = column < (float)view.width ? (vfloat)(1.0f) : (vfloat)(-1.0f);
        r[i] = g[i] = b[i] = (vfloat)(0.0f);
        last[i] = (vint)(-1);
    }

    int first_alive = 0, end_alive = pixel_rows;
    uint kept = begin, swept = begin;
    SplatBlock block;
    for (uint read = begin; read < end; read += BLOCK) {
        const uint block_begin = kept;
        for (uint e = read; e < min(read + BLOCK, end); ++e) {
            const uint splat = entries[e];
            if (alive[splat] && sums[e].y >= 0.0f) {
                entries[kept] = splat;
                sums[kept++] = sums[e];
            }
        }
        if (first_alive >= end_alive || kept == block_begin)
            continue;
        swept = kept;
        fetch_block(&block, shapes, colours, entries, block_begin, kept, origin);
        for (int k = 0; k < BLOCK; ++k) {
            const int first_row = max(block.first_row[k], first_alive);
            const int end_row = min(block.end_row[k], end_alive);
            const vint number = (vint)((int)(block_begin - begin) + k);
            const float x = block.x[k], a = block.a[k];
            vfloat au[VECTORS];
            for (int v = 0; v < VECTORS; ++v)
                au[v] = a * ((LANE_NUMBERS + (origin.x + v * LANES + 0.5f)) - x);
            for (int row = first_row; row < end_row; ++row) {
                const float dy = origin.y + row + 0.5f - block.y[k];
                const float bu = block.b[k] * dy;
                const float cv = block.c[k] * dy;
                const float level = MAD(-cv, cv, block.log2_opacity[k]);
                for (int v = 0; v < VECTORS; ++v) {
                    const int i = row * VECTORS + v;
                    const vfloat u = au[v] + bu;
                    const vfloat power = MAD(-u, u, (vfloat)(level));
                    vfloat alpha = min(exp2_polynomial(power), ALPHA_CAP);
                    alpha = power >= LOG2_ALPHA_MIN ? alpha : (vfloat)(0.0f);
                    const vfloat before = t[i];
                    const vfloat after = MAD(-alpha, before, before);
                    const vint goes_on = after >= STOP;
                    const vfloat weight = goes_on ? alpha * before : (vfloat)(0.0f);
                    t[i] = goes_on ? after : -fabs(before);
                    last[i] = goes_on ? number : last[i];
                    r[i] = MAD(weight, (vfloat)(block.red[k]), r[i]);
                    g[i] = MAD(weight, (vfloat)(block.green[k]), g[i]);
                    b[i] = MAD(weight, (vfloat)(block.blue[k]), b[i]);
                }
            }
        }
        int first = pixel_rows, final = -1;
        for (int row = first_alive; row < end_alive; ++row) {
            vfloat most = t[row * VECTORS];
            for (int v = 1; v < VECTORS; ++v)
                most = fmax(most, t[row * VECTORS + v]);
            if (VANY(most > 0.0f)) {
                first = min(first, row);
                final = row;
            }
        }
        first_alive = first;
        end_alive = final + 1;
    }
    lengths[tile] = kept - begin;
    /* What lies behind the last pixel's end has no effect any more; nor have the slots that the dead left. */
    for (uint e = swept; e < end; ++e) {
        if (e < kept)
            replace_sums(totals + TOTAL_WORDS * entries[e], sums[e], (float2)(0.0f, 0.0f), scale, bound);
        sums[e] = (float2)(0.0f, 0.0f);
    }

    /* From here on r, g, b are twice the difference of the colour to the target, and br, bg, bb the colour behind. */
    vfloat br[TILE * VECTORS], bg[TILE * VECTORS], bb[TILE * VECTORS];
    for (int row = 0; row < pixel_rows; ++row) {
        float differences[3][TILE];
        for (int v = 0; v < VECTORS; ++v) {
            const int i = row * VECTORS + v;
            t[i] = fabs(t[i]);
            VSTORE(MAD(t[i], (vfloat)(red), r[i]), v, differences[0]);
            VSTORE(MAD(t[i], (vfloat)(green), g[i]), v, differences[1]);
            VSTORE(MAD(t[i], (vfloat)(blue), b[i]), v, differences[2]);
            br[i] = (vfloat)(red);
            bg[i] = (vfloat)(green);
            bb[i] = (vfloat)(blue);
        }
        const size_t pixel = 3 * ((size_t)(origin.y + row) * view.width + origin.x);
        for (int column = 0; column < pixel_columns; ++column)
            for (int channel = 0; channel < 3; ++channel) {
                if (first_time)
                    target[pixel + 3 * column + channel] = differences[channel][column];
                differences[channel][column] -= target[pixel + 3 * column + channel];
            }
        for (int v = 0; v < VECTORS; ++v) {
            const int i = row * VECTORS + v;
            r[i] = 2.0f * VLOAD(v, differences[0]);
            g[i] = 2.0f * VLOAD(v, differences[1]);
            b[i] = 2.0f * VLOAD(v, differences[2]);
        }
    }

    for (uint block_end = swept; block_end > begin;) {
        const uint block_begin = block_end - min(block_end - begin, (uint)BLOCK);
        fetch_block(&block, shapes, colours, entries, block_begin, block_end, origin);
        for (int k = (int)(block_end - block_begin) - 1; k >= 0; --k) {
            const int end_row = min(block.end_row[k], pixel_rows);
            const vint number = (vint)((int)(block_begin - begin) + k);
            const float x = block.x[k], a = block.a[k];
            const float red_k = block.red[k], green_k = block.green[k], blue_k = block.blue[k];
            vfloat au[VECTORS];
            for (int v = 0; v < VECTORS; ++v)
                au[v] = a * ((LANE_NUMBERS + (origin.x + v * LANES + 0.5f)) - x);
            vfloat effect = (vfloat)(0.0f), importance = (vfloat)(0.0f);
            vint touched = (vint)(0);
            for (int row = block.first_row[k]; row < end_row; ++row) {
                const float dy = origin.y + row + 0.5f - block.y[k];
                const float bu = block.b[k] * dy;
                const float cv = block.c[k] * dy;
                const float level = MAD(-cv, cv, block.log2_opacity[k]);
                for (int v = 0; v < VECTORS; ++v) {
                    const int i = row * VECTORS + v;
                    const vfloat u = au[v] + bu;
                    const vfloat power = MAD(-u, u, (vfloat)(level));
                    vfloat alpha = min(exp2_polynomial(power), ALPHA_CAP);
                    const vint reached = power >= LOG2_ALPHA_MIN;
                    touched |= reached;
                    alpha = reached && (number <= last[i]) ? alpha : (vfloat)(0.0f);
                    const vfloat front = t[i] / (1.0f - alpha);
                    t[i] = front;
                    const vfloat weight = front * alpha;
                    const vfloat gap_r = br[i] - red_k, gap_g = bg[i] - green_k, gap_b = bb[i] - blue_k;
                    const vfloat pd_r = weight * gap_r, pd_g = weight * gap_g, pd_b = weight * gap_b;
                    effect = MAD(pd_r, pd_r + r[i], effect);
                    effect = MAD(pd_g, pd_g + g[i], effect);
                    effect = MAD(pd_b, pd_b + b[i], effect);
                    importance += weight;
                    br[i] = MAD(-alpha, gap_r, br[i]);
                    bg[i] = MAD(-alpha, gap_g, bg[i]);
                    bb[i] = MAD(-alpha, gap_b, bb[i]);
                }
            }
            float effects[LANES], importances[LANES];
            VSTORE(effect, 0, effects);
            VSTORE(importance, 0, importances);
            float2 sum = (float2)(0.0f, 0.0f);
            for (int lane = 0; lane < LANES; ++lane)
                sum += (float2)(effects[lane], importances[lane]);
            const uint e = block_begin + k;
            replace_sums(totals + TOTAL_WORDS * entries[e], sums[e], sum, scale, bound);
            sums[e] = TIGHTEN && !VANY(touched) ? NEVER : sum;
        }
        block_end = block_begin;
    }
}

/* How much of each tile's area the splats that have just gone (alive == 2) covered when the tile was last swept. */
kernel void staleness(
    global const uchar *alive,
    global const uint *begins,
    global const uint *lengths,
    global const uint *entries,
    global const float2 *sums,
    uint first,
    global float *stale)
{
    const uint tile = get_global_id(0);
    const uint begin = begins[tile], end = begin + lengths[tile];
    float gone = 0.0f;
    for (uint e = begin; e < end; ++e)
        if (alive[entries[e]] == 2 && sums[e].y >= 0.0f)
            gone += fmax(sums[e].y, LEAST_STALENESS);
    stale[first + tile] = gone * (1.0f / (TILE * TILE));
}
