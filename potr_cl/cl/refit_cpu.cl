/* The picture's dependence on the splats' colours, for CPUs: one tile a work-item, two sweeps forward over its list.

   The picture is linear in the colours: pixel = sum of w_k c_k + rest of the background, w_k = T alpha. The first sweep
   makes the pixel's value v, less the target if there is one; the second, with the same arithmetic, each splat's sum over
   the tile's pixels of w_k v, three channels, and with WEIGHTS of w_k^2. Both go to exact totals (totals.clh).

   Macros: LANES, ALPHA_CAP, STOP, WEIGHTS. */

#include "lanes.clh"
#include "splat.clh"
#include "patch_vectors.clh"
#include "refit.clh"

kernel void refit_sweep(
    global const float4 *shapes,
    global const float4 *colours,
    global const uint *offsets,
    global const uint *entries,
    global const uint *patches,
    View view,
    float red,
    float green,
    float blue,
    global const float *target,
    int has_target,
    float scale,
    global float *errors,
    volatile global uint *totals)
{
    const int tile = get_global_id(0);
    const int2 origin = (int2)(tile % view.columns, tile / view.columns) * TILE;
    const uint begin = offsets[tile], end = offsets[tile + 1];

    vfloat t[PATCHES], r[PATCHES], g[PATCHES], b[PATCHES];
    for (int pass = 0; pass < 2; ++pass) {
        for (int i = 0; i < PATCHES; ++i) {
            t[i] = patch_transmittance(i, origin, view.width, view.height);
            if (pass == 0)
                r[i] = g[i] = b[i] = (vfloat)(0.0f);
        }
        uint living = ALL_PATCHES;
        for (uint e = begin; e < end && living; ++e) {
            if (e + AHEAD < end)
                prefetch_splat(shapes, colours, entries[e + AHEAD]);
            uint todo = patches[e] & living;
            if (todo) {
                const Splat splat = load_splat(shapes, colours, entries[e]);
                vfloat sum_r = (vfloat)(0.0f), sum_g = (vfloat)(0.0f), sum_b = (vfloat)(0.0f);
                vfloat squares = (vfloat)(0.0f);
                for (; todo; todo &= todo - 1) {
                    const int i = LOWEST_PATCH(todo);
                    const vfloat power = patch_power(&splat, i, origin);
                    BLEND(weight, power, t[i]);
                    if (pass == 0) {
                        r[i] = MAD(weight, (vfloat)(splat.red), r[i]);
                        g[i] = MAD(weight, (vfloat)(splat.green), g[i]);
                        b[i] = MAD(weight, (vfloat)(splat.blue), b[i]);
                    } else {
                        sum_r = MAD(weight, r[i], sum_r);
                        sum_g = MAD(weight, g[i], sum_g);
                        sum_b = MAD(weight, b[i], sum_b);
#if WEIGHTS
                        squares = MAD(weight, weight, squares);
#endif
                    }
                }
                if (pass == 1) {
                    const float4 sum =
                        (float4)(sum_lanes(sum_r), sum_lanes(sum_g), sum_lanes(sum_b), sum_lanes(squares));
                    add_sums(totals, entries[e], sum, scale);
                }
            }
            if ((e - begin) % AHEAD == AHEAD - 1)
                living = living_patches(t);
        }
        if (pass == 1)
            break;

        float error = 0.0f;
        float values[3][TILE * TILE];
        for (int i = 0; i < PATCHES; ++i) {
            const vfloat through = fabs(t[i]);
            store_patch(MAD(through, (vfloat)(red), r[i]), i, values[0]);
            store_patch(MAD(through, (vfloat)(green), g[i]), i, values[1]);
            store_patch(MAD(through, (vfloat)(blue), b[i]), i, values[2]);
        }
        for (int row = 0; row < TILE; ++row)
            for (int column = 0; column < TILE; ++column) {
                const int inside = origin.x + column < view.width && origin.y + row < view.height;
                const size_t pixel = 3 * ((size_t)(origin.y + row) * view.width + origin.x + column);
                for (int channel = 0; channel < 3; ++channel) {
                    float value = inside ? values[channel][row * TILE + column] : 0.0f;
                    if (has_target && inside)
                        value -= target[pixel + channel];
                    value = clamp(value, -LARGEST_VALUE, LARGEST_VALUE);
                    error += value * value;
                    values[channel][row * TILE + column] = value;
                }
            }
        for (int i = 0; i < PATCHES; ++i) {
            r[i] = load_patch(i, values[0]);
            g[i] = load_patch(i, values[1]);
            b[i] = load_patch(i, values[2]);
        }
        errors[tile] = error;
    }
}
