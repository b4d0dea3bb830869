/* Which splats touch which tile, for GPUs; get_global_id(1) is the view's number in its set. tile_lists_cpu.cl is its
   twin.

   count_tiles adds one to a tile's count for every splat whose ellipse touches it. scan_tiles turns the counts into
   offsets. fill_tiles runs the same tests again and puts each splat's key into its tiles' segments. The order inside a
   segment depends on which work-item came first; sorting by unique keys makes it the same on every run.

   The unit of work is one row of tiles of one splat. A work-group strings the rows of its 256 splats together and deals
   them out evenly, so that one huge splat does not keep one work-item busy while the others wait.

   Macros: COUNTER_STRIDE (see scan_tiles.clh; sort_gpu.cl must be given the same).

   On GPUs: COUNTER_STRIDE=8. */

#include "include/group.clh"
#include "include/splat.clh"
#include "include/view_set.clh"

#define GROUP 256

#include "raster/scan_tiles.clh"

/* first[s] becomes the number of rows that the splats before s have; first[GROUP] that of all of them. */
inline void string_rows(global const ushort4 *bounds, local int *first, local ushort4 *around)
{
    const int lid = get_local_id(0);
    const ushort4 tiles = bounds[get_global_id(0)];
    around[lid] = tiles;
    first[lid + 1] = tiles.w - tiles.z;
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

/* The splat of the work-group that row number `row` belongs to. */
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
void count_tiles(
    global const SetView *views,
    uint stride,
    global const ushort4 *bounds,
    global const float4 *shapes,
    volatile global uint *counts)
{
    local int first[GROUP + 1];
    local ushort4 around[GROUP];
    views += get_global_id(1);
    bounds += (size_t)stride * get_global_id(1);
    shapes += 2 * (size_t)stride * get_global_id(1);
    counts += COUNTER_STRIDE * (size_t)views->first_tile;
    const int width = views->view.width, height = views->view.height, tiles_across = views->view.columns;
    string_rows(bounds, first, around);
    for (int row = get_local_id(0); row < first[GROUP]; row += GROUP) {
        int owner = row_owner(first, row);
        uint splat = GROUP_ID(0) * GROUP + owner;
        int4 tiles = convert_int4(around[owner]);
        int tile_row = tiles.z + row - first[owner];
        int2 columns = splat_tile_columns(shapes, splat, tiles, tile_row, width, height);
        for (int column = columns.x; column < columns.y; ++column)
            atomic_inc(&counts[(tile_row * tiles_across + column) * COUNTER_STRIDE]);
    }
}

kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void fill_tiles(
    global const SetView *views,
    uint stride,
    global const ushort4 *bounds,
    global const float4 *shapes,
    volatile global uint *counts,
    global ulong *keys,
    uint capacity)
{
    local int first[GROUP + 1];
    local ushort4 around[GROUP];
    views += get_global_id(1);
    bounds += (size_t)stride * get_global_id(1);
    shapes += 2 * (size_t)stride * get_global_id(1);
    counts += COUNTER_STRIDE * (size_t)views->first_tile;
    keys += views->first_intersection;
    capacity -= min(capacity, views->first_intersection);
    const int width = views->view.width, height = views->view.height, tiles_across = views->view.columns;
    string_rows(bounds, first, around);
    for (int row = get_local_id(0); row < first[GROUP]; row += GROUP) {
        int owner = row_owner(first, row);
        uint splat = GROUP_ID(0) * GROUP + owner;
        int4 tiles = convert_int4(around[owner]);
        int tile_row = tiles.z + row - first[owner];
        int2 columns = splat_tile_columns(shapes, splat, tiles, tile_row, width, height);
        ulong key = depth_key(shapes[2 * splat + 1].z, splat);
        for (int column = columns.x; column < columns.y; ++column) {
            uint slot = atomic_inc(&counts[(tile_row * tiles_across + column) * COUNTER_STRIDE]);
            if (slot < capacity)
                keys[slot] = key;
        }
    }
}

/* One work-group does a view. */
kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void scan_tiles(global const SetView *views, global uint *counts, global uint *offsets)
{
    local ulong sums[GROUP];
    views += GROUP_ID(1);
    scan(
        counts + COUNTER_STRIDE * (size_t)views->first_tile,
        offsets + views->first_offset,
        (uint)(views->view.columns * views->view.rows),
        sums);
}
