/* Parts of the views that have only the splats that they see: a part's splat i is number numbers[i] of the scene, and no
   splat is in a part twice. A work-item does one of the part's splats, but in `lost`.

   Macros: INT64_ATOMICS (see totals.clh).

   On GPUs: INT64_ATOMICS=0,1. */

#include "include/group.clh"
#include "prune/removal.clh"

/* What a part has measured is added to the scene's totals, two 64-bit integers a splat. */
kernel void add_part(global long *totals, global const long *part, global const uint *numbers, uint count)
{
    const size_t i = get_global_id(0);
    if (i >= count)
        return;
    const size_t splat = numbers[i];
    totals[2 * splat] += part[2 * i];
    totals[2 * splat + 1] += part[2 * i + 1];
}

/* The states of the scene's splats (see removal.clh) become those of the part's. */
kernel void mark_part(global const uchar *states, global uchar *part, global const uint *numbers, uint count)
{
    const size_t i = get_global_id(0);
    if (i < count)
        part[i] = states[numbers[i]];
}

/* How many splats of the scene a work-group does, and its work-items. */
#define LOST_CHUNK 4096
#define LOST_ITEMS 64

/* The importance, two words, that the splats had in these totals which are not alive any more. */
kernel __attribute__((reqd_work_group_size(LOST_ITEMS, 1, 1)))
void lost(global const uchar *states, global const long *totals, uint splats, volatile global uint *importance)
{
    local long sums[LOST_ITEMS];
    const uint lid = get_local_id(0);
    const size_t begin = (size_t)GROUP_ID(0) * LOST_CHUNK, end = min(begin + LOST_CHUNK, (size_t)splats);
    long sum = 0;
    for (size_t i = begin + lid; i < end; i += LOST_ITEMS)
        if (states[i] != SPLAT_ALIVE)
            sum += totals[2 * i + 1];
    sums[lid] = sum;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint step = LOST_ITEMS / 2; step > 0; step /= 2) {
        if (lid < step)
            sums[lid] += sums[lid + step];
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    if (lid == 0)
        add_fixed(importance, sums[0]);
}
