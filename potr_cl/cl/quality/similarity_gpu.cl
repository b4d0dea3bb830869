/* The sums of PSNR and SSIM, for GPUs: a work-group of GROUP x GROUP work-items does a tile of as many pixels, channel
   by channel. similarity_cpu.cl is its twin.

   Beyond its borders a picture goes on with zeros.

   Macros: those of similarity.clh.

   On GPUs: C1=1e-4f C2=9e-4f WEIGHT_0=0.27f WEIGHT_1=0.21f WEIGHT_2=0.11f WEIGHT_3=0.04f WEIGHT_4=0.01f
       WEIGHT_5=0.001f. */

#define LANES 1
#include "include/group.clh"
#include "include/lanes.clh"
#include "quality/similarity.clh"

#define GROUP 16
#define WIDE (GROUP + 2 * RADIUS)

/* sums[first_sum + i] becomes work-group i's sums of squared errors and of 1 - SSIM. */
kernel __attribute__((reqd_work_group_size(GROUP, GROUP, 1))) void similarity(
    global const float *images,
    ulong first_image,
    global const float *references,
    ulong first_reference,
    int width,
    int height,
    global float2 *sums,
    uint first_sum)
{
    local float2 values[WIDE][WIDE]; /* s and d */
    local float2 means[WIDE][GROUP], squares[WIDE][GROUP]; /* of s and d, under the window along a row */
    local float2 partial[GROUP * GROUP];

    const int x = get_local_id(0), y = get_local_id(1), item = y * GROUP + x;
    const int left = GROUP_ID(0) * GROUP, top = GROUP_ID(1) * GROUP;
    global const float *image = images + 3 * (size_t)first_image, *reference = references + 3 * (size_t)first_reference;
    const int inside = left + x < width && top + y < height;
    const size_t middle = (size_t)min(top + GROUP / 2, height - 1) * width + min(left + GROUP / 2, width - 1);

    float2 sum = (float2)(0.0f, 0.0f);
    for (int channel = 0; channel < 3; ++channel) {
        const float middle_x = CLAMPED(image[3 * middle + channel]);
        const float middle_y = CLAMPED(reference[3 * middle + channel]);
        const float2 taken = (float2)(middle_x + middle_y, middle_x - middle_y);
        for (int i = item; i < WIDE * WIDE; i += GROUP * GROUP) {
            const int column = left + i % WIDE - RADIUS, row = top + i / WIDE - RADIUS;
            float2 value = (float2)(0.0f, 0.0f);
            if (column >= 0 && column < width && row >= 0 && row < height) {
                const size_t place = 3 * ((size_t)row * width + column) + channel;
                const float a = CLAMPED(image[place]), b = CLAMPED(reference[place]);
                const float error = a - b;
                value = (float2)(a + b, error);
                if (column >= left && column < left + GROUP && row >= top && row < top + GROUP)
                    sum.x += error * error;
            }
            values[i / WIDE][i % WIDE] = value - taken;
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int row = y; row < WIDE; row += GROUP) {
#define AT_VALUE(k) values[row][x + RADIUS + (k)]
#define AT_SQUARE(k) (AT_VALUE(k) * AT_VALUE(k))
            means[row][x] = UNDER_WINDOW(AT_VALUE);
            squares[row][x] = UNDER_WINDOW(AT_SQUARE);
        }
        barrier(CLK_LOCAL_MEM_FENCE);
#define AT_MEAN(k) means[y + RADIUS + (k)][x]
#define AT_SQUARE_MEAN(k) squares[y + RADIUS + (k)][x]
        const float2 mean = UNDER_WINDOW(AT_MEAN), square = UNDER_WINDOW(AT_SQUARE_MEAN);
        if (inside)
            sum.y += dissimilarity(mean.x, mean.y, square.x, square.y, taken.x, taken.y);
    }
    partial[item] = sum;
    for (int step = GROUP * GROUP / 2; step; step /= 2) {
        barrier(CLK_LOCAL_MEM_FENCE);
        if (item < step)
            partial[item] += partial[item + step];
    }
    if (item == 0)
        sums[first_sum + GROUP_ID(1) * get_num_groups(0) + GROUP_ID(0)] = partial[0];
}
