/* The tokens of a stream of bundles. */

#ifndef POTR_BUNDLES_TOKENS_H
#define POTR_BUNDLES_TOKENS_H

#include "bundles.h"

/* A section's words of a bundle. */
typedef struct {
    const uint8_t *words;
    size_t read, available;
} reader;

/* A stream in rows, before and after it is decoded. */
typedef struct {
    const int32_t *expected; /* sums of terms, constant and bias */
    uint8_t *tokens;
    int16_t *sizes;          /* of the tokens */
    mapped_level *extra;     /* bits beside tokens, in rows that have some */
} rows_of_tokens;

/* Entries of stream_model.intervals. */
static INLINE uint32_t frequency_of(uint32_t interval)
{
    return (interval & (TOTAL - 1)) + 1;
}

static INLINE uint32_t start_of(uint32_t interval)
{
    return interval >> PRECISION & (TOTAL - 1);
}

/* A stream of some items. states: LANES of them. Rows of LANES are written, also where there are fewer lanes. Returns 0,
 * or 1 if there are too few words. */
int decode_tokens(
    const stream_model *model, reader *r, uint32_t *states, size_t lanes, size_t items, const rows_of_tokens *out);

#endif
