/* The encoder's half of bundles (docs/format.md): what contexts are fitted to, and range coding.
 *
 * A bundle is gone through three times: for the sums of which weights are the least squares' solution, for counts of
 * tokens by expected size, and for its words. Its streams are made anew each time, which takes less than to keep them.
 * Its input is the encoder's own, not a file's. */

#include <string.h>

#include "bundles.h"

enum {
    COLUMNS = TERMS + 2 + BAND + 1, /* terms, recent sizes, constant, coefficients; and what is fitted to */
    SAMPLES = 2048               /* at a time */
};

/* Integers of a file's splats, (splats) each, below 2^28 in magnitude; NULL where all are 0. Of DC what its prediction
 * has left. */
typedef struct {
    const int32_t *opacity, *scales[3], *rotations[3], *dc[3], *ac[45];
    const int8_t *classes; /* (splats) of the steps of DC */
    uint64_t splats;
} file_integers;

/* What is known of a stream before it is fitted, and what was fitted. */
typedef struct {
    const int16_t *sizes;      /* (256) of each token */
    const uint8_t *classes;    /* (256) context of each expected size */
    const uint32_t *intervals; /* (contexts · 256) of each token: frequency, and from bit 16 on the sum of those below */
    int32_t numbers[TERMS + 2 + BAND]; /* weights of terms, of recent sizes, constant, biases */
    int32_t terms, coefficients;
    int32_t unused;
} fitted_stream;

typedef struct {
    uint32_t items;
    uint32_t integers[ITEMS + LANES]; /* mapped to unsigned, in rows */
    uint8_t tokens[ITEMS + LANES];
    uint8_t expected[ITEMS + LANES];
} made_stream;

typedef struct {
    made_stream made[STREAMS];
    int16_t terms[18][BUNDLE];              /* of splats, in rows: see the names below */
    int16_t item_terms[9][ITEMS + LANES];   /* of a stream of items, in rows */
    int16_t recent[ITEMS + LANES];
    uint8_t row_coefficients[ITEMS + LANES];
    int32_t sums[ITEMS + LANES];
    /* Items of a degree in their order. */
    uint16_t places[ITEMS + 8], splats[ITEMS + 8];
    uint8_t coefficients[ITEMS + 8], patterns[ITEMS + 8];
    uint32_t chosen[ITEMS + 8];
    uint8_t masks[BUNDLE], made_masks[BUNDLE];
    int32_t channels[3][ITEMS + 8];
    int16_t item_sizes[3][ITEMS + 8];
    int32_t rows[BUNDLE];
    int32_t samples[COLUMNS][SAMPLES];
    uint64_t coefficient_bytes[128]; /* a table: the bits of each mask */
} encoding;

/* Terms of splats. */
enum { T_OPACITY, T_SCALE, T_STEP = T_SCALE + 3, T_DC, T_SUM = T_DC + 3, T_MASK = T_SUM + 3, T_DIFFERENCE,
    T_ROTATION = T_DIFFERENCE + 3 };

/* Which of the three times it is, and what it gathers. */
typedef struct {
    encoding *e;
    const fitted_stream *fitted;
    int64_t *grams;    /* (streams, COLUMNS, COLUMNS) */
    uint32_t *largest; /* (streams) largest integer, mapped to unsigned */
    uint32_t *counts;  /* (streams, 256, alphabet) of expected size and token */
    size_t alphabet;
    uint64_t at_least; /* samples of a bundle */
    size_t lanes;
} pass;

static INLINE uint32_t to_zigzag(int32_t value)
{
    return (uint32_t)value << 1 ^ (uint32_t)(value < 0 ? -1 : 0);
}

static INLINE uint8_t token_of(uint32_t u)
{
    if (u < DIRECT)
        return (uint8_t)u;
    unsigned exponent = 7;
    while (u >> (exponent + 1))
        exponent++;
    return (uint8_t)(DIRECT + 4 * (exponent - 7) + (u >> (exponent - 2)) - 4);
}

/* About 8 times the mean size of the last items in the lane, before each. */
POTR_WIDE
static void recent_sizes(const int16_t *restrict sizes, size_t rows, int16_t *restrict recent)
{
    memset(recent, 0, LANES * sizeof *recent);
    for (size_t i = 0; i + LANES < rows * LANES; i++)
        recent[i + LANES] = (int16_t)(recent[i] - (recent[i] >> 2) + 2 * sizes[i]);
}

POTR_WIDE
static void weigh(int32_t *restrict sums, const int16_t *restrict term, int32_t weight, size_t number)
{
    for (size_t i = 0; i < number; i++)
        sums[i] += weight * term[i];
}

POTR_WIDE
static void cut(const int32_t *restrict sums, uint8_t *restrict expected, size_t number)
{
    for (size_t i = 0; i < number; i++) {
        const int32_t size = sums[i] >> 8;
        expected[i] = (uint8_t)(size < 0 ? 0 : size > LARGEST_SIZE ? LARGEST_SIZE : size);
    }
}

POTR_WIDE
static int64_t dot(const int32_t *restrict a, const int32_t *restrict b, size_t number)
{
    int64_t sum = 0;
    for (size_t i = 0; i < number; i++)
        sum += (int64_t)a[i] * b[i];
    return sum;
}

static void add_gram(int32_t samples[COLUMNS][SAMPLES], size_t columns, size_t number, int64_t *gram)
{
    for (size_t a = 0; a < columns; a++)
        for (size_t b = a; b < columns; b++)
            gram[a * COLUMNS + b] += dot(samples[a], samples[b], number);
}

/* Adds what some of a stream's items say of its weights. */
static void survey(const pass *p, size_t s, const int16_t *const *terms, const int16_t *sizes)
{
    encoding *const e = p->e;
    const fitted_stream *const f = &p->fitted[s];
    const size_t items = e->made[s].items, steps = (items + p->lanes - 1) / p->lanes;
    const size_t every = items / p->at_least > 1 ? (size_t)(items / p->at_least) : 1;
    const size_t known = (size_t)f->terms, columns = known + 2 + (size_t)f->coefficients + 1;
    size_t number = 0;
    for (size_t i = 0; i < items; i += every) {
        const size_t at = i % steps * LANES + i / steps;
        for (size_t k = 0; k < known; k++)
            e->samples[k][number] = terms[k][at];
        e->samples[known][number] = e->recent[at];
        e->samples[known + 1][number] = 1;
        for (size_t k = 0; k < (size_t)f->coefficients; k++)
            e->samples[known + 2 + k][number] = e->row_coefficients[at] == k;
        e->samples[columns - 1][number] = sizes[at];
        if (++number == SAMPLES) {
            add_gram(e->samples, columns, number, p->grams + s * COLUMNS * COLUMNS);
            number = 0;
        }
    }
    add_gram(e->samples, columns, number, p->grams + s * COLUMNS * COLUMNS);
}

/* A stream whose integers and tokens are made, by its terms and sizes in rows. */
static void visit(const pass *p, size_t s, const int16_t *const *terms, const int16_t *sizes)
{
    encoding *const e = p->e;
    made_stream *const made = &e->made[s];
    const fitted_stream *const f = &p->fitted[s];
    const size_t items = made->items;
    if (!items)
        return;
    const size_t steps = (items + p->lanes - 1) / p->lanes, rows = LANES * steps;
    recent_sizes(sizes, steps, e->recent);
    if (p->grams) {
        uint32_t most = p->largest[s];
        for (size_t i = 0; i < rows; i++)
            most = made->integers[i] > most ? made->integers[i] : most;
        p->largest[s] = most;
        survey(p, s, terms, sizes);
        return;
    }
    const int32_t *const biases = f->numbers + f->terms + 2;
    for (size_t i = 0; i < rows; i++)
        e->sums[i] = f->numbers[f->terms + 1];
    if (f->coefficients)
        for (size_t i = 0; i < rows; i++)
            e->sums[i] += biases[e->row_coefficients[i]];
    for (int32_t k = 0; k < f->terms; k++)
        if (f->numbers[k])
            weigh(e->sums, terms[k], f->numbers[k], rows);
    weigh(e->sums, e->recent, f->numbers[f->terms], rows);
    cut(e->sums, made->expected, rows);
    if (!p->counts)
        return;
    uint32_t *const counts = p->counts + s * TOKENS * p->alphabet;
    for (size_t step = 0; step < steps; step++) {
        const size_t count = (items - step + steps - 1) / steps;
        for (size_t at = step * LANES; at < step * LANES + count; at++)
            counts[made->expected[at] * p->alphabet + made->tokens[at]]++;
    }
}

/* Integers in rows to tokens and their sizes; idle places hold 0. */
static void tokenise(const pass *p, size_t s, size_t items, int16_t *sizes)
{
    made_stream *const made = &p->e->made[s];
    made->items = (uint32_t)items;
    const size_t rows = LANES * ((items + p->lanes - 1) / p->lanes);
    for (size_t i = 0; i < rows; i++)
        made->tokens[i] = token_of(made->integers[i]);
    for (size_t i = 0; i < rows; i++)
        sizes[i] = p->fitted[s].sizes[made->tokens[i]];
}

static void to_rows(const int32_t *values, size_t lanes, size_t steps, size_t splats, int32_t *rows)
{
    memset(rows, 0, LANES * steps * sizeof *rows);
    for (size_t lane = 0, splat = 0; lane < lanes; lane++)
        for (size_t step = 0; step < steps && splat < splats; step++, splat++)
            rows[step * LANES + lane] = values[splat];
}

/* Streams of an item a splat. */
static void dense_section(
    const pass *p, size_t first, size_t number, const int32_t *const *values, uint64_t begin, size_t splats,
    int is_signed, const int16_t **terms, size_t known, size_t own)
{
    encoding *const e = p->e;
    const size_t steps = steps_of(splats), rows = LANES * steps;
    for (size_t k = 0; k < number; k++) {
        const size_t s = first + k;
        to_rows(values[k] + begin, p->lanes, steps, splats, e->rows);
        for (size_t i = 0; i < rows; i++)
            e->made[s].integers[i] = is_signed ? to_zigzag(e->rows[i]) : (uint32_t)e->rows[i];
        tokenise(p, s, splats, e->terms[own + k]);
        terms[known + k] = e->terms[own + k];
        visit(p, s, terms, e->terms[own + k]);
    }
}

/* Sets bit k of the mask of each splat that has a coefficient of which a channel is not 0. */
POTR_WIDE
static void add_to_masks(
    uint8_t *restrict masks, const int32_t *restrict y, const int32_t *restrict co, const int32_t *restrict cg,
    size_t splats, unsigned k)
{
    for (size_t i = 0; i < splats; i++)
        masks[i] |= (uint8_t)(((y[i] | co[i] | cg[i]) != 0) << k);
}

/* The masks of splats to places and coefficients of their items. Returns their number. */
static size_t list_items(encoding *e, const int32_t *const *values, uint64_t begin, size_t steps, size_t splats)
{
    size_t items = 0;
    for (size_t splat = 0, place = 0, lane = 0, step = 0; splat < splats; splat++) {
        /* Room for eight is always there, and what is too much is written over. */
        const uint8_t mask = e->masks[splat];
        memcpy(e->coefficients + items, &e->coefficient_bytes[mask], 8);
        for (size_t k = 0; k < 8; k++) {
            e->places[items + k] = (uint16_t)place;
            e->splats[items + k] = (uint16_t)splat;
        }
        unsigned bits = mask - (mask >> 1 & 0x55u);
        bits = (bits & 0x33u) + (bits >> 2 & 0x33u);
        items += (bits + (bits >> 4)) & 0x0fu;
        e->made_masks[place] = mask;
        place += LANES;
        if (++step == steps) {
            step = 0;
            place = ++lane;
        }
    }
    for (size_t i = 0; i < items; i++) {
        const int32_t *const *const channels = values + 3 * e->coefficients[i];
        const uint64_t splat = begin + e->splats[i];
        const int32_t y = channels[0][splat], co = channels[1][splat], cg = channels[2][splat];
        e->channels[0][i] = y;
        e->channels[1][i] = co;
        e->channels[2][i] = cg;
        e->patterns[i] = (uint8_t)((y != 0) | (co != 0) << 1 | (cg != 0) << 2);
    }
    return items;
}

/* The streams of a degree's AC coefficients. */
static void make_band(
    const pass *p, size_t band, const int32_t *const *values, uint64_t begin, size_t splats)
{
    encoding *const e = p->e;
    const size_t steps = steps_of(splats), number = 2 * band + 3, first = BAND_STREAM + BAND_STREAMS * band;
    memset(e->masks, 0, splats);
    for (size_t k = 0; k < number; k++)
        add_to_masks(e->masks, values[3 * k] + begin, values[3 * k + 1] + begin, values[3 * k + 2] + begin, splats,
            (unsigned)k);
    memset(e->made_masks, 0, LANES * steps);
    const size_t items = list_items(e, values, begin, steps, splats);
    for (size_t i = 0; i < LANES * steps; i++)
        e->made[first].integers[i] = e->made_masks[i];
    const int16_t *terms[TERMS];
    for (size_t k = 0; k < 11; k++)
        terms[k] = e->terms[T_OPACITY + k];
    tokenise(p, first, splats, e->terms[T_MASK]);
    visit(p, first, terms, e->terms[T_MASK]);

    for (size_t k = 0; k < 8; k++)
        terms[k] = e->item_terms[k];
    int16_t *const sizes = e->item_terms[8];
    for (size_t c = 0; c < 3; c++)
        memset(e->item_sizes[c], 0, items * sizeof(int16_t));
    for (size_t stream = 0; stream < 4; stream++) { /* patterns; Y, Co, Cg */
        const size_t s = first + PATTERN_STREAM + stream;
        size_t chosen = 0;
        for (size_t i = 0; i < items; i++) {
            e->chosen[chosen] = (uint32_t)i;
            chosen += stream == 0 || e->patterns[i] >> (stream - 1) & 1;
        }
        const size_t item_steps = (chosen + p->lanes - 1) / p->lanes, rows = LANES * item_steps;
        made_stream *const made = &e->made[s];
        memset(made->integers, 0, rows * sizeof *made->integers);
        memset(e->row_coefficients, 0, rows);
        for (size_t k = 0; k < 8; k++)
            memset(e->item_terms[k], 0, rows * sizeof(int16_t));
        for (size_t n = 0, at = 0, lane = 0, step = 0; n < chosen; n++) {
            const size_t i = e->chosen[n], place = e->places[i];
            for (size_t k = 0; k < 4; k++)
                e->item_terms[k][at] = e->terms[T_SUM + k][place];
            e->item_terms[4][at] = e->terms[T_STEP][place];
            e->row_coefficients[at] = e->coefficients[i];
            if (stream == 0) {
                made->integers[at] = e->patterns[i];
            } else {
                made->integers[at] = to_zigzag(e->channels[stream - 1][i]) - 1;
                e->item_terms[5][at] = e->patterns[i] > 1 ? CHROMA_SIZE : 0;
                e->item_terms[6][at] = e->item_sizes[0][i];
                e->item_terms[7][at] = e->item_sizes[1][i];
            }
            at += LANES;
            if (++step == item_steps) {
                step = 0;
                at = ++lane;
            }
        }
        tokenise(p, s, chosen, sizes);
        visit(p, s, terms, sizes);
        if (stream == 0)
            continue;
        for (size_t n = 0, at = 0, lane = 0, step = 0; n < chosen; n++) {
            e->item_sizes[stream - 1][e->chosen[n]] = sizes[at];
            at += LANES;
            if (++step == item_steps) {
                step = 0;
                at = ++lane;
            }
        }
    }
    for (size_t c = 0; c < 3; c++)
        for (size_t i = 0; i < items; i++)
            e->terms[T_SUM + c][e->places[i]] += e->item_sizes[c][i];
}

/* All streams of a bundle. */
static void make_streams(const file_integers *file, uint64_t bundle, pass *p)
{
    encoding *const e = p->e;
    for (unsigned mask = 1; mask < 128 && !e->coefficient_bytes[127]; mask++)
        list_bits(mask, &e->coefficient_bytes[mask]);
    const uint64_t begin = bundle * BUNDLE, left = file->splats - begin;
    const size_t splats = left < BUNDLE ? (size_t)left : BUNDLE;
    p->lanes = lanes_of(splats);
    memset(e->terms, 0, sizeof e->terms);
    for (size_t s = 0; s < STREAMS; s++)
        e->made[s].items = 0;
    const int16_t *terms[TERMS];
    dense_section(p, OPACITY_STREAM, 1, &file->opacity, begin, splats, 0, terms, 0, T_OPACITY);
    if (file->scales[0])
        dense_section(p, SCALE_STREAM, 3, file->scales, begin, splats, 0, terms, 0, T_SCALE);
    const size_t steps = steps_of(splats);
    for (size_t splat = 0; splat < splats; splat++)
        e->terms[T_STEP][splat % steps * LANES + splat / steps] =
            (int16_t)(STEP_SIZE * (file->classes[begin + splat] + CLASSES));
    for (size_t k = 0; k < 5; k++)
        terms[k] = e->terms[T_OPACITY + k];
    if (file->dc[0])
        dense_section(p, DC_STREAM, 3, file->dc, begin, splats, 1, terms, 5, T_DC);
    for (size_t band = 0; band < 3; band++) {
        const int32_t *const *const values = file->ac + 3 * ((band + 1) * (band + 1) - 1);
        if (values[0])
            make_band(p, band, values, begin, splats);
    }
    if (!file->rotations[0])
        return;
    for (size_t k = 0; k < 3; k++) {
        const int16_t *const a = e->terms[T_SCALE + (k == 2 ? 0 : k)], *const b = e->terms[T_SCALE + (k == 2 ? 2 : k + 1)];
        for (size_t i = 0; i < BUNDLE; i++)
            e->terms[T_DIFFERENCE + k][i] = (int16_t)(a[i] < b[i] ? b[i] - a[i] : a[i] - b[i]);
    }
    for (size_t k = 0; k < 3; k++) {
        terms[k] = e->terms[T_SCALE + k];
        terms[3 + k] = e->terms[T_DIFFERENCE + k];
    }
    dense_section(p, ROTATION_STREAM, 3, file->rotations, begin, splats, 1, terms, 6, T_ROTATION);
}

/* Bytes of what a bundle's encoding works with; they begin as zeros. */
POTR_EXPORT size_t potr_bundles_encoding(void)
{
    return sizeof(encoding);
}

/* Adds to the sums that weights are fitted to.
 *
 * streams: (25) with sizes and numbers of terms and coefficients. at_least: samples that are taken of a stream, where
 * it has as many. grams: (25, 22, 22) sums of products of terms, recent sizes, constant, coefficients and size; those
 * on and above the diagonal. largest: (25) brought up to the largest integers, mapped to unsigned. */
POTR_EXPORT void potr_bundles_survey(
    const file_integers *file, uint64_t bundle, const fitted_stream *streams, encoding *e, uint64_t at_least,
    int64_t *grams, uint32_t *largest)
{
    pass p = { e, streams, grams, largest, NULL, 0, at_least, 0 };
    make_streams(file, bundle, &p);
}

/* Adds to counts (25, 256, alphabet) how often each expected size has each token. streams: with their numbers. */
POTR_EXPORT void potr_bundles_count(
    const file_integers *file, uint64_t bundle, const fitted_stream *streams, encoding *e, size_t alphabet,
    uint32_t *counts)
{
    pass p = { e, streams, NULL, NULL, counts, alphabet, 0, 0 };
    make_streams(file, bundle, &p);
}

/* Where words go, from the end downwards. */
typedef struct {
    uint16_t *words;
    size_t at;
} writer;

static INLINE void give_word(writer *w, uint32_t *state, int full)
{
    if (full) {
        w->words[--w->at] = (uint16_t)*state;
        *state >>= 16;
    }
}

static void code_stream(const made_stream *made, const fitted_stream *f, size_t lanes, uint32_t *states, writer *w)
{
    const size_t items = made->items, steps = (items + lanes - 1) / lanes;
    for (size_t step = steps; step-- > 0;) {
        const size_t count = (items - step + steps - 1) / steps, row = step * LANES;
        unsigned most = 0;
        for (size_t l = 0; l < count; l++)
            most = made->tokens[row + l] > most ? made->tokens[row + l] : most;
        if (most >= DIRECT)
            for (unsigned shift = (extra_bits(most) - 1) / CHUNK * CHUNK + CHUNK; shift > 0;) {
                shift -= CHUNK;
                for (size_t l = count; l-- > 0;) {
                    const unsigned all = extra_bits(made->tokens[row + l]);
                    if (all <= shift)
                        continue;
                    const unsigned bits = all - shift < CHUNK ? all - shift : CHUNK;
                    give_word(w, &states[l], states[l] >= 1u << (32 - bits));
                    states[l] = states[l] << bits | (made->integers[row + l] >> shift & ((1u << bits) - 1));
                }
            }
        for (size_t l = count; l-- > 0;) {
            const uint32_t interval = f->intervals[(uint32_t)f->classes[made->expected[row + l]] << 8 | made->tokens[row + l]];
            const uint32_t frequency = interval & 0xffff;
            uint32_t state = states[l];
            /* A state whose quotient would not fit gives its lower half away. */
            const uint32_t full = (uint64_t)state >= (uint64_t)frequency << (32 - PRECISION);
            w->words[w->at - 1] = (uint16_t)state;
            w->at -= full;
            state >>= 16 * full;
            states[l] = state + state / frequency * (TOTAL - frequency) + (interval >> 16);
        }
    }
}

/* The words of a bundle, of which there are fewer than `room` - 1.
 *
 * streams: with all that was fitted. words: (room), filled from the end on. counts: (7) words of each section, in the
 * order in which they stand. states: (32) of the chain that begins with opacities, rotation_states: of the other.
 * Returns the first word's place. */
POTR_EXPORT size_t potr_bundles_code(
    const file_integers *file, uint64_t bundle, const fitted_stream *streams, encoding *e, uint16_t *words, size_t room,
    uint64_t *counts, uint32_t *states, uint32_t *rotation_states)
{
    static const size_t begin[SECTIONS + 1] = { OPACITY_STREAM, SCALE_STREAM, DC_STREAM, BAND_STREAM,
        BAND_STREAM + BAND_STREAMS, BAND_STREAM + 2 * BAND_STREAMS, ROTATION_STREAM, STREAMS };
    pass p = { e, streams, NULL, NULL, NULL, 0, 0, 0 };
    make_streams(file, bundle, &p);
    writer w = { words, room };
    for (size_t l = 0; l < LANES; l++)
        states[l] = rotation_states[l] = LOWEST;
    for (size_t section = SECTIONS; section-- > 0;) {
        const size_t before = w.at;
        for (size_t s = begin[section + 1]; s-- > begin[section];)
            code_stream(&e->made[s], &streams[s], p.lanes, section == ROTATION ? rotation_states : states, &w);
        counts[section] = before - w.at;
    }
    return w.at;
}
