/* Which sub-tiles of its tile each intersection touches, for CPUs: one tile a work-item, LANES intersections at a time.
   It is found once for a view, however often its lists are swept. subtile_masks_gpu.cl is its twin.

   Macros: LANES (8 or 16, see lanes.clh), and those of subtile_vectors.clh for prefetching. */

#include "include/lanes.clh"
#include "include/splat.clh"
#include "include/subtile_vectors.clh"

/* subtiles[e] becomes the mask of touched_subtiles (subtiles.clh) for intersection e. */
kernel void subtile_masks(
    global const float4 *shapes,
    global const uint *offsets,
    global const uint *intersections,
    global uint *subtiles,
    uint capacity,
    View view)
{
    const int tile = get_global_id(0);
    const int2 origin = (int2)(tile % view.columns, tile / view.columns) * TILE;
    const uint end = min(offsets[tile + 1], capacity);
    float x[LANES], y[LANES], a[LANES], b[LANES], c[LANES], log2_opacity[LANES];
    int touched[LANES];
    for (uint begin = min(offsets[tile], capacity); begin < end; begin += LANES) {
        const int count = min(end - begin, (uint)LANES);
        for (uint e = begin + LANES; e < min(begin + 2 * LANES, end); ++e)
            PREFETCH(shapes + 2 * intersections[e]);
        for (int k = 0; k < LANES; ++k) {
            const uint splat = intersections[begin + min(k, count - 1)];
            const float4 s0 = shapes[2 * splat], s1 = shapes[2 * splat + 1];
            x[k] = s0.x;
            y[k] = s0.y;
            a[k] = s0.z;
            b[k] = s0.w;
            c[k] = s1.x;
            log2_opacity[k] = s1.y;
        }
        VSTORE(
            touched_subtiles(
                VLOAD(0, x), VLOAD(0, y), VLOAD(0, a), VLOAD(0, b), VLOAD(0, c), VLOAD(0, log2_opacity), origin),
            0,
            touched);
        for (int k = 0; k < count; ++k)
            subtiles[begin + k] = (uint)touched[k];
    }
}
