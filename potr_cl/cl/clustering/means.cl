/* The weighted mean of the points of each cluster: four coordinates of a cluster a work-item, its points one after the
   other in the order that is given, so that every run gives the same bits.

   Macros: WIDTH (floats of a row of points and of centres, a multiple of 4). */

/* order: the points sorted by cluster. starts: where each cluster begins in it, with the end of the last behind. The
   centre of a cluster without weight stays. */
kernel void means(
    global const float *points,
    global const float *weights,
    global const uint *order,
    global const uint *starts,
    global float *centres)
{
    const size_t cluster = get_global_id(0) / (WIDTH / 4);
    const size_t quarter = get_global_id(0) % (WIDTH / 4);
    float4 sum = (float4)(0.0f), lost = (float4)(0.0f);
    float weight = 0.0f, lost_weight = 0.0f;
    for (uint i = starts[cluster]; i < starts[cluster + 1]; ++i) {
        const size_t point = order[i];
        const float w = weights[point];
        /* Kahan's compensated sums: a cluster may have very many points. */
        const float4 term = w * vload4(point * (WIDTH / 4) + quarter, points) - lost;
        const float4 next = sum + term;
        lost = (next - sum) - term;
        sum = next;
        const float term_weight = w - lost_weight;
        const float next_weight = weight + term_weight;
        lost_weight = (next_weight - weight) - term_weight;
        weight = next_weight;
    }
    if (weight > 0.0f)
        vstore4(sum / weight, get_global_id(0), centres);
}
