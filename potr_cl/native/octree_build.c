/* The encoder's half of octrees (docs/format.md, "Positions"): from centres to Morton words, their order, and streams.
 *
 * The same bits as potr_cl/codec/octree/builder.py. A splat's words say in which octant it lies at each level: three bits
 * a level, x in the lowest, 21 levels a word, the first level of a word in bits 60 to 62. */

#include <math.h>
#include <string.h>

#include "potr_native.h"

enum { LEVELS_A_WORD = 21, DIGIT = 11, DIGITS = 6, BUCKETS = 1 << DIGIT, LEVELS = 54, UNDECIDED = -1 };

/* Where the centres of n splats (n, 3) lie, and how finely they are to be told apart.
 *
 * tolerance: of splat i at tolerance[i * step]. limit: (n), filled: the same, but never finer than float32 holds the
 * coordinates. bounds: (7), filled: the least and the largest coordinates, and the least limit. */
POTR_EXPORT void potr_octree_bounds(
    const float *restrict means, size_t n, const double *restrict tolerance, size_t step, double *restrict limit,
    double *restrict bounds)
{
    float low[3] = { INFINITY, INFINITY, INFINITY }, high[3] = { -INFINITY, -INFINITY, -INFINITY };
    double least = INFINITY;
    for (size_t i = 0; i < n; i++) {
        float largest = 0;
        for (size_t axis = 0; axis < 3; axis++) {
            const float x = means[3 * i + axis], size = fabsf(x);
            low[axis] = x < low[axis] ? x : low[axis];
            high[axis] = x > high[axis] ? x : high[axis];
            largest = size > largest ? size : largest;
        }
        const double resolution = (double)largest * 0x1p-23, asked = tolerance[i * step];
        limit[i] = asked > resolution ? asked : resolution;
        least = limit[i] < least ? limit[i] : least;
    }
    for (size_t axis = 0; axis < 3; axis++) {
        bounds[axis] = low[axis];
        bounds[3 + axis] = high[axis];
    }
    bounds[6] = least;
}

/* Moves bit i to bit 3 i, for 21 bits. */
static INLINE uint64_t spread(uint64_t x)
{
    x = (x | x << 32) & 0x1F00000000FFFF;
    x = (x | x << 16) & 0x1F0000FF0000FF;
    x = (x | x << 8) & 0x100F00F00F00F00F;
    x = (x | x << 4) & 0x10C30C30C30C30C3;
    return (x | x << 2) & 0x1249249249249249;
}

/* The Morton words of n centres.
 *
 * low: (3) corner of the root. ratio: cells of the deepest level in a unit of length; cells: in the root's edge, a power
 * of two. words: (number, stride), of which n are filled, the most significant first. */
POTR_EXPORT void potr_octree_words(
    const float *restrict means, size_t n, const double *restrict low, double ratio, double cells, int depth,
    size_t number, size_t stride, uint64_t *restrict words)
{
    for (size_t i = 0; i < n; i++) {
        uint64_t grid[3];
        for (size_t axis = 0; axis < 3; axis++) {
            const double at = ((double)means[3 * i + axis] - low[axis]) * ratio;
            grid[axis] = (uint64_t)(int64_t)(at < cells - 1 ? at : cells - 1);
        }
        for (size_t k = 0; k < number; k++) {
            const int shift = depth - ((int)k + 1) * LEVELS_A_WORD;
            uint64_t word = 0;
            for (size_t axis = 0; axis < 3; axis++) {
                const uint64_t part = shift >= 0 ? grid[axis] >> shift : grid[axis] << -shift;
                word |= spread(part & 0x1FFFFF) << axis;
            }
            words[k * stride + i] = word;
        }
    }
}

/* The first level whose cells' half diagonal is below each of n limits: floor(log2(half / limit) + 1e-6) + 1, from 0 to
 * `depth`; UNDECIDED where that depends on the last digits of the logarithm. */
POTR_EXPORT void potr_octree_wanted(
    const double *restrict limit, size_t n, double half, int depth, int8_t *restrict wanted)
{
    const double turn = 0x1.ffffe8bde9c24p-1; /* 2^(-1e-6) */
    for (size_t i = 0; i < n; i++) {
        const double ratio = half / limit[i];
        if (!(ratio >= 0x1p-1000 && ratio <= 0x1p1000)) {
            wanted[i] = UNDECIDED;
            continue;
        }
        uint64_t bits;
        memcpy(&bits, &ratio, sizeof bits);
        const int exponent = (int)(bits >> 52) - 1022; /* of a mantissa from a half to 1 */
        bits = (bits & 0xFFFFFFFFFFFFF) | (uint64_t)1022 << 52;
        double mantissa;
        memcpy(&mantissa, &bits, sizeof mantissa);
        const int level = exponent + (mantissa >= turn);
        wanted[i] = fabs(mantissa - turn) < 1e-12 ? UNDECIDED : (int8_t)(level < 0 ? 0 : level > depth ? depth : level);
    }
}

POTR_EXPORT size_t potr_octree_sorting(void)
{
    return (size_t)DIGITS * BUCKETS * sizeof(uint64_t);
}

/* The order of n splats by one of their words; where that is the same, the order in which they are.
 *
 * counts: potr_octree_sorting() bytes. keys: the words of the splats in the order so far; order: that. other_keys,
 * other_order: (n) to work with. Returns whether the result is in these two. */
POTR_EXPORT int potr_octree_sort(
    size_t n, uint64_t *counts, uint64_t *keys, int64_t *order, uint64_t *other_keys, int64_t *other_order)
{
    int turned = 0;
    memset(counts, 0, potr_octree_sorting());
    for (size_t i = 0; i < n; i++)
        for (size_t digit = 0; digit < DIGITS; digit++)
            counts[digit * BUCKETS + (keys[i] >> digit * DIGIT & (BUCKETS - 1))]++;
    for (size_t digit = 0; digit < DIGITS; digit++) {
        uint64_t *const starts = counts + digit * BUCKETS, shift = digit * DIGIT, before = 0;
        if (n == 0 || starts[keys[0] >> shift & (BUCKETS - 1)] == n)
            continue;
        for (size_t k = 0; k < BUCKETS; k++) {
            const uint64_t here = starts[k];
            starts[k] = before;
            before += here;
        }
        for (size_t i = 0; i < n; i++) {
            const uint64_t to = starts[keys[i] >> shift & (BUCKETS - 1)]++;
            other_keys[to] = keys[i];
            other_order[to] = order[i];
        }
        uint64_t *const some_keys = keys;
        int64_t *const some_order = order;
        keys = other_keys, other_keys = some_keys;
        order = other_order, other_order = some_order;
        turned = !turned;
    }
    return turned;
}

static INLINE unsigned octant_of(const uint64_t *words, size_t n, size_t i, unsigned level)
{
    return (unsigned)(words[level / LEVELS_A_WORD * n + i] >> 3 * (LEVELS_A_WORD - 1 - level % LEVELS_A_WORD)) & 7;
}

static INLINE int highest_bit(uint64_t x)
{
#if defined(__GNUC__)
    return 63 - __builtin_clzll(x);
#else
    int bit = 0;
    while (x >>= 1)
        bit++;
    return bit;
#endif
}

/* Levels that splat i - 1 and splat i share; fewer than 0 at both ends. */
static INLINE int common_levels(const uint64_t *words, size_t n, size_t number, int depth, size_t i)
{
    if (i == 0 || i == n)
        return -1;
    for (size_t k = 0; k < number; k++) {
        const uint64_t differs = words[k * n + i] ^ words[k * n + i - 1];
        if (differs)
            return LEVELS_A_WORD * (int)k + (3 * LEVELS_A_WORD - 1 - highest_bit(differs)) / 3;
    }
    return depth;
}

/* How much of an octree's streams is where. */
typedef struct {
    uint64_t nodes[LEVELS], children[LEVELS]; /* of each level */
    uint64_t tails[LEVELS];                   /* of each length */
    uint64_t singles, packed;                 /* leaves with a lone splat, and with several */
} sizes;

POTR_EXPORT size_t potr_octree_sizes(void)
{
    return sizeof(sizes);
}

static INLINE int tail_of(int wanted, int alone)
{
    return wanted > alone ? wanted - alone : 0;
}

/* Counts what the streams of n splats will hold.
 *
 * words: (number, n) in the order of the leaves. wanted: (n) levels of the leaves in the scene's order, which `order`
 * leads to. */
POTR_EXPORT void potr_octree_survey(
    const uint64_t *words, size_t n, size_t number, int depth, const int64_t *order, const int8_t *wanted, sizes *found)
{
    memset(found, 0, sizeof *found);
    int above = -1;
    for (size_t i = 0; i < n; i++) {
        const int below = common_levels(words, n, number, depth, i + 1);
        const int alone = (above > below ? above : below) + 1;
        /* The splat is the first of its cell, and of those that the cell lies in, from the level after `above` on. */
        for (int level = above > 0 ? above : 0; level < alone && level < depth; level++) {
            found->children[level]++;
            found->nodes[level] += above < level;
        }
        if (alone <= depth) {
            found->singles++;
            found->tails[tail_of(wanted[order[i]], alone)]++;
        } else if (above < depth) {
            found->packed++;
        }
        above = below;
    }
}

/* The streams.
 *
 * What potr_octree_survey takes and gives. All that follows is 0, and filled: occupancy: a byte a node. several: a bit a
 * child. multiplicities: (packed). leaf_levels: (singles), the wanted levels. tails: their bit planes. */
POTR_EXPORT void potr_octree_streams(
    const uint64_t *words, size_t n, size_t number, int depth, const int64_t *order, const int8_t *wanted,
    const sizes *found, uint8_t *occupancy, uint8_t *several, uint64_t *multiplicities, uint8_t *leaf_levels,
    uint8_t *tails)
{
    uint64_t node[LEVELS], child[LEVELS], rank[LEVELS], plane[LEVELS], plane_bytes[LEVELS];
    uint64_t nodes = 0, children = 0, offset = 0, longer = 0, packed = 0, single = 0;
    for (int level = 0; level < LEVELS; level++) {
        node[level] = nodes; /* the next to begin: the one being filled is before it */
        child[level] = children;
        nodes += found->nodes[level];
        children += found->children[level];
    }
    for (int tail = LEVELS - 1; tail >= 1; tail--) {
        rank[tail] = longer;
        longer += found->tails[tail];
        plane_bytes[tail] = (longer + 7) / 8;
    }
    for (int step = 1; step < LEVELS; step++) {
        plane[step] = offset;
        offset += 3 * plane_bytes[step];
    }
    int above = -1;
    for (size_t i = 0; i < n; i++) {
        const int below = common_levels(words, n, number, depth, i + 1);
        const int alone = (above > below ? above : below) + 1;
        for (int level = above > 0 ? above : 0; level < alone && level < depth; level++) {
            const uint64_t at = child[level]++;
            node[level] += above < level;
            occupancy[node[level] - 1] |= (uint8_t)(1u << octant_of(words, n, i, (unsigned)level));
            several[at >> 3] |= (uint8_t)((alone > level + 1) << (at & 7));
        }
        if (alone <= depth) {
            const int asked = wanted[order[i]], tail = tail_of(asked, alone);
            leaf_levels[single++] = (uint8_t)asked;
            const uint64_t at = tail ? rank[tail]++ : 0;
            for (int step = 1; step <= tail; step++) {
                const unsigned octant = octant_of(words, n, i, (unsigned)(alone + step - 1));
                uint8_t *to = tails + plane[step] + (at >> 3);
                for (unsigned axis = 0; axis < 3; axis++, to += plane_bytes[step])
                    *to |= (uint8_t)((octant >> axis & 1) << (at & 7));
            }
        } else {
            packed += above < depth;
            multiplicities[packed - 1]++;
        }
        above = below;
    }
}

/* Centres as a decoder finds them, of the splats from number `begin` of the order on to the one before `end`.
 *
 * What potr_octree_survey takes, and: sides: (depth + 1) edges of the cells of each level. origin: (3).
 * means: (n, 3), filled from `begin` on to `end`, in the order of the leaves. */
POTR_EXPORT void potr_octree_decoded(
    const uint64_t *words, size_t n, size_t number, int depth, const int64_t *order, const int8_t *wanted,
    const double *sides, const double *origin, size_t begin, size_t end, float *means)
{
    int above = begin < end ? common_levels(words, n, number, depth, begin) : -1;
    for (size_t i = begin; i < end; i++) {
        const int below = common_levels(words, n, number, depth, i + 1);
        const int alone = (above > below ? above : below) + 1, asked = wanted[order[i]];
        const int level = alone > depth ? depth : asked > alone ? asked : alone;
        uint64_t cell[3] = { 0, 0, 0 };
        for (int step = 0; step < level; step++) {
            const unsigned octant = octant_of(words, n, i, (unsigned)step);
            for (unsigned axis = 0; axis < 3; axis++)
                cell[axis] = 2 * cell[axis] + (octant >> axis & 1);
        }
        for (size_t axis = 0; axis < 3; axis++) {
            const double along = ((double)(int64_t)cell[axis] + 0.5) * sides[level];
            means[3 * i + axis] = (float)(along + origin[axis]);
        }
        above = below;
    }
}
