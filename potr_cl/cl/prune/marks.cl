/* Which splats a controller has marked to go, as bits that travel, and back. Eight splats a work-item.

   On GPUs: no macros. */

#include "prune/removal.clh"

kernel void marked_bits(global const uchar *states, ulong splats, global uchar *bits)
{
    const size_t first = 8 * get_global_id(0);
    if (first >= splats)
        return;
    uint found = 0;
    for (uint k = 0; k < 8 && first + k < splats; ++k)
        found |= (uint)(states[first + k] == SPLAT_JUST_REMOVED) << k;
    bits[first / 8] = (uchar)found;
}

/* Splats that were marked before are gone by now, as the controller notes it where it runs. */
kernel void mark_bits(global uchar *states, ulong splats, global const uchar *bits)
{
    const size_t first = 8 * get_global_id(0);
    if (first >= splats)
        return;
    const uint marked = bits[first / 8];
    for (uint k = 0; k < 8 && first + k < splats; ++k) {
        const uchar state = states[first + k];
        if (marked >> k & 1)
            states[first + k] = SPLAT_JUST_REMOVED;
        else if (state == SPLAT_JUST_REMOVED)
            states[first + k] = SPLAT_REMOVED;
    }
}
