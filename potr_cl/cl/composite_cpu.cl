/* Compositing for CPUs: one tile a work-item, splat by splat, over the rows that the splat's ellipse touches.

   The 256 pixels' state lives in private memory, rows of 16 / LANES vectors. A pixel that has ended keeps the negative of
   its transmittance. Every BLOCK splats the rows that are still alive are counted; the tile ends when none is.

   Macros: LANES, ALPHA_CAP, STOP (a pixel ends before its transmittance would fall below it). */

#include "lanes.clh"
#include "splat.clh"

#define VECTORS (TILE / LANES)
#define BLOCK 16

/* Half-open range of pixel rows, within a tile whose first pixel is `origin`, that the ellipse touches between the
   tile's left and right edge: its vertical extent within that strip. */
inline int2 ellipse_pixel_rows(float4 s0, float4 s1, int2 origin)
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
    for (uint block = min(offsets[tile], capacity); block < end && first_alive < end_alive; block += BLOCK) {
        const uint block_end = min(block + BLOCK, end);
        for (uint e = block; e < block_end; ++e) {
            uint splat = entries[e];
            float4 s0 = shapes[2 * splat], s1 = shapes[2 * splat + 1];
            float4 colour = colours[splat];
            int2 rows = ellipse_pixel_rows(s0, s1, origin);
            rows.x = max(rows.x, first_alive);
            rows.y = min(rows.y, end_alive);
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
                    r[i] = mad(weight, (vfloat)(colour.x), r[i]);
                    g[i] = mad(weight, (vfloat)(colour.y), g[i]);
                    b[i] = mad(weight, (vfloat)(colour.z), b[i]);
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
            VSTORE(mad(through, (vfloat)(red), r[i]), v, reds);
            VSTORE(mad(through, (vfloat)(green), g[i]), v, greens);
            VSTORE(mad(through, (vfloat)(blue), b[i]), v, blues);
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
