/* From the sums of a sweep back to the coefficients: the second half of the transposed map. It also adds up the splats'
   own blocks of the normal equations.

   What views add to coefficients and blocks is made integers, view by view, before it is added up. So the sums are the
   same whatever views are done together, in whatever order and on however many devices.

   Macros: LANES (splats a work-item), SH_COUNT, WEIGHTS (1: the totals hold the sums of w^2 too, for the blocks),
   SOME_BLOCKS (1: only the blocks of some splats are added up), PICKED (1: each view has some splats only, in an order
   of its own, which `numbers` names. Then views are done one after another, because two of them may have the same
   splat. 0: all views have all).

   On GPUs: LANES=1 SH_COUNT=1,4,9,16 WEIGHTS=0,1 SOME_BLOCKS=0,1 PICKED=-,0,1. */

#include "refit/refit.clh"
#include "refit/view_colours.clh"

/* Takes the totals of LANES splats, times a scale, channel by channel, and sets them to 0. Returns whether any of them
   was not 0. */
inline int take_totals(global long *totals, float scale, vfloat *sums)
{
    global long4 *splats = (global long4 *)totals;
#if LANES == 1
    const long4 total = splats[0];
    if (!(total.x | total.y | total.z | total.w))
        return 0;
    splats[0] = (long4)(0);
    sums[0] = (float)total.x * scale;
    sums[1] = (float)total.y * scale;
    sums[2] = (float)total.z * scale;
    sums[3] = (float)total.w * scale;
    return 1;
#else
    long4 all = splats[0];
    for (int lane = 1; lane < LANES; ++lane)
        all |= splats[lane];
    if (!(all.x | all.y | all.z | all.w))
        return 0;
    float values[4 * LANES];
    for (int lane = 0; lane < LANES; ++lane) {
        /* In two parts of 32 bits: conversions of 64 are calls on some CPU runtimes. */
        const long4 total = splats[lane], high = (total + (1l << 30)) >> 31;
        const float4 value =
            MAD(convert_float4(convert_int4(high)),
                (float4)(0x1p31f),
                convert_float4(convert_int4(total - (high << 31))));
        vstore4(value * scale, lane, values);
        splats[lane] = (long4)(0);
    }
    vfloat four[4];
    for (int k = 0; k < 4; ++k)
        four[k] = VLOAD(k, values);
    separate(four, &sums[0], &sums[1], &sums[2], &sums[3]);
    return 1;
#endif
}

/* Numbers of less than 62 bits as integers, with the fraction cut off; in two parts, as to_fixed of totals.clh. */
inline vlong to_fixed_lanes(vfloat value)
{
    const vint high = CONVERT_VINT(value * 0x1p-31f);
    const vint low = CONVERT_VINT(value - CONVERT_VFLOAT(high) * 0x1p31f);
    return (CONVERT_VLONG(high) << 31) + CONVERT_VLONG(low);
}

#if PICKED && LANES > 1
inline vlong load_sums(Place place, global const long *column)
{
    long values[LANES];
    for (int lane = 0; lane < LANES; ++lane)
        values[lane] = column[place[lane]];
    return VLOAD(0, values);
}

inline void store_sums(vlong sums, Place place, const int there[LANES], global long *column)
{
    long values[LANES];
    VSTORE(sums, 0, values);
    for (int lane = 0; lane < LANES; ++lane)
        if (there[lane])
            column[place[lane]] = values[lane];
}
#define LOAD_SUMS(place, column) load_sums(place, column)
#define STORE_SUMS(sums, place, column) store_sums(sums, place, there, column)
#else
#define LOAD_SUMS(place, column) VLOAD(place, column)
#define STORE_SUMS(sums, place, column) VSTORE(sums, place, column)
#endif

/* A work-item has one view, and nothing to keep of the results between views: it adds some at a time, so that all fits
   the registers of any GPU. */
#define ONE_VIEW (PICKED && LANES == 1)
#define AT_A_TIME 12

#if WEIGHTS && !PICKED
/* Views whose parts of the blocks are found before any of them is added: blocks come from memory, once for so many. */
#define OF_BLOCKS 4

/* blocks += the sum of w^2 x basis x basis of some views. */
inline void add_blocks(
    int views,
    const vfloat *weights,
    const VREAL basis[OF_BLOCKS][SH_COUNT],
    size_t block,
    ulong block_stride,
    global long *blocks)
{
    for (int i = 0; i < SH_COUNT; ++i)
        for (int j = i; j < SH_COUNT; ++j) {
            global long *column = blocks + AT(i, j) * block_stride;
            vlong sum = VLOAD(block, column);
            for (int k = 0; k < views; ++k)
                sum += to_fixed_lanes(weights[k] * basis[k][i] * basis[k][j]);
            VSTORE(sum, block, column);
        }
}
#endif

/* The totals of some of a set's views, times the view's scale, onto the coefficients: result += basis x (Y, Co, Cg) of
   the free channels' sums, view by view; on CPUs not for those that none of LANES splats may change, whose sums nobody
   looks at. What views have lies `apart`. With WEIGHTS also blocks += the sum of
   w^2 x basis x basis, for `block_stride` splats from number `first_block` on. Both are columns of integers; the scales
   say what is 1. Leaves the totals zero. */
kernel void gather(
    global long *totals,
    global const float *means,
    global const uint *active,
    ulong stride,
    ulong apart,
    global const uint *numbers,
    global const SetView *views,
    uint first_view,
    uint view_count,
    global const float *scales,
    uint first_scale,
    global const uchar *free,
    ulong first_free,
    global long *result,
    ulong first_block,
    ulong block_stride,
    global long *blocks)
{
    const size_t index = get_global_id(0);
#if PICKED && LANES > 1
    uint splat[LANES];
    int there[LANES];
    if (!read_place(numbers + first_view * apart + LANES * index, splat, there))
        return;
#elif PICKED
    const uint splat = numbers[first_view * apart + index];
    if (splat == NO_SPLAT)
        return;
#else
    const size_t splat = index;
#endif
#if !ONE_VIEW
    vlong results[3 * SH_COUNT];
    int any_view = 0;
#endif
#if LANES > 1
    Changing changing;
#endif
#if WEIGHTS && !PICKED
    const size_t block = index - first_block / LANES;
    const int has_block = !SOME_BLOCKS || (index >= first_block / LANES && block < block_stride / LANES);
    vfloat weights[OF_BLOCKS];
    VREAL bases[OF_BLOCKS][SH_COUNT];
    int views_of_block = 0;
#endif
    for (uint number = first_view; number < first_view + view_count; ++number) {
        const size_t place = number * apart / LANES + index;
        vfloat sums[4];
        const int any_sum = take_totals(totals + (size_t)TOTALS * LANES * place, scales[first_scale + number], sums);
        if (!any_sum)
            continue;
#if !ONE_VIEW
#if LANES > 1
        if (!any_view) {
            changing_coefficients(active, stride, splat, &changing);
            for (int c = 0; c < 3; ++c)
                for (uint k = 0; k < changing.counts[c]; ++k)
                    results[c * SH_COUNT + k] = LOAD_SUMS(splat, result + (3 * changing.rows[c][k] + c) * stride);
        }
#else
        if (!any_view)
            for (int i = 0; i < 3 * SH_COUNT; ++i)
                results[i] = LOAD_SUMS(splat, result + i * stride);
#endif
        any_view = 1;
#endif
        VREAL basis[SH_COUNT];
        basis_towards(means, stride, splat, &views[number].view, basis);
        const vint kept = CONVERT_VINT(VLOAD(place, free + first_free));
        const vfloat r = (kept & 1) != 0 ? sums[0] : (vfloat)(0.0f);
        const vfloat g = (kept & 2) != 0 ? sums[1] : (vfloat)(0.0f);
        const vfloat b = (kept & 4) != 0 ? sums[2] : (vfloat)(0.0f);
        const vfloat channels[3] = {r + g + b, r - b, g - r - b};
#if ONE_VIEW
        for (int first = 0; first < 3 * SH_COUNT; first += AT_A_TIME) {
            long some[AT_A_TIME];
            for (int i = 0; i < AT_A_TIME && first + i < 3 * SH_COUNT; ++i)
                some[i] = result[splat + (first + i) * stride];
            for (int i = 0; i < AT_A_TIME && first + i < 3 * SH_COUNT; ++i)
                result[splat + (first + i) * stride] =
                    some[i] + to_fixed_lanes(basis[(first + i) / 3] * channels[(first + i) % 3]);
        }
#elif LANES > 1
        for (int c = 0; c < 3; ++c)
            for (uint k = 0; k < changing.counts[c]; ++k)
                results[c * SH_COUNT + k] += to_fixed_lanes(basis[changing.rows[c][k]] * channels[c]);
#else
        for (int m = 0; m < SH_COUNT; ++m)
            for (int c = 0; c < 3; ++c)
                results[3 * m + c] += to_fixed_lanes(basis[m] * channels[c]);
#endif
#if WEIGHTS && PICKED && LANES > 1
        const vfloat weight = sums[3];
        for (int i = 0; i < SH_COUNT; ++i)
            for (int j = i; j < SH_COUNT; ++j) {
                global long *column = blocks + AT(i, j) * block_stride;
                long more[LANES];
                VSTORE(to_fixed_lanes(weight * basis[i] * basis[j]), 0, more);
                for (int lane = 0; lane < LANES; ++lane) {
                    const size_t block = splat[lane] - first_block; /* of splats before the first one it is far beyond */
                    if (there[lane] && block < block_stride)
                        column[block] += more[lane];
                }
            }
#elif WEIGHTS
        weights[views_of_block] = sums[3];
        for (int m = 0; m < SH_COUNT; ++m)
            bases[views_of_block][m] = basis[m];
        if (++views_of_block == OF_BLOCKS) {
            if (has_block)
                add_blocks(OF_BLOCKS, weights, bases, block, block_stride, blocks);
            views_of_block = 0;
        }
#endif
    }
#if WEIGHTS && !PICKED
    if (has_block && views_of_block)
        add_blocks(views_of_block, weights, bases, block, block_stride, blocks);
#endif
#if LANES > 1
    if (any_view)
        for (int c = 0; c < 3; ++c)
            for (uint k = 0; k < changing.counts[c]; ++k)
                STORE_SUMS(results[c * SH_COUNT + k], splat, result + (3 * changing.rows[c][k] + c) * stride);
#elif !ONE_VIEW
    if (any_view)
        for (int i = 0; i < 3 * SH_COUNT; ++i)
            STORE_SUMS(results[i], splat, result + i * stride);
#endif
}

#if LANES == 1
/* The blocks' part of what `gather` does with WEIGHTS, before that takes the totals away without: for `block_stride`
   splats from number `first_block` on.

   A work-item has row get_global_id(1) of a splat's block, and the row that is as far from the end, which together are
   as long as any other two. It adds up all views before it writes. A GPU whose work-items each wrote a whole block
   again for every view did nothing else. */
kernel void gather_blocks(
    global const long *totals,
    global const float *means,
    ulong stride,
    ulong apart,
    global const uint *numbers,
    global const SetView *views,
    uint first_view,
    uint view_count,
    global const float *scales,
    uint first_scale,
    ulong first_block,
    ulong block_stride,
    global long *blocks)
{
#if PICKED
    const size_t index = get_global_id(0);
    if (index >= apart)
        return;
    const uint splat = numbers[first_view * apart + index];
    const size_t block = splat - first_block; /* of splats before the first one it is far beyond the last */
    if (splat == NO_SPLAT || block >= block_stride)
        return;
#else
    const size_t block = get_global_id(0), index = first_block + block, splat = index;
    if (block >= block_stride || splat >= stride)
        return;
#endif
    const int row = get_global_id(1), last = SH_COUNT - 1 - row;
    /* Element j of the row, or, before its beginning, element SH_COUNT - 1 - j of the last row; and the latter's first
       one, on the diagonal. */
    long found[SH_COUNT], diagonal = 0;
    for (int j = 0; j < SH_COUNT; ++j)
        found[j] = 0;
    int any = 0;
    for (uint number = first_view; number < first_view + view_count; ++number) {
        const long total = totals[TOTALS * (number * apart + index) + 3];
        if (!total)
            continue;
        any = 1;
        const float weight = (float)total * scales[first_scale + number];
        float basis[SH_COUNT], own = 0.0f, its = 0.0f;
        basis_towards(means, stride, splat, &views[number].view, basis);
        for (int m = 0; m < SH_COUNT; ++m) {
            own = m == row ? basis[m] : own;
            its = m == last ? basis[m] : its;
        }
        for (int j = 0; j < SH_COUNT; ++j)
            found[j] += to_fixed_lanes(weight * (j < row ? its : own) * basis[j < row ? SH_COUNT - 1 - j : j]);
        diagonal += to_fixed_lanes(weight * its * its);
    }
    if (!any)
        return;
    for (int j = 0; j < SH_COUNT; ++j)
        if (j >= row)
            blocks[AT(row, j) * block_stride + block] += found[j];
        else if (last != row)
            blocks[AT(last, SH_COUNT - 1 - j) * block_stride + block] += found[j];
    if (last != row)
        blocks[AT(last, last) * block_stride + block] += diagonal;
}
#endif

/* result += unit x sums from number `first` on, and these become 0. One number a work-item. */
kernel void from_fixed(global long *sums, ulong first, float unit, global float *result)
{
    const size_t i = get_global_id(0);
    const long sum = sums[first + i], high = (sum + (1l << 30)) >> 31;
    /* In two parts of 32 bits: conversions of 64 are calls on some CPU runtimes. */
    const float value = MAD((float)(int)high, 0x1p31f, (float)(int)(sum - (high << 31)));
    result[i] = MAD(value, unit, result[i]);
    sums[first + i] = 0;
}
