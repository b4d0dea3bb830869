/* The compositing of potr_cl/cl/composite_cpu.cl as a plain C loop, for the compiler to vectorise: what OpenCL on a CPU
   is measured against. And a loop of nothing but fused multiply-adds, for the machine's peak.

   Built and called by composite_yardstick.py; arrays as in the View of potr_cl/raster/rasterizer.py. */

#include <math.h>
#include <stdint.h>
#include <string.h>

#define TILE 16
#define BLOCK 16
#define MIN(a, b) ((a) < (b) ? (a) : (b))
#define MAX(a, b) ((a) > (b) ? (a) : (b))
#define LOG2_ALPHA_MIN -7.99435344f
#define LEVEL_SLACK 0.01f
#define PIXEL_SLACK 0.01f
#define RELATIVE_SLACK 4e-7f

static inline float exp2_polynomial(float x)
{
    union { float f; int32_t i; } shifted, p;
    x = x > -120.0f ? x : -120.0f;
    shifted.f = x + 12582912.0f;
    float f = x - (shifted.f - 12582912.0f);
    p.f = ((((1.326472725e-3f * f + 9.671512688e-3f) * f + 5.550733744e-2f) * f + 2.402224208e-1f) * f +
           6.931469776e-1f) * f + 1.0f;
    p.i += shifted.i << 23;
    return p.f;
}

typedef struct {
    float x[BLOCK], y[BLOCK], a[BLOCK], b[BLOCK], c[BLOCK], log2_opacity[BLOCK];
    float red[BLOCK], green[BLOCK], blue[BLOCK];
    int first_row[BLOCK], end_row[BLOCK];
} SplatBlock;

static void fetch_block(
    SplatBlock *restrict s, const float *shapes, const float *colours, const uint32_t *intersections, uint32_t begin,
    uint32_t end, int x, int y)
{
    for (uint32_t k = 0; k < BLOCK; ++k) {
        const uint32_t splat = intersections[begin + k < end ? begin + k : end - 1];
        const float *shape = shapes + 8 * (size_t)splat, *colour = colours + 4 * (size_t)splat;
        s->x[k] = shape[0];
        s->y[k] = shape[1];
        s->a[k] = shape[2];
        s->b[k] = shape[3];
        s->c[k] = shape[4];
        s->log2_opacity[k] = shape[5];
        s->red[k] = colour[0];
        s->green[k] = colour[1];
        s->blue[k] = colour[2];
    }
    for (int k = 0; k < BLOCK; ++k) {
        const float level = s->log2_opacity[k] - LOG2_ALPHA_MIN + LEVEL_SLACK;
        const float a = s->a[k], b = s->b[k], c = s->c[k];
        const float g = b * b + c * c, ac = a * c, root = sqrtf(level);
        const float reach_x = root * sqrtf(g) / ac + PIXEL_SLACK + RELATIVE_SLACK * fabsf(s->x[k]);
        const float d0 = MAX(x + 0.5f - s->x[k], -reach_x);
        const float d1 = MIN(x + (TILE - 0.5f) - s->x[k], reach_x);
        const float peak = -b * root / ac;
        const float bottom_x = MIN(MAX(peak, d0), d1), top_x = MIN(MAX(-peak, d0), d1);
        const float inverse_g = 1.0f / g;
        const float bottom = (sqrtf(MAX(g * level - ac * ac * bottom_x * bottom_x, 0.0f)) - a * b * bottom_x) * inverse_g;
        const float top = (-sqrtf(MAX(g * level - ac * ac * top_x * top_x, 0.0f)) - a * b * top_x) * inverse_g;
        const float slack = PIXEL_SLACK + RELATIVE_SLACK * (fabsf(s->y[k]) + MAX(fabsf(bottom), fabsf(top)));
        s->first_row[k] = MIN(MAX(ceilf(s->y[k] + top - slack - 0.5f) - y, 0.0f), (float)TILE);
        s->end_row[k] = MIN(MAX(floorf(s->y[k] + bottom + slack - 0.5f) - y + 1.0f, 0.0f), (float)TILE);
    }
    for (uint32_t k = end - begin; k < BLOCK; ++k)
        s->end_row[k] = 0;
}

/* Returns the (pixel, splat) pairs that were evaluated. */
int64_t composite(
    const float *shapes, const float *colours, const uint32_t *offsets, const uint32_t *intersections, int columns, int rows,
    int width, int height, float alpha_cap, float stop, float *image, float *transmittance)
{
    int64_t pairs = 0;
#pragma omp parallel for schedule(dynamic, 1) reduction(+ : pairs)
    for (int tile = 0; tile < columns * rows; ++tile) {
        const int x = tile % columns * TILE, y = tile / columns * TILE;
        const int pixel_rows_inside = height - y < TILE ? height - y : TILE;
        float t[TILE][TILE], r[TILE][TILE], g[TILE][TILE], b[TILE][TILE];
        memset(r, 0, sizeof r);
        memset(g, 0, sizeof g);
        memset(b, 0, sizeof b);
        for (int row = 0; row < TILE; ++row)
            for (int i = 0; i < TILE; ++i)
                t[row][i] = x + i < width ? 1.0f : -1.0f;
        int first_alive = 0, end_alive = pixel_rows_inside;
        SplatBlock s;
        for (uint32_t begin = offsets[tile]; begin < offsets[tile + 1] && first_alive < end_alive; begin += BLOCK) {
            fetch_block(&s, shapes, colours, intersections, begin, offsets[tile + 1], x, y);
            for (int k = 0; k < BLOCK; ++k) {
                const float red = s.red[k], green = s.green[k], blue = s.blue[k];
                const int first = MAX(s.first_row[k], first_alive);
                const int last = MIN(s.end_row[k], end_alive);
                float au[TILE];
                for (int i = 0; i < TILE; ++i)
                    au[i] = s.a[k] * ((x + i + 0.5f) - s.x[k]);
                for (int row = first; row < last; ++row) {
                    const float dy = y + row + 0.5f - s.y[k];
                    const float bu = s.b[k] * dy, cv = s.c[k] * dy;
                    const float level = s.log2_opacity[k] - cv * cv;
                    float *tr = t[row], *rr = r[row], *gr = g[row], *br = b[row];
#pragma GCC ivdep
                    for (int i = 0; i < TILE; ++i) {
                        float u = au[i] + bu;
                        float power = level - u * u;
                        float alpha = exp2_polynomial(power);
                        alpha = alpha < alpha_cap ? alpha : alpha_cap;
                        alpha = power >= LOG2_ALPHA_MIN ? alpha : 0.0f;
                        float before = tr[i];
                        float after = before - alpha * before;
                        float weight = after >= stop ? alpha * before : 0.0f;
                        tr[i] = after >= stop ? after : -fabsf(before);
                        rr[i] += weight * red;
                        gr[i] += weight * green;
                        br[i] += weight * blue;
                    }
                }
                pairs += last > first ? TILE * (last - first) : 0;
            }
            int first = pixel_rows_inside, last = -1;
            for (int row = first_alive; row < end_alive; ++row) {
                float most = -1.0f;
                for (int i = 0; i < TILE; ++i)
                    most = t[row][i] > most ? t[row][i] : most;
                if (most > 0.0f) {
                    first = row < first ? row : first;
                    last = row;
                }
            }
            first_alive = first;
            end_alive = last + 1;
        }
        for (int row = 0; row < pixel_rows_inside; ++row)
            for (int i = 0; i < TILE && x + i < width; ++i) {
                size_t pixel = (size_t)(y + row) * width + x + i;
                image[3 * pixel] = r[row][i];
                image[3 * pixel + 1] = g[row][i];
                image[3 * pixel + 2] = b[row][i];
                transmittance[pixel] = fabsf(t[row][i]);
            }
    }
    return pairs;
}

/* Eight independent rows of fused multiply-adds on every thread, `rounds` times; returns the operations done. */
double peak(int64_t rounds, int threads, float *sink)
{
#pragma omp parallel for
    for (int thread = 0; thread < threads; ++thread) {
        float a[8][TILE];
        for (int k = 0; k < 8; ++k)
            for (int i = 0; i < TILE; ++i)
                a[k][i] = k + i;
        for (int64_t round = 0; round < rounds; ++round)
            for (int k = 0; k < 8; ++k)
                for (int i = 0; i < TILE; ++i)
                    a[k][i] = a[k][i] * 0.999f + 0.5f;
        for (int k = 0; k < 8; ++k)
            for (int i = 0; i < TILE; ++i)
                sink[thread] += a[k][i];
    }
    return 2.0 * rounds * 8 * TILE * threads;
}
