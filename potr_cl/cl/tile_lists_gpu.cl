/* Which splats touch which tile, for GPUs.

   count_tiles adds one to a tile's count for every splat whose ellipse touches it; scan_tiles turns the counts into
   offsets; fill_tiles runs the same tests again and drops each splat's key into its tiles' segments. The order inside a
   segment is whatever the atomics made it: sorting by unique keys makes it the same on every run.

   A splat's rows of tiles are its unit of work. A work-group strings the rows of its 256 splats together and deals them
   out evenly, so that one huge splat does not keep one work-item busy while the others wait. */

#include "splat.clh"

#define GROUP 256
/* Every tile's counter has 32 bytes to itself: the memory system does one atomic at a time in so many. */
#define COUNTER_STRIDE 8

/* first[s] = number of rows of the splats before s; first[GROUP] = all of them. */
inline void string_rows(global const float4 *shapes, uint splats, View view, local int *first, local int *low)
{
    const int lid = get_local_id(0);
    const uint splat = get_global_id(0);
    int2 rows = (int2)(0, 0);
    if (splat < splats) {
        float4 s1 = shapes[2 * splat + 1];
        if (s1.w > 0.0f)
            rows = ellipse_tile_rows(shapes[2 * splat], s1, view.rows);
    }
    low[lid] = rows.x;
    first[lid + 1] = max(rows.y - rows.x, 0);
    if (lid == 0)
        first[0] = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int step = 1; step < GROUP; step *= 2) {
        int value = first[lid + 1];
        if (lid >= step)
            value += first[lid + 1 - step];
        barrier(CLK_LOCAL_MEM_FENCE);
        first[lid + 1] = value;
        barrier(CLK_LOCAL_MEM_FENCE);
    }
}

/* The splat of the group that row number `row` belongs to. */
inline int row_owner(local const int *first, int row)
{
    int low = 0, high = GROUP;
    while (high - low > 1) {
        int middle = (low + high) / 2;
        if (first[middle] <= row)
            low = middle;
        else
            high = middle;
    }
    return low;
}

kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void count_tiles(global const float4 *shapes, uint splats, View view, volatile global uint *counts)
{
    local int first[GROUP + 1], low[GROUP];
    string_rows(shapes, splats, view, first, low);
    for (int row = get_local_id(0); row < first[GROUP]; row += GROUP) {
        int owner = row_owner(first, row);
        uint splat = get_group_id(0) * GROUP + owner;
        int tile_row = low[owner] + row - first[owner];
        int2 columns = ellipse_tile_columns(
            shapes[2 * splat], shapes[2 * splat + 1], tile_row, view.columns, view.width, view.height);
        for (int column = columns.x; column < columns.y; ++column)
            atomic_inc(&counts[(tile_row * view.columns + column) * COUNTER_STRIDE]);
    }
}

kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void fill_tiles(
    global const float4 *shapes, uint splats, View view, volatile global uint *cursors, global ulong *keys, uint capacity)
{
    local int first[GROUP + 1], low[GROUP];
    string_rows(shapes, splats, view, first, low);
    for (int row = get_local_id(0); row < first[GROUP]; row += GROUP) {
        int owner = row_owner(first, row);
        uint splat = get_group_id(0) * GROUP + owner;
        int tile_row = low[owner] + row - first[owner];
        float4 s1 = shapes[2 * splat + 1];
        int2 columns =
            ellipse_tile_columns(shapes[2 * splat], s1, tile_row, view.columns, view.width, view.height);
        ulong key = depth_key(s1.z, splat);
        for (int column = columns.x; column < columns.y; ++column) {
            uint slot = atomic_inc(&cursors[(tile_row * view.columns + column) * COUNTER_STRIDE]);
            if (slot < capacity)
                keys[slot] = key;
        }
    }
}

#include "scan_tiles.clh"
