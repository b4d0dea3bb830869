/* Composites the splats to a picture, for CPUs: one tile a work-item. It goes splat by splat over the sub-tiles that
   the splat's ellipse touches. composite_gpu.cl is its twin.

   The state of the 256 pixels lives in private memory, one vector for each sub-tile. A pixel that has ended keeps the
   negative of its transmittance. Every LOOK_EVERY splats it is found which sub-tiles go on. The tile ends when none
   does.

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

kernel void composite(
    global const float4 *shapes,
    global const float4 *colours,
    global const uint *offsets,
    global const uint *intersections,
    global const uint *subtiles,
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
    const uint end = min(offsets[tile + 1], capacity);

    vfloat t[SUBTILES], r[SUBTILES], g[SUBTILES], b[SUBTILES];
    for (int i = 0; i < SUBTILES; ++i) {
        t[i] = subtile_transmittance(i, origin, view.width, view.height);
        r[i] = g[i] = b[i] = (vfloat)(0.0f);
    }

    uint living = ALL_SUBTILES;
    const uint begin = min(offsets[tile], capacity);
    for (uint e = begin; e < end && living; ++e) {
        if (e + PREFETCH_AHEAD < end)
            prefetch_splat(shapes, colours, intersections[e + PREFETCH_AHEAD]);
        uint todo = subtiles[e] & living;
        if (todo) {
            const Splat splat = load_splat(shapes, colours, intersections[e]);
            for (; todo; todo &= todo - 1) {
                const int i = LOWEST_SUBTILE(todo);
                const vfloat power = subtile_power(&splat, i, origin);
                BLEND(weight, power, t[i]);
                r[i] = MAD(weight, (vfloat)(splat.red), r[i]);
                g[i] = MAD(weight, (vfloat)(splat.green), g[i]);
                b[i] = MAD(weight, (vfloat)(splat.blue), b[i]);
            }
        }
        if ((e - begin) % LOOK_EVERY == LOOK_EVERY - 1)
            living = living_subtiles(t);
    }

    float rest[TILE * TILE], reds[TILE * TILE], greens[TILE * TILE], blues[TILE * TILE];
    for (int i = 0; i < SUBTILES; ++i) {
        const vfloat through = fabs(t[i]);
        store_subtile(through, i, rest);
        store_subtile(MAD(through, (vfloat)(red), r[i]), i, reds);
        store_subtile(MAD(through, (vfloat)(green), g[i]), i, greens);
        store_subtile(MAD(through, (vfloat)(blue), b[i]), i, blues);
    }
    const int pixel_columns = min(TILE, view.width - origin.x), pixel_rows = min(TILE, view.height - origin.y);
    for (int row = 0; row < pixel_rows; ++row) {
        size_t pixel = (size_t)(origin.y + row) * view.width + origin.x;
        for (int i = row * TILE; i < row * TILE + pixel_columns; ++i, ++pixel) {
            image[3 * pixel] = reds[i];
            image[3 * pixel + 1] = greens[i];
            image[3 * pixel + 2] = blues[i];
            transmittance[pixel] = rest[i];
        }
    }
}
