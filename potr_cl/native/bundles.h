/* What the decoder and the encoder of bundles share (docs/format.md, "Bundles"). */

#ifndef POTR_BUNDLES_H
#define POTR_BUNDLES_H

#include <string.h>

#include "potr_native.h"

enum {
    PRECISION = 12,
    TOTAL = 1 << PRECISION,
    LOWEST = 1 << 16,
    LANES = 32,
    LANE = 256,
    BUNDLE = LANES * LANE,
    DIRECT = 128,          /* tokens below stand for themselves */
    CHUNK = 12,            /* extra bits that a state gives at a time */
    BAND = 7,              /* most coefficients of a degree */
    ITEMS = BAND * BUNDLE, /* most items of a bundle's stream */
    TOKENS = 256,
    LARGEST_SIZE = 255,
    COUNT_SIZE = 32,
    CHROMA_SIZE = 128,
    STEP_SIZE = 4,
    ENOUGH = 1024,         /* levels of scales whose logarithms are looked up */
    CLASSES = 32,          /* of steps: from minus this to one less */
    KNOTS = 17,
    TERMS = 12             /* most of a stream */
};

/* Integers of splats. Those of real files are below 2^29 in magnitude; POTR_WIDE_LEVELS has room for all that the format
 * allows, for builds that have no other path for them. */
#if defined(POTR_WIDE_LEVELS)
typedef int64_t level;
typedef uint64_t mapped_level;
#else
typedef int32_t level;
typedef uint32_t mapped_level;
#endif

/* Sections in the order of decoding, and where the streams of each begin among all. */
enum { OPACITY, SCALE, DC, BAND_1, BAND_2, BAND_3, ROTATION, SECTIONS };
enum { OPACITY_STREAM = 0, SCALE_STREAM = 1, DC_STREAM = 4, BAND_STREAM = 7, ROTATION_STREAM = 22, STREAMS = 25 };
enum { MASK_STREAM, PATTERN_STREAM, VALUE_STREAM, BAND_STREAMS = 5 };

static INLINE unsigned extra_bits(unsigned token)
{
    return token < DIRECT ? 0 : 5 + (token - DIRECT) / 4;
}

/* What is known of a stream. */
typedef struct {
    const uint8_t *classes;    /* (256) context of each expected size */
    const uint8_t *slots;      /* (contexts · 4096 + 3) token of each slot */
    const uint32_t *intervals; /* (contexts · 256) of each token: frequency less 1, from bit 12 on the sum of those below,
                                  from bit 24 on the size, where all sizes are that small */
    const int16_t *sizes;      /* (256) of each token */
    int32_t weights[TERMS];    /* of its terms */
    int32_t biases[8];         /* by coefficient */
    int32_t recent, constant;
    int32_t alphabet;
    int32_t by_vectors;        /* whether all sizes are below 256, and the processor has what potr_bundles_vectors says */
} stream_model;

/* What gives each splat the steps of its colours; groups is NULL where all steps are the same. */
typedef struct {
    const int8_t *groups; /* of 2^group_bits splats each */
    int32_t group_bits, knot_shift, first_knot;
    int32_t powers[2], offsets[2], scales[3], knots[KNOTS];
} colour_steps;

/* A block's sections of bundles. */
typedef struct {
    stream_model streams[STREAMS];
    const uint8_t *words[SECTIONS];   /* NULL where there is no such section */
    const uint64_t *starts[SECTIONS]; /* (bundles + 1) first word of each bundle */
    const uint32_t *states;           /* (lanes of all bundles) of the chain of all sections but rotations */
    const uint32_t *rotation_states;
    uint64_t splats;
    colour_steps steps;
} bundled_file;

/* What a bundle's decoding works with, and its results. */
typedef struct {
    /* Sizes of tokens in rows, which are terms of contexts. */
    int16_t opacity_sizes[BUNDLE], scale_sizes[3][BUNDLE], dc_sizes[3][BUNDLE], rotation_sizes[3][BUNDLE];
    int16_t difference_sizes[3][BUNDLE], mask_sizes[BUNDLE], sums[3][BUNDLE];
    int16_t step_sizes[BUNDLE];
    /* Classes of the steps of DC and of AC, in rows, from 0 on: more by CLASSES than they are. */
    uint8_t dc_classes[BUNDLE], ac_classes[BUNDLE];
    /* Integers in rows; of DC what its prediction has left. */
    level opacity[BUNDLE], scales[3][BUNDLE], rotations[3][BUNDLE], dc[3][BUNDLE];
    /* AC coefficients that are not 0, degree by degree, in the order of splats: place, number of the coefficient from
     * the first of the degree on, channels. */
    uint16_t places[3][ITEMS + 8];
    uint8_t coefficients[3][ITEMS + 8];
    level channels[3][3][ITEMS];
    uint32_t items[3];
    /* Of the stream that is being decoded: in rows of its own. */
    int32_t expected[ITEMS + LANES];
    uint8_t tokens[ITEMS + LANES];
    int16_t sizes[ITEMS + LANES];
    mapped_level extra[ITEMS + LANES];
    /* Of the degree that is being decoded. */
    int32_t of_splats[BUNDLE];
    uint8_t patterns[ITEMS];
    uint32_t chosen[ITEMS + 1];
    int16_t value_sizes[3][ITEMS];
    /* Tables. */
    uint64_t coefficient_bytes[128];
    int16_t logarithms[ENOUGH];
} work;

enum { FINE, TOO_FEW_WORDS, TOO_MANY_WORDS, BAD_END, BEYOND_TABLE };

/* The bits of a mask, a byte each, lowest first; 0 behind the last. */
static INLINE void list_bits(unsigned mask, uint64_t *bits)
{
    uint8_t bytes[8] = { 0 };
    for (unsigned bit = 0, number = 0; bit < BAND; bit++)
        if (mask >> bit & 1)
            bytes[number++] = (uint8_t)bit;
    memcpy(bits, bytes, 8);
}

/* Bundles have as many lanes as their splats need, and lanes as many steps. */
static INLINE size_t splats_of(const bundled_file *file, uint64_t bundle)
{
    const uint64_t left = file->splats - bundle * BUNDLE;
    return left < BUNDLE ? (size_t)left : BUNDLE;
}

static INLINE size_t lanes_of(size_t splats)
{
    return (splats + LANE - 1) / LANE;
}

static INLINE size_t steps_of(size_t splats)
{
    return (splats + lanes_of(splats) - 1) / lanes_of(splats);
}

/* A bundle's integers into `w`: of so many sections of the chain that begins with opacities, and of rotations.
 * *section becomes the one at fault. */
int decode_bundle(const bundled_file *file, uint64_t bundle, int sections, int rotations, work *w, int *section);

/* n quaternions w, x, y, z of any length, as long as 1. */
void potr_unit_quaternions(const float *restrict quaternions, size_t n, float *restrict units);

#endif
