/* The best centre of each point, for CPUs: a block of LANES points a work-item, each centre against all of them.

   Macros: WIDTH (floats of a row of points and of centres, a multiple of 4; unused ones are 0), LANES. */

#include "include/lanes.clh"
#include "clustering/candidates.clh"

/* Centres that are compared side by side: their sums stay in registers. */
#define SIDE 4

/* order: the points of each block, NO_POINT beyond the last. cells: of each block. runs_of: of each cell, where its
   runs begin in `runs`, with the end of the last behind. labels, scores: by point; the score is the least bias + x c. */
kernel void nearest(
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
    const size_t block = get_global_id(0);
    global const uint *members = order + block * LANES;
    float gathered[WIDTH * LANES];
    for (int lane = 0; lane < LANES; ++lane) {
        const uint member = members[lane] == NO_POINT ? members[0] : members[lane];
        for (int d = 0; d < WIDTH; ++d)
            gathered[d * LANES + lane] = points[(size_t)member * WIDTH + d];
    }
    vfloat x[WIDTH];
    for (int d = 0; d < WIDTH; ++d)
        x[d] = VLOAD(d, gathered);
    vfloat least = (vfloat)(INFINITY);
    vint label = (vint)(0);
    for (uint r = runs_of[cells[block]]; r < runs_of[cells[block] + 1]; ++r) {
        const uint end = runs[2 * r] + runs[2 * r + 1];
        for (uint first = runs[2 * r]; first < end; first += SIDE) {
            /* The last ones of a run are compared more than once, which does no harm. */
            vfloat sums[SIDE];
            global const float *rows[SIDE];
            for (int k = 0; k < SIDE; ++k) {
                const uint centre = min(first + k, end - 1);
                sums[k] = (vfloat)(biases[centre]);
                rows[k] = centres + (size_t)centre * WIDTH;
            }
            for (int d = 0; d < WIDTH; ++d) {
                for (int k = 0; k < SIDE; ++k)
                    sums[k] = MAD(x[d], (vfloat)(rows[k][d]), sums[k]);
            }
            for (int k = 0; k < SIDE; ++k) {
                const vint better = sums[k] < least;
                least = better ? sums[k] : least;
                label = better ? (vint)((int)min(first + k, end - 1)) : label;
            }
        }
    }
    float found[LANES];
    int numbers[LANES];
    VSTORE(least, 0, found);
    VSTORE(label, 0, numbers);
    for (int lane = 0; lane < LANES; ++lane)
        if (members[lane] != NO_POINT) {
            labels[members[lane]] = (uint)numbers[lane];
            scores[members[lane]] = found[lane];
        }
}
