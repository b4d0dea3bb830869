/* Positions (docs/format.md, "Positions"): the octree's streams to the centres of splats.
 *
 * The streams are breadth first, level by level, and splats are in depth-first order. A walk depth first meets the
 * cells of each level in that level's order: with a place in the streams for each level it needs nothing else. */

#include <string.h>

#include "potr_native.h"

enum {
    DEEPEST = 52,
    MOST_TAIL = DEEPEST
};

/* Where the cells of each level begin. */
typedef struct {
    uint64_t nodes[DEEPEST + 2];    /* crowded cells of the levels above: bytes of occupancy before the level's own */
    uint64_t children[DEEPEST + 2]; /* children of crowded cells of the levels above: bits of `several` before */
} levels_of_tree;

static unsigned bits_in(uint8_t byte)
{
    unsigned number = byte - (byte >> 1 & 0x55u);
    number = (number & 0x33u) + (number >> 2 & 0x33u);
    return (number + (number >> 4)) & 0x0fu;
}

static unsigned lowest_bit(uint8_t byte)
{
#if defined(_MSC_VER)
    unsigned bit = 0;
    while (!(byte >> bit & 1))
        bit++;
    return bit;
#else
    return (unsigned)__builtin_ctz(byte);
#endif
}

static unsigned bit_at(const uint8_t *bits, uint64_t at)
{
    return bits[at >> 3] >> (at & 7) & 1u;
}

/* Checks that occupancy and `several` have exactly what the tree asks for, and finds where its levels begin.
 *
 * crowded_root: whether the root holds several splats. *singles and *crowded become the numbers of leaves with a lone
 * splat and of crowded ones of the deepest level. Returns 0, or 1 if the streams contradict each other. */
POTR_EXPORT int potr_octree_levels(
    const uint8_t *occupancy, size_t cells, const uint8_t *several, size_t several_bytes, int depth, int crowded_root,
    levels_of_tree *levels, uint64_t *singles, uint64_t *crowded)
{
    if (depth < 0 || depth > DEEPEST)
        return 1;
    memset(levels, 0, sizeof *levels);
    uint64_t nodes = crowded_root ? 1 : 0, lone = crowded_root ? 0 : 1;
    uint64_t read = 0, children = 0;
    for (int level = 0; level < depth && nodes; level++) {
        if (nodes > cells - read)
            return 1;
        levels->nodes[level] = read;
        levels->children[level] = children;
        uint64_t born = 0;
        for (uint64_t i = read; i < read + nodes; i++) {
            if (occupancy[i] == 0)
                return 1;
            born += bits_in(occupancy[i]);
        }
        if (born > 8 * (uint64_t)several_bytes - children)
            return 1;
        read += nodes;
        nodes = 0;
        uint64_t at = children;
        const uint64_t end = children + born;
        for (; at < end && at & 7; at++)
            nodes += bit_at(several, at);
        for (; at + 8 <= end; at += 8)
            nodes += bits_in(several[at >> 3]);
        for (; at < end; at++)
            nodes += bit_at(several, at);
        lone += born - nodes;
        children = end;
    }
    if (read != cells || several_bytes != (children + 7) / 8)
        return 1;
    for (uint64_t at = children; at < 8 * (uint64_t)several_bytes; at++)
        if (bit_at(several, at))
            return 1;
    *singles = lone;
    *crowded = nodes;
    return 0;
}

/* A walk through the leaves, depth first. */
typedef struct {
    const uint8_t *occupancy, *several;
    levels_of_tree at; /* what comes next in each level */
    int depth, level;
    uint8_t left[DEEPEST + 1];        /* children of the current cell of each level that were not looked at */
    uint64_t path[DEEPEST + 1][3];    /* coordinates of the current cell of each level */
} walk;

typedef struct {
    int level, crowded;
    uint64_t cell[3];
} leaf;

static void begin_walk(
    walk *w, const uint8_t *occupancy, const uint8_t *several, int depth, const levels_of_tree *levels)
{
    w->occupancy = occupancy;
    w->several = several;
    w->at = *levels;
    w->depth = depth;
    w->level = 0;
    memset(w->path[0], 0, sizeof w->path[0]);
    w->left[0] = occupancy[w->at.nodes[0]++];
}

/* The next leaf of a tree whose root was split, as potr_octree_levels has found it to be; there must be one. */
static INLINE void next_leaf(walk *w, leaf *found)
{
    for (;;) {
        const int level = w->level;
        const uint8_t left = w->left[level];
        if (left == 0) {
            w->level--;
            continue;
        }
        const unsigned octant = lowest_bit(left);
        w->left[level] = left & (uint8_t)(left - 1);
        const unsigned crowded = bit_at(w->several, w->at.children[level]++);
        const uint64_t x = 2 * w->path[level][0] + (octant & 1);
        const uint64_t y = 2 * w->path[level][1] + (octant >> 1 & 1);
        const uint64_t z = 2 * w->path[level][2] + (octant >> 2);
        if (!crowded || level + 1 == w->depth) {
            found->level = level + 1;
            found->crowded = (int)crowded;
            found->cell[0] = x;
            found->cell[1] = y;
            found->cell[2] = z;
            return;
        }
        w->level = level + 1;
        w->path[level + 1][0] = x;
        w->path[level + 1][1] = y;
        w->path[level + 1][2] = z;
        w->left[level + 1] = w->occupancy[w->at.nodes[level + 1]++];
    }
}

/* Levels of the tail of a leaf with a lone splat; negative if it leads too deep. */
static INLINE int tail_of(uint8_t length, int level, int depth, int absolute)
{
    if (absolute)
        return length > depth ? -1 : length > level ? length - level : 0;
    return length + level > depth ? -1 : length;
}

/* How many leaves have a tail of each length.
 *
 * A tree of one leaf, its root, has occupancy of no cells. tail_lengths: one a leaf with a lone splat, of which there
 * are as many as potr_octree_levels has found. counts: (53), filled. Returns 0, or 1 if a tail leads too deep. */
POTR_EXPORT int potr_octree_tails(
    const uint8_t *occupancy, size_t cells, const uint8_t *several, int depth, const levels_of_tree *levels,
    const uint8_t *tail_lengths, uint64_t singles, uint64_t crowded, int absolute, uint64_t *counts)
{
    memset(counts, 0, (MOST_TAIL + 1) * sizeof *counts);
    walk w;
    if (cells)
        begin_walk(&w, occupancy, several, depth, levels);
    uint64_t lone = 0;
    for (uint64_t number = 0; number < singles + crowded; number++) {
        leaf here = { 0, crowded != 0, { 0, 0, 0 } };
        if (cells)
            next_leaf(&w, &here);
        if (here.crowded)
            continue;
        const int tail = tail_of(tail_lengths[lone++], here.level, depth, absolute);
        if (tail < 0)
            return 1;
        counts[tail]++;
    }
    return 0;
}

/* Centres of all splats.
 *
 * What potr_octree_levels and potr_octree_tails take and give, and: multiplicities: (crowded). tails: bit planes, as
 * many as the counts of tails ask for. sides: (depth + 1) edges of the cells of each level. origin: (3). means:
 * (splats, 3), filled. Returns 0; 1 if the padding of a plane is not zero; 2 if there are not as many splats. */
POTR_EXPORT int potr_octree_centres(
    const uint8_t *occupancy, size_t cells, const uint8_t *several, int depth, const levels_of_tree *levels,
    const uint8_t *tail_lengths, uint64_t singles, uint64_t crowded, int absolute, const uint64_t *counts,
    const uint64_t *multiplicities, const uint8_t *tails, const double *sides, const double *origin, float *means,
    uint64_t splats)
{
    uint64_t rank[MOST_TAIL + 1];         /* of the next leaf with a tail of that length, the longest first */
    uint64_t plane[MOST_TAIL + 1];        /* where the planes of a step begin, bytes */
    uint64_t plane_bytes[MOST_TAIL + 1];
    uint64_t longer = 0;
    for (int t = MOST_TAIL; t >= 1; t--) {
        rank[t] = longer;
        longer += counts[t];
        plane_bytes[t] = (longer + 7) / 8;
    }
    uint64_t offset = 0;
    longer = singles - counts[0];
    for (int t = 1; t <= MOST_TAIL; t++) {
        plane[t] = offset;
        offset += 3 * plane_bytes[t];
        if (longer & 7)
            for (uint64_t axis = 1; axis <= 3; axis++)
                if (tails[plane[t] + axis * plane_bytes[t] - 1] >> (longer & 7))
                    return 1;
        longer -= counts[t];
    }
    walk w;
    if (cells)
        begin_walk(&w, occupancy, several, depth, levels);
    uint64_t lone = 0, packed = 0, written = 0;
    for (uint64_t number = 0; number < singles + crowded; number++) {
        leaf here = { 0, crowded != 0, { 0, 0, 0 } };
        if (cells)
            next_leaf(&w, &here);
        uint64_t copies = 1;
        if (here.crowded) {
            copies = multiplicities[packed++];
        } else {
            const int tail = tail_of(tail_lengths[lone++], here.level, depth, absolute);
            if (tail > 0) {
                const uint64_t at = rank[tail]++;
                for (int step = 1; step <= tail; step++) {
                    const uint8_t *bytes = tails + plane[step] + (at >> 3);
                    for (int axis = 0; axis < 3; axis++, bytes += plane_bytes[step])
                        here.cell[axis] = 2 * here.cell[axis] + (*bytes >> (at & 7) & 1u);
                }
                here.level += tail;
            }
        }
        if (copies > splats - written)
            return 2;
        float centre[3];
        for (int axis = 0; axis < 3; axis++) {
            const double cell = (double)here.cell[axis] + 0.5;
            const double along = cell * sides[here.level];
            centre[axis] = (float)(along + origin[axis]);
        }
        for (; copies; copies--, written++)
            memcpy(means + 3 * written, centre, sizeof centre);
    }
    return written == splats ? 0 : 2;
}
