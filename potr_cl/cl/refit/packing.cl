/* Coefficients that may change, splat by splat in one row, as they travel between devices; and back into columns. One
   splat a work-item.

   Macros: SH_COUNT; LANES (1); RUN, splats that a work-item counts.

   On GPUs: SH_COUNT=1,4,9,16 LANES=1 RUN=64. */

#include "refit/coefficients.clh"

inline int may_change(global const uint *active, ulong stride, size_t splat, int column)
{
    return active[(column / 24) * stride + splat] >> (column % 24) & 1;
}

/* A flag for each coefficient of which any bit is set, that of the sign too. */
kernel void mark_nonzero(global const float *columns, ulong stride, ulong splats, global uint *flags)
{
    const size_t splat = get_global_id(0);
    if (splat >= splats)
        return;
    uint words[2] = {0, 0};
    for (int column = 0; column < 3 * SH_COUNT; ++column)
        if (as_uint(columns[column * stride + splat]))
            words[column / 24] |= 1u << (column % 24);
    flags[splat] = words[0];
    flags[stride + splat] = words[1];
}

/* How many coefficients of a run of splats may change. */
kernel void count_active(global const uint *active, ulong stride, ulong splats, global ulong *counts)
{
    const size_t first = RUN * get_global_id(0), end = min(first + RUN, (size_t)splats);
    if (first >= splats)
        return;
    uint count = 0;
    for (size_t splat = first; splat < end; ++splat)
        count += popcount(active[splat]) + popcount(active[stride + splat]);
    counts[get_global_id(0)] = count;
}

/* Where each splat's coefficients begin in the row, from where those of each run do. */
kernel void place_active(
    global const uint *active, ulong stride, ulong splats, global const ulong *starts, global ulong *places)
{
    const size_t first = RUN * get_global_id(0), end = min(first + RUN, (size_t)splats);
    if (first >= splats)
        return;
    ulong place = starts[get_global_id(0)];
    for (size_t splat = first; splat < end; ++splat) {
        places[splat] = place;
        place += popcount(active[splat]) + popcount(active[stride + splat]);
    }
}

kernel void pack_floats(
    global const float *columns,
    global const uint *active,
    ulong stride,
    ulong splats,
    global const ulong *places,
    global float *packed)
{
    const size_t splat = get_global_id(0);
    if (splat >= splats)
        return;
    size_t place = places[splat];
    for (int column = 0; column < 3 * SH_COUNT; ++column)
        if (may_change(active, stride, splat, column))
            packed[place++] = columns[column * stride + splat];
}

/* The others become 0. */
kernel void unpack_floats(
    global float *columns,
    global const uint *active,
    ulong stride,
    ulong splats,
    global const ulong *places,
    global const float *packed)
{
    const size_t splat = get_global_id(0);
    if (splat >= splats)
        return;
    size_t place = places[splat];
    for (int column = 0; column < 3 * SH_COUNT; ++column)
        columns[column * stride + splat] = may_change(active, stride, splat, column) ? packed[place++] : 0.0f;
}

/* The sums become 0. */
kernel void pack_sums(
    global long *columns,
    global const uint *active,
    ulong stride,
    ulong splats,
    global const ulong *places,
    global long *packed)
{
    const size_t splat = get_global_id(0);
    if (splat >= splats)
        return;
    size_t place = places[splat];
    for (int column = 0; column < 3 * SH_COUNT; ++column) {
        if (may_change(active, stride, splat, column))
            packed[place++] = columns[column * stride + splat];
        columns[column * stride + splat] = 0;
    }
}

kernel void add_sums(
    global long *columns,
    global const uint *active,
    ulong stride,
    ulong splats,
    global const ulong *places,
    global const long *packed)
{
    const size_t splat = get_global_id(0);
    if (splat >= splats)
        return;
    size_t place = places[splat];
    for (int column = 0; column < 3 * SH_COUNT; ++column)
        if (may_change(active, stride, splat, column))
            columns[column * stride + splat] += packed[place++];
}

/* Sums from a place on += more: one number a work-item. */
kernel void add_rows(global long *sums, ulong start, global const long *more, ulong count)
{
    const size_t i = get_global_id(0);
    if (i < count)
        sums[start + i] += more[i];
}
