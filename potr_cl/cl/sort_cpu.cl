/* Depth order of each tile's list, for CPUs: one tile a work-item, insertion sort of short runs, then merges. */

#define RUN 16

kernel void sort_tiles(
    global ulong *all_keys,
    global ulong *all_spare,
    global const uint *offsets,
    global uint *entries,
    global uint *counts,
    uint capacity)
{
    const uint tile = get_global_id(0);
    const uint begin = min(offsets[tile], capacity);
    const uint n = min(offsets[tile + 1], capacity) - begin;
    global ulong *keys = all_keys + begin;
    global ulong *spare = all_spare + begin;
    counts[tile] = 0; /* ready for the next view */

    for (uint run = 0; run < n; run += RUN) {
        uint end = min(run + RUN, n);
        for (uint i = run + 1; i < end; ++i) {
            ulong key = keys[i];
            uint j = i;
            for (; j > run && keys[j - 1] > key; --j)
                keys[j] = keys[j - 1];
            keys[j] = key;
        }
    }
    for (uint size = RUN; size < n; size *= 2) {
        for (uint low = 0; low < n; low += 2 * size) {
            uint middle = min(low + size, n), high = min(low + 2 * size, n);
            uint i = low, j = middle, k = low;
            while (i < middle && j < high) {
                ulong left = keys[i], right = keys[j];
                int first = left < right;
                spare[k++] = first ? left : right;
                i += first;
                j += !first;
            }
            while (i < middle)
                spare[k++] = keys[i++];
            while (j < high)
                spare[k++] = keys[j++];
        }
        global ulong *swap = keys;
        keys = spare;
        spare = swap;
    }
    for (uint i = 0; i < n; ++i)
        entries[begin + i] = (uint)keys[i];
}
