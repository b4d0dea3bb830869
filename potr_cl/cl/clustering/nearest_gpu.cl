/* The best centre of each point, for GPUs: a block of GROUP points a work-group, a point a work-item. The group
   brings some centres at a time into local memory, and each work-item compares its point with them.

   Macros: WIDTH (floats of a row of points and of centres, a multiple of 4; unused ones are 0), GROUP.

   On GPUs: WIDTH:4,12,24,48 GROUP=128. */

#include "clustering/candidates.clh"
#include "include/group.clh"

/* Centres in local memory at a time. */
#define TILE 64

/* order: the points of each block, NO_POINT beyond the last. cells: of each block. runs_of: of each cell, where its
   runs begin in `runs`, with the end of the last behind. labels, scores: by point; the score is the least bias + x c. */
kernel __attribute__((reqd_work_group_size(GROUP, 1, 1))) void nearest(
    global const float *points,
    global const uint *order,
    global const uint *cells,
    global const uint *runs_of,
    global const uint *runs,
    global const float *centres,
    global const float *biases,
    global uint *labels,
    global float *scores)
{
    local float4 rows[TILE * WIDTH / 4];
    local float offsets[TILE];
    const size_t block = GROUP_ID(0);
    const uint item = get_local_id(0);
    const uint member = order[block * GROUP + item];
    const size_t point = member == NO_POINT ? 0 : member;
    float4 x[WIDTH / 4];
    for (int d = 0; d < WIDTH / 4; ++d)
        x[d] = vload4(point * (WIDTH / 4) + d, points);
    float least = INFINITY;
    uint label = 0;
    /* All work-items of a group are of one cell: these loops are alike for them. */
    for (uint r = runs_of[cells[block]]; r < runs_of[cells[block] + 1]; ++r) {
        const uint end = runs[2 * r] + runs[2 * r + 1];
        for (uint first = runs[2 * r]; first < end; first += TILE) {
            const uint count = min(end - first, (uint)TILE);
            barrier(CLK_LOCAL_MEM_FENCE);
            for (uint i = item; i < count * (WIDTH / 4); i += GROUP)
                rows[i] = vload4((size_t)first * (WIDTH / 4) + i, centres);
            for (uint i = item; i < count; i += GROUP)
                offsets[i] = biases[first + i];
            barrier(CLK_LOCAL_MEM_FENCE);
            for (uint k = 0; k < count; ++k) {
                float4 sum = (float4)(0.0f);
                for (int d = 0; d < WIDTH / 4; ++d)
                    sum += x[d] * rows[k * (WIDTH / 4) + d];
                const float score = offsets[k] + ((sum.x + sum.y) + (sum.z + sum.w));
                if (score < least) {
                    least = score;
                    label = first + k;
                }
            }
        }
    }
    if (member != NO_POINT) {
        labels[member] = label;
        scores[member] = least;
    }
}
