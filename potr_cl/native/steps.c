/* Steps of colours (docs/format.md, "Steps of colours"): from scales and opacities to classes of steps. */

#include <string.h>

#include "steps.h"

static INLINE uint8_t class_of(int64_t weight, int32_t power, int32_t offset)
{
    const int64_t class = (weight * power + offset) >> 6;
    return (uint8_t)((class < -CLASSES ? -CLASSES : class > CLASSES - 1 ? CLASSES - 1 : class) + CLASSES);
}

/* About 16 · log2(4 · x), linear between powers of two; 0 for level 0. Levels of 2^32 and more count as one less. */
static INLINE int32_t logarithm(level x)
{
    const uint64_t most = UINT32_MAX, quarters = x <= 0 ? 1 : 4 * ((uint64_t)x < most ? (uint64_t)x : most);
    int exponent = 0;
    for (uint64_t rest = quarters >> 1; rest; rest >>= 1)
        exponent++;
    return 16 * exponent + (int32_t)(((quarters - (UINT64_C(1) << exponent)) * 16) >> exponent);
}

void list_logarithms(int16_t *logarithms)
{
    for (int32_t x = 0; x < ENOUGH; x++)
        logarithms[x] = (int16_t)logarithm(x);
}

static INLINE int32_t logarithm_of(const int16_t *logarithms, level x)
{
    return x < ENOUGH ? logarithms[x] : logarithm(x);
}

/* What the opacity of a splat, and its group, add to its weight. */
static INLINE int64_t beside_scales(const colour_steps *steps, level opacity, uint64_t splat)
{
    const int64_t first = (int64_t)steps->first_knot << steps->knot_shift;
    const int64_t most = first + ((int64_t)1 << (4 + steps->knot_shift)) - 1;
    int64_t above = opacity < most ? opacity : most;
    above = above > first ? above - first : 0;
    const int64_t knot = above >> steps->knot_shift, part = above - (knot << steps->knot_shift);
    return steps->knots[knot] + ((part * (steps->knots[knot + 1] - steps->knots[knot])) >> steps->knot_shift)
        + 8 * steps->groups[splat >> steps->group_bits];
}

POTR_WIDE
void find_classes(
    const colour_steps *steps, const int16_t *logarithms, const level *const *scales, const level *opacities,
    uint64_t first, size_t apart, size_t n, uint8_t *dc, uint8_t *ac)
{
    int32_t weights[LANES], a[LANES], b[LANES], c[LANES];
    for (size_t i = 0; i < n; i++) {
        a[i] = logarithm_of(logarithms, scales[0][i]);
        b[i] = logarithm_of(logarithms, scales[1][i]);
        c[i] = logarithm_of(logarithms, scales[2][i]);
    }
    for (size_t i = 0; i < n; i++) {
        const int32_t low = a[i] < b[i] ? a[i] : b[i], high = a[i] < b[i] ? b[i] : a[i];
        const int32_t largest = high > c[i] ? high : c[i], smallest = low < c[i] ? low : c[i];
        const int32_t between = a[i] + b[i] + c[i] - largest - smallest;
        weights[i] = (steps->scales[0] * largest + steps->scales[1] * between + steps->scales[2] * smallest) >> 8;
    }
    for (size_t i = 0; i < n; i++) {
        const int64_t weight = weights[i] + beside_scales(steps, opacities[i], first + i * apart);
        dc[i] = class_of(weight, steps->powers[0], steps->offsets[0]);
        ac[i] = class_of(weight, steps->powers[1], steps->offsets[1]);
    }
}

/* Classes of n splats.
 *
 * scales: (3, n) and opacities: (n), not negative and below 2^29. steps: with groups for as many splats. dc, ac: (n). */
POTR_EXPORT void potr_steps_classes(
    const colour_steps *steps, const level *scales, const level *opacities, size_t n, int8_t *dc, int8_t *ac)
{
    int16_t logarithms[ENOUGH];
    list_logarithms(logarithms);
    for (size_t at = 0; at < n; at += LANES) {
        const level *const axes[3] = { scales + at, scales + n + at, scales + 2 * n + at };
        const size_t number = n - at < LANES ? n - at : LANES;
        uint8_t more[2][LANES];
        find_classes(steps, logarithms, axes, opacities + at, at, 1, number, more[0], more[1]);
        for (size_t i = 0; i < number; i++) {
            dc[at + i] = (int8_t)(more[0][i] - CLASSES);
            ac[at + i] = (int8_t)(more[1][i] - CLASSES);
        }
    }
}
