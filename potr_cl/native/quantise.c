/* The encoder's loops over all splats: distances to views, canonical rotations, levels of all but centres.
 *
 * Each operation is rounded by itself, in the order of the NumPy modules (geometry.py, quantize.py), whose bits these
 * functions give: the build forbids to fuse multiplications and additions. */

#include <math.h>

#include "potr_native.h"

/* Splats worked on at a time: what a block needs stays in the nearest cache. */
#define BLOCK 256
/* The same where a splat has all SH coefficients. */
#define SH_BLOCK 64
/* Equivalent forms of a splat, and how many of them make a vector. */
#define FORMS 24
#define LANES 8

/* The least distance of n points (n, 3) to v others (v, 3). */
POTR_WIDE
POTR_EXPORT void potr_nearest(
    const float *restrict points, size_t n, const double *restrict others, size_t v, double *restrict nearest)
{
    double x[BLOCK], y[BLOCK], z[BLOCK], least[BLOCK];
    for (size_t start = 0; start < n; start += BLOCK) {
        const size_t some = n - start < BLOCK ? n - start : BLOCK;
        for (size_t i = 0; i < some; i++) {
            x[i] = points[3 * (start + i)];
            y[i] = points[3 * (start + i) + 1];
            z[i] = points[3 * (start + i) + 2];
            least[i] = INFINITY;
        }
        for (size_t k = 0; k < v; k++) {
            const double *other = others + 3 * k;
            for (size_t i = 0; i < some; i++) {
                const double dx = x[i] - other[0], dy = y[i] - other[1], dz = z[i] - other[2];
                const double square = dx * dx + dy * dy + dz * dz;
                least[i] = square < least[i] ? square : least[i];
            }
        }
        for (size_t i = 0; i < some; i++)
            nearest[start + i] = sqrt(least[i]);
    }
}

/* rint for what is small, in operations that become vectors everywhere. */
static INLINE double nearest_whole(double x)
{
    const double shift = 6755399441055744.0; /* 3 * 2^51: what is added to it has no digits behind the point */
    return (x + shift) - shift;
}

/* The equivalent form of a splat with the largest real part: its number, and imaginary parts of its quaternion.
 *
 * row: w, x, y, z, of any length. group: (4, 24) w, x, y, z of the axes' rotations, conjugated. */
static INLINE size_t canonical_form(const float *restrict row, const double *restrict group, double *restrict imaginary)
{
    const double a = row[0], b = row[1], c = row[2], d = row[3];
    const double length = sqrt(a * a + b * b + c * c + d * d);
    const double w = a / length, x = b / length, y = c / length, z = d / length;
    double real[FORMS], size[FORMS], lanes[LANES] = {0}, largest = 0;
    size_t best = 0;
    for (size_t k = 0; k < FORMS; k++) {
        /* Rounded, so that ties between equivalent forms fall the same way on every processor. */
        real[k] = nearest_whole(
            (w * group[k] + x * group[FORMS + k] + y * group[2 * FORMS + k] + z * group[3 * FORMS + k]) * 1e9);
        size[k] = fabs(real[k]);
    }
    for (size_t k = 0; k < FORMS; k += LANES)
        for (size_t lane = 0; lane < LANES; lane++)
            lanes[lane] = size[k + lane] > lanes[lane] ? size[k + lane] : lanes[lane];
    for (size_t lane = 0; lane < LANES; lane++)
        largest = lanes[lane] > largest ? lanes[lane] : largest;
    while (best < FORMS - 1 && size[best] < largest)
        best++;
    const double sign = real[best] < 0 ? -1 : 1;
    const double gw = group[best], gx = -group[FORMS + best], gy = -group[2 * FORMS + best],
                 gz = -group[3 * FORMS + best];
    imaginary[0] = sign * (w * gx + x * gw + y * gz - z * gy);
    imaginary[1] = sign * (w * gy - x * gz + y * gw + z * gx);
    imaginary[2] = sign * (w * gz + x * gy - y * gx + z * gw);
    return best;
}

/* The equivalent form with the largest real part of n splats, which `order` picks among some rows.
 *
 * quaternions: (rows, 4) w, x, y, z; log_scales: (rows, 3). group: as of canonical_form; permutations: (24, 3), the scales
 * that each form makes first, second and third. imaginary, turned: (n, 3). */
POTR_WIDE
POTR_EXPORT void potr_canonical(
    const float *restrict quaternions, const float *restrict log_scales, const int64_t *restrict order, size_t n,
    const double *restrict group, const uint8_t *restrict permutations, double *restrict imaginary,
    float *restrict turned)
{
    for (size_t i = 0; i < n; i++) {
        const float *scales = log_scales + 3 * order[i];
        const size_t form = canonical_form(quaternions + 4 * order[i], group, imaginary + 3 * i);
        for (size_t axis = 0; axis < 3; axis++)
            turned[3 * i + axis] = scales[permutations[3 * form + axis]];
    }
}

/* The whole number below x, of at most 31 bits; *fits becomes 0 where there is none. */
static INLINE int32_t floor_of(double x, int *fits)
{
    const int sound = (x > -2147483647.0) & (x < 2147483648.0);
    const double safe = sound ? x : 0.0;
    const int32_t whole = (int32_t)safe;
    *fits &= sound;
    return whole - (safe < whole);
}

static INLINE void widen(int32_t level, int32_t *largest)
{
    const int32_t size = level < 0 ? -level : level;
    *largest = size > *largest ? size : *largest;
}

/* Levels of the scales, rotations and opacities of n splats in their canonical forms, which `order` picks among some rows.
 *
 * quaternions, group, permutations: as of potr_canonical. sizes: (n, 3) standard deviations. logits: (rows) of
 * opacities, counted from `least` to `most`. levels: (7, stride), of which n are filled: three of scales, three of
 * rotations, opacities. largest: (7), of their magnitudes. Returns whether all fit; if not, what was filled means
 * nothing. */
POTR_WIDE
POTR_EXPORT int potr_splat_levels(
    const float *restrict quaternions, const double *restrict sizes, const float *restrict logits,
    const int64_t *restrict order, size_t n, const double *restrict group, const uint8_t *restrict permutations,
    double sf_scale, float sf_rotation, double sf_opacity, double least, double most, size_t stride,
    int32_t *restrict levels, int32_t *restrict largest)
{
    int fits = 1;
    for (size_t i = 0; i < n; i++) {
        const double *size = sizes + 3 * i;
        double imaginary[3];
        const size_t form = canonical_form(quaternions + 4 * order[i], group, imaginary);
        int32_t scales[3], longest = 1;
        for (size_t axis = 0; axis < 3; axis++) {
            scales[axis] = floor_of(size[permutations[3 * form + axis]] * sf_scale + 0.5, &fits);
            levels[axis * stride + i] = scales[axis];
            longest = scales[axis] > longest ? scales[axis] : longest;
            widen(scales[axis], &largest[axis]);
        }
        const float factor = sqrtf((float)longest) * sf_rotation;
        /* What is decoded as a ball has no direction. */
        const int ball = (scales[0] == scales[1]) & (scales[1] == scales[2]);
        for (size_t axis = 0; axis < 3; axis++) {
            const int32_t level = floor_of(imaginary[axis] * (double)factor + 0.5, &fits);
            levels[(3 + axis) * stride + i] = ball ? 0 : level;
            widen(level, &largest[3 + axis]);
        }
        const double logit = logits[order[i]], above = logit < least ? least : logit, kept = above > most ? most : above;
        const int32_t opacity = floor_of((kept - least) * sf_opacity + 0.5, &fits);
        levels[6 * stride + i] = opacity;
        widen(opacity, &largest[6]);
    }
    return fits;
}

/* R, G, B of `some` splats, which lie `step` floats apart, to Y, Co, Cg. */
static INLINE void to_ycocg(const float *rgb, size_t step, size_t some, double (*channels)[SH_BLOCK])
{
    for (size_t i = 0; i < some; i++, rgb += step) {
        const double r = rgb[0], half = rgb[1] * 0.5, b = rgb[2];
        channels[0][i] = r * 0.25 + half + b * 0.25;
        channels[1][i] = (r - b) * 0.5;
        channels[2][i] = half - (r + b) * 0.25;
    }
}

/* Levels of three channels of `some` splats that `order` picks, which lie `splat_step` apart in sh, to columns that are
 * `stride` apart. Returns whether all fit. */
static INLINE int three_levels(
    const float *restrict sh, size_t splat_step, size_t channel_step, const int64_t *restrict order, size_t some,
    const double *restrict factors, size_t stride, int16_t *restrict columns)
{
    float rgb[3 * SH_BLOCK];
    double channels[3][SH_BLOCK];
    int sound = 1;
    for (size_t i = 0; i < some; i++)
        for (size_t c = 0; c < 3; c++)
            rgb[3 * i + c] = sh[(size_t)order[i] * splat_step + c * channel_step];
    to_ycocg(rgb, 3, some, channels);
    for (size_t c = 0; c < 3; c++)
        for (size_t i = 0; i < some; i++) {
            const double level = channels[c][i] * factors[i] + 0.5; /* the whole number below it, that is */
            const int fits = (level >= -32767.0) & (level < 32768.0);
            const double safe = fits ? level : 0.0;
            const int32_t whole = (int32_t)safe;
            sound &= fits;
            columns[c * stride + i] = (int16_t)(whole - (safe < whole));
        }
    return sound;
}

/* Levels of the SH coefficients of n splats, which `order` picks among some: columns (count, 3, stride) in Y, Co, Cg, of
 * which those from `start` on are set.
 *
 * Coefficient m of channel c of splat i is sh[i * splat_step + m * three_step + c * channel_step]. dc, ac: (n,) scale
 * factors. Returns whether all levels fit; if not, what was set means nothing. */
POTR_EXPORT int potr_colour_levels(
    const float *restrict sh, size_t splat_step, size_t three_step, size_t channel_step, size_t count,
    const int64_t *restrict order, size_t n, const double *restrict dc, const double *restrict ac, size_t start,
    size_t stride, int16_t *restrict columns)
{
    const size_t blocks = (n + SH_BLOCK - 1) / SH_BLOCK;
    int sound = 1;
    for (size_t step = 0; step < blocks * count; step++) {
        /* Caches hold a column of coefficients, or the rows of a few splats: one is done before the next begins. */
        const size_t block = splat_step == 1 ? step % blocks : step / count;
        const size_t m = splat_step == 1 ? step / blocks : step % count;
        const size_t first = block * SH_BLOCK, some = n - first < SH_BLOCK ? n - first : SH_BLOCK;
        sound &= three_levels(
            sh + m * three_step, splat_step, channel_step, order + first, some, (m ? ac : dc) + first, stride,
            columns + 3 * m * stride + start + first);
    }
    return sound;
}

/* What the prediction of DC leaves of levels (docs/format.md, "Prediction"). Sums and products wrap round.
 *
 * levels, residuals: (channels, n). run: splats after which prediction begins anew. classes: (n) of the steps of DC, -32
 * to 31. steps, inverses: (64), of each class. */
POTR_EXPORT void potr_predicted(
    const int64_t *restrict levels, size_t channels, size_t n, size_t run, const int8_t *restrict classes,
    const uint64_t *restrict steps, const uint64_t *restrict inverses, int64_t *restrict residuals)
{
    for (size_t c = 0; c < channels; c++) {
        const int64_t *const from = levels + c * n;
        int64_t *const to = residuals + c * n;
        for (size_t start = 0; start < n; start += run) {
            const size_t stop = n - start < run ? n : start + run;
            uint64_t last[4] = {0, 0, 0, 0}, total = 0;
            for (size_t i = start; i < stop; i++) {
                const unsigned class = (unsigned)(classes[i] + 32) & 63;
                const int64_t mean = (int64_t)(total * inverses[class] + (UINT64_C(1) << 33)) >> 34;
                const uint64_t level = (uint64_t)from[i], value = level * steps[class];
                to[i] = (int64_t)(level - (uint64_t)mean);
                total += value - last[(i - start) & 3];
                last[(i - start) & 3] = value;
            }
        }
    }
}

/* Which of the coefficients, in Y, Co, Cg, have a level other than 0: columns (count, 3, n) of 0 and 1. Returns whether
 * no level is as large as `most`, or no number at all. */
POTR_EXPORT int potr_nonzero_levels(
    const float *restrict sh, size_t n, size_t count, double factor, double most, uint8_t *restrict columns)
{
    int sound = 1;
    for (size_t start = 0; start < n; start += SH_BLOCK) {
        const size_t some = n - start < SH_BLOCK ? n - start : SH_BLOCK;
        for (size_t m = 0; m < count; m++) {
            double channels[3][SH_BLOCK];
            to_ycocg(sh + 3 * (start * count + m), 3 * count, some, channels);
            for (size_t c = 0; c < 3; c++)
                for (size_t i = 0; i < some; i++) {
                    const double level = channels[c][i] * factor + 0.5; /* the whole number below it, that is */
                    sound &= fabs(level) < most;
                    columns[(3 * m + c) * n + start + i] = !((level >= 0) & (level < 1));
                }
        }
    }
    return sound;
}

/* n quaternions to ones of unit length; those of length 0 to the identity. The same bits as raster/activation.py. */
POTR_EXPORT void potr_unit_quaternions(const float *restrict quaternions, size_t n, float *restrict units)
{
    for (size_t i = 0; i < n; i++) {
        const float *q = quaternions + 4 * i;
        const double w = q[0], x = q[1], y = q[2], z = q[3];
        const double length = sqrt(w * w + x * x + y * y + z * z);
        const int nothing = length == 0;
        units[4 * i] = nothing ? 1.0f : (float)(w / length);
        units[4 * i + 1] = nothing ? 0.0f : (float)(x / length);
        units[4 * i + 2] = nothing ? 0.0f : (float)(y / length);
        units[4 * i + 3] = nothing ? 0.0f : (float)(z / length);
    }
}

/* Splats whose blocks are factored at a time, and the most coefficients of one. */
#define FACTORED 32
#define MOST_COEFFICIENTS 16

/* Unit upper triangles U with U^T D U = block for n splats, one step of all at a time. The same bits as
 * outputs/feedback.py.
 *
 * packed: (count (count + 1) / 2, all), the blocks' upper triangles, row by row; of it n columns from `first` on. columns:
 * (count (count - 1) / 2, n), what stands above the diagonals, column by column. */
POTR_EXPORT void potr_unit_factors(
    const float *restrict packed, size_t all, size_t first, size_t n, size_t count, float damping,
    float *restrict columns)
{
    float block[MOST_COEFFICIENTS][MOST_COEFFICIENTS][FACTORED], row[MOST_COEFFICIENTS][FACTORED];
    for (size_t start = 0; start < n; start += FACTORED) {
        const size_t some = n - start < FACTORED ? n - start : FACTORED;
        const float *from = packed + first + start;
        for (size_t m = 0; m < count; m++)
            for (size_t k = m; k < count; k++, from += all)
                for (size_t i = 0; i < FACTORED; i++)
                    block[m][k][i] = i < some ? from[i] : 0.0f;
        float size[FACTORED];
        for (size_t i = 0; i < FACTORED; i++)
            size[i] = block[0][0][i];
        for (size_t m = 1; m < count; m++)
            for (size_t i = 0; i < FACTORED; i++)
                size[i] = size[i] + block[m][m][i];
        for (size_t i = 0; i < FACTORED; i++)
            size[i] = size[i] / (float)count;
        for (size_t m = 0; m < count; m++)
            for (size_t i = 0; i < FACTORED; i++) {
                const float own = block[m][m][i] + damping * size[i];
                block[m][m][i] = size[i] <= 1e-30f ? 1.0f : own;
            }
        for (size_t m = 0; m + 1 < count; m++) {
            for (size_t k = m + 1; k < count; k++)
                for (size_t i = 0; i < FACTORED; i++)
                    row[k][i] = block[m][k][i] / block[m][m][i];
            for (size_t k = m + 1; k < count; k++)
                for (size_t j = k; j < count; j++)
                    for (size_t i = 0; i < FACTORED; i++)
                        block[k][j][i] = block[k][j][i] - block[m][j][i] * row[k][i];
            for (size_t k = m + 1; k < count; k++)
                for (size_t i = 0; i < some; i++)
                    columns[(k * (k - 1) / 2 + m) * n + start + i] = row[k][i];
        }
    }
}
