/* The depth order of each tile's list, for CPUs: one tile a work-item, which sorts short runs by insertion and then
   merges them. sort_gpu.cl is its twin.

   Macros: RUN (keys of a run; 16 by default). */

#ifndef RUN
#define RUN 16
#endif

/* Behind the keys, from `capacity` on, there is as much room again to merge into. */
kernel void sort_tiles(
    global ulong *keys, global const uint *offsets, global uint *intersections, global uint *counts, uint capacity)
{
    const uint tile = get_global_id(0);
    const uint begin = min(offsets[tile], capacity);
    const uint n = min(offsets[tile + 1], capacity) - begin;
    counts[tile] = 0; /* ready for the next view */

    keys += begin;
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
    size_t from = 0, to = capacity;
    for (uint size = RUN; size < n; size *= 2) {
        for (uint low = 0; low < n; low += 2 * size) {
            uint middle = min(low + size, n), high = min(low + 2 * size, n);
            uint i = low, j = middle, k = low;
            while (i < middle && j < high) {
                ulong left = keys[from + i], right = keys[from + j];
                int first = left < right;
                keys[to + k++] = first ? left : right;
                i += first;
                j += !first;
            }
            while (i < middle)
                keys[to + k++] = keys[from + i++];
            while (j < high)
                keys[to + k++] = keys[from + j++];
        }
        from = to;
        to = capacity - to;
    }
    for (uint i = 0; i < n; ++i)
        intersections[begin + i] = (uint)keys[from + i];
}
