/* The encoder's half of coder 3 (docs/format.md, "Context coder"): what contexts are made of, and range coding.
 *
 * Its input is the encoder's own, not a file's. */

#include <string.h>

#include "potr_native.h"

enum {
    PRECISION = 12,
    TOTAL = 1 << PRECISION,
    LARGEST_SIZE = 255,
    GROUP = 256
};

/* About 8 times the mean size of a lane's last splats, before each. sizes, recent: (steps, lanes). */
POTR_WIDE
POTR_EXPORT void potr_encode_recent(
    const int32_t *restrict sizes, size_t steps, size_t lanes, int32_t *restrict recent)
{
    memset(recent, 0, lanes * sizeof *recent);
    for (size_t i = 0; i + lanes < steps * lanes; i++)
        recent[i + lanes] = recent[i] - (recent[i] >> 2) + 2 * sizes[i];
}

/* Expected size · alphabet + token of `number` splats.
 *
 * terms: (count) arrays (number) of sizes; weights: (count), and then the constant. tokens: below the alphabet, which is
 * below 256. */
POTR_WIDE
POTR_EXPORT void potr_encode_cells(
    const int32_t *const *terms, size_t count, const int32_t *weights, const uint8_t *restrict tokens, size_t number,
    int32_t alphabet, uint16_t *restrict cells)
{
    for (size_t first = 0; first < number; first += GROUP) {
        const size_t n = number - first < GROUP ? number - first : GROUP;
        int32_t expected[GROUP];
        for (size_t i = 0; i < n; i++)
            expected[i] = weights[count];
        for (size_t term = 0; term < count; term++) {
            const int32_t *const part = terms[term] + first;
            const int32_t weight = weights[term];
            for (size_t i = 0; i < n; i++)
                expected[i] += weight * part[i];
        }
        for (size_t i = 0; i < n; i++) {
            int32_t size = expected[i] >> 8;
            size = size < 0 ? 0 : size > LARGEST_SIZE ? LARGEST_SIZE : size;
            cells[first + i] = (uint16_t)(size * alphabet + tokens[first + i]);
        }
    }
}

/* Adds to counts how often each of `number` cells occurs; all are below the length of counts. */
POTR_EXPORT void potr_encode_count(const uint16_t *restrict cells, size_t number, int64_t *restrict counts)
{
    for (size_t i = 0; i < number; i++)
        counts[cells[i]]++;
}

/* Range codes a stream, from its last token to its first: states (lanes) take the tokens in, and words leave them.
 *
 * cells: (steps, lanes). intervals: for each cell that occurs the frequency of the token in the context, not 0, and
 * from bit 16 on the sum of those below; a lane without a splat has a cell of frequency 4096, which changes nothing.
 * words: room for steps · lanes; they are written from its end downwards, so that they stand in the order in which a
 * decoder takes them. Returns how many there are. */
POTR_EXPORT size_t potr_encode_stream(
    const uint16_t *restrict cells, size_t steps, size_t lanes, const uint32_t *restrict intervals,
    uint32_t *restrict states, uint16_t *restrict words)
{
    size_t at = steps * lanes;
    for (size_t step = steps; step-- > 0;) {
        const uint16_t *const row = cells + step * lanes;
        for (size_t lane = lanes; lane-- > 0;) {
            const uint32_t interval = intervals[row[lane]];
            const uint32_t frequency = interval & 0xffff;
            uint32_t state = states[lane];
            /* A state whose quotient would not fit gives its lower half away. */
            const uint32_t full = (uint64_t)state >= (uint64_t)frequency << (32 - PRECISION);
            words[at - 1] = (uint16_t)state;
            at -= full;
            state >>= 16 * full;
            states[lane] = state + state / frequency * (TOTAL - frequency) + (interval >> 16);
        }
    }
    return steps * lanes - at;
}
