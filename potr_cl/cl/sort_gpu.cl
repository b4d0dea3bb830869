/* Depth order of each tile's list, for GPUs: one work-group a tile, a bitonic network.

   Every merge of size `size` begins with a mirrored step (partner = index ^ (size - 1)), so all comparisons put the
   smaller key first and positions beyond the end behave like infinite keys without being stored. Lists of up to
   SORT_CAPACITY keys stay in local memory; in longer ones, steps that reach further than that run in global memory. */

#define GROUP 256

#define ORDER(memory, low, high)                        \
    {                                                   \
        ulong first = memory[low], second = memory[high]; \
        if (first > second) {                           \
            memory[low] = second;                       \
            memory[high] = first;                       \
        }                                               \
    }

/* The i-th pair of a step over distance `half`; mirrored or straight. */
inline uint pair_low(uint i, uint half_size)
{
    return (i / half_size) * 2 * half_size + i % half_size;
}

/* Steps of distance half_size, half_size / 2, … 1 on keys in local memory; the first mirrored if asked. */
inline void merge_local(local ulong *keys, uint n, uint half_size, int mirrored, uint lid)
{
    for (; half_size > 0; half_size /= 2) {
        barrier(CLK_LOCAL_MEM_FENCE);
        for (uint i = lid; i < SORT_CAPACITY / 2 && i < n; i += GROUP) {
            uint low = pair_low(i, half_size);
            uint high = mirrored ? low + 2 * half_size - 1 - 2 * (low % half_size) : low + half_size;
            if (high < n)
                ORDER(keys, low, high)
        }
        mirrored = 0;
    }
}

kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void sort_tiles(
    global ulong *all_keys, global const uint *offsets, global uint *entries, global uint *counts, uint capacity)
{
    local ulong near[SORT_CAPACITY];
    const uint lid = get_local_id(0);
    const uint tile = get_group_id(0);
    const uint begin = min(offsets[tile], capacity);
    const uint n = min(offsets[tile + 1], capacity) - begin;
    global ulong *keys = all_keys + begin;
    if (lid == 0)
        counts[tile] = 0; /* ready for the next view */

    /* Pieces that fit local memory, sorted one by one. */
    for (uint piece = 0; piece < n; piece += SORT_CAPACITY) {
        uint m = min(n - piece, (uint)SORT_CAPACITY);
        for (uint i = lid; i < m; i += GROUP)
            near[i] = keys[piece + i];
        for (uint half_size = 1; half_size < m; half_size *= 2)
            merge_local(near, m, half_size, 1, lid);
        barrier(CLK_LOCAL_MEM_FENCE);
        if (n <= SORT_CAPACITY) {
            for (uint i = lid; i < m; i += GROUP)
                entries[begin + i] = (uint)near[i];
        } else {
            for (uint i = lid; i < m; i += GROUP)
                keys[piece + i] = near[i];
        }
        barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE);
    }
    if (n <= SORT_CAPACITY)
        return;

    for (uint size = SORT_CAPACITY; size < n; size *= 2) {
        int mirrored = 1;
        for (uint half_size = size; half_size >= SORT_CAPACITY; half_size /= 2) {
            for (uint i = lid;; i += GROUP) {
                uint low = pair_low(i, half_size);
                if (low >= n)
                    break;
                uint high = mirrored ? low + 2 * half_size - 1 - 2 * (low % half_size) : low + half_size;
                if (high < n)
                    ORDER(keys, low, high)
            }
            mirrored = 0;
            barrier(CLK_GLOBAL_MEM_FENCE);
        }
        for (uint piece = 0; piece < n; piece += SORT_CAPACITY) {
            uint m = min(n - piece, (uint)SORT_CAPACITY);
            for (uint i = lid; i < m; i += GROUP)
                near[i] = keys[piece + i];
            merge_local(near, m, SORT_CAPACITY / 2, 0, lid);
            barrier(CLK_LOCAL_MEM_FENCE);
            for (uint i = lid; i < m; i += GROUP)
                keys[piece + i] = near[i];
            barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE);
        }
    }
    for (uint i = lid; i < n; i += GROUP)
        entries[begin + i] = (uint)keys[i];
}
