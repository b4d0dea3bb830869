/* Which sub-tiles of its tile each intersection touches, for GPUs: one work-group a tile; GROUP_ID(1) is the view's
   number in its set. It is found once for a view, however often its lists are swept. subtile_masks_cpu.cl is its twin.

   Macros: none.

   On GPUs: no macros. */

#define LANES 1
#define SUBTILE_WIDTH 4
#include "include/group.clh"
#include "include/lanes.clh"
#include "include/splat.clh"
#include "include/subtiles.clh"
#include "include/view_set.clh"

#define GROUP 128

kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void subtile_masks(
    global const SetView *views,
    uint stride,
    global const float4 *shapes,
    global const uint *offsets,
    global const uint *intersections,
    global ushort *subtiles,
    uint capacity)
{
    const uint tile = GROUP_ID(0);
    views += GROUP_ID(1);
    const int columns = views->view.columns;
    if (tile >= (uint)(columns * views->view.rows))
        return;
    shapes += 2 * (size_t)stride * GROUP_ID(1);
    offsets += views->first_offset + tile;
    const uint room = capacity - min(capacity, views->first_intersection);
    const uint end = views->first_intersection + min(offsets[1], room);
    const int2 origin = (int2)(tile % columns, tile / columns) * TILE;
    for (uint e = views->first_intersection + min(offsets[0], room) + get_local_id(0); e < end; e += GROUP) {
        const size_t splat = intersections[e];
        const float4 s0 = shapes[2 * splat], s1 = shapes[2 * splat + 1];
        subtiles[e] = (ushort)touched_subtiles(s0.x, s0.y, s0.z, s0.w, s1.x, s1.y, origin);
    }
}
