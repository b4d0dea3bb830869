/* The way back from pixels to splats: the sums of sums.clh over a view's pixels, for CPUs: one tile a work-item,
   sub-tile by sub-tile. derivatives_gpu.cl is its twin.

   A walk over a sub-tile's list finds its pixels' colours, and remembers each splat's alphas and weights. The pixels'
   numbers v are their differences to the target, times `unit`, or, if they are given, what stands in place of the
   target. Then a walk back goes from the last splat to the first. It keeps h = B . v, where B is the colour behind a
   splat as seen with nothing in front of it: a convex sum that grows by one splat at a time, so that nothing cancels.

   Lists of more than SEGMENT splats are walked twice: h at a segment's end follows from what the later segments add to
   the pixels, which is only known after a first walk.

   Macros:
       LANES                               8 or 16, see lanes.clh;
       ALPHA_CAP, TRANSMITTANCE_THRESHOLD  see subtile_vectors.clh;
       LARGEST_VALUE, LARGEST_GAP          see sums.clh;
       INT64_ATOMICS                       see totals.clh. */

#include "include/lanes.clh"
#include "include/splat.clh"
#include "include/subtile_vectors.clh"
#include "include/subtile_walk.clh"
/* memory[2 j] and memory[2 j + 1] become the alphas and weights of the j-th splat. */
#define REMEMBER(memory, j, alpha, weight) \
    VSTORE(alpha, 2 * (j), memory);        \
    VSTORE(weight, 2 * (j) + 1, memory)
#include "include/subtile_blend.clh"
#include "fit/sums.clh"

/* A sub-tile's walk back over what the walk forward remembers: memory[2 j] becomes e. */
inline void walk_back(
    const Splat *splats, const ushort *list, uint length, const float values[3][LANES], vfloat behind, float *memory)
{
    const vfloat r = VLOAD(0, values[0]), g = VLOAD(0, values[1]), b = VLOAD(0, values[2]);
    for (uint j = length; j-- > 0;) {
        const Splat *splat = &splats[list[j]];
        const vfloat alpha = VLOAD(2 * j, memory), weight = VLOAD(2 * j + 1, memory);
        const vfloat gap = MAD(r, (vfloat)(splat->red), MAD(g, (vfloat)(splat->green), b * splat->blue)) - behind;
        const vfloat bounded = LESSER(GREATER(gap, (vfloat)(-LARGEST_GAP)), (vfloat)(LARGEST_GAP));
        VSTORE(alpha < ALPHA_CAP ? weight * bounded : (vfloat)(0.0f), 2 * j, memory);
        behind = MAD(alpha, gap, behind);
    }
}

/* sums[list[j]] += the j-th splat's sums over the sub-tile's pixels, LANES splats at a time. */
inline void sum_pixels(
    const Splat *splats,
    const ushort *list,
    uint length,
    float2 first,
    const float values[3][LANES],
    float *memory,
    float sums[SEGMENT][SUMS])
{
    for (uint j = length; j % LANES; ++j) {
        VSTORE((vfloat)(0.0f), 2 * j, memory);
        VSTORE((vfloat)(0.0f), 2 * j + 1, memory);
    }
    for (uint j = 0; j < length; j += LANES) {
        const uint count = min(length - j, (uint)LANES);
        float shapes[5][LANES];
        for (uint k = 0; k < LANES; ++k) {
            const Splat *splat = &splats[list[j + min(k, count - 1)]];
            shapes[0][k] = splat->x;
            shapes[1][k] = splat->y;
            shapes[2][k] = splat->a;
            shapes[3][k] = splat->b;
            shapes[4][k] = splat->c;
        }
        const vfloat x = first.x - VLOAD(0, shapes[0]), y = first.y - VLOAD(0, shapes[1]);
        const vfloat a = VLOAD(0, shapes[2]), b = VLOAD(0, shapes[3]), c = VLOAD(0, shapes[4]);
        vfloat e[LANES], w[LANES];
        for (int k = 0; k < LANES; ++k) {
            e[k] = VLOAD(2 * (j + k), memory);
            w[k] = VLOAD(2 * (j + k) + 1, memory);
        }
        transpose(e);
        transpose(w);
        vfloat total[SUMS];
        for (int i = 0; i < SUMS; ++i)
            total[i] = (vfloat)(0.0f);
        for (int k = 0; k < LANES; ++k) {
            const vfloat dx = x + (float)(k % SUBTILE_WIDTH), dy = y + (float)(k / SUBTILE_WIDTH);
            const vfloat u = MAD(a, dx, b * dy), v = c * dy;
            const vfloat eu = e[k] * u, ev = e[k] * v;
            total[0] = MAD(w[k], (vfloat)(values[0][k]), total[0]);
            total[1] = MAD(w[k], (vfloat)(values[1][k]), total[1]);
            total[2] = MAD(w[k], (vfloat)(values[2][k]), total[2]);
            total[3] += e[k];
            total[4] += eu;
            total[5] += ev;
            total[6] = MAD(eu, u, total[6]);
            total[7] = MAD(eu, v, total[7]);
            total[8] = MAD(ev, v, total[8]);
        }
        float columns[SUMS][LANES];
        for (int i = 0; i < SUMS; ++i)
            VSTORE(total[i], 0, columns[i]);
        for (uint k = 0; k < count; ++k)
            for (int i = 0; i < SUMS; ++i)
                sums[list[j + k]][i] += columns[i][k];
    }
}

kernel void derivatives(
    global const float4 *shapes,
    global const float4 *colours,
    global const uint *offsets,
    global const uint *intersections,
    global const uint *subtiles,
    View view,
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
    const int tile = get_global_id(0);
    const int2 origin = (int2)(tile % view.columns, tile / view.columns) * TILE;
    const uint begin = offsets[tile], end = offsets[tile + 1];
    target += 3 * first_pixel;

    Splat splats[SEGMENT];
    ushort lists[SUBTILES][SEGMENT];
    uint lengths[SUBTILES];
    float memory[2 * (SEGMENT + LANES) * LANES];
    float sums[SEGMENT][SUMS];
    vfloat t[SUBTILES], rgb[SUBTILES][3];
    float values[SUBTILES][3][LANES];
    vfloat whole[SUBTILES]; /* the pixel's colour . v, of lists that are walked twice */
    const int twice = end - begin > SEGMENT;
    for (int pass = twice ? 0 : 1; pass < 2; ++pass) {
        for (int i = 0; i < SUBTILES; ++i) {
            t[i] = subtile_transmittance(i, origin, view.width, view.height);
            rgb[i][0] = rgb[i][1] = rgb[i][2] = (vfloat)(0.0f);
        }
        for (uint from = begin; pass == 1 || from < end; from += SEGMENT) {
            const uint count = from < end ?
                gather_splats(shapes, colours, intersections, subtiles, from, end, splats, lists, lengths) : 0;
            const int is_last = from + count >= end;
            for (uint k = 0; k < count; ++k)
                for (int i = 0; i < SUMS; ++i)
                    sums[k][i] = 0.0f;
            for (int i = 0; i < SUBTILES; ++i) {
                const uint length = count ? lengths[i] : 0;
                const float2 first = subtile_centre(origin, i);
                const uint walked = blend(splats, lists[i], length, first, &t[i], rgb[i], memory);
                const vfloat through = fabs(t[i]);
                if (is_last && pass == (twice ? 0 : 1)) {
                    /* The pixels' colours are known. */
                    const vfloat colour[3] = {
                        MAD(through, (vfloat)(red), rgb[i][0]),
                        MAD(through, (vfloat)(green), rgb[i][1]),
                        MAD(through, (vfloat)(blue), rgb[i][2])};
                    pixel_values(
                        colour, i, origin, view.width, view.height, target, 1, given, unit, LARGEST_VALUE, values[i]);
                    whole[i] = (vfloat)(0.0f);
                    for (int channel = 0; channel < 3; ++channel)
                        whole[i] = MAD(colour[channel], VLOAD(0, values[i][channel]), whole[i]);
                }
                if (pass == 0 || walked == 0)
                    continue;
                const vfloat r = VLOAD(0, values[i][0]), g = VLOAD(0, values[i][1]), b = VLOAD(0, values[i][2]);
                vfloat behind = MAD(r, (vfloat)(red), MAD(g, (vfloat)(green), b * blue));
                if (!is_last) {
                    const vfloat front = MAD(r, rgb[i][0], MAD(g, rgb[i][1], b * rgb[i][2]));
                    behind = (whole[i] - front) / through;
                }
                walk_back(splats, lists[i], walked, values[i], behind, memory);
                sum_pixels(splats, lists[i], walked, first, values[i], memory, sums);
            }
            if (pass == 1)
                for (uint k = 0; k < count; ++k) {
                    if (k + PREFETCH_AHEAD < count)
                        PREFETCH_TO_WRITE(totals + 2 * SUMS * (size_t)intersections[from + k + PREFETCH_AHEAD]);
                    add_sums(totals, intersections[from + k], sums[k], scale);
                }
            if (is_last)
                break;
        }
    }
}
