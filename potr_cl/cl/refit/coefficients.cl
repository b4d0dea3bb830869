/* Sums and products of vectors of coefficients.

   Macros: LANES (splats a work-item of those kernels that go over splats), SH_COUNT. */

#include "refit/coefficients.clh"

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

/* y = a y + b x. */
kernel void combine(float a, global float *y, float b, global const float *x)
{
    const size_t i = get_global_id(0);
    y[i] = a * y[i] + b * x[i];
}

/* parts[i] = the sum of x y over every get_global_size(0)-th element from i on, in a fixed order;
   parts[get_global_size(0) + i] = the largest |x| among them. */
kernel void dot_parts(global const float *x, global const float *y, ulong count, global float *parts)
{
    const size_t items = get_global_size(0), first = get_global_id(0);
    float sum = 0.0f, lost = 0.0f, largest = 0.0f;
    for (size_t i = first; i < count; i += items) {
        /* Kahan's compensated sum. */
        const float term = MAD(x[i], y[i], -lost);
        const float next = sum + term;
        lost = (next - sum) - term;
        sum = next;
        largest = fmax(largest, fabs(x[i]));
    }
    parts[first] = sum;
    parts[items + first] = largest;
}
