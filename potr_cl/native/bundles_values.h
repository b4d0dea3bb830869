/* Values of bundles. */

#ifndef POTR_BUNDLES_VALUES_H
#define POTR_BUNDLES_VALUES_H

#include "bundles.h"

/* Where the values of a file's splats go, or those of n = `stride` of them; NULL where they are not asked for. */
typedef struct {
    float *log_scales;  /* (n, 3), or (3, n) where `columns` says so */
    float *quaternions; /* (n, 4) w, x, y, z, or (4, n) */
    float *logits;      /* (n) */
    float *dc;          /* (3, n) R, G, B */
    float *ac;          /* (coefficients, 3, n), from coefficient 1 on */
    uint32_t *items;    /* (15 · splats of the bundle, 4) instead: of each coefficient that is not 0 its number · 8192 and
                           that of its splat in the bundle; R, G, B, floats as they are stored */
    const float *scale_table;   /* value of each level, */
    const float *opacity_table; /* and so many levels each */
    uint64_t scale_levels, opacity_levels;
    const float *sf_dc, *sf_ac;      /* (64) scale factors of each class of steps */
    const uint64_t *step, *inverse;  /* (64) of each class of steps, of the prediction of DC */
    float sf_rotation;
    int32_t coefficients;            /* from coefficient 1 on */
    int32_t columns, units;          /* units: whether quaternions become as long as 1 in double precision */
    uint64_t begin, stride;          /* the file's splat that is the arrays' first, and how many they have */
    uint64_t listed;                 /* is set to the number of items, where there are any: else threads may share this */
} scene_values;

POTR_EXPORT void potr_bundles_begin(work *w);

POTR_EXPORT int potr_bundles_values(
    const bundled_file *file, uint64_t bundle, int sections, int rotating, work *w, scene_values *out, int *section);

#endif
