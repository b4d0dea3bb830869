/* The picture as a function of the splats' colours, and the way back from pixels to splats, for CPUs: one tile a
   work-item, sub-tile by sub-tile. refit_gpu.cl is its twin.

   The picture is linear in the colours: pixel = sum of w_k c_k + the background's part, w_k = T alpha. A walk over a
   sub-tile's list finds the values v of its pixels, less the target if there is one, and remembers the weights. From
   these it then finds for each splat the sum of w_k v over the pixels, in three channels, and with WEIGHTS that of
   w_k^2. A tile's sums go to exact totals (totals.clh). Lists of more than SEGMENT splats are walked twice.

   Weights depend on geometry and opacities alone. So with WEIGHTS, and `trim`, lists and masks lose what lies behind the
   ends of all pixels: what is left comes first, and masks behind it are 0. Views that stay are walked less far then, and
   no bit of any sum changes.

   Macros:
       LANES                               8 or 16, see lanes.clh;
       ALPHA_CAP, TRANSMITTANCE_THRESHOLD  see subtile_vectors.clh;
       WEIGHTS, LARGEST_VALUE              see refit.clh;
       INT64_ATOMICS                       see totals.clh;
       SUMS_AHEAD                          splats whose totals are fetched before they are needed; 16 by default. */

#include "include/lanes.clh"
#include "include/splat.clh"
#include "include/subtile_vectors.clh"
#include "include/subtile_walk.clh"
#define REMEMBER(memory, j, alpha, weight) VSTORE(weight, j, memory)
#include "include/subtile_blend.clh"
#include "refit/refit.clh"
#include "refit/samples.clh"

#ifndef SUMS_AHEAD
#define SUMS_AHEAD 16
#endif

/* sums[list[j]] += the sums over the pixels of weights[j] x values, and of its square. */
inline void sum_pairs(const ushort *list, uint length, float *weights, const float values[3][LANES], float4 *sums)
{
    for (uint j = length; j % LANES; ++j)
        VSTORE((vfloat)(0.0f), j, weights);
    for (uint j = 0; j < length; j += LANES) {
        vfloat w[LANES];
        for (int k = 0; k < LANES; ++k)
            w[k] = VLOAD(j + k, weights);
        transpose(w);
        vfloat r = (vfloat)(0.0f), g = (vfloat)(0.0f), b = (vfloat)(0.0f), squares = (vfloat)(0.0f);
        for (int k = 0; k < LANES; ++k) {
            r = MAD(w[k], (vfloat)(values[0][k]), r);
            g = MAD(w[k], (vfloat)(values[1][k]), g);
            b = MAD(w[k], (vfloat)(values[2][k]), b);
#if WEIGHTS
            squares = MAD(w[k], w[k], squares);
#endif
        }
        vfloat four[4];
        interleave(r, g, b, squares, four);
        float vectors[4 * LANES];
        for (int k = 0; k < 4; ++k)
            VSTORE(four[k], k, vectors);
        const uint count = min(length - j, (uint)LANES);
        for (uint k = 0; k < count; ++k)
            sums[list[j + k]] += vload4(k, vectors);
    }
}

kernel void refit_sweep(
    global const float4 *shapes,
    global const float4 *colours,
    global const uint *offsets,
    global uint *intersections,
    global uint *subtiles,
    View view,
    float red,
    float green,
    float blue,
    global const float *target,
    int has_target,
    float scale,
    global const uint *numbers,
    uint first_number,
    uint every,
    int back,
    int trim,
    global float *errors,
    volatile global uint *totals)
{
    const int tile = get_global_id(0);
    const int2 origin = (int2)(tile % view.columns, tile / view.columns) * TILE;
    const uint begin = offsets[tile];
    uint end = offsets[tile + 1];
    while (end > begin && !subtiles[end - 1])
        --end;

    const uint some = sampled_subtiles(every, numbers[first_number]);
    Splat splats[SEGMENT];
    uint places[SEGMENT];
    ushort lists[SUBTILES][SEGMENT];
    uint lengths[SUBTILES];
    float weights[(SEGMENT + LANES) * LANES];
    float4 sums[SEGMENT];
    vfloat t[SUBTILES], rgb[SUBTILES][3];
    float values[SUBTILES][3][LANES];
    float error = 0.0f;
#if WEIGHTS
    uint seen[SEGMENT], left = begin;
#endif
    const int first_pass = end - begin > SEGMENT ? 0 : 1, last_pass = back ? 1 : first_pass;
    for (int pass = first_pass; pass <= last_pass; ++pass) {
        for (int i = 0; i < SUBTILES; ++i) {
            t[i] = subtile_transmittance(i, origin, view.width, view.height);
            rgb[i][0] = rgb[i][1] = rgb[i][2] = (vfloat)(0.0f);
        }
        for (uint from = begin; pass == 1 || from < end; from += SEGMENT) {
            const int is_last = from >= end || end - from <= SEGMENT;
            const uint count = from < end ?
                gather_some(
                    shapes, colours, intersections, subtiles, from, end, some, splats, places, lists, lengths) : 0;
            for (uint k = 0; k < count; ++k)
                sums[k] = (float4)(0.0f);
#if WEIGHTS
            for (uint k = 0; k < count; ++k)
                seen[k] = 0;
#endif
            for (int i = 0; i < SUBTILES; ++i) {
                if (!(some >> i & 1))
                    continue;
                const uint length = count ? lengths[i] : 0;
                const uint walked = blend(splats, lists[i], length, subtile_centre(origin, i), &t[i], rgb[i], weights);
                if (is_last && pass == first_pass) {
                    /* The pixels' values are known. */
                    const vfloat through = fabs(t[i]);
                    const vfloat colour[3] = {
                        MAD(through, (vfloat)(red), rgb[i][0]),
                        MAD(through, (vfloat)(green), rgb[i][1]),
                        MAD(through, (vfloat)(blue), rgb[i][2])};
                    error += pixel_values(
                        colour, i, origin, view.width, view.height, target, has_target, 0, 1.0f, LARGEST_VALUE,
                        values[i]);
                }
                if (pass == 1 && back)
                    sum_pairs(lists[i], walked, weights, values[i], sums);
#if WEIGHTS
                for (uint j = 0; j < walked; ++j)
                    seen[lists[i][j]] |= 1u << i;
#endif
            }
            if (pass == 1 && back)
                for (uint k = 0; k < count; ++k) {
                    if (k + SUMS_AHEAD < count)
                        PREFETCH_TO_WRITE(totals + 2 * TOTALS * intersections[places[k + SUMS_AHEAD]]);
                    add_sums(totals, intersections[places[k]], sums[k], scale);
                }
#if WEIGHTS
            for (uint k = 0; trim && pass == 1 && k < count; ++k)
                if (seen[k]) {
                    intersections[left] = intersections[places[k]];
                    subtiles[left++] = seen[k];
                }
#endif
            if (is_last)
                break;
        }
    }
#if WEIGHTS
    for (; trim && left < end; ++left)
        subtiles[left] = 0;
#endif
    errors[tile] = error;
}
