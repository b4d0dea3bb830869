/* Classes of the steps of colours. */

#ifndef POTR_STEPS_H
#define POTR_STEPS_H

#include "bundles.h"

/* Logarithms of the first ENOUGH levels. */
void list_logarithms(int16_t *logarithms);

/* Classes of n splats, at most LANES, from 0 on: more by CLASSES than they are. Splats' numbers in the file begin with
 * `first` and are `apart`. Levels are not negative. */
void find_classes(
    const colour_steps *steps, const int16_t *logarithms, const level *const *scales, const level *opacities,
    uint64_t first, size_t apart, size_t n, uint8_t *dc, uint8_t *ac);

#endif
