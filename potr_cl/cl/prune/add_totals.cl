/* totals += more, where others have measured more views, or totals -= more: one 64-bit integer a work-item.

   On GPUs: no macros. */

kernel void add_totals(global long *totals, global const long *more, ulong count)
{
    const size_t i = get_global_id(0);
    if (i < count)
        totals[i] += more[i];
}

kernel void subtract_totals(global long *totals, global const long *more, ulong count)
{
    const size_t i = get_global_id(0);
    if (i < count)
        totals[i] -= more[i];
}
