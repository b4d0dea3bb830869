/* DC from what its prediction has left (docs/format.md, "Prediction"). Sums and products wrap round.
 *
 * Prediction begins anew after 256 splats, so several such runs are worked on side by side: what one splat waits for of
 * the splat before it does not keep the others from going on. */

#ifndef POTR_PREDICTION_H
#define POTR_PREDICTION_H

#include <string.h>

#include "potr_native.h"

enum { RUN = 256, SIDE_BY_SIDE = 4 };

/* What is known of the classes of steps. */
typedef struct {
    const uint64_t *step, *inverse; /* (64) of each class */
    const float *factors;           /* (64) scale factors */
} dc_steps;

/* The next splat of a run. total, last: its state. rgb: its colour, times its scale factor. */
static INLINE void next_dc(
    const dc_steps *of, unsigned class, const uint64_t *residuals, uint64_t *total, uint64_t *last, float *rgb)
{
    const uint64_t step = of->step[class], inverse = of->inverse[class];
    uint64_t level[3];
    for (size_t c = 0; c < 3; c++) {
        const int64_t mean = (int64_t)(total[c] * inverse + (UINT64_C(1) << 33)) >> 34;
        level[c] = residuals[c] + (uint64_t)mean;
        const uint64_t value = level[c] * step;
        total[c] += value - last[c];
        last[c] = value;
    }
    const uint64_t rest = level[0] - level[2];
    rgb[0] = (float)(int64_t)(rest + level[1]);
    rgb[1] = (float)(int64_t)(level[0] + level[2]);
    rgb[2] = (float)(int64_t)(rest - level[1]);
}

/* Declares `name`, which does `runs` runs of `number` splats: 4 of 256, or one of fewer. What is left of the levels of
 * Y, Co, Cg comes in arrays of `type`, integers that `read` makes of it, from a splat to the next `along` further, from
 * a run to the next `apart`; classes from 0 on, in the same way. R, G, B go to arrays in the order of splats. */
#define DC_OF(name, type, read) \
    static INLINE void name( \
        const dc_steps *of, const type *y, const type *co, const type *cg, const uint8_t *classes, size_t along, \
        size_t apart, size_t runs, size_t number, float *red, float *green, float *blue) \
    { \
        uint64_t total[SIDE_BY_SIDE][3] = { { 0 } }, last[4][SIDE_BY_SIDE][3] = { { { 0 } } }; \
        float sums[3][SIDE_BY_SIDE][RUN], divisors[SIDE_BY_SIDE][RUN]; \
        for (size_t i = 0; i < number; i++) \
            for (size_t r = 0; r < runs; r++) { \
                const size_t at = i * along + r * apart; \
                const uint64_t residuals[3] = { \
                    (uint64_t)(int64_t)read(y[at]), (uint64_t)(int64_t)read(co[at]), (uint64_t)(int64_t)read(cg[at]) \
                }; \
                const unsigned class = classes[at] & 63; \
                float rgb[3]; \
                next_dc(of, class, residuals, total[r], last[i & 3][r], rgb); \
                divisors[r][i] = of->factors[class]; \
                for (size_t c = 0; c < 3; c++) \
                    sums[c][r][i] = rgb[c]; \
            } \
        for (size_t r = 0; r < runs; r++) \
            for (size_t i = 0; i < number; i++) { \
                red[r * RUN + i] = sums[0][r][i] / divisors[r][i]; \
                green[r * RUN + i] = sums[1][r][i] / divisors[r][i]; \
                blue[r * RUN + i] = sums[2][r][i] / divisors[r][i]; \
            } \
    }

#endif
