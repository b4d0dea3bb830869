/* The splats' own blocks of the normal equations. `precondition` applies their inverses, `select_active` finds by them
   which coefficients are given up.

   Macros: LANES (splats a work-item), SH_COUNT (coefficients of a channel).

   On GPUs: LANES=1 SH_COUNT=1,4,9,16. */

#include "refit/coefficients.clh"

/* The diagonal's least part of its mean: columns that no view tells apart get no huge steps. */
#define DAMPING 1e-5f
/* The least part of its diagonal that a pivot keeps; below, the coefficient is left as it is. */
#define LEAST_PIVOT 1e-6f
/* Added to the unit diagonal of a scaled block before it is inverted in single precision. */
#define UNIT_DAMPING 1e-4f

/* a b + c. Where loops are unrolled a compiler can choose which of two products it fuses with a sum; here it is told,
   so that the bits are those of the loops. */
#if LANES == 1
#define FUSED(a, b, c) fma(a, b, c)
#else
#define FUSED MAD
#endif

/* result = the inverse of each splat's own block of the normal equations, restricted to the active coefficients, times
   residual and the splat's share: a Cholesky factorisation a channel, which is the second dimension. The squared lengths of Y, Co and Cg in R, G, B are 3, 2 and 3. */
kernel NARROW void precondition(
    global const float *residual,
    global const float *blocks,
    global const uint *active,
    global const float *shares,
    ulong stride,
    float lambda_luma,
    float lambda_chroma,
    float prior,
    global float *result)
{
#if LANES == 1
#pragma OPENCL FP_CONTRACT OFF
#endif
    const size_t index = get_global_id(0);
    vfloat trace = (vfloat)(0.0f);
    UNROLL
    for (int i = 0; i < SH_COUNT; ++i)
        trace += VLOAD(index, blocks + AT(i, i) * stride);
    const size_t c = get_global_id(1);
    const float length = c == 1 ? 2.0f : 3.0f;
    const float lambda = c == 0 ? lambda_luma : lambda_chroma;
    const vfloat least = trace * (DAMPING * length / SH_COUNT);
    /* Row by row, U with U^T U = block. The diagonal holds the pivots' inverse square roots, and 0 for what is left
       out. */
    ARRAY(factor, TRIANGLE);
    ARRAY(y, SH_COUNT);
    UNROLL
    for (int j = 0; j < SH_COUNT; ++j) {
        const size_t column = 3 * j + c;
        const vfloat own = VLOAD(index, blocks + AT(j, j) * stride);
        const vfloat diagonal = FUSED((vfloat)(length), own, least + (prior + (j ? lambda : 0.0f)));
        vfloat pivot = diagonal, rest = VLOAD(index, residual + column * stride);
        UNROLL
        for (int i = 0; i < j; ++i) {
            pivot = FUSED(-factor[OWN(AT(i, j))], factor[OWN(AT(i, j))], pivot);
            rest = FUSED(-factor[OWN(AT(i, j))], y[OWN(i)], rest);
        }
        const vint keep = (pivot > LEAST_PIVOT * diagonal) && (pivot > 1e-30f);
        const vfloat inverse =
            (keep ? 1.0f / sqrt(pivot) : (vfloat)(0.0f)) * active_lanes(active, stride, index, column);
        factor[OWN(AT(j, j))] = inverse;
        y[OWN(j)] = rest * inverse;
        UNROLL
        for (int k = j + 1; k < SH_COUNT; ++k) {
            vfloat sum = length * VLOAD(index, blocks + AT(j, k) * stride);
            UNROLL
            for (int i = 0; i < j; ++i)
                sum = FUSED(-factor[OWN(AT(i, j))], factor[OWN(AT(i, k))], sum);
            factor[OWN(AT(j, k))] = sum * inverse * active_lanes(active, stride, index, 3 * k + c);
        }
    }
    UNROLL
    for (int j = SH_COUNT - 1; j >= 0; --j) {
        UNROLL
        for (int k = j + 1; k < SH_COUNT; ++k)
            y[OWN(j)] = FUSED(-factor[OWN(AT(j, k))], y[OWN(k)], y[OWN(j)]);
        y[OWN(j)] *= factor[OWN(AT(j, j))];
        VSTORE(y[OWN(j)] * VLOAD(index, shares), index, result + (3 * j + c) * stride);
    }
}

/* direction = 1 in the constant coefficients of Y that may change, 0 in all others. */
kernel void same_for_all(global const uint *active, ulong stride, global float *direction)
{
    const size_t index = get_global_id(0);
    VSTORE(active_lanes(active, stride, index, 0), index, direction);
    for (int column = 1; column < 3 * SH_COUNT; ++column)
        VSTORE((vfloat)(0.0f), index, direction + column * stride);
}

/* From the product of the normal equations with that: the fourth root of the part that each splat has itself of what
   its pixels take in when all splats change alike; 1 where nothing is known. */
kernel void set_shares(global const float *product, global const float *blocks, ulong stride, global float *shares)
{
    const size_t index = get_global_id(0);
    const vfloat own = 3.0f * VLOAD(index, blocks), all = VLOAD(index, product);
    const vint others = own > 0.0f && all > own && all < 1e30f;
    VSTORE(others ? sqrt(sqrt(own / all)) : (vfloat)(1.0f), index, shares);
}

/* Where select_active keeps a splat's block, which it indexes while it runs: local memory where a work-item does one splat.
   Registers would not hold it beside the others. OWN_GROUP splats a work-group. */
#if LANES == 1
#define BLOCK_MEMORY local float block[TRIANGLE * OWN_GROUP]
#define P(i, j) block[AT(i, j) * OWN_GROUP + get_local_id(0)]
#else
#define BLOCK_MEMORY vfloat block[TRIANGLE]
#define P(i, j) block[AT(i, j)]
#endif

/* Gives up AC coefficients, splat by splat and channel by channel: again and again the one whose loss costs least, as
   long as that is less than `least`. The other coefficients of the channel make up for it as well as they can; all
   other splats stay as they are. With P the inverse of the block, the loss of x_m costs x_m^2 / P_mm, moves the others
   by -x_m P_jm / P_mm, and takes P_im P_jm / P_mm off P. A launch does channel c: flags of all channels share words. */
kernel NARROW void select_active(
    global float *coefficients,
    global const float *blocks,
    global uint *active,
    ulong stride,
    float prior,
    float least,
    int c)
{
    const size_t index = get_global_id(0);
    const float length = c == 1 ? 2.0f : 3.0f;
    /* Scaled to a unit diagonal; what is not active has an empty row and column. */
    BLOCK_MEMORY;
    ARRAY(x, SH_COUNT);
    ARRAY(scale, SH_COUNT);
    ARRAY(keep, SH_COUNT);
    ARRAY(column, SH_COUNT);
    UNROLL
    for (int j = 0; j < SH_COUNT; ++j) {
        const vfloat diagonal = MAD(length, VLOAD(index, blocks + AT(j, j) * stride), (vfloat)(prior));
        keep[OWN(j)] = active_lanes(active, stride, index, 3 * j + c);
        scale[OWN(j)] = sqrt(fmax(diagonal, (vfloat)(1e-30f)));
        x[OWN(j)] = keep[OWN(j)] * scale[OWN(j)] * VLOAD(index, coefficients + (3 * j + c) * stride);
    }
    UNROLL
    for (int i = 0; i < SH_COUNT; ++i)
        UNROLL
        for (int j = i; j < SH_COUNT; ++j) {
            const vfloat product = length * VLOAD(index, blocks + AT(i, j) * stride) / (scale[OWN(i)] * scale[OWN(j)]);
            P(i, j) = i == j ? (vfloat)(1.0f + UNIT_DAMPING) : product * keep[OWN(i)] * keep[OWN(j)];
        }
    /* p becomes minus the inverse: one sweep a column, symmetric all the way. */
    for (int k = 0; k < SH_COUNT; ++k) {
        UNROLL
        for (int j = 0; j < SH_COUNT; ++j)
            column[OWN(j)] = j < k ? P(j, k) : P(k, j);
        const vfloat inverse = 1.0f / fmax(P(k, k), (vfloat)(UNIT_DAMPING));
        UNROLL
        for (int i = 0; i < SH_COUNT; ++i)
            UNROLL
            for (int j = i; j < SH_COUNT; ++j)
                if (i == k || j == k)
                    P(i, j) = i == j ? -inverse : column[OWN(i == k ? j : i)] * inverse;
                else
                    P(i, j) = MAD(-column[OWN(i)] * inverse, column[OWN(j)], P(i, j));
    }
    for (int round = 1; round < SH_COUNT; ++round) {
        vfloat best = (vfloat)(least);
        vint worst = (vint)(0);
        UNROLL
        for (int m = 1; m < SH_COUNT; ++m) {
            const vfloat cost = x[OWN(m)] * x[OWN(m)] / fmax(-P(m, m), (vfloat)(1e-30f));
            const vint cheaper = (keep[OWN(m)] > 0.0f) && !(cost >= best);
            best = cheaper ? cost : best;
            worst = cheaper ? (vint)(m) : worst;
        }
        if (!VANY(worst > 0))
            break;
        vfloat value = (vfloat)(0.0f), pivot = (vfloat)(-1.0f);
        UNROLL
        for (int j = 0; j < SH_COUNT; ++j) {
            column[OWN(j)] = (vfloat)(0.0f);
            UNROLL
            for (int m = 1; m < SH_COUNT; ++m)
                column[OWN(j)] = worst == m ? (j < m ? P(j, m) : P(m, j)) : column[OWN(j)];
        }
        UNROLL
        for (int m = 1; m < SH_COUNT; ++m) {
            value = worst == m ? x[OWN(m)] : value;
            pivot = worst == m ? P(m, m) : pivot;
            keep[OWN(m)] = worst == m ? (vfloat)(0.0f) : keep[OWN(m)];
        }
        const vfloat inverse = 1.0f / fmin(pivot, (vfloat)(-1e-30f));
        UNROLL
        for (int i = 0; i < SH_COUNT; ++i) {
            x[OWN(i)] = (MAD(-column[OWN(i)] * inverse, value, x[OWN(i)])) * (i ? keep[OWN(i)] : (vfloat)(1.0f));
            UNROLL
            for (int j = i; j < SH_COUNT; ++j)
                P(i, j) = MAD(-column[OWN(i)] * inverse, column[OWN(j)], P(i, j));
        }
    }
    UNROLL
    for (int j = 0; j < SH_COUNT; ++j) {
        const size_t column = 3 * j + c;
        const vfloat was = VLOAD(index, coefficients + column * stride), value = x[OWN(j)] / scale[OWN(j)];
        const vint changed = active_lanes(active, stride, index, column) > 0.0f;
        VSTORE(
            changed ? (fabs(value) < 1e30f ? value : (vfloat)(0.0f)) : was, index, coefficients + column * stride);
        float kept[LANES];
        VSTORE(keep[OWN(j)], 0, kept);
        for (int lane = 0; lane < LANES; ++lane)
            if (j && kept[lane] == 0.0f)
                active[(column / 24) * stride + index * LANES + lane] &= ~(1u << (column % 24));
    }
}
