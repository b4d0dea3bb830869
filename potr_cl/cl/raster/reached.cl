/* Which splats a view of a set reaches, for GPUs: one work-group a tile.

   A tile's list is walked from front to back until all pixels have ended (subtile_lists.clh). What is behind that makes
   no difference to any bit of what is composited, or of what goes back to splats: nobody fetches it.

   Macros: ALPHA_CAP, TRANSMITTANCE_THRESHOLD, NATIVE_EXP2 (see subtile_lists.clh).

   On GPUs: ALPHA_CAP=0.99f TRANSMITTANCE_THRESHOLD=1e-4f NATIVE_EXP2=0,1. */

#include "include/group.clh"
#include "include/subtile_lists.clh"

/* marks[k] = 1 for each splat k that is fetched for view `number`. The others' marks stay. */
kernel __attribute__((reqd_work_group_size(ITEMS, 1, 1)))
void mark_reached(
    global const SetView *views,
    uint number,
    uint stride,
    global const float4 *shapes,
    global const float4 *colours,
    global const uint *offsets,
    global const uint *intersections,
    global const ushort *subtiles,
    global uchar *marks)
{
    local State state;
    local Batch batch;
    local int unfinished[2];

    const int lid = get_local_id(0);
    const uint tile = GROUP_ID(0);
    views += number;
    const int2 picture = (int2)(views->view.width, views->view.height);
    const int columns = views->view.columns;
    if (tile >= (uint)(columns * views->view.rows))
        return;
    shapes += 2 * (size_t)stride * number;
    colours += (size_t)stride * number;
    offsets += views->first_offset + tile;
    const uint length = offsets[1] - offsets[0];
    intersections += views->first_intersection + offsets[0];
    subtiles += views->first_intersection + offsets[0];
    const int2 origin = (int2)(tile % columns, tile / columns) * TILE;
    uint last; /* batch, which nobody needs */
    const uint swept = forward(
        &state, &batch, unfinished, origin, picture, shapes, colours, intersections, subtiles, length,
        ALL_SUBTILES, lid, &last);
    /* Other tiles may write there too, and the same. */
    for (uint i = lid; i < swept; i += ITEMS)
        marks[intersections[i]] = 1;
}
