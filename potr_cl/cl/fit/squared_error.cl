/* How far a picture is from another: each work-item's sum of squared differences. Both kernel families use it.

   Work-item k takes the numbers k, k + n, k + 2 n, … of the pictures, with n work-items in all. So neighbours read what
   lies side by side, and each sum has few terms: the host adds the sums up in double precision.

   Macros: none.

   On GPUs: no macros. */

/* first: number of the picture's first value. count: of the numbers in each of the two. sums: work-item by work-item,
 * beginning at first_sum. */
kernel void squared_error(
    global const float *picture, ulong first, global const float *target, ulong count, global float *sums,
    uint first_sum)
{
    float sum = 0.0f;
    for (ulong i = get_global_id(0); i < count; i += get_global_size(0)) {
        const float difference = picture[first + i] - target[i];
        sum += difference * difference;
    }
    sums[first_sum + get_global_id(0)] = sum;
}
