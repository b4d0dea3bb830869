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

static uint64_t bits_between(const uint8_t *bits, uint64_t at, uint64_t end)
{
    uint64_t number = 0;
    for (; at < end && at & 7; at++)
        number += bit_at(bits, at);
    for (; at + 8 <= end; at += 8)
        number += bits_in(bits[at >> 3]);
    for (; at < end; at++)
        number += bit_at(bits, at);
    return number;
}

/* Where a walk through the leaves, depth first, may begin or end: before a leaf, or behind the last. */
typedef struct {
    uint64_t singles, crowded, splats; /* leaves of each kind before it, and splats */
    levels_of_tree at;                 /* what comes next in each level */
    int64_t level;                     /* of the cell whose children come next; below 0 behind the last leaf */
    uint64_t path[DEEPEST + 1][3];     /* coordinates of that cell, and of those that it lies in */
    uint8_t left[DEEPEST + 1];         /* their children that were not looked at, by octant */
} cut;

POTR_EXPORT size_t potr_octree_cut(void)
{
    return sizeof(cut);
}

/* Crowded cells of a level above the deepest; 0 where the tree does not reach. */
static uint64_t nodes_of(const levels_of_tree *levels, size_t cells, int depth, int level)
{
    if (level >= depth || (level > 0 && levels->nodes[level] == 0))
        return 0;
    const int last = level + 1 >= depth || levels->nodes[level + 1] == 0;
    return (last ? cells : levels->nodes[level + 1]) - levels->nodes[level];
}

/* Walks on through the levels above `split`, over all subtrees from there on, until `number` of these are left behind.
 * *met: how many are. Returns how many leaves were met on the way. */
static uint64_t walk_above(
    cut *w, const uint8_t *occupancy, const uint8_t *several, int split, uint64_t number, uint64_t *met)
{
    uint64_t lone = 0;
    for (;;) {
        const int64_t level = w->level;
        if (w->left[level] == 0) {
            w->level--;
            continue;
        }
        const unsigned crowded = bit_at(several, w->at.children[level]);
        if (crowded && level + 1 == split && *met == number)
            return lone;
        const unsigned octant = lowest_bit(w->left[level]);
        w->left[level] &= (uint8_t)(w->left[level] - 1);
        w->at.children[level]++;
        if (!crowded) {
            lone++;
        } else if (level + 1 == split) {
            ++*met;
        } else {
            for (unsigned axis = 0; axis < 3; axis++)
                w->path[level + 1][axis] = 2 * w->path[level][axis] + (octant >> axis & 1);
            w->left[level + 1] = occupancy[w->at.nodes[level + 1]++];
            w->level++;
        }
    }
}

/* Cuts the walk through a tree's leaves into parts.
 *
 * What potr_octree_levels takes and gives, and: multiplicities: (crowded). splats: what there must be. parts: at most so
 * many. cuts: (parts + 1), filled: where each part begins, and the end of the last. Returns the number of parts, 0 if
 * there are not as many splats. */
POTR_EXPORT size_t potr_octree_cuts(
    const uint8_t *occupancy, size_t cells, const uint8_t *several, int depth, const levels_of_tree *levels,
    uint64_t singles, uint64_t crowded, const uint64_t *multiplicities, uint64_t splats, size_t parts, cut *cuts)
{
    uint64_t total = singles;
    if (singles > splats)
        return 0;
    for (uint64_t i = 0; i < crowded; i++) {
        if (multiplicities[i] == 0 || multiplicities[i] > splats - total)
            return 0;
        total += multiplicities[i];
    }
    if (total != splats)
        return 0;
    memset(cuts, 0, (parts + 1) * sizeof *cuts);
    cut w = { .at = *levels, .level = -1 };
    if (cells) {
        w.level = 0;
        w.left[0] = occupancy[w.at.nodes[0]++];
    }
    cuts[0] = w;
    /* The parts begin with crowded cells of a level that has enough of them for parts to be alike. */
    int split = 0;
    for (int level = 1; level < depth && nodes_of(levels, cells, depth, split) < 16 * parts; level++)
        if (nodes_of(levels, cells, depth, level) > nodes_of(levels, cells, depth, split))
            split = level;
    const uint64_t nodes = nodes_of(levels, cells, depth, split);
    uint64_t before[DEEPEST + 2] = { 0 }, children[DEEPEST + 2] = { 0 }; /* of each level from there on, left behind */
    uint64_t met = 0, lone = 0, packed = 0, of_packed = 0;
    size_t made = 1;
    for (size_t part = 1; part < parts && split > 0; part++) {
        const uint64_t number = nodes / parts * part;
        if (number <= met)
            continue;
        lone += walk_above(&w, occupancy, several, split, number, &met);
        uint64_t to = met;
        for (int level = split; level < depth; level++) {
            uint64_t born = 0;
            for (uint64_t i = levels->nodes[level] + before[level]; i < levels->nodes[level] + to; i++)
                born += bits_in(occupancy[i]);
            const uint64_t first = levels->children[level] + children[level];
            const uint64_t several_of = bits_between(several, first, first + born);
            lone += born - several_of;
            before[level] = to;
            children[level] += born;
            to = before[level + 1] + several_of;
        }
        before[depth] = to;
        for (; packed < to; packed++)
            of_packed += multiplicities[packed];
        cut *const here = &cuts[made++];
        *here = w;
        for (int level = split; level < depth; level++) {
            here->at.nodes[level] = levels->nodes[level] + before[level];
            here->at.children[level] = levels->children[level] + children[level];
        }
        here->singles = lone;
        here->crowded = packed;
        here->splats = lone + of_packed;
    }
    cuts[made].singles = singles;
    cuts[made].crowded = crowded;
    cuts[made].splats = splats;
    cuts[made].level = -1;
    return made;
}

enum { CROWDED = 255 };

/* What is known of the leaves before their tails are read: in the memory of a centre each where three numbers of 32 bits
 * fit, else in memory of their own. */
typedef struct {
    float *means;    /* (splats, 3) */
    uint64_t *cells; /* (splats, 3), or NULL */
    uint8_t *levels; /* (splats) */
    uint8_t *tails;  /* (splats) levels below, or CROWDED */
} leaves;

static INLINE void put_cell(const leaves *out, int wide, uint64_t splat, uint64_t x, uint64_t y, uint64_t z)
{
    if (wide) {
        uint64_t *const to = out->cells + 3 * splat;
        to[0] = x, to[1] = y, to[2] = z;
    } else {
        const uint32_t cell[3] = { (uint32_t)x, (uint32_t)y, (uint32_t)z };
        memcpy(out->means + 3 * splat, cell, sizeof cell);
    }
}

/* Bits of the children of a cell, the first in the lowest. */
static INLINE unsigned bits_from(const uint8_t *bits, uint64_t at, unsigned number)
{
    unsigned found = bits[at >> 3] >> (at & 7);
    if ((at & 7) + number > 8)
        found |= (unsigned)bits[(at >> 3) + 1] << (8 - (at & 7));
    return found;
}

/* Levels of the tail of a leaf with a lone splat. */
static INLINE int tail_of(uint8_t leaf_level, int level)
{
    return leaf_level > level ? leaf_level - level : 0;
}

static INLINE void walk_leaves(
    const uint8_t *occupancy, const uint8_t *several, int depth, const cut *from, const cut *to,
    const uint8_t *leaf_levels, const uint64_t *multiplicities, int wide, const leaves *out,
    uint64_t *counts)
{
    uint64_t number = to->singles + to->crowded - from->singles - from->crowded;
    uint64_t splat = from->splats, single = from->singles, packed = from->crowded;
    if (from->level < 0) { /* a tree of one leaf */
        for (; number; number--) {
            const int is_crowded = to->crowded > from->crowded;
            const int tail = is_crowded ? CROWDED : tail_of(leaf_levels[single], 0);
            if (!is_crowded)
                counts[tail]++;
            put_cell(out, wide, splat, 0, 0, 0);
            out->levels[splat] = 0;
            out->tails[splat] = (uint8_t)tail;
        }
        return;
    }
    uint64_t nodes[DEEPEST + 1], children[DEEPEST + 1], path[DEEPEST + 1][3];
    unsigned lefts[DEEPEST + 1], crowds[DEEPEST + 1];
    int level = (int)from->level;
    memcpy(nodes, from->at.nodes, sizeof nodes);
    memcpy(children, from->at.children, sizeof children);
    memcpy(path, from->path, sizeof path);
    for (int l = 0; l <= level; l++) {
        const unsigned born = bits_in(from->left[l]);
        lefts[l] = from->left[l];
        crowds[l] = born ? bits_from(several, children[l], born) : 0;
        children[l] += born;
    }
    unsigned left = lefts[level], crowd = crowds[level];
    uint64_t x = 2 * path[level][0], y = 2 * path[level][1], z = 2 * path[level][2];
    while (number) {
        if (left == 0) {
            level--;
            left = lefts[level];
            crowd = crowds[level];
            x = 2 * path[level][0], y = 2 * path[level][1], z = 2 * path[level][2];
            continue;
        }
        const unsigned octant = lowest_bit((uint8_t)left), is_crowded = crowd & 1;
        left &= left - 1;
        crowd >>= 1;
        if (is_crowded && level + 1 < depth) {
            lefts[level] = left;
            crowds[level] = crowd;
            level++;
            path[level][0] = x | (octant & 1), path[level][1] = y | (octant >> 1 & 1), path[level][2] = z | octant >> 2;
            x = 2 * path[level][0], y = 2 * path[level][1], z = 2 * path[level][2];
            left = occupancy[nodes[level]++];
            const unsigned born = bits_in((uint8_t)left);
            crowd = bits_from(several, children[level], born);
            children[level] += born;
            continue;
        }
        number--;
        put_cell(out, wide, splat, x | (octant & 1), y | (octant >> 1 & 1), z | octant >> 2);
        out->levels[splat] = (uint8_t)(level + 1);
        if (is_crowded) {
            out->tails[splat] = CROWDED;
            splat += multiplicities[packed++];
            continue;
        }
        const int tail = tail_of(leaf_levels[single++], level + 1);
        counts[tail]++;
        out->tails[splat++] = (uint8_t)tail;
    }
}

/* The cells of a part's leaves, and how many have a tail of each length.
 *
 * What potr_octree_cuts takes and gives. leaf_levels: one a leaf with a lone splat, at most `depth`. out: filled where the
 * part's splats are, of those in one place at the first. counts: (53), filled. */
POTR_EXPORT void potr_octree_leaves(
    const uint8_t *occupancy, const uint8_t *several, int depth, const cut *from, const cut *to,
    const uint8_t *leaf_levels, const uint64_t *multiplicities, const leaves *out, uint64_t *counts)
{
    memset(counts, 0, (MOST_TAIL + 1) * sizeof *counts);
    if (out->cells)
        walk_leaves(occupancy, several, depth, from, to, leaf_levels, multiplicities, 1, out, counts);
    else
        walk_leaves(occupancy, several, depth, from, to, leaf_levels, multiplicities, 0, out, counts);
}

/* Where the planes of each step of the tails begin, and their bytes; counts: (53) of tails of each length, of all
 * leaves. Returns the number of leaves with a tail. */
static uint64_t find_planes(const uint64_t *counts, uint64_t *plane, uint64_t *plane_bytes)
{
    uint64_t longer = 0, offset = 0;
    for (int t = MOST_TAIL; t >= 1; t--) {
        longer += counts[t];
        plane_bytes[t] = (longer + 7) / 8;
    }
    for (int t = 1; t <= MOST_TAIL; t++) {
        plane[t] = offset;
        offset += 3 * plane_bytes[t];
    }
    return longer;
}

/* Whether the padding of all planes of tails is zero: 0 if it is. */
POTR_EXPORT int potr_octree_padding(const uint64_t *counts, const uint8_t *tails)
{
    uint64_t plane[MOST_TAIL + 1], plane_bytes[MOST_TAIL + 1];
    uint64_t longer = find_planes(counts, plane, plane_bytes);
    for (int t = 1; t <= MOST_TAIL; t++) {
        if (longer & 7)
            for (uint64_t axis = 1; axis <= 3; axis++)
                if (tails[plane[t] + axis * plane_bytes[t] - 1] >> (longer & 7))
                    return 1;
        longer -= counts[t];
    }
    return 0;
}

static INLINE void place_leaves(
    const cut *from, const cut *to, const uint64_t *counts, const uint64_t *ranks, const uint64_t *multiplicities,
    const uint8_t *tails, const double *sides, const double *origin, int wide, const leaves *in)
{
    uint64_t rank[MOST_TAIL + 1], plane[MOST_TAIL + 1], plane_bytes[MOST_TAIL + 1];
    memcpy(rank, ranks, sizeof rank);
    find_planes(counts, plane, plane_bytes);
    uint64_t packed = from->crowded;
    for (uint64_t splat = from->splats; splat < to->splats;) {
        float *const mean = in->means + 3 * splat;
        uint64_t cell[3];
        uint32_t narrow[3];
        memcpy(narrow, mean, sizeof narrow);
        for (int axis = 0; axis < 3; axis++)
            cell[axis] = wide ? in->cells[3 * splat + axis] : narrow[axis];
        int level = in->levels[splat];
        const int tail = in->tails[splat];
        uint64_t copies = 1;
        if (tail == CROWDED) {
            copies = multiplicities[packed++];
        } else if (tail) {
            const uint64_t at = rank[tail]++;
            for (int step = 1; step <= tail; step++) {
                const uint8_t *bytes = tails + plane[step] + (at >> 3);
                for (int axis = 0; axis < 3; axis++, bytes += plane_bytes[step])
                    cell[axis] = 2 * cell[axis] + (*bytes >> (at & 7) & 1u);
            }
            level += tail;
        }
        const double side = sides[level];
        float centre[3];
        for (int axis = 0; axis < 3; axis++) {
            const double along = ((double)(int64_t)cell[axis] + 0.5) * side;
            centre[axis] = (float)(along + origin[axis]);
        }
        splat += copies;
        for (uint64_t copy = 0; copy < copies; copy++)
            memcpy(mean + 3 * copy, centre, sizeof centre);
    }
}

/* Centres of a part's splats.
 *
 * What potr_octree_leaves takes and gives, and: counts: (53) of the tails of all leaves. ranks: (53) of the part's first
 * leaf with a tail of each length, the longest first. tails: bit planes, as many as the counts ask for. sides:
 * (depth + 1) edges of the cells of each level. origin: (3). */
POTR_EXPORT void potr_octree_centres(
    const cut *from, const cut *to, const uint64_t *counts, const uint64_t *ranks, const uint64_t *multiplicities,
    const uint8_t *tails, const double *sides, const double *origin, const leaves *in)
{
    if (in->cells)
        place_leaves(from, to, counts, ranks, multiplicities, tails, sides, origin, 1, in);
    else
        place_leaves(from, to, counts, ranks, multiplicities, tails, sides, origin, 0, in);
}
