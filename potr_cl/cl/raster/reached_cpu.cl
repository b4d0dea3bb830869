/* Which splats a view reaches, for CPUs: one tile a work-item. reached.cl is its twin.

   A tile's list is walked from front to back until all pixels have ended, as composite_cpu.cl does. What is behind that
   makes no difference to any bit of what is composited, or of what goes back to splats.

   Macros:
       LANES                               8 or 16, see lanes.clh;
       ALPHA_CAP, TRANSMITTANCE_THRESHOLD  see subtile_vectors.clh;
       LOOK_EVERY                          after so many splats it is found whether any pixel goes on; 16 by default. */

#include "include/lanes.clh"
#include "include/splat.clh"
#include "include/subtile_vectors.clh"

#ifndef LOOK_EVERY
#define LOOK_EVERY 16
#endif

/* marks[k] = 1 for each splat k that is fetched for the view. The others' marks stay. */
kernel void mark_reached(
    global const float4 *shapes,
    global const float4 *colours,
    global const uint *offsets,
    global const uint *intersections,
    global const uint *subtiles,
    View view,
    global uchar *marks)
{
    const int tile = get_global_id(0);
    const int2 origin = (int2)(tile % view.columns, tile / view.columns) * TILE;
    const uint begin = offsets[tile], end = offsets[tile + 1];

    vfloat t[SUBTILES];
    for (int i = 0; i < SUBTILES; ++i)
        t[i] = subtile_transmittance(i, origin, view.width, view.height);
    uint living = ALL_SUBTILES;
    for (uint e = begin; e < end && living; ++e) {
        if (e + PREFETCH_AHEAD < end)
            prefetch_splat(shapes, colours, intersections[e + PREFETCH_AHEAD]);
        /* Other tiles may write there too, and the same. */
        marks[intersections[e]] = 1;
        uint todo = subtiles[e] & living;
        if (todo) {
            const Splat splat = load_splat(shapes, colours, intersections[e]);
            for (; todo; todo &= todo - 1) {
                const int i = LOWEST_SUBTILE(todo);
                const vfloat power = subtile_power(&splat, i, origin);
                BLEND(weight, power, t[i]);
            }
        }
        if ((e - begin) % LOOK_EVERY == LOOK_EVERY - 1)
            living = living_subtiles(t);
    }
}
