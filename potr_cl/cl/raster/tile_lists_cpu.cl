/* Which splats touch which tile, for CPUs: one splat a work-item. See tile_lists_gpu.cl, its twin, for the scheme.

   Macros: none. */

#include "include/splat.clh"

#define GROUP 1

#include "raster/scan_tiles.clh"

kernel void count_tiles(
    global const ushort4 *bounds, global const float4 *shapes, View view, volatile global uint *counts)
{
    const uint splat = get_global_id(0);
    const int4 around = convert_int4(bounds[splat]);
    for (int row = around.z; row < around.w; ++row) {
        int2 columns = splat_tile_columns(shapes, splat, around, row, view.width, view.height);
        for (int column = columns.x; column < columns.y; ++column)
            atomic_inc(&counts[row * view.columns + column]);
    }
}

kernel void fill_tiles(
    global const ushort4 *bounds,
    global const float4 *shapes,
    View view,
    volatile global uint *counts,
    global ulong *keys,
    uint capacity)
{
    const uint splat = get_global_id(0);
    const int4 around = convert_int4(bounds[splat]);
    if (around.z == around.w)
        return;
    const ulong key = depth_key(shapes[2 * splat + 1].z, splat);
    for (int row = around.z; row < around.w; ++row) {
        int2 columns = splat_tile_columns(shapes, splat, around, row, view.width, view.height);
        for (int column = columns.x; column < columns.y; ++column) {
            uint slot = atomic_inc(&counts[row * view.columns + column]);
            if (slot < capacity)
                keys[slot] = key;
        }
    }
}

kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void scan_tiles(global uint *counts, global uint *offsets, uint tiles)
{
    local ulong sums[GROUP];
    scan(counts, offsets, tiles, sums);
}
