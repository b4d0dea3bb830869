/* Parts of the views that have only the splats that they see: a part's splat i is number numbers[i] of the scene, and no
   splat is in a part twice. A work-item does one of the part's splats. */

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
