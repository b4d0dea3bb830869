/* Composites the splats to a picture, for GPUs: one work-group a tile; GROUP_ID(1) is the view's number in its set.
   See subtile_lists.clh for how a tile's work is shared out. composite_cpu.cl is its twin; composite_frame_gpu.cl does
   a view alone.

   Macros: ALPHA_CAP, TRANSMITTANCE_THRESHOLD, NATIVE_EXP2 (see subtile_lists.clh).

   On GPUs: ALPHA_CAP=0.99f TRANSMITTANCE_THRESHOLD=1e-4f NATIVE_EXP2=0,1. */

#include "include/group.clh"
#include "include/subtile_lists.clh"

kernel __attribute__((reqd_work_group_size(ITEMS, 1, 1)))
void composite(
    global const SetView *views,
    uint stride,
    global const float4 *shapes,
    global const float4 *colours,
    global const uint *offsets,
    global const uint *intersections,
    global const ushort *subtiles,
    uint capacity,
    float red,
    float green,
    float blue,
    global float *image,
    global float *transmittance)
{
    local State state;
    local Batch batch;
    local int unfinished[2];

    const int lid = get_local_id(0);
    const uint tile = GROUP_ID(0), number = GROUP_ID(1);
    views += number;
    const int2 picture = (int2)(views->view.width, views->view.height);
    const int columns = views->view.columns;
    if (tile >= (uint)(columns * views->view.rows))
        return;
    shapes += 2 * (size_t)stride * number;
    colours += (size_t)stride * number;
    offsets += views->first_offset + tile;
    const uint room = capacity - min(capacity, views->first_intersection);
    const uint begin = min(offsets[0], room), end = min(offsets[1], room);
    intersections += views->first_intersection + begin;
    subtiles += views->first_intersection + begin;
    const int2 origin = (int2)(tile % columns, tile / columns) * TILE;
    const uint length = end - begin;
    uint last; /* batch, which nobody needs */
    forward(
        &state, &batch, unfinished, origin, picture, shapes, colours, intersections, subtiles, length,
        ALL_SUBTILES, lid, &last);
    const Mine mine = pixels_of(lid / SHARE, origin, lid);
    for (int p = 0; p < PIXELS; ++p)
        if (inside(mine, p, picture)) {
            const int i = mine.first + p * SHARE;
            const size_t pixel = views->first_pixel + pixel_number(mine, p, picture);
            const float t = fabs(state.t[i]);
            image[3 * pixel] = MAD(t, red, state.r[i]);
            image[3 * pixel + 1] = MAD(t, green, state.g[i]);
            image[3 * pixel + 2] = MAD(t, blue, state.b[i]);
            transmittance[pixel] = t;
        }
}
