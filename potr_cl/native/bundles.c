/* Bundles (docs/format.md): a bundle's integers from the words of its sections.
 *
 * All streams of a bundle are decoded one after another while what they need of each other stays in a cache. Arrays of
 * an item a splat are in *rows*: the lanes of a step side by side, so that loops over lanes become vectors; splat s is
 * in row s mod 256, column s / 256, and its *place* is the number of both. */

#include <string.h>

#include "bundles_tokens.h"
#include "bundles_values.h"
#include "steps.h"

/* A stream of some items: from w->expected, where the sums of terms, constant and bias stand in rows, to w->tokens, to
 * `sizes`, which has room for as many rows, and, where tokens have bits beside them, to w->extra. Returns 0, or 1 if
 * there are too few words. */
static int decode_items(const stream_model *model, reader *r, uint32_t *states, size_t lanes, size_t items, work *w,
    int16_t *sizes)
{
    const rows_of_tokens rows = { w->expected, w->tokens, sizes, w->extra };
    return decode_tokens(model, r, states, lanes, items, &rows);
}

static INLINE level integer_of(const work *w, size_t at)
{
    const uint32_t token = w->tokens[at];
    if (token < DIRECT)
        return (level)token;
    return (level)((mapped_level)(4 + (token - DIRECT) % 4) << extra_bits(token) | w->extra[at]);
}

static INLINE level from_zigzag(level u)
{
    return (level)((mapped_level)u >> 1) ^ -(u & 1);
}

/* Tokens where no splat is, to the end of the rows: what lanes without one have found there may stand for anything. */
static void clear_idle(uint8_t *tokens, size_t splats, size_t whole)
{
    const size_t steps = steps_of(splats);
    memset(tokens + LANES * steps, 0, whole - LANES * steps);
    if (splats == LANES * steps)
        return;
    for (size_t step = 0; step < steps; step++) {
        const size_t count = (splats - step + steps - 1) / steps;
        memset(tokens + step * LANES + count, 0, LANES - count);
    }
}

/* Weighted sums of terms in rows. */
POTR_WIDE
static void add_terms(
    int32_t *restrict sums, int32_t constant, const int32_t *weights, const int16_t *const *terms, size_t number,
    size_t places)
{
    for (size_t first = 0; first < places; first += LANE) {
        int32_t *const part = sums + first;
        for (size_t i = 0; i < LANE; i++)
            part[i] = constant;
        for (size_t k = 0; k < number; k++) {
            const int32_t weight = weights[k];
            const int16_t *const term = terms[k] + first;
            if (weight)
                for (size_t i = 0; i < LANE; i++)
                    part[i] += weight * term[i];
        }
    }
}

/* The integers of a stream of an item a splat. Nearly all are tokens by themselves. */
POTR_WIDE
static void keep_dense(const stream_model *model, const work *w, size_t places, int is_signed, level *restrict integers)
{
    const uint8_t *const tokens = w->tokens;
    if (is_signed)
        for (size_t i = 0; i < places; i++)
            integers[i] = from_zigzag(tokens[i]);
    else
        for (size_t i = 0; i < places; i++)
            integers[i] = tokens[i];
    if (model->alphabet <= DIRECT)
        return;
    for (size_t first = 0; first < places; first += LANE) {
        uint8_t any = 0;
        for (size_t i = first; i < first + LANE; i++)
            any |= tokens[i];
        for (size_t i = first; any & DIRECT && i < first + LANE; i++)
            if (tokens[i] & DIRECT)
                integers[i] = is_signed ? from_zigzag(integer_of(w, i)) : integer_of(w, i);
    }
}

/* Streams of an item a splat: `known` terms, and then those of the streams before. */
static int dense_section(
    const stream_model *models, size_t number, const int16_t *const *known, size_t known_number, int is_signed,
    reader *r, uint32_t *states, size_t lanes, size_t splats, work *w, int16_t sizes[][BUNDLE],
    level integers[][BUNDLE])
{
    const size_t steps = steps_of(splats), places = LANES * steps;
    const size_t whole = (places + LANE - 1) / LANE * LANE;
    const int16_t *terms[TERMS];
    for (size_t k = 0; k < known_number; k++)
        terms[k] = known[k];
    for (size_t s = 0; s < number; s++) {
        add_terms(w->expected, models[s].constant, models[s].weights, terms, known_number + s, whole);
        if (decode_items(&models[s], r, states, lanes, splats, w, sizes[s]))
            return TOO_FEW_WORDS;
        clear_idle(w->tokens, splats, whole);
        keep_dense(&models[s], w, whole, is_signed, integers[s]);
        terms[known_number + s] = sizes[s];
    }
    return r->read == r->available ? FINE : TOO_MANY_WORDS;
}

/* Classes of the steps of splats' colours. */
static void find_steps(const colour_steps *steps, uint64_t begin, size_t splats, work *w)
{
    if (!steps->groups) {
        memset(w->dc_classes, CLASSES, sizeof w->dc_classes);
        memset(w->ac_classes, CLASSES, sizeof w->ac_classes);
    } else {
        const size_t rows = steps_of(splats);
        for (size_t step = 0; step < rows; step++) {
            const size_t at = step * LANES, count = (splats - step + rows - 1) / rows;
            const level *const scales[3] = { w->scales[0] + at, w->scales[1] + at, w->scales[2] + at };
            find_classes(steps, w->logarithms, scales, w->opacity + at, begin + step, rows, count,
                w->dc_classes + at, w->ac_classes + at);
        }
    }
    for (size_t i = 0; i < BUNDLE; i++)
        w->step_sizes[i] = (int16_t)(STEP_SIZE * w->dc_classes[i]);
}

/* The mask of each splat to places and coefficients of its items. Returns their number. */
static size_t list_items(work *w, size_t lanes, size_t steps, size_t splats, uint16_t *places, uint8_t *coefficients)
{
    size_t number = 0;
    for (size_t lane = 0; lane < lanes; lane++) {
        const size_t end = splats - lane * steps < steps ? splats - lane * steps : steps;
        for (size_t step = 0; step < end; step++) {
            const size_t place = step * LANES + lane;
            const uint8_t mask = w->tokens[place];
            /* Room for eight is always there, and what is too much is written over. */
            memcpy(coefficients + number, &w->coefficient_bytes[mask], 8);
            for (size_t k = 0; k < 8; k++)
                places[number + k] = (uint16_t)place;
            unsigned bits = mask - (mask >> 1 & 0x55u);
            bits = (bits & 0x33u) + (bits >> 2 & 0x33u);
            number += (bits + (bits >> 4)) & 0x0fu;
        }
    }
    return number;
}

/* The AC coefficients of a degree. */
static int decode_band(
    const stream_model *models, size_t band, reader *r, uint32_t *states, size_t lanes, size_t splats, work *w)
{
    const size_t steps = steps_of(splats), places = LANES * steps;
    const size_t whole = (places + LANE - 1) / LANE * LANE;
    const int16_t *const known[11] = { w->opacity_sizes, w->scale_sizes[0], w->scale_sizes[1], w->scale_sizes[2],
        w->step_sizes, w->dc_sizes[0], w->dc_sizes[1], w->dc_sizes[2], w->sums[0], w->sums[1], w->sums[2] };
    const int16_t *const of_items[5] = { w->sums[0], w->sums[1], w->sums[2], w->mask_sizes, w->step_sizes };
    const stream_model *model = &models[MASK_STREAM];
    add_terms(w->expected, model->constant, model->weights, known, 11, whole);
    if (decode_items(model, r, states, lanes, splats, w, w->mask_sizes))
        return TOO_FEW_WORDS;
    uint16_t *const place = w->places[band];
    uint8_t *const coefficient = w->coefficients[band];
    const size_t items = list_items(w, lanes, steps, splats, place, coefficient);
    w->items[band] = (uint32_t)items;

    model = &models[PATTERN_STREAM];
    add_terms(w->of_splats, model->constant, model->weights, of_items, 5, whole);
    size_t item_steps = (items + lanes - 1) / lanes;
    for (size_t lane = 0, i = 0; i < items; lane++)
        for (size_t at = lane, end = i + item_steps < items ? i + item_steps : items; i < end; i++, at += LANES)
            w->expected[at] = w->of_splats[place[i]] + model->biases[coefficient[i]];
    if (decode_items(model, r, states, lanes, items, w, w->sizes))
        return TOO_FEW_WORDS;
    for (size_t lane = 0, i = 0; i < items; lane++)
        for (size_t at = lane, end = i + item_steps < items ? i + item_steps : items; i < end; i++, at += LANES)
            w->patterns[i] = w->tokens[at];

    for (size_t c = 0; c < 3; c++) {
        model = &models[VALUE_STREAM + c];
        level *const channel = w->channels[band][c];
        memset(channel, 0, items * sizeof *channel);
        memset(w->value_sizes[c], 0, items * sizeof *w->value_sizes[c]);
        size_t chosen = 0;
        for (size_t i = 0; i < items; i++) {
            w->chosen[chosen] = (uint32_t)i;
            chosen += w->patterns[i] >> c & 1;
        }
        add_terms(w->of_splats, model->constant, model->weights, of_items, 5, whole);
        const int32_t chroma = model->weights[5] * CHROMA_SIZE;
        item_steps = (chosen + lanes - 1) / lanes;
        for (size_t lane = 0, k = 0; k < chosen; lane++)
            for (size_t at = lane, end = k + item_steps < chosen ? k + item_steps : chosen; k < end; k++, at += LANES) {
                const size_t i = w->chosen[k];
                int32_t sum = w->of_splats[place[i]] + model->biases[coefficient[i]];
                sum += w->patterns[i] > 1 ? chroma : 0;
                for (size_t b = 0; b < c; b++)
                    sum += model->weights[6 + b] * w->value_sizes[b][i];
                w->expected[at] = sum;
            }
        if (decode_items(model, r, states, lanes, chosen, w, w->sizes))
            return TOO_FEW_WORDS;
        for (size_t lane = 0, k = 0; k < chosen; lane++)
            for (size_t at = lane, end = k + item_steps < chosen ? k + item_steps : chosen; k < end; k++, at += LANES) {
                const size_t i = w->chosen[k];
                channel[i] = from_zigzag(integer_of(w, at) + 1);
                w->value_sizes[c][i] = w->sizes[at];
            }
    }
    for (size_t c = 0; c < 3; c++)
        for (size_t i = 0; i < items; i++)
            w->sums[c][place[i]] += w->value_sizes[c][i];
    return r->read == r->available ? FINE : TOO_MANY_WORDS;
}

static int at_end(const uint32_t *states, size_t lanes)
{
    for (size_t l = 0; l < lanes; l++)
        if (states[l] != LOWEST)
            return BAD_END;
    return FINE;
}

/* Of a chain; lanes that are not there rest. */
static void first_states(const uint32_t *all, uint64_t bundle, size_t lanes, uint32_t *states)
{
    for (size_t i = 0; i < LANES; i++)
        states[i] = LOWEST;
    memcpy(states, all + bundle * LANES, lanes * sizeof *states);
}

int decode_bundle(
    const bundled_file *file, uint64_t bundle, int sections, int rotations, work *w, int *section)
{
    const size_t splats = splats_of(file, bundle), lanes = lanes_of(splats);
    uint32_t states[LANES];
    first_states(file->states, bundle, lanes, states);
    memset(w->sums, 0, sizeof w->sums);
    memset(w->items, 0, sizeof w->items);
    const int16_t *const known[5] = { w->opacity_sizes, w->scale_sizes[0], w->scale_sizes[1], w->scale_sizes[2],
        w->step_sizes };
    for (int s = 0; s < SECTIONS; s++) {
        if (s == ROTATION ? !rotations : s >= sections)
            continue;
        *section = s;
        reader r = { NULL, 0, 0 };
        const int there = file->words[s] != NULL;
        if (there) {
            r.words = file->words[s] + 2 * file->starts[s][bundle];
            r.available = (size_t)(file->starts[s][bundle + 1] - file->starts[s][bundle]);
        }
        const stream_model *const models = file->streams;
        int wrong = FINE;
        if (s == DC)
            find_steps(&file->steps, bundle * BUNDLE, splats, w);
        if (s == OPACITY) {
            wrong = dense_section(models + OPACITY_STREAM, 1, NULL, 0, 0, &r, states, lanes, splats, w,
                &w->opacity_sizes, &w->opacity);
        } else if (s == SCALE && there) {
            wrong = dense_section(models + SCALE_STREAM, 3, NULL, 0, 0, &r, states, lanes, splats, w, w->scale_sizes,
                w->scales);
        } else if (s == SCALE) {
            memset(w->scale_sizes, 0, sizeof w->scale_sizes);
            memset(w->scales, 0, sizeof w->scales);
        } else if (s == DC && there) {
            wrong = dense_section(
                models + DC_STREAM, 3, known, 5, 1, &r, states, lanes, splats, w, w->dc_sizes, w->dc);
        } else if (s == DC) {
            memset(w->dc_sizes, 0, sizeof w->dc_sizes);
            memset(w->dc, 0, sizeof w->dc);
        } else if (s < ROTATION && there) {
            const size_t band = (size_t)(s - BAND_1);
            wrong = decode_band(
                models + BAND_STREAM + BAND_STREAMS * band, band, &r, states, lanes, splats, w);
        } else if (s == ROTATION && there) {
            const int16_t *terms[9] = { w->scale_sizes[0], w->scale_sizes[1], w->scale_sizes[2] };
            for (size_t k = 0; k < 3; k++) {
                const int16_t *const a = w->scale_sizes[k == 2 ? 0 : k], *const b = w->scale_sizes[k == 2 ? 2 : k + 1];
                for (size_t i = 0; i < BUNDLE; i++)
                    w->difference_sizes[k][i] = (int16_t)(a[i] < b[i] ? b[i] - a[i] : a[i] - b[i]);
                terms[3 + k] = w->difference_sizes[k];
            }
            uint32_t own[LANES];
            first_states(file->rotation_states, bundle, lanes, own);
            wrong = dense_section(models + ROTATION_STREAM, 3, terms, 6, 1, &r, own, lanes, splats, w,
                w->rotation_sizes, w->rotations);
            if (!wrong)
                wrong = at_end(own, lanes);
        } else if (s == ROTATION) {
            memset(w->rotations, 0, sizeof w->rotations);
        }
        if (wrong)
            return wrong;
    }
    *section = OPACITY;
    return sections == ROTATION ? at_end(states, lanes) : FINE;
}

/* What each slot of a model's contexts stands for, and the interval of each token.
 *
 * frequencies: (contexts, alphabet). sizes: (alphabet). slots: (contexts · 4096 + 3). intervals: (contexts · 256).
 * Returns 0, or 1 where a context's frequencies do not add up to 4096. */
POTR_EXPORT int potr_bundles_table(
    const uint16_t *frequencies, size_t contexts, size_t alphabet, const int16_t *sizes, uint8_t *slots,
    uint32_t *intervals)
{
    for (size_t context = 0; context < contexts; context++) {
        const uint16_t *row = frequencies + context * alphabet;
        uint32_t at = 0;
        for (size_t token = 0; token < alphabet; token++) {
            const uint32_t frequency = row[token];
            if (frequency > TOTAL - at)
                return 1;
            if (!frequency)
                continue;
            memset(slots + context * TOTAL + at, (int)token, frequency);
            intervals[context * TOKENS + token] =
                (frequency - 1) | at << PRECISION | (uint32_t)(sizes[token] & LARGEST_SIZE) << 2 * PRECISION;
            at += frequency;
        }
        if (at != TOTAL)
            return 1;
    }
    memset(slots + contexts * TOTAL, 0, 3);
    return 0;
}

/* Bytes of what a bundle's decoding works with. */
POTR_EXPORT size_t potr_bundles_work(void)
{
    return sizeof(work);
}

/* Makes it ready, once, of any content. */
POTR_EXPORT void potr_bundles_begin(work *w)
{
    /* Lanes that have no splat compute with what stands there, which must not be too large. */
    memset(w, 0, offsetof(work, places));
    memset(w->expected, 0, sizeof w->expected);
    for (unsigned mask = 0; mask < 128; mask++)
        list_bits(mask, &w->coefficient_bytes[mask]);
    list_logarithms(w->logarithms);
}

/* Where a bundle's integers go. */
typedef struct {
    level *opacity;        /* (splats of the bundle) */
    level *scales;         /* (3, splats) */
    level *rotations;      /* (3, splats) */
    level *dc;             /* (3, splats) */
    uint16_t *item_splats; /* (15 · splats) of each item, counted from the bundle's first */
    uint8_t *item_coefficients; /* (15 · splats) 1 to 15 */
    level *item_channels;       /* (3, 15 · splats) */
    uint64_t items[3];     /* of each degree */
} bundle_levels;

static void to_splats(const level *rows, size_t steps, size_t splats, level *out)
{
    for (size_t s = 0; s < splats; s++)
        out[s] = rows[s % steps * LANES + s / steps];
}

/* The integers of a bundle: so many sections of the chain that begins with opacities, and rotations or none.
 *
 * *section becomes the one at fault, in the order of `words`. Returns 0; 1 where there are too few words, 2 where there
 * are too many, 3 where a lane does not end where it should. */
POTR_EXPORT int potr_bundles_levels(
    const bundled_file *file, uint64_t bundle, int sections, int rotations, work *w, bundle_levels *out, int *section)
{
    const int wrong = decode_bundle(file, bundle, sections, rotations, w, section);
    if (wrong)
        return wrong;
    const size_t splats = splats_of(file, bundle), steps = steps_of(splats);
    to_splats(w->opacity, steps, splats, out->opacity);
    for (size_t k = 0; k < 3; k++) {
        if (sections > SCALE)
            to_splats(w->scales[k], steps, splats, out->scales + k * splats);
        if (sections > DC)
            to_splats(w->dc[k], steps, splats, out->dc + k * splats);
        if (rotations)
            to_splats(w->rotations[k], steps, splats, out->rotations + k * splats);
    }
    size_t number = 0;
    for (size_t band = 0; band < 3; band++) {
        const size_t items = w->items[band], first = (band + 1) * (band + 1);
        out->items[band] = items;
        for (size_t i = 0; i < items; i++) {
            const size_t place = w->places[band][i];
            out->item_splats[number + i] = (uint16_t)(place % LANES * steps + place / LANES);
            out->item_coefficients[number + i] = (uint8_t)(first + w->coefficients[band][i]);
        }
        for (size_t c = 0; c < 3; c++)
            memcpy(out->item_channels + c * 15 * splats + number, w->channels[band][c], items * sizeof(level));
        number += items;
    }
    return FINE;
}
