/* The removal kernel with the paper's second half (section "Effect of a splat's removal"), one tile a work-item, splat by
   splat: the tile's list front to back twice, the second time with the final colour P_K known, P_k and T as running sums
   and products,

       PD_k = P_k - P_{k+1} / (1 - alpha) + alpha / (1 - alpha) P_K

   In place of prune/removal_cpu.cl, which walks sub-tile by sub-tile; see removal_formulas.py.

   Macros: LANES, ALPHA_CAP, TRANSMITTANCE_THRESHOLD, TIGHTEN. */

#include "include/lanes.clh"
#include "include/splat.clh"
#include "include/subtile_vectors.clh"
#include "include/subtile_walk.clh"
#include "prune/removal.clh"
#include "prune/staleness_cpu.clh"

/* Work-item i handles tile tiles[start + i]. */
kernel void removal(
    uint start,
    global const uint *tiles,
    global const float4 *shapes,
    global const float4 *colours,
    global const uchar *alive,
    global const uint *offsets,
    global uint *lengths,
    global uint *intersections,
    global uint *subtiles,
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
    const uint begin = offsets[tile];
    const uint end = begin + lengths[tile];

    vfloat t[SUBTILES], r[SUBTILES], g[SUBTILES], b[SUBTILES];
    vint last[SUBTILES];
    for (int i = 0; i < SUBTILES; ++i) {
        t[i] = subtile_transmittance(i, origin, view.width, view.height);
        r[i] = g[i] = b[i] = (vfloat)(0.0f);
        last[i] = (vint)(-1);
    }

    uint living = ALL_SUBTILES;
    uint kept = begin, swept = begin;
    for (uint read = begin; read < end; ++read) {
        if (living && read + PREFETCH_AHEAD < end)
            prefetch_splat(shapes, colours, intersections[read + PREFETCH_AHEAD]);
        const uint number = intersections[read];
        if (!alive[number] || sums[read].y < 0.0f)
            continue;
        uint todo = subtiles[read];
        if (kept < read) {
            intersections[kept] = number;
            sums[kept] = sums[read];
            subtiles[kept] = todo;
        }
        const vint place = (vint)((int)(kept++ - begin));
        if (!living)
            continue;
        swept = kept;
        todo &= living;
        if (todo) {
            const Splat splat = load_splat(shapes, colours, number);
            for (; todo; todo &= todo - 1) {
                const int i = LOWEST_SUBTILE(todo);
                const vfloat power = subtile_power(&splat, i, origin);
                BLEND(weight, power, t[i]);
                last[i] = goes_on ? place : last[i];
                r[i] = MAD(weight, (vfloat)(splat.red), r[i]);
                g[i] = MAD(weight, (vfloat)(splat.green), g[i]);
                b[i] = MAD(weight, (vfloat)(splat.blue), b[i]);
            }
        }
        if ((kept - begin) % PREFETCH_AHEAD == 0)
            living = living_subtiles(t);
    }
    lengths[tile] = kept - begin;
    /* What lies behind the last pixel's end has no effect any more; nor have the slots that the dead left. */
    for (uint e = swept; e < end; ++e) {
        if (e < kept)
            replace_sums(totals + TOTAL_WORDS * intersections[e], sums[e], (float2)(0.0f, 0.0f), scale, bound);
        sums[e] = (float2)(0.0f, 0.0f);
    }

    /* From here on r, g, b are the final colour, dr, dg, db twice its difference to the target, and pr, pg, pb the colour
       before a splat. */
    vfloat dr[SUBTILES], dg[SUBTILES], db[SUBTILES];
    vfloat pr[SUBTILES], pg[SUBTILES], pb[SUBTILES];
    float differences[3][TILE * TILE];
    for (int i = 0; i < SUBTILES; ++i) {
        const vfloat left = fabs(t[i]);
        r[i] = MAD(left, (vfloat)(red), r[i]);
        g[i] = MAD(left, (vfloat)(green), g[i]);
        b[i] = MAD(left, (vfloat)(blue), b[i]);
        store_subtile(r[i], i, differences[0]);
        store_subtile(g[i], i, differences[1]);
        store_subtile(b[i], i, differences[2]);
        t[i] = (vfloat)(1.0f);
        pr[i] = pg[i] = pb[i] = (vfloat)(0.0f);
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
    int ends[SUBTILES];
    for (int i = 0; i < SUBTILES; ++i) {
        dr[i] = load_subtile(i, differences[0]);
        dg[i] = load_subtile(i, differences[1]);
        db[i] = load_subtile(i, differences[2]);
        int lanes[LANES];
        VSTORE(last[i], 0, lanes);
        ends[i] = -1;
        for (int lane = 0; lane < LANES; ++lane)
            ends[i] = max(ends[i], lanes[lane]);
    }

    for (uint e = begin; e < swept; ++e) {
        if (e + PREFETCH_AHEAD < swept)
            prefetch_splat(shapes, colours, intersections[e + PREFETCH_AHEAD]);
        if ((e - begin) % PREFETCH_AHEAD == 0) {
            living = 0;
            for (int i = 0; i < SUBTILES; ++i)
                if (ends[i] >= (int)(e - begin))
                    living |= 1u << i;
        }
        const uint number = intersections[e];
        const vint place = (vint)((int)(e - begin));
        vfloat effect = (vfloat)(0.0f), importance = (vfloat)(0.0f);
        uint todo = subtiles[e] & living;
        if (todo) {
            const Splat splat = load_splat(shapes, colours, number);
            for (; todo; todo &= todo - 1) {
                const int i = LOWEST_SUBTILE(todo);
                const vfloat power = subtile_power(&splat, i, origin);
                vfloat alpha = exp2_polynomial(power);
                alpha = LESSER(alpha, (vfloat)(ALPHA_CAP));
                alpha = (power >= LOG2_ALPHA_MIN) && (place <= last[i]) ? alpha : (vfloat)(0.0f);
                const vfloat weight = alpha * t[i];
                const vfloat inverse = 1.0f / (1.0f - alpha);
                const vfloat after_r = MAD(weight, (vfloat)(splat.red), pr[i]);
                const vfloat after_g = MAD(weight, (vfloat)(splat.green), pg[i]);
                const vfloat after_b = MAD(weight, (vfloat)(splat.blue), pb[i]);
                const vfloat pd_r = MAD(MAD(alpha, r[i], -after_r), inverse, pr[i]);
                const vfloat pd_g = MAD(MAD(alpha, g[i], -after_g), inverse, pg[i]);
                const vfloat pd_b = MAD(MAD(alpha, b[i], -after_b), inverse, pb[i]);
                effect = MAD(pd_r, pd_r + dr[i], effect);
                effect = MAD(pd_g, pd_g + dg[i], effect);
                effect = MAD(pd_b, pd_b + db[i], effect);
                importance += weight;
                t[i] = MAD(-alpha, t[i], t[i]);
                pr[i] = after_r;
                pg[i] = after_g;
                pb[i] = after_b;
            }
        }
        const float2 sum = (float2)(sum_lanes(effect), sum_lanes(importance));
        replace_sums(totals + TOTAL_WORDS * number, sums[e], sum, scale, bound);
        sums[e] = sum;
    }
}
