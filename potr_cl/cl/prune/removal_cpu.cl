/* Removal effects for CPUs: one tile a work-item, which walks forward and then back over the list of each sub-tile.
   removal_gpu.cl is its twin.

   The walk forward finds the pixels' colours, as composite_cpu.cl does, and remembers each splat's alphas and weights
   T alpha. The walk back goes from the last splat to the first. It keeps B, the colour behind a splat as seen with
   nothing in front of it. B is a convex sum that grows by one splat at a time, so that nothing cancels, however many
   layers hide a splat. For each intersection the sweep leaves two sums over the tile's pixels:

       PD^2 + 2 PD (c - c_t),  PD = T alpha (B - c_k)      and      T alpha

   (paper, section "Effect of a splat's removal").

   A list of more than SEGMENT splats is walked in segments. First all of them are walked forward, and the
   transmittances before each are kept. Then, from the last segment to the first, each is walked forward once more for
   its alphas and weights, and back.

   On the way a list loses, in place, the intersections of removed splats. A tile's list begins at offsets[tile] and has
   lengths[tile] intersections.

   The first sweep can leave the picture that composite_cpu.cl would, bit for bit, whose pixels end earlier.

   Macros:
       LANES                               8 or 16, see lanes.clh;
       ALPHA_CAP, TRANSMITTANCE_THRESHOLD  see subtile_vectors.clh;
       PICTURES                            1: leave pictures; 0, the default: it would take time in each sweep;
       PICTURE_THRESHOLD                   with those, where their pixels end, at least TRANSMITTANCE_THRESHOLD;
       INT64_ATOMICS                       see totals.clh. */

#include "include/lanes.clh"
#include "include/splat.clh"
#include "include/subtile_vectors.clh"
#include "include/subtile_walk.clh"
#include "prune/removal.clh"
#include "prune/staleness_cpu.clh"

/* At how many places of a list the transmittances are kept at most. If there are more segments, those between the last
   such place and the segment in question are walked again. */
#define CHECKPOINTS 16
#ifndef PICTURES
#define PICTURES 0
#endif

/* A sub-tile's walk forward. Its transmittances and colours move on; memory[2 j] and memory[2 j + 1] become the alphas
   and weights of the j-th splat. `drawn`: transmittances and colours where the picture's pixels end, which move on with
   PICTURES. Returns the number of splats before the last pixel's end. */
inline uint walk(
    const Splat *splats,
    const ushort *list,
    uint length,
    float2 first,
    vfloat t[1],
    vfloat rgb[3],
    vfloat drawn[4],
    float *memory)
{
    vfloat through = t[0], r = rgb[0], g = rgb[1], b = rgb[2];
    uint j = 0;
    while (j < length && VANY(through > 0.0f)) {
        const uint stop = min(j + PAIRS_AT_ONCE, length);
        for (; j < stop; ++j) {
            const Splat *splat = &splats[list[j]];
            const vfloat power = splat_power(splat, first);
            BLEND(weight, power, through);
            r = MAD(weight, (vfloat)(splat->red), r);
            g = MAD(weight, (vfloat)(splat->green), g);
            b = MAD(weight, (vfloat)(splat->blue), b);
            VSTORE(goes_on ? alpha : (vfloat)(0.0f), 2 * j, memory);
            VSTORE(weight, 2 * j + 1, memory);
#if PICTURES
            const vint shown = after >= PICTURE_THRESHOLD;
            drawn[0] = shown ? after : drawn[0];
            drawn[1] = shown ? r : drawn[1];
            drawn[2] = shown ? g : drawn[2];
            drawn[3] = shown ? b : drawn[3];
#endif
        }
    }
    t[0] = through;
    rgb[0] = r;
    rgb[1] = g;
    rgb[2] = b;
    return j;
}

/* A sub-tile's walk back over what the walk forward remembers; `twice` is twice the colour's difference to the target,
   `behind` the colour behind. sums[list[j]] += the j-th splat's sums over the pixels. */
inline void walk_back(
    const Splat *splats,
    const ushort *list,
    uint length,
    const vfloat twice[3],
    vfloat behind[3],
    float *memory,
    float2 *sums)
{
    const vfloat r = twice[0], g = twice[1], b = twice[2];
    vfloat br = behind[0], bg = behind[1], bb = behind[2];
    for (uint j = length; j-- > 0;) {
        const Splat *splat = &splats[list[j]];
        const vfloat alpha = VLOAD(2 * j, memory), weight = VLOAD(2 * j + 1, memory);
        const vfloat gap_r = br - splat->red, gap_g = bg - splat->green, gap_b = bb - splat->blue;
        const vfloat pd_r = weight * gap_r, pd_g = weight * gap_g, pd_b = weight * gap_b;
        VSTORE(MAD(pd_r, pd_r + r, MAD(pd_g, pd_g + g, pd_b * (pd_b + b))), 2 * j, memory);
        br = MAD(-alpha, gap_r, br);
        bg = MAD(-alpha, gap_g, bg);
        bb = MAD(-alpha, gap_b, bb);
    }
    behind[0] = br;
    behind[1] = bg;
    behind[2] = bb;

    for (uint j = length; j % LANES; ++j) {
        VSTORE((vfloat)(0.0f), 2 * j, memory);
        VSTORE((vfloat)(0.0f), 2 * j + 1, memory);
    }
    for (uint j = 0; j < length; j += LANES) {
        vfloat effects[LANES], importances[LANES];
        for (int k = 0; k < LANES; ++k) {
            effects[k] = VLOAD(2 * (j + k), memory);
            importances[k] = VLOAD(2 * (j + k) + 1, memory);
        }
        const vfloat effect = sum_each(effects), importance = sum_each(importances);
        float pairs[2 * LANES];
        VSTORE(ZIP_LOW(effect, importance), 0, pairs);
        VSTORE(ZIP_HIGH(effect, importance), 1, pairs);
        const uint count = min(length - j, (uint)LANES);
        for (uint k = 0; k < count; ++k)
            sums[list[j + k]] += vload2(k, pairs);
    }
}

/* Work-item i handles tile tiles[start + i]. counts[tile] becomes what its pixels count in `staleness`. */
kernel void removal(
    uint start,
    global const uint *tiles,
    global const float4 *shapes,
    global const float4 *colours,
    global const uchar *alive,
    global const uint *offsets,
    global uint *lengths,
    global uint *intersections,
    global uint *subtiles,
    View view,
    float red,
    float green,
    float blue,
    int first_time,
    float scale,
    float bound,
    global float *target,
    global float *picture,
    global float2 *sums,
    global float *counts,
    volatile global uint *totals)
{
    const int tile = tiles[start + get_global_id(0)];
    const int2 origin = (int2)(tile % view.columns, tile / view.columns) * TILE;
    const uint begin = offsets[tile];
    const uint end = begin + lengths[tile];

    uint kept = begin;
    for (uint read = begin; read < end; ++read) {
        const uint number = intersections[read];
        if (alive[number] == SPLAT_REMOVED)
            continue;
        if (kept < read) {
            intersections[kept] = number;
            sums[kept] = sums[read];
            subtiles[kept] = subtiles[read];
        }
        ++kept;
    }
    lengths[tile] = kept - begin;
    for (uint e = kept; e < end; ++e)
        sums[e] = (float2)(0.0f, 0.0f);

    Splat splats[SEGMENT];
    ushort lists[SUBTILES][SEGMENT];
    uint listed[SUBTILES];
    float memory[2 * (SEGMENT + LANES) * LANES];
    float2 fresh[SEGMENT];
    vfloat t[SUBTILES], rgb[SUBTILES][3], twice[SUBTILES][3], behind[SUBTILES][3];
    vfloat checkpoints[CHECKPOINTS][SUBTILES], drawn[SUBTILES][4];
    for (int i = 0; i < SUBTILES; ++i) {
        t[i] = drawn[i][0] = subtile_transmittance(i, origin, view.width, view.height);
        rgb[i][0] = rgb[i][1] = rgb[i][2] = (vfloat)(0.0f);
        drawn[i][1] = drawn[i][2] = drawn[i][3] = (vfloat)(0.0f);
        behind[i][0] = (vfloat)(red);
        behind[i][1] = (vfloat)(green);
        behind[i][2] = (vfloat)(blue);
    }

    const uint segments = max((kept - begin + SEGMENT - 1) / SEGMENT, 1u);
    const uint apart = (segments + CHECKPOINTS - 1) / CHECKPOINTS;
    uint last = 0; /* the last segment in which a pixel goes on */
    for (; last + 1 < segments && living_subtiles(t); ++last) {
        if (last % apart == 0)
            for (int i = 0; i < SUBTILES; ++i)
                checkpoints[last / apart][i] = t[i];
        gather_splats(shapes, colours, intersections, subtiles, begin + last * SEGMENT, kept, splats, lists, listed);
        for (int i = 0; i < SUBTILES; ++i)
            walk(splats, lists[i], listed[i], subtile_centre(origin, i), &t[i], rgb[i], drawn[i], memory);
    }

    float importance = 0.0f;
    for (uint segment = last + 1; segment-- > 0;) {
        const uint from = begin + segment * SEGMENT;
        if (segment < last) {
            const uint checkpoint = segment / apart;
            for (int i = 0; i < SUBTILES; ++i)
                t[i] = checkpoints[checkpoint][i];
            for (uint before = checkpoint * apart; before < segment; ++before) {
                gather_splats(
                    shapes, colours, intersections, subtiles, begin + before * SEGMENT, kept, splats, lists, listed);
                for (int i = 0; i < SUBTILES; ++i)
                    walk(splats, lists[i], listed[i], subtile_centre(origin, i), &t[i], rgb[i], drawn[i], memory);
            }
        }
        const uint count = gather_splats(shapes, colours, intersections, subtiles, from, kept, splats, lists, listed);
        for (uint k = 0; k < count; ++k)
            fresh[k] = (float2)(0.0f, 0.0f);
        for (int i = 0; i < SUBTILES; ++i) {
            const uint walked =
                walk(splats, lists[i], listed[i], subtile_centre(origin, i), &t[i], rgb[i], drawn[i], memory);
            if (segment == last) {
                const vfloat through = fabs(t[i]);
                float differences[3][LANES];
                VSTORE(MAD(through, (vfloat)(red), rgb[i][0]), 0, differences[0]);
                VSTORE(MAD(through, (vfloat)(green), rgb[i][1]), 0, differences[1]);
                VSTORE(MAD(through, (vfloat)(blue), rgb[i][2]), 0, differences[2]);
#if PICTURES
                float shown[3][LANES];
                VSTORE(MAD(drawn[i][0], (vfloat)(red), drawn[i][1]), 0, shown[0]);
                VSTORE(MAD(drawn[i][0], (vfloat)(green), drawn[i][2]), 0, shown[1]);
                VSTORE(MAD(drawn[i][0], (vfloat)(blue), drawn[i][3]), 0, shown[2]);
#endif
                for (int lane = 0; lane < LANES; ++lane) {
                    const int column = origin.x + SUBTILE_COLUMN(i) + lane % SUBTILE_WIDTH;
                    const int row = origin.y + SUBTILE_ROW(i) + lane / SUBTILE_WIDTH;
                    if (column >= view.width || row >= view.height)
                        continue;
                    const size_t place = 3 * ((size_t)row * view.width + column);
                    for (int channel = 0; channel < 3; ++channel) {
                        if (first_time)
                            target[place + channel] = differences[channel][lane];
#if PICTURES
                        picture[place + channel] = shown[channel][lane];
#endif
                        differences[channel][lane] = 2.0f * (differences[channel][lane] - target[place + channel]);
                    }
                }
                for (int channel = 0; channel < 3; ++channel)
                    twice[i][channel] = VLOAD(0, differences[channel]);
            }
            walk_back(splats, lists[i], walked, twice[i], behind[i], memory, fresh);
        }
        for (uint k = 0; k < count; ++k) {
            if (k + PREFETCH_AHEAD < count)
                PREFETCH_TO_WRITE(totals + TOTAL_WORDS * intersections[from + k + PREFETCH_AHEAD]);
            replace_sums(totals + TOTAL_WORDS * intersections[from + k], sums[from + k], fresh[k], scale, bound);
            sums[from + k] = fresh[k];
            importance += fresh[k].y;
        }
    }
    counts[tile] = removed_counts(importance, kept - begin);
    /* What lies behind the last pixel's end has no effect any more. */
    for (uint e = begin + (last + 1) * SEGMENT; e < kept; ++e) {
        replace_sums(totals + TOTAL_WORDS * intersections[e], sums[e], (float2)(0.0f, 0.0f), scale, bound);
        sums[e] = (float2)(0.0f, 0.0f);
    }
}
