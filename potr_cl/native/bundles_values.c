/* Bundles' integers to single precision values (docs/format.md, "Single precision"), while they are in a cache.
 *
 * As in dequantize.c each operation is rounded by itself: nothing here may be compiled for several processors. */

#include <math.h>
#include <string.h>

#include "bundles_values.h"
#include "prediction.h"

/* Values of a table for the levels in rows, every `stride`-th number of `out`; whether a level is beyond the table. */
static int look_up(
    const level *rows, size_t lanes, size_t steps, size_t splats, const float *table, uint64_t levels, float *out,
    size_t stride)
{
    mapped_level most = 0;
    for (size_t i = 0; i < LANES * steps; i++)
        most = (mapped_level)rows[i] > most ? (mapped_level)rows[i] : most;
    if (most >= levels)
        return 1;
    for (size_t lane = 0, splat = 0; lane < lanes; lane++)
        for (size_t step = 0; step < steps && splat < splats; step++, splat++)
            out[splat * stride] = table[rows[step * LANES + lane]];
    return 0;
}

static void rotations(
    const work *w, const scene_values *values, size_t lanes, size_t steps, size_t splats, uint64_t first, uint64_t all)
{
    float x[LANE], y[LANE], z[LANE], factors[LANE], rest[LANE], rows[4 * LANE], units[4 * LANE];
    for (size_t lane = 0; lane < lanes; lane++) {
        const size_t begin = lane * steps, number = splats - begin < steps ? splats - begin : steps;
        for (size_t step = 0; step < number; step++) {
            const size_t place = step * LANES + lane;
            level largest = w->scales[0][place];
            largest = w->scales[1][place] > largest ? w->scales[1][place] : largest;
            largest = w->scales[2][place] > largest ? w->scales[2][place] : largest;
            factors[step] = (float)(largest > 1 ? largest : 1);
            x[step] = (float)w->rotations[0][place];
            y[step] = (float)w->rotations[1][place];
            z[step] = (float)w->rotations[2][place];
        }
        for (size_t i = 0; i < number; i++)
            factors[i] = sqrtf(factors[i]) * values->sf_rotation;
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
            float *const to = rows + 4 * i;
            to[0] = rest[i];
            to[1] = x[i];
            to[2] = y[i];
            to[3] = z[i];
        }
        const float *from = rows;
        if (values->units) {
            potr_unit_quaternions(rows, number, units);
            from = units;
        }
        float *const out = values->quaternions + (values->columns ? 1 : 4) * (first + begin);
        if (!values->columns)
            memcpy(out, from, 4 * number * sizeof *out);
        else
            for (size_t k = 0; k < 4; k++)
                for (size_t i = 0; i < number; i++)
                    out[k * all + i] = from[4 * i + k];
    }
}

static INLINE level as_it_is(level integer)
{
    return integer;
}

DC_OF(dc_runs, level, as_it_is)

/* DC of a bundle's splats. Lanes that are whole are runs of the prediction; where they are shorter, it goes on from lane
 * to lane. */
static void colours_of_dc(const work *w, const scene_values *out, size_t steps, size_t splats, float *to, uint64_t all)
{
    const dc_steps of = { out->step, out->inverse, out->sf_dc };
    const level *const *const dc = (const level *const[]) { w->dc[0], w->dc[1], w->dc[2] };
    if (steps == RUN) {
        const size_t whole = splats / RUN, four = whole / SIDE_BY_SIDE * SIDE_BY_SIDE;
        for (size_t lane = 0; lane < four; lane += SIDE_BY_SIDE) {
            float *const red = to + lane * RUN;
            dc_runs(&of, dc[0] + lane, dc[1] + lane, dc[2] + lane, w->dc_classes + lane, LANES, 1, SIDE_BY_SIDE, RUN, red,
                red + all, red + 2 * all);
        }
        for (size_t lane = four; lane * RUN < splats; lane++) {
            float *const red = to + lane * RUN;
            const size_t left = splats - lane * RUN, number = left < RUN ? left : RUN;
            dc_runs(&of, dc[0] + lane, dc[1] + lane, dc[2] + lane, w->dc_classes + lane, LANES, 1, 1, number, red,
                red + all, red + 2 * all);
        }
        return;
    }
    uint64_t total[3] = { 0 }, last[4][3] = { { 0 } };
    for (size_t splat = 0; splat < splats; splat++) {
        if (splat % RUN == 0) {
            memset(total, 0, sizeof total);
            memset(last, 0, sizeof last);
        }
        const size_t place = splat % steps * LANES + splat / steps;
        const unsigned class = w->dc_classes[place];
        const uint64_t residuals[3] = {
            (uint64_t)(int64_t)dc[0][place], (uint64_t)(int64_t)dc[1][place], (uint64_t)(int64_t)dc[2][place]
        };
        float rgb[3];
        next_dc(&of, class, residuals, total, last[splat & 3], rgb);
        for (size_t c = 0; c < 3; c++)
            to[splat + c * all] = rgb[c] / of.factors[class];
    }
}

/* R, G, B of `number` items of a degree, from `begin` on. */
static INLINE void colours_of_items(
    const work *w, size_t band, const float *divisors, size_t begin, size_t number, float *red, float *green,
    float *blue)
{
    const uint16_t *const places = w->places[band] + begin;
    const level *const y = w->channels[band][0] + begin, *const co = w->channels[band][1] + begin,
                *const cg = w->channels[band][2] + begin;
    float divisor[LANE];
    for (size_t i = 0; i < number; i++)
        divisor[i] = divisors[w->ac_classes[places[i]]];
    for (size_t i = 0; i < number; i++) {
        const level rest = y[i] - cg[i];
        red[i] = (float)(rest + co[i]) / divisor[i];
        green[i] = (float)(y[i] + cg[i]) / divisor[i];
        blue[i] = (float)(rest - co[i]) / divisor[i];
    }
}

static INLINE size_t splat_of(size_t place, size_t steps)
{
    return place % LANES * steps + place / LANES;
}

/* The items of a degree to the columns of their coefficients. */
static void spread_items(const work *w, size_t band, const float *divisors, size_t steps, float *out, uint64_t all)
{
    const uint16_t *const places = w->places[band];
    const uint8_t *const coefficients = w->coefficients[band];
    const size_t first = (band + 1) * (band + 1) - 1, items = w->items[band];
    for (size_t begin = 0; begin < items; begin += LANE) {
        const size_t number = items - begin < LANE ? items - begin : LANE;
        float red[LANE], green[LANE], blue[LANE];
        uint64_t at[LANE];
        colours_of_items(w, band, divisors, begin, number, red, green, blue);
        for (size_t i = 0; i < number; i++)
            at[i] = 3 * (first + coefficients[begin + i]) * all + splat_of(places[begin + i], steps);
        for (size_t i = 0; i < number; i++) {
            float *const to = out + at[i];
            to[0] = red[i];
            to[all] = green[i];
            to[2 * all] = blue[i];
        }
    }
}

/* The items of a degree one after another. Returns their number. */
static size_t list_values(const work *w, size_t band, const float *divisors, size_t steps, uint32_t *out)
{
    const uint16_t *const places = w->places[band];
    const uint8_t *const coefficients = w->coefficients[band];
    const size_t first = (band + 1) * (band + 1), items = w->items[band];
    for (size_t begin = 0; begin < items; begin += LANE) {
        const size_t number = items - begin < LANE ? items - begin : LANE;
        float red[LANE], green[LANE], blue[LANE];
        colours_of_items(w, band, divisors, begin, number, red, green, blue);
        for (size_t i = 0; i < number; i++) {
            uint32_t *const to = out + 4 * (begin + i);
            to[0] = (uint32_t)((first + coefficients[begin + i]) * BUNDLE + splat_of(places[begin + i], steps));
            memcpy(to + 1, &red[i], sizeof *red);
            memcpy(to + 2, &green[i], sizeof *green);
            memcpy(to + 3, &blue[i], sizeof *blue);
        }
    }
    return items;
}

/* The values of a bundle. What potr_bundles_levels takes and returns; and 4 where a level is beyond its table: then
 * the bundle's values are not whole. */
POTR_EXPORT int potr_bundles_values(
    const bundled_file *file, uint64_t bundle, int sections, int rotating, work *w, scene_values *out,
    int *section)
{
    const int wrong = decode_bundle(file, bundle, sections, rotating, w, section);
    if (wrong)
        return wrong;
    const size_t splats = splats_of(file, bundle), lanes = lanes_of(splats), steps = steps_of(splats);
    const uint64_t first = bundle * BUNDLE - out->begin, all = out->stride;
    int beyond = 0;
    if (out->logits)
        beyond |= look_up(
            w->opacity, lanes, steps, splats, out->opacity_table, out->opacity_levels, out->logits + first, 1);
    if (out->log_scales && sections > SCALE)
        for (size_t axis = 0; axis < 3; axis++)
            beyond |= look_up(w->scales[axis], lanes, steps, splats, out->scale_table, out->scale_levels,
                out->columns ? out->log_scales + axis * all + first : out->log_scales + 3 * first + axis,
                out->columns ? 1 : 3);
    if (out->quaternions && rotating)
        rotations(w, out, lanes, steps, splats, first, all);
    if (out->dc && sections > DC)
        colours_of_dc(w, out, steps, splats, out->dc + first, all);
    /* Most are 0. They are cleared here, where they are in a cache when the others follow. */
    for (int32_t plane = 0; out->ac && plane < 3 * out->coefficients; plane++)
        memset(out->ac + (size_t)plane * all + first, 0, splats * sizeof *out->ac);
    if (out->ac)
        for (size_t band = 0; band < 3; band++)
            spread_items(w, band, out->sf_ac, steps, out->ac + first, all);
    uint64_t listed = 0;
    for (size_t band = 0; out->items && band < 3; band++)
        listed += list_values(w, band, out->sf_ac, steps, out->items + 4 * listed);
    if (out->items)
        out->listed = listed;
    return beyond ? BEYOND_TABLE : FINE;
}
