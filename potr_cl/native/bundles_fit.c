/* Contexts of a stream from counts (potr_cl/codec/bundles/fitting.py says the same in NumPy): sizes that are expected
 * are put into groups, and neighbours merged while that saves bytes. Integers decide, so that both find the same. */

#include <string.h>

#include "bundles.h"

enum {
    MOST_CONTEXTS = 32,
    GROUPS = 2 * MOST_CONTEXTS,
    LOG_BITS = 16,
    LOGS = 1 << 12,
    FREQUENCY_BITS = 7 << LOG_BITS
};

typedef struct {
    const int64_t *logs; /* (4096) log2 of each number, in units of 2^-16 */
    size_t alphabet;
    size_t number; /* of groups */
    int64_t counts[GROUPS][TOKENS], costs[GROUPS], merged[GROUPS];
    int starts[GROUPS];
} grouping;

static int64_t logarithm(const int64_t *logs, int64_t number)
{
    unsigned shift = 0;
    while (number >> shift >= LOGS)
        shift++;
    return logs[number >> shift] + ((int64_t)shift << LOG_BITS);
}

/* Bits of the tokens of a context that has the counts of both groups, and of its frequencies, in units of 2^-16. */
static int64_t cost(const grouping *g, size_t a, size_t b)
{
    int64_t total = 0, spent = 0;
    for (size_t k = 0; k < g->alphabet; k++) {
        const int64_t n = g->counts[a][k] + (a == b ? 0 : g->counts[b][k]);
        if (!n)
            continue;
        total += n;
        spent += FREQUENCY_BITS - n * logarithm(g->logs, n);
    }
    return total ? spent + total * logarithm(g->logs, total) : 0;
}

static void merge(grouping *g)
{
    for (size_t k = 0; k < g->number; k++)
        g->costs[k] = cost(g, k, k);
    for (size_t k = 0; k + 1 < g->number; k++)
        g->merged[k] = cost(g, k, k + 1);
    while (g->number > 1) {
        size_t best = 0;
        int64_t least = INT64_MAX;
        for (size_t k = 0; k + 1 < g->number; k++) {
            const int64_t growth = g->merged[k] - g->costs[k] - g->costs[k + 1];
            if (growth < least) {
                least = growth;
                best = k;
            }
        }
        if (least >= 0 && g->number <= MOST_CONTEXTS)
            return;
        for (size_t k = 0; k < g->alphabet; k++)
            g->counts[best][k] += g->counts[best + 1][k];
        g->costs[best] = g->merged[best];
        const size_t behind = g->number - best - 2;
        memmove(g->counts[best + 1], g->counts[best + 2], behind * sizeof g->counts[0]);
        memmove(&g->costs[best + 1], &g->costs[best + 2], behind * sizeof g->costs[0]);
        memmove(&g->starts[best + 1], &g->starts[best + 2], behind * sizeof g->starts[0]);
        memmove(&g->merged[best], &g->merged[best + 1], (behind + 1) * sizeof g->merged[0]);
        g->number--;
        if (best)
            g->merged[best - 1] = cost(g, best - 1, best);
        if (best + 1 < g->number)
            g->merged[best] = cost(g, best, best + 1);
    }
}

/* Counts to frequencies that add up to 4096, none of them 0: as potr_cl.codec.rans.normalise. */
static void normalise(const int64_t *counts, size_t alphabet, uint16_t *frequencies)
{
    int64_t total = 0, rest = TOTAL;
    for (size_t k = 0; k < alphabet; k++)
        total += counts[k];
    for (size_t k = 0; k < alphabet; k++) {
        const int64_t part = counts[k] * TOTAL / total;
        frequencies[k] = (uint16_t)(counts[k] ? part > 1 ? part : 1 : 0);
        rest -= frequencies[k];
    }
    /* The gain of a token changes only with its frequency, so that each is what it would be at once for all. */
    while (rest > 0) {
        size_t token = 0;
        double most = -2;
        for (size_t k = 0; k < alphabet; k++) {
            const double gain = counts[k] ? (double)counts[k] / frequencies[k] : -1;
            if (gain > most) {
                most = gain;
                token = k;
            }
        }
        const int64_t more = (rest + 3) / 4;
        frequencies[token] = (uint16_t)(frequencies[token] + more);
        rest -= more;
    }
    while (rest < 0) {
        size_t token = alphabet;
        double least = 0;
        for (size_t k = 0; k < alphabet; k++)
            if (frequencies[k] > 1) {
                const double loss = (double)counts[k] / frequencies[k];
                if (token == alphabet || loss < least) {
                    least = loss;
                    token = k;
                }
            }
        frequencies[token]--;
        rest++;
    }
}

POTR_EXPORT size_t potr_bundles_grouping(void)
{
    return sizeof(grouping);
}

/* Contexts by expected size, and the frequencies of each.
 *
 * counts: (256, alphabet) of expected sizes and tokens, at least one. alphabet: more than the largest token. logs:
 * (4096) log2 of each number, rounded to units of 2^-16. g: room. classes: (256), filled. frequencies: (64 · alphabet), filled
 * with (contexts, alphabet). Returns the number of contexts. */
POTR_EXPORT size_t potr_bundles_contexts(
    const uint32_t *counts, size_t alphabet, const int64_t *logs, grouping *g, uint8_t *classes, uint16_t *frequencies)
{
    uint64_t total = 0, before = 0, last = 0;
    for (size_t i = 0; i < TOKENS * alphabet; i++)
        total += counts[i];
    g->logs = logs;
    g->alphabet = alphabet;
    g->number = 0;
    for (int size = 0; size < TOKENS; size++) {
        const uint32_t *const row = counts + (size_t)size * alphabet;
        uint64_t of_size = 0;
        for (size_t k = 0; k < alphabet; k++)
            of_size += row[k];
        if (!of_size)
            continue;
        before += of_size;
        const uint64_t group = (before - 1) * GROUPS / total;
        if (!g->number || group != last) {
            memset(g->counts[g->number], 0, sizeof g->counts[0]);
            g->starts[g->number] = g->number ? size : 0;
            g->number++;
        }
        last = group;
        for (size_t k = 0; k < alphabet; k++)
            g->counts[g->number - 1][k] += row[k];
    }
    merge(g);
    memset(classes, 0, TOKENS);
    for (size_t k = 1; k < g->number; k++)
        for (int size = g->starts[k]; size < TOKENS; size++)
            classes[size]++;
    for (size_t k = 0; k < g->number; k++)
        normalise(g->counts[k], alphabet, frequencies + k * alphabet);
    return g->number;
}
