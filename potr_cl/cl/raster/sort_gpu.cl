/* The depth order of each tile's list, for GPUs, by a bitonic network: one work-group a tile; GROUP_ID(1) is the
   view's number in its set. sort_cpu.cl is its twin.

   Every merge of size `size` begins with a mirrored step (partner = index ^ (size - 1)). So all comparisons put the
   smaller key first, and positions beyond the end behave like infinite keys without being stored. Lists of up to
   SORT_CAPACITY keys stay in local memory. In longer ones, steps that reach further than that run in global memory.

   Macros: SORT_CAPACITY (a power of two; must be given), COUNTER_STRIDE (as in tile_lists_gpu.cl; 1 by default).

   On GPUs: SORT_CAPACITY:2048 COUNTER_STRIDE=8. */

#include "include/group.clh"
#include "include/splat.clh"
#include "include/view_set.clh"

#define GROUP 256
#ifndef COUNTER_STRIDE
#define COUNTER_STRIDE 1
#endif

#define ORDER(memory, low, high)                        \
    {                                                   \
        ulong first = memory[low], second = memory[high]; \
        if (first > second) {                           \
            memory[low] = second;                       \
            memory[high] = first;                       \
        }                                               \
    }

/* The lower index of the i-th pair of a step over the distance `reach`, which is a power of two. There is no division
   in it because divisions are slow. */
inline uint pair_low(uint i, uint reach)
{
    return 2 * i - (i & (reach - 1));
}

inline uint pair_high(uint low, uint reach, int mirrored)
{
    return mirrored ? low ^ (2 * reach - 1) : low + reach;
}

/* The steps of distance reach, reach / 2, ..., 1 on keys in local memory. The first one is mirrored if asked for. */
inline void merge_local(local ulong *keys, uint n, uint reach, int mirrored, uint lid)
{
    for (; reach > 0; reach /= 2) {
        barrier(CLK_LOCAL_MEM_FENCE);
        for (uint i = lid; i < SORT_CAPACITY / 2 && i < n; i += GROUP) {
            uint low = pair_low(i, reach);
            uint high = pair_high(low, reach, mirrored);
            if (high < n)
                ORDER(keys, low, high)
        }
        mirrored = 0;
    }
}

kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void sort_tiles(
    global const SetView *views,
    global ulong *keys,
    global const uint *offsets,
    global uint *intersections,
    global uint *counts,
    uint capacity,
    uint longest)
{
    local ulong piece_keys[SORT_CAPACITY];
    const uint lid = get_local_id(0);
    const uint tile = GROUP_ID(0);
    views += GROUP_ID(1);
    if (tile >= (uint)(views->view.columns * views->view.rows))
        return;
    offsets += views->first_offset + tile;
    /* Offsets that did not fit 32 bits are 2^32 - 1, so that nothing overflows below. */
    const uint room = capacity - min(capacity, views->first_intersection);
    const uint begin = views->first_intersection + min(offsets[0], room);
    const uint n = views->first_intersection + min(offsets[1], room) - begin;
    keys += begin;
    if (lid == 0)
        counts[(views->first_tile + tile) * COUNTER_STRIDE] = 0; /* ready for the next view */
    if (n > longest) /* sort_long_gpu.cl does these */
        return;

    /* Pieces that fit local memory are sorted one by one. */
    for (uint piece = 0; piece < n; piece += SORT_CAPACITY) {
        uint m = min(n - piece, (uint)SORT_CAPACITY);
        for (uint i = lid; i < m; i += GROUP)
            piece_keys[i] = keys[piece + i];
        for (uint reach = 1; reach < m; reach *= 2)
            merge_local(piece_keys, m, reach, 1, lid);
        barrier(CLK_LOCAL_MEM_FENCE);
        if (n <= SORT_CAPACITY) {
            for (uint i = lid; i < m; i += GROUP)
                intersections[begin + i] = (uint)piece_keys[i];
        } else {
            for (uint i = lid; i < m; i += GROUP)
                keys[piece + i] = piece_keys[i];
        }
        barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE);
    }
    if (n <= SORT_CAPACITY)
        return;

    for (uint size = SORT_CAPACITY; size < n; size *= 2) {
        int mirrored = 1;
        for (uint reach = size; reach >= SORT_CAPACITY; reach /= 2) {
            for (uint i = lid;; i += GROUP) {
                uint low = pair_low(i, reach);
                if (low >= n)
                    break;
                uint high = pair_high(low, reach, mirrored);
                if (high < n)
                    ORDER(keys, low, high)
            }
            mirrored = 0;
            barrier(CLK_GLOBAL_MEM_FENCE);
        }
        for (uint piece = 0; piece < n; piece += SORT_CAPACITY) {
            uint m = min(n - piece, (uint)SORT_CAPACITY);
            for (uint i = lid; i < m; i += GROUP)
                piece_keys[i] = keys[piece + i];
            merge_local(piece_keys, m, SORT_CAPACITY / 2, 0, lid);
            barrier(CLK_LOCAL_MEM_FENCE);
            for (uint i = lid; i < m; i += GROUP)
                keys[piece + i] = piece_keys[i];
            barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE);
        }
    }
    for (uint i = lid; i < n; i += GROUP)
        intersections[begin + i] = (uint)keys[i];
}
