/* What ridge.cl does with ORTHOGONAL=1, for GPUs that keep private arrays of its size in memory (AMD's): 16 work-items
   share a splat, each with one column of every matrix. What is indexed at run time lies in local memory; all else is in
   registers once the loops are unrolled.

   Macros:
       SH_COUNT  coefficients of a channel: 4, 9 or 16.

   On GPUs: SH_COUNT=4,9,16. */

#define LANES 1
#include "include/group.clh"
#include "include/reals.clh"
#include "include/sh_basis.clh"

/* Work-items of a splat, splats of a work-group, and how much of a column a reflection may need. */
#define COLUMNS 16
#define SPLATS 4
#define TAIL (COLUMNS + 2)
#define UNROLL _Pragma("unroll")
/* As in ridge.cl. */
#define TOLERANCE (4 * ROUNDING)
#define LARGEST_GROWTH 4

/* A splat's part of the local memory. Two reflections take turns, so that one barrier each is enough. */
typedef struct {
    float matrix[COLUMNS][COLUMNS]; /* rows of the weighted basis matrix; then R, 0 below its diagonal */
    float reflection[2][TAIL];      /* its vector after the 1, then tau */
    float vectors[4][COLUMNS];
    uint parallel[COLUMNS];
} Shared;

/* See ridge_orthogonal.clh. */
inline float reflector(float *head, float *tail, int count)
{
    float square = 0;
    UNROLL
    for (int b = 0; b < count; ++b)
        square = mad(tail[b], tail[b], square);
    float pivot = copysign(sqrt(mad(*head, *head, square)), *head);
    float first = *head + pivot;
    float inverse = 1 / (square > 0 ? first : 1.0f);
    UNROLL
    for (int b = 0; b < count; ++b)
        tail[b] *= inverse;
    float tau = square > 0 ? first / pivot : 0.0f;
    *head = square > 0 ? -pivot : *head;
    return tau;
}

/* Folds COLUMNS rows, of which this work-item has column `lane`, into R. */
inline void add_rows(local Shared *shared, int lane, float *r, float *rows)
{
    UNROLL
    for (int j = 0; j < SH_COUNT; ++j) {
        local float *reflection = shared->reflection[j & 1];
        if (lane == j) {
            float tau = reflector(&r[j], rows, COLUMNS);
            UNROLL
            for (int b = 0; b < COLUMNS; ++b)
                reflection[b] = rows[b];
            reflection[COLUMNS] = tau;
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        if (lane > j) {
            float t = r[j];
            UNROLL
            for (int b = 0; b < COLUMNS; ++b)
                t = mad(reflection[b], rows[b], t);
            t *= reflection[COLUMNS];
            r[j] -= t;
            UNROLL
            for (int b = 0; b < COLUMNS; ++b)
                rows[b] = mad(-t, reflection[b], rows[b]);
        }
    }
}

/* Element `lane` of the x that ridge_orthogonal.clh's solve finds. The targets are in vectors[0]; keep is of this
   work-item's column. */
inline float solve(local Shared *shared, int lane, const float *r, float keep, float lambda)
{
    float top[SH_COUNT], bottom[SH_COUNT], top_rhs[SH_COUNT], bottom_rhs[SH_COUNT];
    float whole = 0, own_rhs = 0, x = 0, is_free = 0;
    UNROLL
    for (int k = 0; k < SH_COUNT; ++k) {
        top[k] = r[k] * keep;
        bottom[k] = lane != k ? 0.0f : keep > 0 ? (k ? sqrt(lambda) : 0.0f) : 1.0f;
        bottom_rhs[k] = 0;
        whole = mad(r[k], r[k], whole);
        own_rhs = mad(shared->matrix[lane][k], shared->vectors[0][k], own_rhs);
    }
    shared->vectors[1][lane] = own_rhs;
    barrier(CLK_LOCAL_MEM_FENCE);
    UNROLL
    for (int k = 0; k < SH_COUNT; ++k)
        top_rhs[k] = shared->vectors[1][k];

    UNROLL
    for (int j = 0; j < SH_COUNT; ++j) {
        local float *reflection = shared->reflection[j & 1];
        if (lane == j) {
            float tail[SH_COUNT];
            float rest = top[j] * top[j];
            UNROLL
            for (int i = 0; i <= j; ++i)
                rest = mad(bottom[i], bottom[i], rest);
            is_free = rest > TOLERANCE * TOLERANCE * whole ? 1.0f : 0.0f;
            float head = top[j] * is_free;
            UNROLL
            for (int i = 0; i < j; ++i)
                tail[i] = bottom[i] * is_free;
            tail[j] = is_free > 0 ? bottom[j] : 1.0f;
            float tau = reflector(&head, tail, j + 1);
            top[j] = head;
            UNROLL
            for (int i = 0; i <= j; ++i)
                reflection[i] = tail[i];
            reflection[COLUMNS] = tau;
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        const float tau = reflection[COLUMNS];
        if (lane > j) {
            float t = top[j];
            UNROLL
            for (int i = 0; i <= j; ++i)
                t = mad(reflection[i], bottom[i], t);
            t *= tau;
            top[j] -= t;
            UNROLL
            for (int i = 0; i <= j; ++i)
                bottom[i] = mad(-t, reflection[i], bottom[i]);
        }
        float t = top_rhs[j];
        UNROLL
        for (int i = 0; i <= j; ++i)
            t = mad(reflection[i], bottom_rhs[i], t);
        t *= tau;
        top_rhs[j] -= t;
        UNROLL
        for (int i = 0; i <= j; ++i)
            bottom_rhs[i] = mad(-t, reflection[i], bottom_rhs[i]);
    }
    UNROLL
    for (int j = SH_COUNT - 1; j >= 0; --j) {
        local float *column = shared->reflection[j & 1];
        barrier(CLK_LOCAL_MEM_FENCE); /* the last one that was there has been read */
        if (lane == j) {
            x = is_free * (top_rhs[j] / top[j]);
            UNROLL
            for (int i = 0; i < j; ++i)
                column[i] = top[i] * x;
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        UNROLL
        for (int i = 0; i < j; ++i)
            top_rhs[i] -= column[i];
    }
    return x;
}

/* The sum of the squares of the numbers in one of the vectors. */
inline float sum_of_squares(local const float *values, int first)
{
    float sum = 0;
    UNROLL
    for (int k = first; k < SH_COUNT; ++k)
        sum = mad(values[k], values[k], sum);
    return sum;
}

/* This work-item's row of R times one of the vectors. */
inline float row_times(local const Shared *shared, int lane, local const float *vector)
{
    float sum = 0;
    UNROLL
    for (int k = 0; k < SH_COUNT; ++k)
        sum = mad(shared->matrix[lane][k], vector[k], sum);
    return sum;
}

kernel __attribute__((reqd_work_group_size(COLUMNS * SPLATS, 1, 1))) void compact(
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
    local Shared shared_by[SPLATS];
    local uint counts[SPLATS];
    const int lane = get_local_id(0) % COLUMNS, which = get_local_id(0) / COLUMNS;
    local Shared *shared = &shared_by[which];
    const uint place = GROUP_ID(0) * SPLATS + which;
    const bool there = place < splats;
    const uint splat = order[min(place, splats - 1)], first = offsets[splat];
    const uint end = there ? offsets[splat + 1] : first;
    const float4 centre = means[splat];
    if (lane == 0)
        counts[which] = end - first;
    barrier(CLK_LOCAL_MEM_FENCE);
    uint longest = 0;
    UNROLL
    for (int k = 0; k < SPLATS; ++k)
        longest = max(longest, counts[k]);

    float r[SH_COUNT];
    UNROLL
    for (int k = 0; k < SH_COUNT; ++k)
        r[k] = 0;
    for (uint done = 0; done < longest; done += COLUMNS) {
        /* A work-item makes a row, and takes a column. */
        const bool present = done + lane < end - first;
        const uint entry = present ? first + done + lane : first;
        const uint view = present ? view_numbers[entry] : 0;
        const float4 to_splat = centre - camera_centres[2 * view] - camera_centres[2 * view + 1];
        const float length = sqrt(to_splat.x * to_splat.x + to_splat.y * to_splat.y + to_splat.z * to_splat.z);
        const float inverse = 1 / (length > 0 ? length : 1.0f);
        const float weight = present ? weights[entry] : 0;
        float values[SH_COUNT], rows[COLUMNS];
        sh_basis(to_splat.x * inverse, to_splat.y * inverse, to_splat.z * inverse, values);
        UNROLL
        for (int k = 0; k < SH_COUNT; ++k)
            shared->matrix[lane][k] = values[k] * weight;
        barrier(CLK_LOCAL_MEM_FENCE);
        UNROLL
        for (int b = 0; b < COLUMNS; ++b)
            rows[b] = lane < SH_COUNT ? shared->matrix[b][lane] : 0.0f;
        add_rows(shared, lane, r, rows);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    UNROLL
    for (int k = 0; k < SH_COUNT; ++k)
        shared->matrix[k][lane] = r[k];
    float norm = 0;
    UNROLL
    for (int k = 0; k < SH_COUNT; ++k)
        norm = mad(r[k], r[k], norm);
    norm = sqrt(norm);
    shared->vectors[0][lane] = norm;
    barrier(CLK_LOCAL_MEM_FENCE);

    /* Which columns before it this one is nearly parallel to; then, which are used. */
    uint parallel = 0;
    UNROLL
    for (int i = 0; i < SH_COUNT; ++i) {
        float product = 0;
        UNROLL
        for (int k = 0; k <= i; ++k)
            product = mad(shared->matrix[k][i], r[k], product);
        if (i < lane && threshold < 1 && fabs(product) - threshold * shared->vectors[0][i] * norm > 0)
            parallel |= 1u << i;
    }
    shared->parallel[lane] = parallel;
    barrier(CLK_LOCAL_MEM_FENCE);
    uint usable = 0;
    for (int k = 0; k < SH_COUNT; ++k)
        if (shared->vectors[0][k] > 0 && !(shared->parallel[k] & usable))
            usable |= 1u << k;

    const bool owns = there && lane < SH_COUNT;
    global float *own_sh = sh + ((size_t)splat * SH_COUNT + lane) * 3;
    const float red = owns ? own_sh[0] : 0, green = owns ? own_sh[1] : 0, blue = owns ? own_sh[2] : 0;
    float own[3];
    own[0] = ycocg ? green / 2 + (red + blue) / 4 : red;
    own[1] = ycocg ? (red - blue) / 2 : green;
    own[2] = ycocg ? green / 2 - (red + blue) / 4 : blue;

    UNROLL
    for (int c = 0; c < 3; ++c) {
        const float lambda = c == 0 || !ycocg ? lambda_luma : lambda_chroma;
        float keep = (usable >> lane) & 1 ? 1.0f : 0.0f;
        barrier(CLK_LOCAL_MEM_FENCE);
        shared->vectors[0][lane] = own[c];
        barrier(CLK_LOCAL_MEM_FENCE);
        const float before = shared->vectors[0][0], original = sum_of_squares(shared->vectors[0], 0);
        barrier(CLK_LOCAL_MEM_FENCE);
        const float target = lane ? own[c] : 0.0f;
        shared->vectors[0][lane] = target;
        barrier(CLK_LOCAL_MEM_FENCE);
        float x = solve(shared, lane, r, keep, lambda);
        if (scale_factor > 0) {
            keep = lane && floor(mad(x, scale_factor, 0.5f)) == 0 ? 0.0f : keep;
            x = solve(shared, lane, r, keep, lambda);
        }

        /* The minimum must not be larger than the objective at the original coefficients with the dropped ones zero. */
        barrier(CLK_LOCAL_MEM_FENCE);
        shared->vectors[0][lane] = target - x;
        shared->vectors[1][lane] = lane ? target * (1 - keep) : 0.0f;
        shared->vectors[2][lane] = x;
        shared->vectors[3][lane] = target * keep;
        barrier(CLK_LOCAL_MEM_FENCE);
        const float penalty = sum_of_squares(shared->vectors[2], 1);
        const float start_penalty = sum_of_squares(shared->vectors[3], 1);
        float largest = 0;
        UNROLL
        for (int k = 1; k < SH_COUNT; ++k)
            largest = fmax(largest, fabs(shared->vectors[2][k]));
        const float row = row_times(shared, lane, shared->vectors[0]);
        const float start_row = row_times(shared, lane, shared->vectors[1]);
        barrier(CLK_LOCAL_MEM_FENCE);
        shared->vectors[0][lane] = row;
        shared->vectors[1][lane] = start_row;
        barrier(CLK_LOCAL_MEM_FENCE);
        const float objective = sum_of_squares(shared->vectors[0], 0) + lambda * penalty;
        const float start = sum_of_squares(shared->vectors[1], 0) + lambda * start_penalty;
        const float corner = shared->matrix[0][0];
        const float noise = 256 * ROUNDING * ROUNDING * original * corner * corner;
        const float limit = LARGEST_GROWTH * fmax(sqrt(original), 1.0f);
        const float found = lane ? x : x + before;
        if (objective <= 1.01f * start + noise && largest <= limit)
            own[c] = found;
    }
    if (owns) {
        own_sh[0] = ycocg ? own[0] - own[2] + own[1] : own[0];
        own_sh[1] = ycocg ? own[0] + own[2] : own[1];
        own_sh[2] = ycocg ? own[0] - own[2] - own[1] : own[2];
    }
}
