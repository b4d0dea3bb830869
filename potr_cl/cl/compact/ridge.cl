/* Spherical-harmonics energy compaction: a weighted ridge regression for each splat and colour channel (paper section
   "Spherical harmonics energy compaction"). A work-item does LANES splats in structure-of-arrays form. Both kernel
   families use it.

   For a splat, the rows of its basis matrix are the SH basis in the directions from the views that see it, times the
   views' weights. The matrix is reduced to a triangle (ridge_orthogonal.clh or ridge_cholesky.clh), and nearly parallel
   columns are dropped. Each channel is solved, the AC coefficients that quantise to zero are dropped, and it is solved
   again. The colours to match are the basis times the splat's own coefficients, so they are never formed: only the
   difference to the known coefficients matters. The DC term is not penalised, so the unknown is its change, which keeps
   its digits out of the rounding of the AC terms.

   Macros:
       LANES       see reals.clh; 1 on GPUs;
       SH_COUNT    coefficients of a channel: 4, 9 or 16;
       BLOCK       rows of the matrix that are reduced at a time;
       ORTHOGONAL  1: reduce by reflections (ridge_orthogonal.clh);
                   0: by the normal equations (ridge_cholesky.clh).

   On GPUs: LANES=1 SH_COUNT=4,9,16 BLOCK=4 ORTHOGONAL=0,1. */

#include "include/reals.clh"
#include "include/sh_basis.clh"

#define TRIANGLE (SH_COUNT * (SH_COUNT + 1) / 2)
#define AT(row, column) ((row) * (2 * SH_COUNT - (row) - 1) / 2 + (column))
/* Of a column of which less than this part remains, only rounding remains. */
#define TOLERANCE (4 * ROUNDING)
/* An AC coefficient is at most this times the larger of 1 and the norm of the channel's original coefficients. */
#define LARGEST_GROWTH 4

#if ORTHOGONAL
#include "compact/ridge_orthogonal.clh"
#else
#include "compact/ridge_cholesky.clh"
#endif

/* keep becomes 1 for the columns to use. They are not zero, and the |cosine| to every column used before is at most
   `threshold`. */
inline void drop_parallel(const VREAL *state, REAL threshold, VREAL *keep)
{
    VREAL norm[SH_COUNT];
    for (int j = 0; j < SH_COUNT; ++j) {
        norm[j] = sqrt(fmax(column_product(state, j, j), (VREAL)(0)));
        keep[j] = norm[j] > 0 ? (VREAL)(1) : (VREAL)(0);
        if (threshold < 1)
            for (int i = 0; i < j; ++i) {
                VREAL excess = fabs(column_product(state, i, j)) - threshold * norm[i] * norm[j];
                keep[j] = keep[i] * excess > 0 ? (VREAL)(0) : keep[j];
            }
    }
}

kernel void compact(
    global float *sh,                    /* splats x SH_COUNT x 3, R, G, B; replaced */
    global const float4 *means,
    global const uint *order,            /* the splats that any view sees, by how many views see them */
    global const uint *offsets,          /* where each splat's run in view_numbers and weights begins; splats + 1 */
    global const uint *view_numbers,
    global const float *weights,
    global const float4 *camera_centres, /* two for each view: the high and the low part of its position */
    uint splats,                         /* that order holds */
    float threshold,
    float lambda_luma,
    float lambda_chroma,
    float scale_factor,                  /* of the quantiser; 0: one pass only */
    int ycocg)
{
    const uint first = get_global_id(0) * LANES;

    uint splat[LANES], cursor[LANES], end[LANES];
    REAL4 centre[LANES];
    uint longest = 0;
    for (int lane = 0; lane < LANES; ++lane) {
        splat[lane] = order[min(first + lane, splats - 1)];
        cursor[lane] = offsets[splat[lane]];
        end[lane] = first < splats ? offsets[splat[lane] + 1] : cursor[lane];
        centre[lane] = TO_REAL4(means[splat[lane]]);
        longest = max(longest, end[lane] - cursor[lane]);
    }
    /* Work-items beyond the last splat end here. Their number alone must not tell that: Intel's CPU runtime would run a
       work-group cut short by it through its scalar code, which rounds differently (it fuses other products and
       sums). */
    if (longest == 0)
        return;

    VREAL state[TRIANGLE];
    for (int i = 0; i < TRIANGLE; ++i)
        state[i] = 0;
    for (uint done = 0; done < longest; done += BLOCK) {
        REAL ray[BLOCK][4][LANES];
        for (int lane = 0; lane < LANES; ++lane)
            for (int b = 0; b < BLOCK; ++b) {
                uint entry = cursor[lane] + done + b;
                bool present = entry < end[lane];
                entry = present ? entry : cursor[lane];
                uint view = view_numbers[entry];
                REAL4 high = TO_REAL4(camera_centres[2 * view]), low = TO_REAL4(camera_centres[2 * view + 1]);
                REAL4 to_splat = centre[lane] - high - low;
                ray[b][0][lane] = to_splat.x;
                ray[b][1][lane] = to_splat.y;
                ray[b][2][lane] = to_splat.z;
                ray[b][3][lane] = present ? weights[entry] : 0;
            }
        VREAL rows[SH_COUNT * BLOCK];
        for (int b = 0; b < BLOCK; ++b) {
            VREAL x = VLOAD(0, ray[b][0]), y = VLOAD(0, ray[b][1]), z = VLOAD(0, ray[b][2]);
            VREAL length = sqrt(x * x + y * y + z * z);
            VREAL inverse = 1 / (length > 0 ? length : (VREAL)(1));
            VREAL values[SH_COUNT];
            sh_basis(x * inverse, y * inverse, z * inverse, values);
            VREAL weight = VLOAD(0, ray[b][3]);
            for (int k = 0; k < SH_COUNT; ++k)
                rows[k * BLOCK + b] = values[k] * weight;
        }
        add_rows(state, rows);
    }

    VREAL usable[SH_COUNT];
    drop_parallel(state, threshold, usable);

    VREAL coefficients[3][SH_COUNT];
    for (int k = 0; k < SH_COUNT; ++k) {
        REAL rgb[3][LANES];
        for (int lane = 0; lane < LANES; ++lane)
            for (int c = 0; c < 3; ++c)
                rgb[c][lane] = sh[((size_t)splat[lane] * SH_COUNT + k) * 3 + c];
        VREAL r = VLOAD(0, rgb[0]), g = VLOAD(0, rgb[1]), b = VLOAD(0, rgb[2]);
        coefficients[0][k] = ycocg ? g / 2 + (r + b) / 4 : r;
        coefficients[1][k] = ycocg ? (r - b) / 2 : g;
        coefficients[2][k] = ycocg ? g / 2 - (r + b) / 4 : b;
    }

    for (int c = 0; c < 3; ++c) {
        const REAL lambda = c == 0 || !ycocg ? lambda_luma : lambda_chroma;
        VREAL target[SH_COUNT], keep[SH_COUNT], x[SH_COUNT];
        VREAL original = 0;
        for (int k = 0; k < SH_COUNT; ++k) {
            target[k] = coefficients[c][k];
            original = mad(target[k], target[k], original);
            keep[k] = usable[k];
        }
        target[0] = 0;
        solve(state, target, keep, lambda, x);
        if (scale_factor > 0) {
            for (int k = 1; k < SH_COUNT; ++k)
                keep[k] = floor(mad(x[k], (VREAL)(scale_factor), (VREAL)(LITERAL(0.5)))) == 0 ? (VREAL)(0) : keep[k];
            solve(state, target, keep, lambda, x);
        }

        /* The minimum must not be larger than the objective at the original coefficients with the dropped ones zero. */
        VREAL error[SH_COUNT], start_error[SH_COUNT];
        VREAL penalty = 0, start_penalty = 0, largest = 0;
        for (int k = 0; k < SH_COUNT; ++k) {
            error[k] = target[k] - x[k];
            start_error[k] = k ? target[k] * (1 - keep[k]) : (VREAL)(0);
            if (k) {
                penalty = mad(x[k], x[k], penalty);
                start_penalty = mad(target[k] * keep[k], target[k] * keep[k], start_penalty);
                largest = fmax(largest, fabs(x[k]));
            }
        }
        VREAL objective = squared_norm(state, error) + lambda * penalty;
        VREAL start = squared_norm(state, start_error) + lambda * start_penalty;
        VREAL noise = 256 * ROUNDING * ROUNDING * original * column_product(state, 0, 0);
        VREAL limit = LARGEST_GROWTH * fmax(sqrt(original), (VREAL)(1));
        x[0] += coefficients[c][0];
        for (int k = 0; k < SH_COUNT; ++k) {
            /* It is read before the choice. Of a choice between two elements of private arrays Intel's CPU compiler
               makes a read at a chosen address, and its vectoriser gives all work-items what the first one reads
               there. */
            VREAL own = coefficients[c][k];
            VREAL accepted = objective <= LITERAL(1.01) * start + noise ? x[k] : own;
            coefficients[c][k] = largest <= limit ? accepted : own;
        }
    }

    for (int k = 0; k < SH_COUNT; ++k) {
        VREAL a = coefficients[0][k], b = coefficients[1][k], c = coefficients[2][k];
        REAL rgb[3][LANES];
        VSTORE(ycocg ? a - c + b : a, 0, rgb[0]);
        VSTORE(ycocg ? a + c : b, 0, rgb[1]);
        VSTORE(ycocg ? a - c - b : c, 0, rgb[2]);
        for (int lane = 0; lane < LANES; ++lane)
            for (int channel = 0; channel < 3; ++channel)
                sh[((size_t)splat[lane] * SH_COUNT + k) * 3 + channel] = (float)rgb[channel][lane];
    }
}
