/* Coder 3 (docs/format.md, "Context coder"): tokens of a stream, and the integers that tokens stand for. */

#include <string.h>

#include "potr_native.h"

enum {
    PRECISION = 12,
    TOTAL = 1 << PRECISION,
    DIRECT = 128,         /* tokens below stand for themselves */
    MOST_TOKENS = 252,
    MOST_EXTRA = 35,      /* bits beside the largest token */
    LOWEST = 1 << 16,
    GROUP = 128,          /* lanes whose contexts are computed at a time */
    TURNED = 32           /* steps and lanes that are turned round at a time */
};

static unsigned extra_bits(unsigned token)
{
    return token < DIRECT ? 0 : 5 + (token - DIRECT) / 4;
}

/* What each slot (context · 4096 + the lowest bits of a state) stands for, in one number: frequency − 1 in bits 0 to
 * 11, place within the token in 12 to 23, token in 24 to 31.
 *
 * frequencies: (contexts, alphabet). entries: (contexts · 4096). Returns 0, or 1 where a context's frequencies do not
 * add up to 4096. */
POTR_EXPORT int potr_context_table(
    const uint16_t *frequencies, size_t contexts, size_t alphabet, uint32_t *entries)
{
    for (size_t context = 0; context < contexts; context++) {
        const uint16_t *row = frequencies + context * alphabet;
        uint32_t *slots = entries + context * TOTAL;
        size_t at = 0;
        for (size_t token = 0; token < alphabet; token++) {
            const uint32_t frequency = row[token];
            if (frequency > TOTAL - at)
                return 1;
            const uint32_t entry = (uint32_t)token << 24 | (frequency - 1);
            for (uint32_t place = 0; place < frequency; place++)
                slots[at + place] = entry | place << 12;
            at += frequency;
        }
        if (at != TOTAL)
            return 1;
    }
    return 0;
}

/* Tokens of `count` lanes, at most GROUP, in a step. Words are read without asking whether there are more: `count` of
 * them at least are there. Returns how many were read.
 *
 * What needs no lookup stands in loops of its own, of which compilers make vector instructions. Whether a state takes a
 * word is as good as chance, and processors foretell such branches wrongly: so every lane is given the next word, and
 * only those that need it go on to the one after. */
static INLINE size_t group_of_tokens(
    const uint32_t *restrict entries, const uint32_t *restrict bases, const int16_t *restrict size_of,
    const int32_t *restrict expected, const uint8_t *restrict words, uint32_t *restrict states,
    int32_t *restrict recent, uint8_t *restrict tokens, int16_t *restrict sizes, size_t count)
{
    uint32_t found[GROUP], next[GROUP];
    uint16_t low[GROUP];
    for (size_t i = 0; i < count; i++) {
        const uint32_t entry = entries[bases[expected[i]] + (states[i] & (TOTAL - 1))];
        found[i] = entry;
        sizes[i] = size_of[entry >> 24];
    }
    for (size_t i = 0; i < count; i++)
        next[i] = ((found[i] & (TOTAL - 1)) + 1) * (states[i] >> PRECISION) + (found[i] >> 12 & (TOTAL - 1));
    size_t read = 0;
    for (size_t i = 0; i < count; i++) {
        memcpy(&low[i], words + 2 * read, 2);
        read += next[i] < LOWEST;
    }
    for (size_t i = 0; i < count; i++)
        states[i] = next[i] < LOWEST ? next[i] << 16 | low[i] : next[i];
    for (size_t i = 0; i < count; i++)
        tokens[i] = (uint8_t)(found[i] >> 24);
    for (size_t i = 0; i < count; i++)
        recent[i] += 2 * sizes[i] - (recent[i] >> 2);
    return read;
}

/* One stream of a section.
 *
 * words: (available) 16-bit numbers, at any address; *read of them are taken already, and it is brought up to date.
 * states: (lanes). recent: (lanes), for this function's own use. entries: of the stream's model, as potr_context_table
 * made them. bases: (256) where the context of each expected size begins in entries. size_of: (256) by token.
 * known: five arrays (steps, lanes) of sizes: sums of three channels, two channels of the same coefficient; those whose
 * weight is 0 are not looked at. weights: 7. lane_counts: (steps) lanes that have a splat, never growing.
 * tokens, sizes: (steps, lanes), filled; 0 where a lane has no splat.
 *
 * Returns 0, or 1 if there are too few words. */
POTR_WIDE
POTR_EXPORT int potr_context_stream(
    const uint8_t *words, size_t available, size_t *read, uint32_t *states, int32_t *recent, size_t lanes,
    const uint32_t *entries, const uint32_t *bases, const int16_t *size_of, const int16_t *const *known,
    const int32_t *weights, const int64_t *lane_counts, size_t steps, uint8_t *tokens, int16_t *sizes)
{
    size_t taken = *read;
    memset(recent, 0, lanes * sizeof *recent);
    for (size_t step = 0; step < steps; step++) {
        const size_t count = (size_t)lane_counts[step];
        const size_t row = step * lanes;
        for (size_t first = 0; first < count; first += GROUP) {
            const size_t n = count - first < GROUP ? count - first : GROUP;
            const size_t at = row + first;
            int32_t expected[GROUP];
            for (size_t i = 0; i < n; i++)
                expected[i] = weights[6] + weights[5] * recent[first + i];
            for (int term = 0; term < 5; term++) {
                const int32_t weight = weights[term];
                if (weight == 0)
                    continue;
                const int16_t *const part = known[term] + at;
                for (size_t i = 0; i < n; i++)
                    expected[i] += weight * part[i];
            }
            for (size_t i = 0; i < n; i++) {
                const int32_t size = expected[i] >> 8;
                expected[i] = size < 0 ? 0 : size > 255 ? 255 : size;
            }
            if (available - taken >= n) {
                taken += group_of_tokens(entries, bases, size_of, expected, words + 2 * taken, states + first,
                    recent + first, tokens + at, sizes + at, n);
                continue;
            }
            /* Near the end: a lane at a time, with a word to spare or one that must not be needed. */
            for (size_t i = 0; i < n; i++) {
                static const uint8_t none[2] = { 0, 0 };
                const int left = available > taken;
                const size_t needed = group_of_tokens(entries, bases, size_of, expected + i,
                    left ? words + 2 * taken : none, states + first + i, recent + first + i, tokens + at + i,
                    sizes + at + i, 1);
                if (needed && !left)
                    return 1;
                taken += needed;
            }
        }
        memset(tokens + row + count, 0, lanes - count);
        memset(sizes + row + count, 0, (lanes - count) * sizeof *sizes);
    }
    *read = taken;
    return 0;
}

/* How many bits stand beside some tokens; *largest becomes the largest of them, 0 if there are none. */
POTR_WIDE
POTR_EXPORT uint64_t potr_context_beside(const uint8_t *tokens, size_t number, uint8_t *largest)
{
    uint8_t most = 0;
    for (size_t i = 0; i < number; i++)
        most = tokens[i] > most ? tokens[i] : most;
    *largest = most;
    if (most < DIRECT)
        return 0;
    uint64_t bits = 0;
    for (size_t i = 0; i < number; i++)
        bits += extra_bits(tokens[i]);
    return bits;
}

/* (steps, lanes) bytes to (lanes, steps): the order of splats. */
POTR_EXPORT void potr_context_join(
    const uint8_t *restrict laid, size_t steps, size_t lanes, uint8_t *restrict joined)
{
    for (size_t lane = 0; lane < lanes; lane += TURNED) {
        const size_t width = lanes - lane < TURNED ? lanes - lane : TURNED;
        for (size_t step = 0; step < steps; step += TURNED) {
            const size_t height = steps - step < TURNED ? steps - step : TURNED;
            uint8_t tile[TURNED][TURNED];
            for (size_t t = 0; t < height; t++)
                for (size_t l = 0; l < width; l++)
                    tile[l][t] = laid[(step + t) * lanes + lane + l];
            for (size_t l = 0; l < width; l++)
                memcpy(joined + (lane + l) * steps + step, tile[l], height);
        }
    }
}

/* Adds to each integer the mean of the four before in its lane, rounded. Sums wrap round. */
#define ADD_PREDICTIONS(kind, type) \
    static void add_predictions_##kind(type *values, size_t steps, size_t lanes) \
    { \
        for (size_t step = 1; step < steps; step++) { \
            const size_t before = step < 4 ? step : 4; \
            type *row = values + step * lanes; \
            for (size_t l = 0; l < lanes; l++) { \
                type sum = 2; \
                for (size_t k = 1; k <= before; k++) \
                    sum += row[l - k * lanes]; \
                /* ⌊sum / 4⌋, without the shift of a negative number, which compilers may understand as they like. */ \
                const type sign = sum >> (8 * sizeof sum - 1); \
                row[l] += sum >> 2 | (0 - sign) << (8 * sizeof sum - 2); \
            } \
        } \
    }

ADD_PREDICTIONS(medium, uint32_t)
ADD_PREDICTIONS(wide, uint64_t)

/* Where the next lowest, second lowest, … bit of the tokens stands: first those of all tokens that have the one, and so
 * on. Returns the number of the bit behind the last. */
static uint64_t bit_planes(const uint8_t *tokens, size_t number, uint64_t first, uint64_t at[MOST_EXTRA + 1])
{
    memset(at, 0, (MOST_EXTRA + 1) * sizeof *at);
    for (size_t i = 0; i < number; i++)
        if (tokens[i] >= DIRECT)
            at[extra_bits(tokens[i])]++;
    for (int b = MOST_EXTRA - 1; b >= 1; b--)
        at[b] += at[b + 1]; /* tokens with at least b bits */
    for (int b = 0; b < MOST_EXTRA; b++) {
        const uint64_t having = at[b + 1];
        at[b] = first;
        first += having;
    }
    return first;
}

/* The integers of tokens and the bits beside them, in the order of splats: medium ones, which the caller knows to be
 * below 2^29 in magnitude, or wide ones.
 *
 * tokens: (steps, lanes), below 252. bits: (available) bits, eight a byte, lowest first, all of them of this stream from
 * number `first` on. is_signed: undo the mapping of signed integers. predicted: they are differences from the mean of
 * the four before in the lane. work, values: (lanes · steps) each; only `values` is a result.
 *
 * Returns 0, or 1 if there are too few bits. */
#define INTEGERS(kind, type) \
    POTR_EXPORT int potr_context_integers_##kind( \
        const uint8_t *restrict tokens, size_t steps, size_t lanes, const uint8_t *restrict bits, uint64_t first, \
        uint64_t available, int is_signed, int predicted, type *restrict work, type *restrict values) \
    { \
        const size_t number = steps * lanes; \
        uint64_t at[MOST_EXTRA + 1]; \
        if (bit_planes(tokens, number, first, at) > available) \
            return 1; \
        for (size_t i = 0; i < number; i++) { \
            type u = tokens[i]; \
            if (u >= DIRECT) { \
                const unsigned extra = extra_bits(tokens[i]); \
                u = (type)(4 + (tokens[i] - DIRECT) % 4) << extra; \
                for (unsigned b = 0; b < extra; b++) { \
                    u |= (type)(bits[at[b] >> 3] >> (at[b] & 7) & 1) << b; \
                    at[b]++; \
                } \
            } \
            work[i] = is_signed ? u >> 1 ^ (0 - (u & 1)) : u; \
        } \
        if (predicted) \
            add_predictions_##kind(work, steps, lanes); \
        enum { WIDTH = 64 / sizeof(type) }; \
        for (size_t lane = 0; lane < lanes; lane += WIDTH) { \
            const size_t width = lanes - lane < WIDTH ? lanes - lane : WIDTH; \
            for (size_t step = 0; step < steps; step++) \
                for (size_t l = 0; l < width; l++) \
                    values[(lane + l) * steps + step] = work[step * lanes + lane + l]; \
        } \
        return 0; \
    }

INTEGERS(medium, uint32_t)
INTEGERS(wide, uint64_t)
