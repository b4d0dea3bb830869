/* Sums and products of vectors of coefficients.

   Macros: LANES (splats a work-item of those kernels that go over splats), SH_COUNT.

   On GPUs: LANES=1 SH_COUNT=1,4,9,16. */

#include "refit/coefficients.clh"

/* Values that a work-item of a dot product loads together. */
#define AT_ONCE 16

/* sums += (lambda, on AC only, + prior) x coefficients, and 0 where a coefficient is not active. */
kernel void regularise(
    global float *sums,
    global const float *coefficients,
    global const uint *active,
    ulong stride,
    float lambda_luma,
    float lambda_chroma,
    float prior)
{
    const size_t index = get_global_id(0);
    for (int m = 0; m < SH_COUNT; ++m)
        for (int c = 0; c < 3; ++c) {
            const size_t column = 3 * m + c;
            const float pull = prior + (m == 0 ? 0.0f : c == 0 ? lambda_luma : lambda_chroma);
            const vfloat value =
                MAD(pull, VLOAD(index, coefficients + column * stride), VLOAD(index, sums + column * stride));
            VSTORE(value * active_lanes(active, stride, index, column), index, sums + column * stride);
        }
}

/* Columns in R, G, B, as rows of a scene are turned to columns, become Y, Co, Cg where they are. */
kernel void to_ycocg(global float *columns, ulong stride)
{
    const size_t index = get_global_id(0);
    for (int m = 0; m < SH_COUNT; ++m) {
        global float *three = columns + 3 * m * stride;
        /* In this order nothing overflows. */
        const vfloat r = 0.5f * VLOAD(index, three), g = 0.5f * VLOAD(index, three + stride);
        const vfloat b = 0.5f * VLOAD(index, three + 2 * stride);
        VSTORE(MAD(0.5f, r, MAD(0.5f, b, g)), index, three);
        VSTORE(r - b, index, three + stride);
        VSTORE(MAD(-0.5f, r, MAD(-0.5f, b, g)), index, three + 2 * stride);
    }
}

/* The way back, to other columns. In this order nothing overflows that did not in R, G, B. */
kernel void to_rgb(global const float *columns, ulong stride, global float *result)
{
    const size_t index = get_global_id(0);
    for (int m = 0; m < SH_COUNT; ++m) {
        global const float *three = columns + 3 * m * stride;
        global float *rgb = result + 3 * m * stride;
        const vfloat y = VLOAD(index, three), co = VLOAD(index, three + stride);
        const vfloat cg = VLOAD(index, three + 2 * stride);
        VSTORE((y - cg) + co, index, rgb);
        VSTORE(y + cg, index, rgb + stride);
        VSTORE((y - cg) - co, index, rgb + 2 * stride);
    }
}

/* y = a y + b x. */
kernel void combine(float a, global float *y, float b, global const float *x)
{
    const size_t i = get_global_id(0);
    y[i] = a * y[i] + b * x[i];
}

/* parts[i] = the sum of x y over every get_global_size(0)-th element from i on, in a fixed order;
   parts[get_global_size(0) + i] = the largest |x| among them; the third part is what the sums still lack. With `more`,
   it goes on where it was: x and y are then the next elements of longer vectors, all pieces of which but the last are
   whole multiples of get_global_size(0). */
kernel void dot_parts(global const float *x, global const float *y, ulong count, uint more, global float *parts)
{
    const size_t items = get_global_size(0), first = get_global_id(0);
    float sum = 0.0f, lost = 0.0f, largest = 0.0f;
    if (more) {
        sum = parts[first];
        largest = parts[items + first];
        lost = parts[2 * items + first];
    }
    size_t i = first;
#if LANES == 1
    /* A GPU waits long for what it loads: for many values at a time no longer than for one. */
    for (; i + (AT_ONCE - 1) * items < count; i += AT_ONCE * items) {
        float xs[AT_ONCE], ys[AT_ONCE];
        for (int k = 0; k < AT_ONCE; ++k) {
            xs[k] = x[i + k * items];
            ys[k] = y[i + k * items];
        }
        for (int k = 0; k < AT_ONCE; ++k) {
            const float term = MAD(xs[k], ys[k], -lost);
            const float next = sum + term;
            lost = (next - sum) - term;
            sum = next;
            largest = fmax(largest, fabs(xs[k]));
        }
    }
#endif
    for (; i < count; i += items) {
        /* Kahan's compensated sum. */
        const float term = MAD(x[i], y[i], -lost);
        const float next = sum + term;
        lost = (next - sum) - term;
        sum = next;
        largest = fmax(largest, fabs(x[i]));
    }
    parts[first] = sum;
    parts[items + first] = largest;
    parts[2 * items + first] = lost;
}
