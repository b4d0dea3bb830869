/* Bundles' integers to single precision values (docs/format.md, "Single precision"), while they are in a cache.
 *
 * As in dequantize.c each operation is rounded by itself: nothing here may be compiled for several processors. */

#include <math.h>
#include <string.h>

#include "bundles.h"

/* Where the values of a file's splats go; NULL where they are not asked for. */
typedef struct {
    float *log_scales;  /* (N, 3) */
    float *quaternions; /* (N, 4) w, x, y, z */
    float *logits;      /* (N) */
    float *dc;          /* (3, N) R, G, B */
    float *ac;          /* (coefficients, 3, N), from coefficient 1 on; it holds zeros */
    const float *scale_table;   /* value of each level, */
    const float *opacity_table; /* and so many levels each */
    uint64_t scale_levels, opacity_levels;
    float sf_rotation, sf_dc, sf_ac;
    float unused;
} scene_values;

/* Values of a table for the levels in rows, every `stride`-th number of `out`; whether a level is beyond the table. */
static int look_up(
    const int32_t *rows, size_t lanes, size_t steps, size_t splats, const float *table, uint64_t levels, float *out,
    size_t stride)
{
    uint32_t most = 0;
    for (size_t i = 0; i < LANES * steps; i++)
        most = (uint32_t)rows[i] > most ? (uint32_t)rows[i] : most;
    if (most >= levels)
        return 1;
    for (size_t lane = 0, splat = 0; lane < lanes; lane++)
        for (size_t step = 0; step < steps && splat < splats; step++, splat++)
            out[splat * stride] = table[rows[step * LANES + lane]];
    return 0;
}

static void rotations(const work *w, float factor, size_t lanes, size_t steps, size_t splats, float *out)
{
    float x[LANE], y[LANE], z[LANE], factors[LANE], rest[LANE];
    for (size_t lane = 0; lane < lanes; lane++) {
        const size_t begin = lane * steps, number = splats - begin < steps ? splats - begin : steps;
        for (size_t step = 0; step < number; step++) {
            const size_t place = step * LANES + lane;
            int32_t largest = w->scales[0][place];
            largest = w->scales[1][place] > largest ? w->scales[1][place] : largest;
            largest = w->scales[2][place] > largest ? w->scales[2][place] : largest;
            factors[step] = (float)(largest > 1 ? largest : 1);
            x[step] = (float)w->rotations[0][place];
            y[step] = (float)w->rotations[1][place];
            z[step] = (float)w->rotations[2][place];
        }
        for (size_t i = 0; i < number; i++)
            factors[i] = sqrtf(factors[i]) * factor;
        for (size_t i = 0; i < number; i++) {
            x[i] /= factors[i];
            y[i] /= factors[i];
            z[i] /= factors[i];
        }
        for (size_t i = 0; i < number; i++) {
            float left = 1.0f - x[i] * x[i];
            left -= y[i] * y[i];
            left -= z[i] * z[i];
            rest[i] = sqrtf(left > 0 ? left : 0);
        }
        for (size_t i = 0; i < number; i++) {
            float *const to = out + 4 * (begin + i);
            to[0] = rest[i];
            to[1] = x[i];
            to[2] = y[i];
            to[3] = z[i];
        }
    }
}

static void colours_of_dc(
    const work *w, float divisor, size_t lanes, size_t steps, size_t splats, float *out, uint64_t all)
{
    int32_t y[LANE], co[LANE], cg[LANE];
    for (size_t lane = 0; lane < lanes; lane++) {
        const size_t begin = lane * steps, number = splats - begin < steps ? splats - begin : steps;
        for (size_t step = 0; step < number; step++) {
            const size_t place = step * LANES + lane;
            y[step] = w->dc[0][place];
            co[step] = w->dc[1][place];
            cg[step] = w->dc[2][place];
        }
        float *const red = out + begin, *const green = red + all, *const blue = green + all;
        for (size_t i = 0; i < number; i++) {
            const int32_t rest = y[i] - cg[i];
            red[i] = (float)(rest + co[i]) / divisor;
            green[i] = (float)(y[i] + cg[i]) / divisor;
            blue[i] = (float)(rest - co[i]) / divisor;
        }
    }
}

static void colours_of_items(const work *w, size_t band, float divisor, size_t steps, float *out, uint64_t all)
{
    const uint16_t *const places = w->places[band];
    const uint8_t *const coefficients = w->coefficients[band];
    const int32_t *const y = w->channels[band][0], *const co = w->channels[band][1], *const cg = w->channels[band][2];
    const size_t first = (band + 1) * (band + 1) - 1;
    for (size_t i = 0; i < w->items[band]; i++) {
        float *const to = out + 3 * (first + coefficients[i]) * all + places[i] % LANES * steps + places[i] / LANES;
        const int32_t rest = y[i] - cg[i];
        to[0] = (float)(rest + co[i]) / divisor;
        to[all] = (float)(y[i] + cg[i]) / divisor;
        to[2 * all] = (float)(rest - co[i]) / divisor;
    }
}

/* The values of a bundle. What potr_bundles_levels takes and returns; and 4 where a level is beyond its table: then
 * the bundle's values are not whole. */
POTR_EXPORT int potr_bundles_values(
    const bundled_file *file, uint64_t bundle, int sections, int rotating, work *w, const scene_values *out,
    int *section)
{
    const int wrong = decode_bundle(file, bundle, sections, rotating, w, section);
    if (wrong)
        return wrong;
    const size_t splats = splats_of(file, bundle), lanes = lanes_of(splats), steps = steps_of(splats);
    const uint64_t first = bundle * BUNDLE, all = file->splats;
    int beyond = 0;
    if (out->logits)
        beyond |= look_up(
            w->opacity, lanes, steps, splats, out->opacity_table, out->opacity_levels, out->logits + first, 1);
    if (out->log_scales && sections > SCALE)
        for (size_t axis = 0; axis < 3; axis++)
            beyond |= look_up(w->scales[axis], lanes, steps, splats, out->scale_table, out->scale_levels,
                out->log_scales + 3 * first + axis, 3);
    if (out->quaternions && rotating)
        rotations(w, out->sf_rotation, lanes, steps, splats, out->quaternions + 4 * first);
    if (out->dc && sections > DC)
        colours_of_dc(w, out->sf_dc, lanes, steps, splats, out->dc + first, all);
    if (out->ac)
        for (size_t band = 0; band < 3; band++)
            colours_of_items(w, band, out->sf_ac, steps, out->ac + first, all);
    return beyond ? BEYOND_TABLE : FINE;
}
