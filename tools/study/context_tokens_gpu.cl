/* The tokens of one stream of the context coder (docs/format.md): one work-group a section, some neighbouring lanes a
   work-item. In each step the items count the words that their lanes need; a prefix sum over the group says which words
   are whose. So a step costs the latency of a few lookups and barriers, whatever the number of lanes.

   Macros: ITEMS, work-items of the group, a power of two. LANES_OF_ITEM, the most lanes an item has. */

#define TOTAL 4096

kernel __attribute__((reqd_work_group_size(ITEMS, 1, 1))) void context_tokens(
    global const ushort *words,
    uint available,
    global uint *read,
    global uint *states,
    global int *recent,
    uint lanes,
    uint steps,
    uint splats,
    global const uint *entries,
    global const uint *bases,
    global const short *size_of,
    global const short *sum0,
    global const short *sum1,
    global const short *sum2,
    global const short *same0,
    global const short *same1,
    global const int *weights,
    global uchar *tokens,
    global short *sizes)
{
    local uint needs[ITEMS];
    local uint local_bases[256];
    local short local_sizes[256];
    const uint item = get_local_id(0);
    const uint each = (lanes + ITEMS - 1) / ITEMS;
    const uint first = item * each;
    for (uint i = item; i < 256; i += ITEMS) {
        local_bases[i] = bases[i];
        local_sizes[i] = size_of[i];
    }
    uint state[LANES_OF_ITEM];
    int trail[LANES_OF_ITEM];
    for (uint k = 0; k < LANES_OF_ITEM; k++) {
        state[k] = k < each && first + k < lanes ? states[first + k] : 65536;
        trail[k] = 0;
    }
    uint taken = *read;
    const uint last = max(available, 1u) - 1;
    const int w0 = weights[0], w1 = weights[1], w2 = weights[2], w3 = weights[3], w4 = weights[4];
    const int w5 = weights[5], w6 = weights[6];
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint step = 0; step < steps; step++) {
        const uint count = (splats - 1 - step) / steps + 1;
        uint need = 0;
        for (uint k = 0; k < LANES_OF_ITEM; k++) {
            if (k >= each || first + k >= count)
                continue;
            const uint at = step * lanes + first + k;
            const int expected = w6 + w5 * trail[k] + w0 * sum0[at] + w1 * sum1[at] + w2 * sum2[at] + w3 * same0[at]
                + w4 * same1[at];
            const uint entry = entries[local_bases[clamp(expected >> 8, 0, 255)] + (state[k] & (TOTAL - 1))];
            state[k] = ((entry & (TOTAL - 1)) + 1) * (state[k] >> 12) + (entry >> 12 & (TOTAL - 1));
            need += state[k] < 65536;
            const short size = local_sizes[entry >> 24];
            sizes[at] = size;
            tokens[at] = (uchar)(entry >> 24);
            trail[k] += 2 * size - (trail[k] >> 2);
        }
        needs[item] = need;
        barrier(CLK_LOCAL_MEM_FENCE);
        for (uint reach = 1; reach < ITEMS; reach <<= 1) {
            const uint before = item >= reach ? needs[item - reach] : 0;
            barrier(CLK_LOCAL_MEM_FENCE);
            needs[item] += before;
            barrier(CLK_LOCAL_MEM_FENCE);
        }
        uint at = taken + needs[item] - need;
        taken += needs[ITEMS - 1];
        for (uint k = 0; k < LANES_OF_ITEM; k++)
            if (k < each && first + k < count && state[k] < 65536)
                state[k] = state[k] << 16 | words[min(at++, last)];
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    for (uint k = 0; k < LANES_OF_ITEM; k++)
        if (k < each && first + k < lanes)
            states[first + k] = state[k];
    if (item == 0)
        *read = taken;
}

kernel void add_sizes(global short *sums, global const short *sizes)
{
    sums[get_global_id(0)] += sizes[get_global_id(0)];
}
