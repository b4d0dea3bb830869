/* Totals of the splats that are left, in one row, as they travel between devices; and back.

   On GPUs: no macros. */

#include "prune/removal.clh"

#define RUN 64

/* Which splats of a run are left, a bit each, and how many they are. A run a work-item. */
kernel void alive_runs(global const uchar *states, ulong splats, global ulong *masks, global uint *counts)
{
    const size_t run = get_global_id(0), first = RUN * run;
    if (first >= splats)
        return;
    ulong mask = 0;
    for (uint k = 0; k < RUN && first + k < splats; ++k)
        mask |= (ulong)(states[first + k] == SPLAT_ALIVE) << k;
    masks[run] = mask;
    counts[run] = (uint)popcount(mask);
}

/* Where a splat's totals are in the row, from where those of each run begin; or where its successor's are. */
inline size_t alive_place(global const ulong *masks, global const uint *starts, size_t splat)
{
    const ulong before = ((ulong)1 << (splat % RUN)) - 1;
    return starts[splat / RUN] + popcount(masks[splat / RUN] & before);
}

inline int is_alive(global const ulong *masks, size_t splat)
{
    return (int)(masks[splat / RUN] >> (splat % RUN) & 1);
}

kernel void pack_alive(
    global const long2 *totals,
    ulong splats,
    global const ulong *masks,
    global const uint *starts,
    global long2 *packed)
{
    const size_t splat = get_global_id(0);
    if (splat < splats && is_alive(masks, splat))
        packed[alive_place(masks, starts, splat)] = totals[splat];
}

/* totals = the row, or += the row. Those of splats that are gone become 0, or stay as they are. */
kernel void unpack_alive(
    global long2 *totals,
    ulong splats,
    global const ulong *masks,
    global const uint *starts,
    global const long2 *packed,
    uint add)
{
    const size_t splat = get_global_id(0);
    if (splat >= splats)
        return;
    const long2 more = is_alive(masks, splat) ? packed[alive_place(masks, starts, splat)] : (long2)(0);
    totals[splat] = add ? totals[splat] + more : more;
}
