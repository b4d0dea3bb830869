/* Which splats touch which tile, for CPUs: one splat a work-item. See tile_lists_gpu.cl for the scheme. */

#include "splat.clh"

#define GROUP 1
#define COUNTER_STRIDE 1

kernel void count_tiles(global const float4 *shapes, uint splats, View view, volatile global uint *counts)
{
    const uint splat = get_global_id(0);
    float4 s1 = shapes[2 * splat + 1];
    if (s1.w == 0.0f)
        return;
    float4 s0 = shapes[2 * splat];
    int2 rows = ellipse_tile_rows(s0, s1, view.rows);
    for (int row = rows.x; row < rows.y; ++row) {
        int2 columns = ellipse_tile_columns(s0, s1, row, view.columns, view.width, view.height);
        for (int column = columns.x; column < columns.y; ++column)
            atomic_inc(&counts[row * view.columns + column]);
    }
}

kernel void fill_tiles(
    global const float4 *shapes, uint splats, View view, volatile global uint *cursors, global ulong *keys, uint capacity)
{
    const uint splat = get_global_id(0);
    float4 s1 = shapes[2 * splat + 1];
    if (s1.w == 0.0f)
        return;
    float4 s0 = shapes[2 * splat];
    ulong key = depth_key(s1.z, splat);
    int2 rows = ellipse_tile_rows(s0, s1, view.rows);
    for (int row = rows.x; row < rows.y; ++row) {
        int2 columns = ellipse_tile_columns(s0, s1, row, view.columns, view.width, view.height);
        for (int column = columns.x; column < columns.y; ++column) {
            uint slot = atomic_inc(&cursors[row * view.columns + column]);
            if (slot < capacity)
                keys[slot] = key;
        }
    }
}

#include "scan_tiles.clh"
