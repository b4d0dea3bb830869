/* The picture's dependence on the splats' colours, for CPUs: one tile a work-item, two sweeps forward over its list.

   The picture is linear in the colours: pixel = sum of w_k c_k + rest of the background, w_k = T alpha. The first sweep
   makes the pixel's value v, less the target if there is one; the second, with the same arithmetic, each splat's sum over
   the tile's pixels of w_k v, three channels, and with WEIGHTS of w_k^2. Both go to exact totals (totals.clh).

   Macros: LANES, ALPHA_CAP, STOP, WEIGHTS. */

#include "lanes.clh"
#include "splat.clh"
#include "splat_block.clh"
#include "refit.clh"

#define VECTORS (TILE / LANES)

/* T alpha of one splat in LANES pixels, whose transmittances t move on; negative ones belong to pixels that have ended. */
#define BLEND(weight, power, t)                                     \
    vfloat alpha = exp2_polynomial(power);                          \
    alpha = LESSER(alpha, (vfloat)(ALPHA_CAP));                     \
    alpha = (power) >= LOG2_ALPHA_MIN ? alpha : (vfloat)(0.0f);     \
    const vfloat before = t;                                        \
    const vfloat after = MAD(-alpha, before, before);               \
    const vint goes_on = after >= STOP;                             \
    const vfloat weight = goes_on ? alpha * before : (vfloat)(0.0f); \
    t = goes_on ? after : NEGATIVE(before)

kernel void refit_sweep(
    global const float4 *shapes,
    global const float4 *colours,
    global const uint *offsets,
    global const uint *entries,
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
    const int pixel_rows = min(TILE, view.height - origin.y);
    const int pixel_columns = min(TILE, view.width - origin.x);
    const uint begin = offsets[tile], end = offsets[tile + 1];

    vfloat t[TILE * VECTORS], r[TILE * VECTORS], g[TILE * VECTORS], b[TILE * VECTORS];
    uint swept = begin;
    for (int pass = 0; pass < 2; ++pass) {
        for (int i = 0; i < TILE * VECTORS; ++i) {
            vfloat column = LANE_NUMBERS + (float)(origin.x + i % VECTORS * LANES);
            t[i] = column < (float)view.width ? (vfloat)(1.0f) : (vfloat)(-1.0f);
            if (pass == 0)
                r[i] = g[i] = b[i] = (vfloat)(0.0f);
        }
        int first_alive = 0, end_alive = pixel_rows;
        SplatBlock block;
        for (uint from = begin; from < end && first_alive < end_alive; from += BLOCK) {
            fetch_block(&block, shapes, colours, entries, from, end, origin);
            swept = min(from + BLOCK, end);
            for (int k = 0; k < BLOCK; ++k) {
                const int first_row = GREATER(block.first_row[k], first_alive);
                const int end_row = LESSER(block.end_row[k], end_alive);
                if (first_row >= end_row)
                    continue;
                const float x = block.x[k], a = block.a[k];
                vfloat au[VECTORS];
                for (int v = 0; v < VECTORS; ++v)
                    au[v] = a * ((LANE_NUMBERS + (origin.x + v * LANES + 0.5f)) - x);
                vfloat sum_r = (vfloat)(0.0f), sum_g = (vfloat)(0.0f), sum_b = (vfloat)(0.0f);
                vfloat squares = (vfloat)(0.0f);
                for (int row = first_row; row < end_row; ++row) {
                    const float dy = origin.y + row + 0.5f - block.y[k];
                    const float bu = block.b[k] * dy;
                    const float cv = block.c[k] * dy;
                    const float level = MAD(-cv, cv, block.log2_opacity[k]);
                    for (int v = 0; v < VECTORS; ++v) {
                        const int i = row * VECTORS + v;
                        const vfloat u = au[v] + bu;
                        const vfloat power = MAD(-u, u, (vfloat)(level));
                        BLEND(weight, power, t[i]);
                        if (pass == 0) {
                            r[i] = MAD(weight, (vfloat)(block.red[k]), r[i]);
                            g[i] = MAD(weight, (vfloat)(block.green[k]), g[i]);
                            b[i] = MAD(weight, (vfloat)(block.blue[k]), b[i]);
                        } else {
                            sum_r = MAD(weight, r[i], sum_r);
                            sum_g = MAD(weight, g[i], sum_g);
                            sum_b = MAD(weight, b[i], sum_b);
#if WEIGHTS
                            squares = MAD(weight, weight, squares);
#endif
                        }
                    }
                }
                if (pass == 1) {
                    float parts[4][LANES];
                    VSTORE(sum_r, 0, parts[0]);
                    VSTORE(sum_g, 0, parts[1]);
                    VSTORE(sum_b, 0, parts[2]);
                    VSTORE(squares, 0, parts[3]);
                    float4 sum = (float4)(0.0f);
                    for (int lane = 0; lane < LANES; ++lane)
                        sum += (float4)(parts[0][lane], parts[1][lane], parts[2][lane], parts[3][lane]);
                    add_sums(totals, entries[from + k], sum, scale);
                }
            }
            int first = pixel_rows, last = -1;
            for (int row = first_alive; row < end_alive; ++row) {
                vfloat most = t[row * VECTORS];
                for (int v = 1; v < VECTORS; ++v)
                    most = fmax(most, t[row * VECTORS + v]);
                if (VANY(most > 0.0f)) {
                    first = min(first, row);
                    last = row;
                }
            }
            first_alive = first;
            end_alive = last + 1;
        }
        if (pass == 1)
            break;

        float error = 0.0f;
        for (int row = 0; row < pixel_rows; ++row) {
            float values[3][TILE];
            for (int v = 0; v < VECTORS; ++v) {
                const int i = row * VECTORS + v;
                const vfloat through = fabs(t[i]);
                VSTORE(MAD(through, (vfloat)(red), r[i]), v, values[0]);
                VSTORE(MAD(through, (vfloat)(green), g[i]), v, values[1]);
                VSTORE(MAD(through, (vfloat)(blue), b[i]), v, values[2]);
            }
            const size_t pixel = 3 * ((size_t)(origin.y + row) * view.width + origin.x);
            for (int column = 0; column < TILE; ++column)
                for (int channel = 0; channel < 3; ++channel) {
                    float value = column < pixel_columns ? values[channel][column] : 0.0f;
                    if (has_target && column < pixel_columns)
                        value -= target[pixel + 3 * column + channel];
                    value = clamp(value, -LARGEST_VALUE, LARGEST_VALUE);
                    error += value * value;
                    values[channel][column] = value;
                }
            for (int v = 0; v < VECTORS; ++v) {
                const int i = row * VECTORS + v;
                r[i] = VLOAD(v, values[0]);
                g[i] = VLOAD(v, values[1]);
                b[i] = VLOAD(v, values[2]);
            }
        }
        errors[tile] = error;
    }
}
