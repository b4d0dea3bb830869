/* How a picture changes when the splats change along a direction, for CPUs: one tile a work-item, splat by splat over
   the sub-tiles that it touches, as composite_cpu.cl. tangents_gpu.cl is its twin.

   With d what splat_tangents.cl says of d ln alpha in a pixel, 0 where alpha is capped, and w = T alpha, a splat adds
   w (its colour's change) + (w d + T' alpha) (its colour) to the pixel's change, where T', the transmittance's change,
   is 0 in front of all splats and becomes (1 - alpha) T' - w d behind this one. Only sums of what is nearer than a splat
   are needed, so one walk from front to back suffices.

   Macros:
       LANES                               8 or 16, see lanes.clh;
       ALPHA_CAP, TRANSMITTANCE_THRESHOLD  see subtile_vectors.clh;
       LOOK_EVERY                          16 by default. */

#include "include/lanes.clh"
#include "include/splat.clh"
#include "include/subtile_vectors.clh"

#ifndef LOOK_EVERY
#define LOOK_EVERY 16
#endif

kernel void tangents(
    global const float4 *shapes,
    global const float4 *colours,
    global const float4 *changes,
    global const uint *offsets,
    global const uint *intersections,
    global const uint *subtiles,
    View view,
    float red,
    float green,
    float blue,
    ulong first_pixel,
    global float *result)
{
    const int tile = get_global_id(0);
    const int2 origin = (int2)(tile % view.columns, tile / view.columns) * TILE;
    const uint begin = offsets[tile], end = offsets[tile + 1];

    vfloat t[SUBTILES], through[SUBTILES], r[SUBTILES], g[SUBTILES], b[SUBTILES];
    for (int i = 0; i < SUBTILES; ++i) {
        t[i] = subtile_transmittance(i, origin, view.width, view.height);
        through[i] = r[i] = g[i] = b[i] = (vfloat)(0.0f);
    }

    uint living = ALL_SUBTILES;
    for (uint e = begin; e < end && living; ++e) {
        if (e + PREFETCH_AHEAD < end) {
            prefetch_splat(shapes, colours, intersections[e + PREFETCH_AHEAD]);
            PREFETCH(changes + 3 * (size_t)intersections[e + PREFETCH_AHEAD]);
        }
        uint todo = subtiles[e] & living;
        if (todo) {
            const Splat splat = load_splat(shapes, colours, intersections[e]);
            global const float4 *change = changes + 3 * (size_t)intersections[e];
            const float4 c0 = change[0], c1 = change[1];
            const float c2 = change[2].x;
            for (; todo; todo &= todo - 1) {
                const int i = LOWEST_SUBTILE(todo);
                const vfloat dx = LANE_COLUMNS + ((origin.x + SUBTILE_COLUMN(i) + 0.5f) - splat.x);
                const vfloat dy = LANE_ROWS + ((origin.y + SUBTILE_ROW(i) + 0.5f) - splat.y);
                const vfloat u = MAD(dx, (vfloat)(splat.a), dy * splat.b), v = dy * splat.c;
                const vfloat power = MAD(-u, u, MAD(-v, v, (vfloat)(splat.log2_opacity)));
                BLEND(weight, power, t[i]);
                const vfloat by_u = MAD(u, (vfloat)(c1.z), MAD(v, (vfloat)(c1.w), (vfloat)(c1.x)));
                const vfloat by_v = MAD(v, (vfloat)(c2), (vfloat)(c1.y));
                const vfloat factor = MAD(u, by_u, MAD(v, by_v, (vfloat)(c0.w)));
                const vfloat change_here = alpha < ALPHA_CAP ? weight * factor : (vfloat)(0.0f);
                const vfloat taken = goes_on ? alpha : (vfloat)(0.0f);
                const vfloat shown = MAD(through[i], taken, change_here);
                through[i] = through[i] - shown;
                r[i] += MAD(weight, (vfloat)(c0.x), shown * splat.red);
                g[i] += MAD(weight, (vfloat)(c0.y), shown * splat.green);
                b[i] += MAD(weight, (vfloat)(c0.z), shown * splat.blue);
            }
        }
        if ((e - begin) % LOOK_EVERY == LOOK_EVERY - 1)
            living = living_subtiles(t);
    }

    float reds[TILE * TILE], greens[TILE * TILE], blues[TILE * TILE];
    for (int i = 0; i < SUBTILES; ++i) {
        store_subtile(MAD(through[i], (vfloat)(red), r[i]), i, reds);
        store_subtile(MAD(through[i], (vfloat)(green), g[i]), i, greens);
        store_subtile(MAD(through[i], (vfloat)(blue), b[i]), i, blues);
    }
    const int pixel_columns = min(TILE, view.width - origin.x), pixel_rows = min(TILE, view.height - origin.y);
    for (int row = 0; row < pixel_rows; ++row) {
        size_t pixel = first_pixel + (size_t)(origin.y + row) * view.width + origin.x;
        for (int i = row * TILE; i < row * TILE + pixel_columns; ++i, ++pixel) {
            result[3 * pixel] = reds[i];
            result[3 * pixel + 1] = greens[i];
            result[3 * pixel + 2] = blues[i];
        }
    }
}
