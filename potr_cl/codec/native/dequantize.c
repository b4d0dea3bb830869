/* Levels to single precision values (docs/format.md, "Attributes" and "Single precision").
 *
 * Each operation is rounded by itself: the build forbids to fuse multiplications and additions, and nothing here may be
 * compiled for processors on which that could not be told (POTR_WIDE_INTEGERS is not for floats).
 *
 * Levels come in two kinds: *narrow*, one byte each, mapped to unsigned as the format says where they are signed; and
 * *wide*, 64 bits each, the values themselves. */

#include <math.h>

#include "potr_native.h"

static INLINE int32_t from_zigzag(uint8_t u)
{
    return (int32_t)(u >> 1) ^ -(int32_t)(u & 1);
}

/* n bytes to 64-bit levels; undoing the mapping if they are signed. */
POTR_EXPORT void potr_widen(const uint8_t *restrict narrow, size_t n, int is_signed, int64_t *restrict wide)
{
    for (size_t i = 0; i < n; i++)
        wide[i] = is_signed ? from_zigzag(narrow[i]) : narrow[i];
}

/* n integers of some byte planes (planes, n) to 64-bit ones. */
POTR_EXPORT void potr_join_planes(
    const uint8_t *restrict raw, size_t n, unsigned planes, int is_signed, uint64_t *restrict wide)
{
    for (size_t i = 0; i < n; i++) {
        uint64_t u = 0;
        for (unsigned p = planes; p-- > 0;)
            u = u << 8 | raw[p * n + i];
        wide[i] = is_signed ? u >> 1 ^ (0 - (u & 1)) : u;
    }
}

/* Y, Co, Cg of n splats to R, G, B. */
POTR_EXPORT void potr_colours_of_narrow(
    const uint8_t *restrict y, const uint8_t *restrict co, const uint8_t *restrict cg, size_t n, float divisor,
    float *restrict red, float *restrict green, float *restrict blue)
{
    for (size_t i = 0; i < n; i++) {
        const int32_t luma = from_zigzag(y[i]), orange = from_zigzag(co[i]), emerald = from_zigzag(cg[i]);
        const int32_t rest = luma - emerald;
        red[i] = (float)(rest + orange) / divisor;
        green[i] = (float)(luma + emerald) / divisor;
        blue[i] = (float)(rest - orange) / divisor;
    }
}

/* The same of wide levels, whose sums wrap round. */
POTR_EXPORT void potr_colours_of_wide(
    const uint64_t *restrict y, const uint64_t *restrict co, const uint64_t *restrict cg, size_t n, float divisor,
    float *restrict red, float *restrict green, float *restrict blue)
{
    for (size_t i = 0; i < n; i++) {
        const uint64_t rest = y[i] - cg[i];
        red[i] = (float)(int64_t)(rest + co[i]) / divisor;
        green[i] = (float)(int64_t)(y[i] + cg[i]) / divisor;
        blue[i] = (float)(int64_t)(rest - co[i]) / divisor;
    }
}

/* Values of n levels from a table of 256, every `stride`-th number of `out`. */
POTR_EXPORT void potr_look_up_narrow(
    const uint8_t *restrict levels, size_t n, const float *restrict table, float *restrict out, size_t stride)
{
    for (size_t i = 0; i < n; i++)
        out[i * stride] = table[levels[i]];
}

/* The same of wide levels from a table of some entries. Returns how many are beyond it: these are left as they are. */
POTR_EXPORT uint64_t potr_look_up_wide(
    const uint64_t *restrict levels, size_t n, const float *restrict table, size_t entries, float *restrict out,
    size_t stride)
{
    uint64_t beyond = 0;
    for (size_t i = 0; i < n; i++)
        if (levels[i] < entries)
            out[i * stride] = table[levels[i]];
        else
            beyond++;
    return beyond;
}

/* A unit quaternion w, x, y, z. */
static INLINE void rotation(float x, float y, float z, float factor, float *out)
{
    const float a = x / factor, b = y / factor, c = z / factor;
    float rest = 1.0f - a * a;
    rest -= b * b;
    rest -= c * c;
    out[0] = sqrtf(rest > 0 ? rest : 0);
    out[1] = a;
    out[2] = b;
    out[3] = c;
}

/* Unit quaternions of n splats; x, y, z: levels. factors: one for each splat, or the same for all if `step` is 0. */
POTR_EXPORT void potr_rotations_of_narrow(
    const uint8_t *restrict x, const uint8_t *restrict y, const uint8_t *restrict z, size_t n,
    const float *restrict factors, size_t step, float *restrict out)
{
    for (size_t i = 0; i < n; i++)
        rotation((float)from_zigzag(x[i]), (float)from_zigzag(y[i]), (float)from_zigzag(z[i]), factors[i * step],
            out + 4 * i);
}

POTR_EXPORT void potr_rotations_of_wide(
    const int64_t *restrict x, const int64_t *restrict y, const int64_t *restrict z, size_t n,
    const float *restrict factors, size_t step, float *restrict out)
{
    for (size_t i = 0; i < n; i++)
        rotation((float)x[i], (float)y[i], (float)z[i], factors[i * step], out + 4 * i);
}
