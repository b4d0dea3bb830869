/* Compositing for CPUs: one tile a work-item, splat by splat, over the rows that the splat's ellipse touches.

   The 256 pixels' state lives in private memory, rows of 16 / LANES vectors. A pixel that has ended keeps the negative of
   its transmittance. Every BLOCK splats the rows that are still alive are counted; the tile ends when none is.

   Macros: LANES, ALPHA_CAP, STOP (a pixel ends before its transmittance would fall below it). */

#include "lanes.clh"
#include "splat.clh"
#include "splat_block.clh"

#define VECTORS (TILE / LANES)

kernel void composite(
    global const float4 *shapes,
    global const float4 *colours,
    global const uint *offsets,
    global const uint *entries,
    uint capacity,
    View view,
    float red,
    float green,
    float blue,
    global float *image,
    global float *transmittance)
{
    const int tile = get_global_id(0);
    const int2 origin = (int2)(tile % view.columns, tile / view.columns) * TILE;
    const int pixel_rows = min(TILE, view.height - origin.y);
    const uint end = min(offsets[tile + 1], capacity);

    vfloat t[TILE * VECTORS], r[TILE * VECTORS], g[TILE * VECTORS], b[TILE * VECTORS];
    for (int i = 0; i < TILE * VECTORS; ++i) {
        vfloat column = LANE_NUMBERS + (float)(origin.x + i % VECTORS * LANES);
        t[i] = column < (float)view.width ? (vfloat)(1.0f) : (vfloat)(-1.0f);
        r[i] = g[i] = b[i] = (vfloat)(0.0f);
    }

    int first_alive = 0, end_alive = pixel_rows;
    SplatBlock block;
    for (uint begin = min(offsets[tile], capacity); begin < end && first_alive < end_alive; begin += BLOCK) {
        fetch_block(&block, shapes, colours, entries, begin, end, origin);
        for (int k = 0; k < BLOCK; ++k) {
            const int first_row = GREATER(block.first_row[k], first_alive);
            const int end_row = LESSER(block.end_row[k], end_alive);
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
                    vfloat alpha = exp2_polynomial(power);
                    alpha = LESSER(alpha, (vfloat)(ALPHA_CAP));
                    alpha = power >= LOG2_ALPHA_MIN ? alpha : (vfloat)(0.0f);
                    const vfloat before = t[i];
                    const vfloat after = MAD(-alpha, before, before);
                    const vint goes_on = after >= STOP;
                    const vfloat weight = goes_on ? alpha * before : (vfloat)(0.0f);
                    t[i] = goes_on ? after : NEGATIVE(before);
                    r[i] = MAD(weight, (vfloat)(block.red[k]), r[i]);
                    g[i] = MAD(weight, (vfloat)(block.green[k]), g[i]);
                    b[i] = MAD(weight, (vfloat)(block.blue[k]), b[i]);
                }
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

    const int pixel_columns = min(TILE, view.width - origin.x);
    for (int row = 0; row < pixel_rows; ++row) {
        float rest[TILE], reds[TILE], greens[TILE], blues[TILE];
        for (int v = 0; v < VECTORS; ++v) {
            int i = row * VECTORS + v;
            vfloat through = fabs(t[i]);
            VSTORE(through, v, rest);
            VSTORE(MAD(through, (vfloat)(red), r[i]), v, reds);
            VSTORE(MAD(through, (vfloat)(green), g[i]), v, greens);
            VSTORE(MAD(through, (vfloat)(blue), b[i]), v, blues);
        }
        size_t pixel = (size_t)(origin.y + row) * view.width + origin.x;
        for (int column = 0; column < pixel_columns; ++column, ++pixel) {
            image[3 * pixel] = reds[column];
            image[3 * pixel + 1] = greens[column];
            image[3 * pixel + 2] = blues[column];
            transmittance[pixel] = rest[column];
        }
    }
}
