/* The tokens of one stream of the context coder (docs/format.md), as potr_cl/codec/native/context.c decodes them: one
   work-item a section, as every lane's next word depends on how many words the lanes before took.

   Macros: none. */

#define TOTAL 4096
#define GROUP 128

kernel void context_tokens(
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
    int expected[GROUP];
    uint found[GROUP], next[GROUP];
    uint taken = *read;
    const uint last = max(available, 1u) - 1;
    for (uint i = 0; i < lanes; i++)
        recent[i] = 0;
    const int w0 = weights[0], w1 = weights[1], w2 = weights[2], w3 = weights[3], w4 = weights[4];
    const int w5 = weights[5], w6 = weights[6];
    for (uint step = 0; step < steps; step++) {
        const uint count = (splats - 1 - step) / steps + 1;
        for (uint first = 0; first < count; first += GROUP) {
            const uint n = min(count - first, (uint)GROUP);
            const uint at = step * lanes + first;
            for (uint i = 0; i < n; i++)
                expected[i] = w6 + w5 * recent[first + i] + w0 * sum0[at + i] + w1 * sum1[at + i] + w2 * sum2[at + i]
                    + w3 * same0[at + i] + w4 * same1[at + i];
            for (uint i = 0; i < n; i++)
                found[i] = entries[bases[clamp(expected[i] >> 8, 0, 255)] + (states[first + i] & (TOTAL - 1))];
            for (uint i = 0; i < n; i++)
                next[i] = ((found[i] & (TOTAL - 1)) + 1) * (states[first + i] >> 12) + (found[i] >> 12 & (TOTAL - 1));
            for (uint i = 0; i < n; i++) {
                const uint few = next[i] < 65536;
                const uint mask = 0 - few;
                const uint word = words[min(taken, last)];
                states[first + i] = (next[i] & ~mask) | ((next[i] << 16 | word) & mask);
                taken += few;
            }
            for (uint i = 0; i < n; i++) {
                const short size = size_of[found[i] >> 24];
                sizes[at + i] = size;
                tokens[at + i] = (uchar)(found[i] >> 24);
                recent[first + i] += 2 * size - (recent[first + i] >> 2);
            }
        }
    }
    *read = taken;
}

kernel void add_sizes(global short *sums, global const short *sizes)
{
    sums[get_global_id(0)] += sizes[get_global_id(0)];
}
