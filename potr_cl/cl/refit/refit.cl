/* The re-fit's stages on splats and coefficients, LANES splats a work-item.

   Coefficient vectors are SH_COUNT x 3 columns of `stride` floats each, column 3 m + c: coefficient m, channel c of
   Y, Co, Cg. R = Y + Co - Cg, G = Y + Cg, B = Y - Co - Cg.

   Macros: LANES, SH_COUNT, WEIGHTS (1: the totals hold the sums of w^2 too, and of the kernels there is gather
   alone, which takes them). */

#define DOUBLE 0
#include "include/reals.clh"
#include "include/sh_basis.clh"
#include "include/splat.clh"
#include "include/view_set.clh"

#define TOTALS 4
#define TRIANGLE (SH_COUNT * (SH_COUNT + 1) / 2)
/* Element i, j of a packed upper triangle, i <= j. */
#define AT(i, j) ((i) * (2 * SH_COUNT - (i) - 1) / 2 + (j))
/* The diagonal's least part of its mean: columns that no view tells apart get no huge steps. */
#define DAMPING 1e-5f
/* The least part of its diagonal that a pivot keeps; below, the coefficient is left as it is. */
#define LEAST_PIVOT 1e-6f
/* Added to the unit diagonal of a scaled block before it is inverted in single precision. */
#define UNIT_DAMPING 1e-4f

/* 1 where a coefficient may change, 0 where not. */
inline vfloat active_lanes(global const uint *active, size_t stride, size_t index, size_t column)
{
    const vint words = VLOAD(index, (global const int *)(active + column / 24 * stride));
    return CONVERT_VFLOAT(words >> (int)(column % 24) & 1);
}

inline void basis_towards(global const float *means, size_t stride, size_t index, global const View *view, vfloat *values)
{
    const vfloat x = (VLOAD(index, means) - view->camera_centre_high[0]) - view->camera_centre_low[0];
    const vfloat y = (VLOAD(index, means + stride) - view->camera_centre_high[1]) - view->camera_centre_low[1];
    const vfloat z = (VLOAD(index, means + 2 * stride) - view->camera_centre_high[2]) - view->camera_centre_low[2];
    const vfloat length = sqrt(x * x + y * y + z * z);
    const vfloat inverse = 1.0f / (length > 0.0f ? length : (vfloat)(1.0f));
    sh_basis(x * inverse, y * inverse, z * inverse, values);
}

/* The channels of LANES splats' colours that are not cut at 0: 1, 2, 4. */
inline vint free_channels(global const float4 *colours, size_t place)
{
#if LANES == 1
    return (int)colours[place].w;
#else
    vfloat four[4], red, green, blue, channels;
    for (int k = 0; k < 4; ++k)
        four[k] = VLOAD(4 * place + k, (global const float *)colours);
    separate(four, &red, &green, &blue, &channels);
    return CONVERT_VINT(channels);
#endif
}

#if !WEIGHTS
/* The splats' colours in each view of a set: of the coefficients themselves (direction == 0), cut at 0, w telling which
   channels are free (1, 2, 4: above 0); or their change along a direction, 0 where `free` says that the channel is cut.
   Work-item i of the second dimension does views i, i + get_global_size(1), … */
kernel void view_colours(
    global const float *coefficients,
    global const float *means,
    uint stride_,
    global const SetView *views,
    uint view_count,
    int direction,
    float unit,
    global const float4 *free,
    global float4 *colours)
{
    const size_t index = get_global_id(0), stride = stride_;
    vfloat values[3 * SH_COUNT];
    for (int i = 0; i < 3 * SH_COUNT; ++i)
        values[i] = VLOAD(index, coefficients + i * stride);
    for (uint number = get_global_id(1); number < view_count; number += get_global_size(1)) {
        VREAL basis[SH_COUNT];
        basis_towards(means, stride, index, &views[number].view, basis);
        vfloat sums[3] = {(vfloat)(0.0f), (vfloat)(0.0f), (vfloat)(0.0f)};
        for (int m = 0; m < SH_COUNT; ++m)
            for (int c = 0; c < 3; ++c)
                sums[c] = MAD(basis[m], values[3 * m + c], sums[c]);
        vfloat red = sums[0] + sums[1] - sums[2], green = sums[0] + sums[2], blue = sums[0] - sums[1] - sums[2];
        vfloat channels = (vfloat)(0.0f);
        const size_t place = number * stride / LANES + index;
        if (direction) {
            const vint kept = free_channels(free, place);
            red = (kept & 1) != 0 ? red * unit : (vfloat)(0.0f);
            green = (kept & 2) != 0 ? green * unit : (vfloat)(0.0f);
            blue = (kept & 4) != 0 ? blue * unit : (vfloat)(0.0f);
        } else {
            red = fmin(red + 0.5f, (vfloat)(1e30f));
            green = fmin(green + 0.5f, (vfloat)(1e30f));
            blue = fmin(blue + 0.5f, (vfloat)(1e30f));
            channels = (red > 0.0f ? (vfloat)(1.0f) : (vfloat)(0.0f)) + (green > 0.0f ? (vfloat)(2.0f) : (vfloat)(0.0f)) +
                (blue > 0.0f ? (vfloat)(4.0f) : (vfloat)(0.0f));
            red = fmax(red, (vfloat)(0.0f));
            green = fmax(green, (vfloat)(0.0f));
            blue = fmax(blue, (vfloat)(0.0f));
        }
#if LANES == 1
        colours[place] = (float4)(red, green, blue, channels);
#else
        vfloat four[4];
        interleave(red, green, blue, channels, four);
        for (int k = 0; k < 4; ++k)
            VSTORE(four[k], 4 * place + k, (global float *)colours);
#endif
    }
}
#endif

/* The totals of LANES splats times a scale, channel by channel; they become 0. Whether any was not. */
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
            MAD(convert_float4(convert_int4(high)), (float4)(0x1p31f), convert_float4(convert_int4(total - (high << 31))));
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

/* The totals of a set's views, times the view's scale, onto the coefficients: result += basis x (Y, Co, Cg) of the free
   channels' sums, view by view-> With WEIGHTS also gram += the sum of w^2 x basis x basis. Leaves the totals zero. */
kernel void gather(
    global long *totals,
    global const float *means,
    uint stride_,
    global const SetView *views,
    uint view_count,
    global const float *scales,
    uint first_scale,
    global const float4 *free,
    global float *result,
    global float *gram)
{
    const size_t index = get_global_id(0), stride = stride_;
    vfloat results[3 * SH_COUNT];
    int any_view = 0;
    for (uint number = 0; number < view_count; ++number) {
        const size_t place = number * stride / LANES + index;
        vfloat sums[4];
        const int any_sum = take_totals(totals + (size_t)TOTALS * LANES * place, scales[first_scale + number], sums);
        if (!any_sum)
            continue;
        if (!any_view)
            for (int i = 0; i < 3 * SH_COUNT; ++i)
                results[i] = VLOAD(index, result + i * stride);
        any_view = 1;
        VREAL basis[SH_COUNT];
        basis_towards(means, stride, index, &views[number].view, basis);
        const vint kept = free_channels(free, place);
        const vfloat r = (kept & 1) != 0 ? sums[0] : (vfloat)(0.0f);
        const vfloat g = (kept & 2) != 0 ? sums[1] : (vfloat)(0.0f);
        const vfloat b = (kept & 4) != 0 ? sums[2] : (vfloat)(0.0f);
        const vfloat channels[3] = {r + g + b, r - b, g - r - b};
        for (int m = 0; m < SH_COUNT; ++m)
            for (int c = 0; c < 3; ++c)
                results[3 * m + c] = MAD(basis[m], channels[c], results[3 * m + c]);
#if WEIGHTS
        const vfloat weight = sums[3];
        for (int i = 0; i < SH_COUNT; ++i)
            for (int j = i; j < SH_COUNT; ++j) {
                global float *column = gram + AT(i, j) * stride;
                VSTORE(MAD(weight * basis[i], basis[j], VLOAD(index, column)), index, column);
            }
#endif
    }
    if (any_view)
        for (int i = 0; i < 3 * SH_COUNT; ++i)
            VSTORE(results[i], index, result + i * stride);
}

#if !WEIGHTS
/* sums += (lambda, on AC only, + prior) x coefficients, and 0 where a coefficient is not active. */
kernel void regularise(
    global float *sums,
    global const float *coefficients,
    global const uint *active,
    uint stride_,
    float lambda_luma,
    float lambda_chroma,
    float prior)
{
    const size_t index = get_global_id(0), stride = stride_;
    for (int m = 0; m < SH_COUNT; ++m)
        for (int c = 0; c < 3; ++c) {
            const size_t column = 3 * m + c;
            const float pull = prior + (m == 0 ? 0.0f : c == 0 ? lambda_luma : lambda_chroma);
            const vfloat value =
                MAD(pull, VLOAD(index, coefficients + column * stride), VLOAD(index, sums + column * stride));
            VSTORE(value * active_lanes(active, stride, index, column), index, sums + column * stride);
        }
}

/* result = the inverse of each splat's own block of the normal equations, restricted to the active coefficients, times
   residual: a Cholesky factorisation a channel. The squared lengths of Y, Co and Cg in R, G, B are 3, 2 and 3. */
kernel void precondition(
    global const float *residual,
    global const float *gram,
    global const uint *active,
    uint stride_,
    float lambda_luma,
    float lambda_chroma,
    float prior,
    global float *result)
{
    const size_t index = get_global_id(0), stride = stride_;
    vfloat trace = (vfloat)(0.0f);
    for (int i = 0; i < SH_COUNT; ++i)
        trace += VLOAD(index, gram + AT(i, i) * stride);
    for (int c = 0; c < 3; ++c) {
        const float length = c == 1 ? 2.0f : 3.0f;
        const float lambda = c == 0 ? lambda_luma : lambda_chroma;
        const vfloat least = trace * (DAMPING * length / SH_COUNT);
        /* Row by row, U with U^T U = block; the diagonal holds the pivots' inverse square roots, 0 for what is left out. */
        vfloat factor[TRIANGLE], y[SH_COUNT];
        for (int j = 0; j < SH_COUNT; ++j) {
            const size_t column = 3 * j + c;
            const vfloat diagonal = MAD(length, VLOAD(index, gram + AT(j, j) * stride), least + (prior + (j ? lambda : 0.0f)));
            vfloat pivot = diagonal, rest = VLOAD(index, residual + column * stride);
            for (int i = 0; i < j; ++i) {
                pivot = MAD(-factor[AT(i, j)], factor[AT(i, j)], pivot);
                rest = MAD(-factor[AT(i, j)], y[i], rest);
            }
            const vint keep = (pivot > LEAST_PIVOT * diagonal) && (pivot > 1e-30f);
            const vfloat inverse = (keep ? 1.0f / sqrt(pivot) : (vfloat)(0.0f)) * active_lanes(active, stride, index, column);
            factor[AT(j, j)] = inverse;
            y[j] = rest * inverse;
            for (int k = j + 1; k < SH_COUNT; ++k) {
                vfloat sum = length * VLOAD(index, gram + AT(j, k) * stride);
                for (int i = 0; i < j; ++i)
                    sum = MAD(-factor[AT(i, j)], factor[AT(i, k)], sum);
                factor[AT(j, k)] = sum * inverse * active_lanes(active, stride, index, 3 * k + c);
            }
        }
        for (int j = SH_COUNT - 1; j >= 0; --j) {
            for (int k = j + 1; k < SH_COUNT; ++k)
                y[j] = MAD(-factor[AT(j, k)], y[k], y[j]);
            y[j] *= factor[AT(j, j)];
            VSTORE(y[j], index, result + (3 * j + c) * stride);
        }
    }
}

/* Give up AC coefficients, splat by splat and channel by channel: again and again the one whose loss costs least, the others
   of its channel making up for it as well as they can, while it costs less than `least` (by the splat's own block of the
   normal equations, the rest of the scene held). With P the inverse of the block, losing x_m costs x_m^2 / P_mm, moves the
   others by -x_m P_jm / P_mm, and takes P_im P_jm / P_mm off P. */
kernel void select_active(
    global float *coefficients,
    global const float *gram,
    global uint *active,
    uint stride_,
    float prior,
    float least)
{
    const size_t index = get_global_id(0), stride = stride_;
    for (int c = 0; c < 3; ++c) {
        const float length = c == 1 ? 2.0f : 3.0f;
        /* Scaled to a unit diagonal; what is not active has an empty row and column. */
        vfloat p[TRIANGLE], x[SH_COUNT], scale[SH_COUNT], keep[SH_COUNT];
        for (int j = 0; j < SH_COUNT; ++j) {
            const vfloat diagonal = MAD(length, VLOAD(index, gram + AT(j, j) * stride), (vfloat)(prior));
            keep[j] = active_lanes(active, stride, index, 3 * j + c);
            scale[j] = sqrt(fmax(diagonal, (vfloat)(1e-30f)));
            x[j] = keep[j] * scale[j] * VLOAD(index, coefficients + (3 * j + c) * stride);
        }
        for (int i = 0; i < SH_COUNT; ++i)
            for (int j = i; j < SH_COUNT; ++j) {
                const vfloat product = length * VLOAD(index, gram + AT(i, j) * stride) / (scale[i] * scale[j]);
                p[AT(i, j)] = i == j ? (vfloat)(1.0f + UNIT_DAMPING) : product * keep[i] * keep[j];
            }
        /* p becomes minus the inverse: one sweep a column, symmetric all the way. */
        for (int k = 0; k < SH_COUNT; ++k) {
            vfloat column[SH_COUNT];
            for (int j = 0; j < SH_COUNT; ++j)
                column[j] = j < k ? p[AT(j, k)] : p[AT(k, j)];
            const vfloat inverse = 1.0f / fmax(column[k], (vfloat)(UNIT_DAMPING));
            for (int i = 0; i < SH_COUNT; ++i)
                for (int j = i; j < SH_COUNT; ++j)
                    if (i == k || j == k)
                        p[AT(i, j)] = i == j ? -inverse : column[i == k ? j : i] * inverse;
                    else
                        p[AT(i, j)] = MAD(-column[i] * inverse, column[j], p[AT(i, j)]);
        }
        for (int round = 1; round < SH_COUNT; ++round) {
            vfloat best = (vfloat)(least);
            vint worst = (vint)(0);
            for (int m = 1; m < SH_COUNT; ++m) {
                const vfloat cost = x[m] * x[m] / fmax(-p[AT(m, m)], (vfloat)(1e-30f));
                const vint cheaper = (keep[m] > 0.0f) && !(cost >= best);
                best = cheaper ? cost : best;
                worst = cheaper ? (vint)(m) : worst;
            }
            if (!VANY(worst > 0))
                break;
            vfloat column[SH_COUNT], value = (vfloat)(0.0f), pivot = (vfloat)(-1.0f);
            for (int j = 0; j < SH_COUNT; ++j) {
                column[j] = (vfloat)(0.0f);
                for (int m = 1; m < SH_COUNT; ++m)
                    column[j] = worst == m ? p[j < m ? AT(j, m) : AT(m, j)] : column[j];
            }
            for (int m = 1; m < SH_COUNT; ++m) {
                value = worst == m ? x[m] : value;
                pivot = worst == m ? p[AT(m, m)] : pivot;
                keep[m] = worst == m ? (vfloat)(0.0f) : keep[m];
            }
            const vfloat inverse = 1.0f / fmin(pivot, (vfloat)(-1e-30f));
            for (int i = 0; i < SH_COUNT; ++i) {
                x[i] = (MAD(-column[i] * inverse, value, x[i])) * (i ? keep[i] : (vfloat)(1.0f));
                for (int j = i; j < SH_COUNT; ++j)
                    p[AT(i, j)] = MAD(-column[i] * inverse, column[j], p[AT(i, j)]);
            }
        }
        for (int j = 0; j < SH_COUNT; ++j) {
            const size_t column = 3 * j + c;
            const vfloat was = VLOAD(index, coefficients + column * stride), value = x[j] / scale[j];
            const vint changed = active_lanes(active, stride, index, column) > 0.0f;
            VSTORE(changed ? (fabs(value) < 1e30f ? value : (vfloat)(0.0f)) : was, index, coefficients + column * stride);
            float kept[LANES];
            VSTORE(keep[j], 0, kept);
            for (int lane = 0; lane < LANES; ++lane)
                if (j && kept[lane] == 0.0f)
                    active[(column / 24) * stride + index * LANES + lane] &= ~(1u << (column % 24));
        }
    }
}

/* y = a y + b x. */
kernel void combine(float a, global float *y, float b, global const float *x)
{
    const size_t i = get_global_id(0);
    y[i] = a * y[i] + b * x[i];
}

/* parts[i] = sum of x y over every get_global_size(0)-th element from i on, in a fixed order; parts[size + i] = the largest
   |x| of them. */
kernel void dot_parts(global const float *x, global const float *y, ulong count, global float *parts)
{
    const size_t items = get_global_size(0), first = get_global_id(0);
    float sum = 0.0f, lost = 0.0f, largest = 0.0f;
    for (size_t i = first; i < count; i += items) {
        /* Kahan's compensated sum. */
        const float term = MAD(x[i], y[i], -lost);
        const float next = sum + term;
        lost = (next - sum) - term;
        sum = next;
        largest = fmax(largest, fabs(x[i]));
    }
    parts[first] = sum;
    parts[items + first] = largest;
}
#endif
