/* The sums of PSNR and SSIM, for CPUs: ROWS rows of BLOCK values a work-item. similarity_gpu.cl is its twin.

   Rows are taken as they lie in memory, with R, G and B in turn: what is k pixels away in the same channel is 3 k
   values away. Each row's means under the window along the row go into a ring that has as many rows as the window. The
   means under the whole window are made from that ring. Beyond its borders a picture goes on with zeros.

   Macros: LANES (8 or 16, see lanes.clh), and those of similarity.clh. */

#include "include/lanes.clh"
#include "quality/similarity.clh"

#define ROWS 32
#define BLOCK 96
#define BESIDE 16 /* values of the window on either side of a block, and one more to make a multiple of LANES */
#define WIDE (BLOCK + 2 * BESIDE)
#define RING (2 * RADIUS + 1)
#define VECTORS (BLOCK / LANES)

/* Adds a row's sum to that of the rows before it, and makes up for what rounding has lost: where all values are alike,
   all are rounded in the same direction. */
#define ADD_ROW(value, sum, lost) \
    { \
        const vfloat mended = (value) - lost, total = sum + mended; \
        lost = (total - sum) - mended; \
        sum = total; \
    }

/* sums[first_sum + i] becomes work-item i's sums of squared errors and of 1 - SSIM. */
kernel void similarity(
    global const float *images,
    ulong first_image,
    global const float *references,
    ulong first_reference,
    int width,
    int height,
    global float2 *sums,
    uint first_sum)
{
    const int columns = 3 * width, begin = get_global_id(0) * BLOCK, top = get_global_id(1) * ROWS;
    const int bottom = min(top + ROWS, height);
    global const float *image = images + 3 * (size_t)first_image, *reference = references + 3 * (size_t)first_reference;

    float taken_s[WIDE], taken_d[WIDE];
    const size_t middle = ((size_t)((top + bottom) / 2) * width + min(begin + BLOCK / 2, columns - 1) / 3) * 3;
    for (int i = 0; i < WIDE; ++i) {
        const size_t place = middle + (i + 3 - BESIDE % 3) % 3;
        const float x = clamp(image[place], 0.0f, 1.0f), y = clamp(reference[place], 0.0f, 1.0f);
        taken_s[i] = x + y;
        taken_d[i] = x - y;
    }

    float xs[WIDE], ys[WIDE], s[WIDE], d[WIDE], ss[WIDE], dd[WIDE];
    vfloat ring_s[RING][VECTORS], ring_d[RING][VECTORS], ring_ss[RING][VECTORS], ring_dd[RING][VECTORS];
    vfloat errors = (vfloat)(0.0f), errors_lost = errors, dissimilarities = errors, dissimilarities_lost = errors;
    const int from = max(begin - BESIDE, 0), to = min(begin + BLOCK + BESIDE, columns);
    for (int i = 0; i < WIDE; ++i)
        xs[i] = ys[i] = 0.0f;

    for (int row = top - RADIUS; row < bottom + RADIUS; ++row) {
        const size_t start = (size_t)row * columns;
        if (row < 0 || row >= height) {
            for (int i = 0; i < WIDE; ++i)
                xs[i] = ys[i] = 0.0f;
        } else if (to - from == WIDE) {
            for (int i = 0; i < WIDE; i += LANES) {
                VSTORE(VLOAD(0, image + start + from + i), 0, xs + i);
                VSTORE(VLOAD(0, reference + start + from + i), 0, ys + i);
            }
        } else {
            for (int column = from; column < to; ++column) {
                xs[column - begin + BESIDE] = image[start + column];
                ys[column - begin + BESIDE] = reference[start + column];
            }
        }
        vfloat row_errors = (vfloat)(0.0f), row_dissimilarities = row_errors;
        for (int i = 0; i < WIDE; i += LANES) {
            const vfloat x = CLAMPED(VLOAD(0, xs + i)), y = CLAMPED(VLOAD(0, ys + i));
            const vfloat sum = x + y - VLOAD(0, taken_s + i), error = x - y, difference = error - VLOAD(0, taken_d + i);
            if (i >= BESIDE && i < BESIDE + BLOCK)
                row_errors = MAD(error, error, row_errors);
            VSTORE(sum, 0, s + i);
            VSTORE(difference, 0, d + i);
            VSTORE(sum * sum, 0, ss + i);
            VSTORE(difference * difference, 0, dd + i);
        }
        if (row >= top && row < bottom)
            ADD_ROW(row_errors, errors, errors_lost)
        const int slot = (row - top + RADIUS) % RING;
        for (int v = 0; v < VECTORS; ++v) {
            const int i = v * LANES + BESIDE;
#define AT_S(k) VLOAD(0, s + i + 3 * (k))
#define AT_D(k) VLOAD(0, d + i + 3 * (k))
#define AT_SS(k) VLOAD(0, ss + i + 3 * (k))
#define AT_DD(k) VLOAD(0, dd + i + 3 * (k))
            ring_s[slot][v] = UNDER_WINDOW(AT_S);
            ring_d[slot][v] = UNDER_WINDOW(AT_D);
            ring_ss[slot][v] = UNDER_WINDOW(AT_SS);
            ring_dd[slot][v] = UNDER_WINDOW(AT_DD);
        }
        if (row < top + RADIUS)
            continue;
        /* The window's middle row is RADIUS rows above this one. Its rows lie in the ring from the slot after this one
           on. */
        int slots[RING];
        for (int k = 0; k < RING; ++k)
            slots[k] = (slot + 1 + k) % RING;
        for (int v = 0; v < VECTORS; ++v) {
#define RING_S(k) ring_s[slots[RADIUS + (k)]][v]
#define RING_D(k) ring_d[slots[RADIUS + (k)]][v]
#define RING_SS(k) ring_ss[slots[RADIUS + (k)]][v]
#define RING_DD(k) ring_dd[slots[RADIUS + (k)]][v]
            const vfloat found = dissimilarity(
                UNDER_WINDOW(RING_S),
                UNDER_WINDOW(RING_D),
                UNDER_WINDOW(RING_SS),
                UNDER_WINDOW(RING_DD),
                VLOAD(0, taken_s + v * LANES + BESIDE),
                VLOAD(0, taken_d + v * LANES + BESIDE));
            const vfloat left = (vfloat)((float)(columns - begin - v * LANES));
            row_dissimilarities += LANE_NUMBERS < left ? found : (vfloat)(0.0f);
        }
        ADD_ROW(row_dissimilarities, dissimilarities, dissimilarities_lost)
    }
    VSTORE(errors, 0, s);
    VSTORE(dissimilarities, 0, d);
    float2 sum = (float2)(0.0f, 0.0f);
    for (int i = 0; i < LANES; ++i)
        sum += (float2)(s[i], d[i]);
    sums[first_sum + get_global_id(1) * get_global_size(0) + get_global_id(0)] = sum;
}
