/* Levels to single precision values (docs/format.md, "Attributes" and "Single precision").
 *
 * Each operation is rounded by itself: the build forbids to fuse multiplications and additions.
 *
 * Levels come in three kinds: *narrow*, one byte each, mapped to unsigned as the format says where they are signed;
 * *medium*, the values themselves in 32 bits, below 2^29 in magnitude; and *wide*, the same in 64 bits, any. */

#include <math.h>

#include "prediction.h"

static INLINE int32_t from_zigzag(uint8_t u)
{
    return (int32_t)(u >> 1) ^ -(int32_t)(u & 1);
}

/* n bytes to medium levels, undoing the mapping if they are signed. */
POTR_EXPORT void potr_widen(const uint8_t *restrict narrow, size_t n, int is_signed, int32_t *restrict medium)
{
    for (size_t i = 0; i < n; i++)
        medium[i] = is_signed ? from_zigzag(narrow[i]) : narrow[i];
}

/* n integers of some byte planes (planes, n): to medium ones, if there are at most 3 planes, or to wide ones. */
#define JOIN_PLANES(kind, type) \
    POTR_EXPORT void potr_join_planes_##kind( \
        const uint8_t *restrict raw, size_t n, unsigned planes, int is_signed, type *restrict levels) \
    { \
        for (size_t i = 0; i < n; i++) { \
            type u = 0; \
            for (unsigned p = planes; p-- > 0;) \
                u = u << 8 | raw[p * n + i]; \
            levels[i] = is_signed ? u >> 1 ^ (0 - (u & 1)) : u; \
        } \
    }

JOIN_PLANES(medium, uint32_t)
JOIN_PLANES(wide, uint64_t)

/* Y, Co, Cg of n splats to R, G, B. Sums of wide levels wrap round. divisors: one for each splat, or the same for all
 * if `each` is 0. */
#define COLOURS(kind, type, read, number, whole) \
    static INLINE void colours_of_##kind( \
        const type *restrict y, const type *restrict co, const type *restrict cg, size_t n, \
        const float *restrict divisors, int each, float *restrict red, float *restrict green, float *restrict blue) \
    { \
        const float same = divisors[0]; \
        for (size_t i = 0; i < n; i++) { \
            const number luma = read(y[i]), orange = read(co[i]), emerald = read(cg[i]); \
            const number rest = luma - emerald; \
            const float divisor = each ? divisors[i] : same; \
            red[i] = (float)(whole)(rest + orange) / divisor; \
            green[i] = (float)(whole)(luma + emerald) / divisor; \
            blue[i] = (float)(whole)(rest - orange) / divisor; \
        } \
    } \
    POTR_EXPORT void potr_colours_of_##kind( \
        const type *restrict y, const type *restrict co, const type *restrict cg, size_t n, \
        const float *restrict divisors, int each, float *restrict red, float *restrict green, float *restrict blue) \
    { \
        if (n == 0) \
            return; \
        if (each) \
            colours_of_##kind(y, co, cg, n, divisors, 1, red, green, blue); \
        else \
            colours_of_##kind(y, co, cg, n, divisors, 0, red, green, blue); \
    }

COLOURS(narrow, uint8_t, from_zigzag, int32_t, int32_t)
COLOURS(medium, int32_t, , int32_t, int32_t)
COLOURS(wide, uint64_t, , uint64_t, int64_t)

/* DC of n splats: what its prediction has left of Y, Co, Cg to R, G, B. classes: from 0 on. steps, inverses, factors:
 * (64,), of each class. */
#define DC(kind, type, read) \
    DC_OF(dc_runs_##kind, type, read) \
    POTR_EXPORT void potr_dc_of_##kind( \
        const type *restrict y, const type *restrict co, const type *restrict cg, size_t n, \
        const uint8_t *restrict classes, const uint64_t *steps, const uint64_t *inverses, const float *factors, \
        float *restrict red, float *restrict green, float *restrict blue) \
    { \
        const dc_steps of = { steps, inverses, factors }; \
        const size_t four = n / (SIDE_BY_SIDE * RUN) * SIDE_BY_SIDE * RUN; \
        for (size_t at = 0; at < four; at += SIDE_BY_SIDE * RUN) \
            dc_runs_##kind(&of, y + at, co + at, cg + at, classes + at, 1, RUN, SIDE_BY_SIDE, RUN, red + at, green + at, \
                blue + at); \
        for (size_t at = four; at < n; at += RUN) \
            dc_runs_##kind(&of, y + at, co + at, cg + at, classes + at, 1, RUN, 1, n - at < RUN ? n - at : RUN, \
                red + at, green + at, blue + at); \
    }

static INLINE int64_t whole(int64_t level)
{
    return level;
}

DC(narrow, uint8_t, from_zigzag)
DC(medium, int32_t, whole)
DC(wide, int64_t, whole)

/* Values of n unsigned levels from a table, every `stride`-th number of `out`. Returns how many are beyond it: these
 * are left as they are. Tables have 256 entries at least, so that no narrow level is. */
#define LOOK_UP(kind, type) \
    POTR_EXPORT uint64_t potr_look_up_##kind( \
        const type *restrict levels, size_t n, const float *restrict table, size_t entries, float *restrict out, \
        size_t stride) \
    { \
        uint64_t beyond = 0; \
        for (size_t i = 0; i < n; i++) \
            if (levels[i] < entries) \
                out[i * stride] = table[levels[i]]; \
            else \
                beyond++; \
        return beyond; \
    }

LOOK_UP(narrow, uint8_t)
LOOK_UP(medium, uint32_t)
LOOK_UP(wide, uint64_t)

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
#define ROTATIONS(kind, type, read) \
    POTR_EXPORT void potr_rotations_of_##kind( \
        const type *restrict x, const type *restrict y, const type *restrict z, size_t n, \
        const float *restrict factors, size_t step, float *restrict out) \
    { \
        for (size_t i = 0; i < n; i++) \
            rotation((float)read(x[i]), (float)read(y[i]), (float)read(z[i]), factors[i * step], out + 4 * i); \
    }

ROTATIONS(narrow, uint8_t, from_zigzag)
ROTATIONS(medium, int32_t, )
ROTATIONS(wide, int64_t, )
