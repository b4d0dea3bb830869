/* Which splats a view draws: those in the list of any of its tiles.

   On GPUs: no macros. */

#include "include/view_set.clh"

/* marks[k] = 1 for each splat k that view `number` of a set draws. The others' marks stay. A tile a work-item. */
kernel void mark_drawn(
    global const SetView *views,
    uint number,
    global const uint *offsets,
    global const uint *intersections,
    global uchar *marks)
{
    views += number;
    const size_t tile = get_global_id(0);
    if (tile >= (size_t)views->view.columns * views->view.rows)
        return;
    offsets += views->first_offset + tile;
    intersections += views->first_intersection;
    /* Other tiles may write there too, and the same. */
    for (uint i = offsets[0]; i < offsets[1]; ++i)
        marks[intersections[i]] = 1;
}
