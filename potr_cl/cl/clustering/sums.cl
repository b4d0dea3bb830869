/* The sum of the rows of each cluster's points: four floats of a row a work-item, one point after the other in the order
   that is given, so that every run gives the same bits.

   Macros: WIDTH (floats of a row, a multiple of 4).

   On GPUs: WIDTH:4,12,24,48. */

/* order: the points sorted by cluster. starts: where each cluster begins in it, with the end of the last behind. */
kernel void sums(
    global const float *points,
    global const uint *order,
    global const uint *starts,
    global float *result)
{
    const size_t cluster = get_global_id(0) / (WIDTH / 4);
    const size_t quarter = get_global_id(0) % (WIDTH / 4);
    float4 sum = (float4)(0.0f), lost = (float4)(0.0f);
    for (uint i = starts[cluster]; i < starts[cluster + 1]; ++i) {
        /* Kahan's compensated sum: a cluster may have very many points. */
        const float4 term = vload4((size_t)order[i] * (WIDTH / 4) + quarter, points) - lost;
        const float4 next = sum + term;
        lost = (next - sum) - term;
        sum = next;
    }
    vstore4(sum, get_global_id(0), result);
}
