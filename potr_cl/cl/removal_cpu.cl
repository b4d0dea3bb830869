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
#include "patch_vectors.clh"
#include "removal.clh"

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
    global uint *patches,
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
    const uint begin = begins[tile];
    const uint end = begin + lengths[tile];

    vfloat t[PATCHES], r[PATCHES], g[PATCHES], b[PATCHES];
    vint last[PATCHES];
    for (int i = 0; i < PATCHES; ++i) {
        t[i] = patch_transmittance(i, origin, view.width, view.height);
        r[i] = g[i] = b[i] = (vfloat)(0.0f);
        last[i] = (vint)(-1);
    }

    uint living = ALL_PATCHES;
    uint kept = begin, swept = begin;
    for (uint read = begin; read < end; ++read) {
        if (living && read + AHEAD < end)
            prefetch_splat(shapes, colours, entries[read + AHEAD]);
        const uint number = entries[read];
        if (!alive[number] || sums[read].y < 0.0f)
            continue;
        uint todo = patches[read];
        if (kept < read) {
            entries[kept] = number;
            sums[kept] = sums[read];
            patches[kept] = todo;
        }
        const vint place = (vint)((int)(kept++ - begin));
        if (!living)
            continue;
        swept = kept;
        todo &= living;
        if (todo) {
            const Splat splat = load_splat(shapes, colours, number);
            for (; todo; todo &= todo - 1) {
                const int i = LOWEST_PATCH(todo);
                const vfloat power = patch_power(&splat, i, origin);
                BLEND(weight, power, t[i]);
                last[i] = goes_on ? place : last[i];
                r[i] = MAD(weight, (vfloat)(splat.red), r[i]);
                g[i] = MAD(weight, (vfloat)(splat.green), g[i]);
                b[i] = MAD(weight, (vfloat)(splat.blue), b[i]);
            }
        }
        if ((kept - begin) % AHEAD == 0)
            living = living_patches(t);
    }
    lengths[tile] = kept - begin;
    /* What lies behind the last pixel's end has no effect any more; nor have the slots that the dead left. */
    for (uint e = swept; e < end; ++e) {
        if (e < kept)
            replace_sums(totals + TOTAL_WORDS * entries[e], sums[e], (float2)(0.0f, 0.0f), scale, bound);
        sums[e] = (float2)(0.0f, 0.0f);
    }

    /* From here on r, g, b are twice the difference of the colour to the target, and br, bg, bb the colour behind. */
    vfloat br[PATCHES], bg[PATCHES], bb[PATCHES];
    float differences[3][TILE * TILE];
    for (int i = 0; i < PATCHES; ++i) {
        t[i] = fabs(t[i]);
        store_patch(MAD(t[i], (vfloat)(red), r[i]), i, differences[0]);
        store_patch(MAD(t[i], (vfloat)(green), g[i]), i, differences[1]);
        store_patch(MAD(t[i], (vfloat)(blue), b[i]), i, differences[2]);
        br[i] = (vfloat)(red);
        bg[i] = (vfloat)(green);
        bb[i] = (vfloat)(blue);
    }
    const int pixel_columns = min(TILE, view.width - origin.x), pixel_rows = min(TILE, view.height - origin.y);
    for (int row = 0; row < pixel_rows; ++row) {
        size_t place = 3 * ((size_t)(origin.y + row) * view.width + origin.x);
        for (int pixel = row * TILE; pixel < row * TILE + pixel_columns; ++pixel)
            for (int channel = 0; channel < 3; ++channel, ++place) {
                if (first_time)
                    target[place] = differences[channel][pixel];
                differences[channel][pixel] = 2.0f * (differences[channel][pixel] - target[place]);
            }
    }
    int ends[PATCHES]; /* the last splat that any of a patch's pixels sees */
    for (int i = 0; i < PATCHES; ++i) {
        r[i] = load_patch(i, differences[0]);
        g[i] = load_patch(i, differences[1]);
        b[i] = load_patch(i, differences[2]);
        int lanes[LANES];
        VSTORE(last[i], 0, lanes);
        ends[i] = -1;
        for (int lane = 0; lane < LANES; ++lane)
            ends[i] = max(ends[i], lanes[lane]);
    }

    uint seeing = 0;
    for (uint e = swept; e-- > begin;) {
        if (e >= begin + AHEAD)
            prefetch_splat(shapes, colours, entries[e - AHEAD]);
        if (e == swept - 1 || (e - begin) % AHEAD == AHEAD - 1)
            for (int i = 0; i < PATCHES; ++i)
                if (TIGHTEN || ends[i] >= (int)((e - begin) / AHEAD * AHEAD))
                    seeing |= 1u << i;
        const uint number = entries[e];
        const vint place = (vint)((int)(e - begin));
        vfloat effect = (vfloat)(0.0f), importance = (vfloat)(0.0f);
        vint touched = (vint)(0);
        uint todo = patches[e] & seeing;
        if (todo) {
            const Splat splat = load_splat(shapes, colours, number);
            for (; todo; todo &= todo - 1) {
                const int i = LOWEST_PATCH(todo);
                const vfloat power = patch_power(&splat, i, origin);
                vfloat alpha = exp2_polynomial(power);
                alpha = LESSER(alpha, (vfloat)(ALPHA_CAP));
                const vint reached = power >= LOG2_ALPHA_MIN;
                touched |= reached;
                alpha = reached && (place <= last[i]) ? alpha : (vfloat)(0.0f);
                const vfloat front = t[i] / (1.0f - alpha);
                t[i] = front;
                const vfloat weight = front * alpha;
                const vfloat gap_r = br[i] - splat.red, gap_g = bg[i] - splat.green, gap_b = bb[i] - splat.blue;
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
        const float2 sum = (float2)(sum_lanes(effect), sum_lanes(importance));
        replace_sums(totals + TOTAL_WORDS * number, sums[e], sum, scale, bound);
        sums[e] = TIGHTEN && !VANY(touched) ? NEVER : sum;
    }
}

/* Adds to each tile's staleness how much of its area the splats that have just gone (alive == 2) covered when it was last
   swept. */
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
    stale[first + tile] += gone * (1.0f / (TILE * TILE));
}
