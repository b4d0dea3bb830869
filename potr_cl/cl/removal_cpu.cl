/* Removal effects for CPUs: one tile a work-item, one sweep forward and one back over the tile's list.

   Forward as in composite_cpu.cl, for the pixels' colours, transmittances and last splats. Then from the last splat to
   the first: B, the colour behind a splat as seen with nothing in front, is a convex sum that grows by one splat at a
   time, and the transmittance in front follows from the one behind by a division. So nothing cancels, however many
   layers hide a splat. Per splat and tile the sweep leaves the sums over the tile's pixels of

       PD^2 + 2 PD (c - c_t),  PD = T alpha (B - c_k)      and      T alpha

   (paper, section "Effect of a splat's removal"), in the slot of the splat's entry.

   Lists are compacted on the way: entries of splats that are not alive are dropped, in place; a tile's list begins at
   begins[tile] and has lengths[tile] entries.

   Macros: LANES, ALPHA_CAP, STOP. */

#include "lanes.clh"
#include "splat.clh"
#include "removal.clh"

#define VECTORS (TILE / LANES)
#define BLOCK 16

inline int2 touched_rows(float4 s0, float4 s1, int2 origin)
{
    float level = ellipse_level(s1);
    float a = s0.z, b = s0.w, c = s1.x;
    float g = b * b + c * c;
    float reach_x = sqrt(level * g) / (a * c) + PIXEL_SLACK + RELATIVE_SLACK * fabs(s0.x);
    float d0 = fmax(origin.x + 0.5f - s0.x, -reach_x);
    float d1 = fmin(origin.x + (TILE - 0.5f) - s0.x, reach_x);
    float peak = -b / a * (sqrt(level) / c);
    float bottom_x = fmin(fmax(peak, d0), d1);
    float top_x = fmin(fmax(-peak, d0), d1);
    float ac = a * c;
    float bottom = (sqrt(fmax(g * level - ac * ac * bottom_x * bottom_x, 0.0f)) - a * b * bottom_x) / g;
    float top = (-sqrt(fmax(g * level - ac * ac * top_x * top_x, 0.0f)) - a * b * top_x) / g;
    float slack = PIXEL_SLACK + RELATIVE_SLACK * (fabs(s0.y) + fmax(fabs(bottom), fabs(top)));
    float first = ceil(s0.y + top - slack - 0.5f) - origin.y;
    float last = floor(s0.y + bottom + slack - 0.5f) - origin.y;
    return (int2)((int)fmin(fmax(first, 0.0f), (float)TILE), (int)fmin(fmax(last + 1.0f, 0.0f), (float)TILE));
}

/* Work-item i handles tile tiles[i]. */
kernel void removal(
    global const float4 *shapes,
    global const float4 *colours,
    global const uchar *alive,
    global const uint *tiles,
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
    const int tile = tiles[get_global_id(0)];
    const int2 origin = (int2)(tile % view.columns, tile / view.columns) * TILE;
    const int pixel_rows = min(TILE, view.height - origin.y);
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
    uint read = begin, kept = begin, swept = begin;
    while (read < end && first_alive < end_alive) {
        const uint block_end = min(read + BLOCK, end);
        for (; read < block_end; ++read) {
            uint splat = entries[read];
            if (!alive[splat])
                continue;
            entries[kept] = splat;
            sums[kept] = sums[read];
            float4 s0 = shapes[2 * splat], s1 = shapes[2 * splat + 1];
            float4 colour = colours[splat];
            int2 rows = touched_rows(s0, s1, origin);
            rows.x = max(rows.x, first_alive);
            rows.y = min(rows.y, end_alive);
            vint number = (vint)((int)(kept - begin));
            ++kept;
            vfloat au[VECTORS];
            for (int v = 0; v < VECTORS; ++v)
                au[v] = s0.z * ((LANE_NUMBERS + (origin.x + v * LANES + 0.5f)) - s0.x);
            for (int row = rows.x; row < rows.y; ++row) {
                float dy = origin.y + row + 0.5f - s0.y;
                float bu = s0.w * dy;
                float cv = s1.x * dy;
                float level = mad(-cv, cv, s1.y);
                for (int v = 0; v < VECTORS; ++v) {
                    int i = row * VECTORS + v;
                    vfloat u = au[v] + bu;
                    vfloat power = mad(-u, u, (vfloat)(level));
                    vfloat alpha = fmin(exp2_polynomial(power), ALPHA_CAP);
                    alpha = power >= LOG2_ALPHA_MIN ? alpha : (vfloat)(0.0f);
                    vfloat before = t[i];
                    vfloat after = mad(-alpha, before, before);
                    vint goes_on = after >= STOP;
                    vfloat weight = goes_on ? alpha * before : (vfloat)(0.0f);
                    t[i] = goes_on ? after : -fabs(before);
                    last[i] = goes_on ? number : last[i];
                    r[i] = mad(weight, (vfloat)(colour.x), r[i]);
                    g[i] = mad(weight, (vfloat)(colour.y), g[i]);
                    b[i] = mad(weight, (vfloat)(colour.z), b[i]);
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
    swept = kept;
    for (; read < end; ++read) {
        uint splat = entries[read];
        if (alive[splat]) {
            sums[kept] = sums[read];
            entries[kept++] = splat;
        }
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
    const int pixel_columns = min(TILE, view.width - origin.x);
    for (int row = 0; row < pixel_rows; ++row) {
        float colours_here[3][TILE];
        for (int v = 0; v < VECTORS; ++v) {
            int i = row * VECTORS + v;
            t[i] = fabs(t[i]);
            r[i] = mad(t[i], (vfloat)(red), r[i]);
            g[i] = mad(t[i], (vfloat)(green), g[i]);
            b[i] = mad(t[i], (vfloat)(blue), b[i]);
            VSTORE(r[i], v, colours_here[0]);
            VSTORE(g[i], v, colours_here[1]);
            VSTORE(b[i], v, colours_here[2]);
        }
        size_t pixel = 3 * ((size_t)(origin.y + row) * view.width + origin.x);
        for (int column = 0; column < pixel_columns; ++column)
            for (int channel = 0; channel < 3; ++channel) {
                if (first_time)
                    target[pixel + 3 * column + channel] = colours_here[channel][column];
                colours_here[channel][column] -= target[pixel + 3 * column + channel];
            }
        for (int v = 0; v < VECTORS; ++v) {
            int i = row * VECTORS + v;
            r[i] = 2.0f * VLOAD(v, colours_here[0]);
            g[i] = 2.0f * VLOAD(v, colours_here[1]);
            b[i] = 2.0f * VLOAD(v, colours_here[2]);
            br[i] = (vfloat)(red);
            bg[i] = (vfloat)(green);
            bb[i] = (vfloat)(blue);
        }
    }

    for (uint e = swept; e-- > begin;) {
        uint splat = entries[e];
        float4 s0 = shapes[2 * splat], s1 = shapes[2 * splat + 1];
        float4 colour = colours[splat];
        int2 rows = touched_rows(s0, s1, origin);
        rows.y = min(rows.y, pixel_rows);
        vint number = (vint)((int)(e - begin));
        vfloat au[VECTORS];
        for (int v = 0; v < VECTORS; ++v)
            au[v] = s0.z * ((LANE_NUMBERS + (origin.x + v * LANES + 0.5f)) - s0.x);
        vfloat effect = (vfloat)(0.0f), importance = (vfloat)(0.0f);
        for (int row = rows.x; row < rows.y; ++row) {
            float dy = origin.y + row + 0.5f - s0.y;
            float bu = s0.w * dy;
            float cv = s1.x * dy;
            float level = mad(-cv, cv, s1.y);
            for (int v = 0; v < VECTORS; ++v) {
                int i = row * VECTORS + v;
                vfloat u = au[v] + bu;
                vfloat power = mad(-u, u, (vfloat)(level));
                vfloat alpha = fmin(exp2_polynomial(power), ALPHA_CAP);
                alpha = (power >= LOG2_ALPHA_MIN) && (number <= last[i]) ? alpha : (vfloat)(0.0f);
                vfloat front = t[i] / (1.0f - alpha);
                t[i] = front;
                vfloat weight = front * alpha;
                vfloat gap_r = br[i] - colour.x, gap_g = bg[i] - colour.y, gap_b = bb[i] - colour.z;
                vfloat pd_r = weight * gap_r, pd_g = weight * gap_g, pd_b = weight * gap_b;
                effect = mad(pd_r, pd_r + r[i], effect);
                effect = mad(pd_g, pd_g + g[i], effect);
                effect = mad(pd_b, pd_b + b[i], effect);
                importance += weight;
                br[i] = mad(-alpha, gap_r, br[i]);
                bg[i] = mad(-alpha, gap_g, bg[i]);
                bb[i] = mad(-alpha, gap_b, bb[i]);
            }
        }
        float effects[LANES], importances[LANES];
        VSTORE(effect, 0, effects);
        VSTORE(importance, 0, importances);
        float2 sum = (float2)(0.0f, 0.0f);
        for (int lane = 0; lane < LANES; ++lane)
            sum += (float2)(effects[lane], importances[lane]);
        replace_sums(totals + TOTAL_WORDS * splat, sums[e], sum, scale, bound);
        sums[e] = sum;
    }
}

/* How much of each tile's area the splats that have just gone (alive == 2) covered when the tile was last swept. */
kernel void staleness(
    global const uchar *alive,
    global const uint *begins,
    global const uint *lengths,
    global const uint *entries,
    global const float2 *sums,
    global float *stale)
{
    const uint tile = get_global_id(0);
    const uint begin = begins[tile], end = begin + lengths[tile];
    float gone = 0.0f;
    for (uint e = begin; e < end; ++e)
        if (alive[entries[e]] == 2)
            gone += sums[e].y;
    stale[tile] = gone * (1.0f / (TILE * TILE));
}
