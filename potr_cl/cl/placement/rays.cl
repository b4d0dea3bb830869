/* Rays through the cells of a space (potr_cl/placement/space.py), in units of a cell, from the grid's lowest corner.

   A cell knows how many cells the nearest matter is away along the axis where it is farthest, so a ray leaps as far
   without a look. Macros: none.

   On GPUs: no macros. */

/* As in space.py: how far before its end a ray may meet matter, and how far it advances at least. */
#define BEFORE 1.75f
#define LEAST 0.6f
/* Leaps of a ray at most: more than any grid is wide. */
#define LEAPS 8192

typedef struct {
    int shape[3];
} Grid;

/* Whether nothing is between a place and a point on a surface. */
static int clear(global const uchar *distance, Grid grid, const float *from, const float *to)
{
    float along[3], length = 0.0f;
    for (int axis = 0; axis < 3; ++axis) {
        along[axis] = to[axis] - from[axis];
        length += along[axis] * along[axis];
    }
    length = sqrt(length);
    const float end = length - BEFORE;
    if (!(end > 0.0f))
        return 1;
    float enter = 0.0f, leave = end;
    for (int axis = 0; axis < 3; ++axis) {
        along[axis] /= length;
        if (fabs(along[axis]) < 1e-9f) {
            if (from[axis] < 0.0f || from[axis] > grid.shape[axis])
                return 1;
        } else {
            const float a = -from[axis] / along[axis], b = (grid.shape[axis] - from[axis]) / along[axis];
            enter = fmax(enter, fmin(a, b));
            leave = fmin(leave, fmax(a, b));
        }
    }
    float way = enter + 1e-3f;
    for (int leap = 0; leap < LEAPS && way < leave; ++leap) {
        int cell[3];
        for (int axis = 0; axis < 3; ++axis)
            cell[axis] = clamp((int)floor(from[axis] + along[axis] * way), 0, grid.shape[axis] - 1);
        const uchar away = distance[((size_t)cell[0] * grid.shape[1] + cell[1]) * grid.shape[2] + cell[2]];
        if (away == 0)
            return 0;
        way += fmax(away - 1.0f, LEAST);
    }
    return 1;
}

/* How well each target is seen from each place, 0: not at all, 255: as near as it asks for. A target a work-item, the
   places along the second axis.

   places: x, y, z, and the distance at which a size of 1 is resolved; targets: x, y, z, size. */
kernel void shown(
    global const uchar *distance,
    Grid grid,
    global const float4 *places,
    global const float4 *targets,
    uint count,
    float near,
    float hardly,
    global uchar *worth)
{
    const size_t target = get_global_id(0), place = get_global_id(1);
    if (target >= count)
        return;
    const float4 here = places[place], there = targets[target];
    const float from[3] = {here.x, here.y, here.z}, to[3] = {there.x, there.y, there.z};
    const float x = to[0] - from[0], y = to[1] - from[1], z = to[2] - from[2];
    const float away = sqrt(x * x + y * y + z * z), resolved = here.w * there.w;
    float found = 0.0f;
    if (away > near && away < hardly * resolved && clear(distance, grid, from, to)) {
        const float part = fmin(1.0f, resolved / away);
        found = fmax(255.0f * part * part, 1.0f);
    }
    worth[place * count + target] = (uchar)found;
}

/* A view: from world to camera, and the planes that bound its picture as positions at a depth of 1. */
typedef struct {
    float rotation[9], translation[3], centre[3];
    float low[2], high[2], resolved;
} Looker;

/* How many views resolve each point, at most so many. A point a work-item; points: x, y, z, size. */
kernel void resolved_by(
    global const uchar *distance,
    Grid grid,
    global const Looker *lookers,
    uint views,
    global const float4 *points,
    uint count,
    float near,
    uint enough,
    global uchar *found)
{
    const size_t point = get_global_id(0);
    if (point >= count)
        return;
    const float4 there = points[point];
    const float to[3] = {there.x, there.y, there.z};
    uint seen = 0;
    for (uint view = 0; view < views && seen < enough; ++view) {
        global const Looker *looker = lookers + view;
        global const float *r = looker->rotation, *t = looker->translation;
        const float depth = r[6] * to[0] + r[7] * to[1] + r[8] * to[2] + t[2];
        if (!(depth > near && depth < looker->resolved * there.w))
            continue;
        int inside = 1;
        for (int axis = 0; axis < 2; ++axis) {
            const float along = r[3 * axis] * to[0] + r[3 * axis + 1] * to[1] + r[3 * axis + 2] * to[2] + t[axis];
            inside &= along > looker->low[axis] * depth && along < looker->high[axis] * depth;
        }
        const float from[3] = {looker->centre[0], looker->centre[1], looker->centre[2]};
        if (inside && clear(distance, grid, from, to))
            ++seen;
    }
    found[point] = (uchar)seen;
}
