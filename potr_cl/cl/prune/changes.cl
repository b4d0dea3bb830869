/* By how much the totals of splats have changed, in one row, as it travels between computers; and adding that up.

   On GPUs: NUMBERED=0,1. */

#include "prune/removal.clh"

#define RUN 64

/* Which splats of a run are left and have other totals than they had, a bit each, and how many. A run a work-item. */
kernel void changed_runs(
    global const uchar *states,
    global const long2 *totals,
    global const long2 *before,
    ulong splats,
    global ulong *masks,
    global uint *counts)
{
    const size_t run = get_global_id(0), first = RUN * run;
    if (first >= splats)
        return;
    ulong mask = 0;
    for (uint k = 0; k < RUN && first + k < splats; ++k) {
        const long2 now = totals[first + k], then = before[first + k];
        const int changed = now.x != then.x || now.y != then.y;
        mask |= (ulong)(states[first + k] == SPLAT_ALIVE && changed) << k;
    }
    masks[run] = mask;
    counts[run] = (uint)popcount(mask);
}

/* How many bits of a run are set, of masks that have arrived. */
kernel void count_runs(global const ulong *masks, ulong runs, global uint *counts)
{
    const size_t run = get_global_id(0);
    if (run < runs)
        counts[run] = (uint)popcount(masks[run]);
}

/* Whether a splat's bit is set; then its place in the row, from where those of each run begin, is in place. */
inline int is_changed(global const ulong *masks, global const uint *starts, size_t splat, size_t *place)
{
    const ulong mask = masks[splat / RUN], bit = (ulong)1 << (splat % RUN);
    *place = starts[splat / RUN] + popcount(mask & (bit - 1));
    return (mask & bit) != 0;
}

/* The row, and what the next one is compared with. */
kernel void take_changes(
    global const long2 *totals,
    global long2 *before,
    ulong splats,
    global const ulong *masks,
    global const uint *starts,
    global long2 *changes)
{
    const size_t splat = get_global_id(0);
    size_t place;
    if (splat < splats && is_changed(masks, starts, splat, &place)) {
        changes[place] = totals[splat] - before[splat];
        before[splat] = totals[splat];
    }
}

/* totals += the row. NUMBERED: its splats have other numbers there. */
kernel void add_changes(
    global long2 *totals,
    global const uint *numbers,
    ulong splats,
    global const ulong *masks,
    global const uint *starts,
    global const long2 *changes)
{
    const size_t splat = get_global_id(0);
    size_t place;
    if (splat < splats && is_changed(masks, starts, splat, &place)) {
#if NUMBERED
        totals[numbers[splat]] += changes[place];
#else
        totals[splat] += changes[place];
#endif
    }
}
