/* A splat's own block of the normal equations, for tools.study.gauss_newton. A work-item does one splat.

   The block's first BLOCK parameters (centre, scales, quaternion, opacity, DC) have a packed lower triangle, in columns
   of `stride` floats: element i, j is in column i (i + 1) / 2 + j. Behind it the other parameters have a diagonal.

   Macros: none. */

#define BLOCK 14
#define TRIANGLE (BLOCK * (BLOCK + 1) / 2)
#define AT(i, j) ((i) * ((i) + 1) / 2 + (j))

/* Where v has random signs, g = J^T v has the expected products g g^T = J^T J. blocks = keep blocks + g g^T; g = 0. */
kernel void add_products(global float *gradient, uint stride, uint columns, float keep, global float *blocks)
{
    const size_t splat = get_global_id(0), column = stride;
    float own[BLOCK];
    for (int i = 0; i < BLOCK; ++i) {
        own[i] = gradient[i * column + splat];
        gradient[i * column + splat] = 0.0f;
    }
    for (int i = 0; i < BLOCK; ++i)
        for (int j = 0; j <= i; ++j) {
            const size_t place = AT(i, j) * column + splat;
            blocks[place] = keep * blocks[place] + own[i] * own[j];
        }
    for (uint i = BLOCK; i < columns; ++i) {
        const float g = gradient[i * column + splat];
        const size_t place = (TRIANGLE + i - BLOCK) * column + splat;
        gradient[i * column + splat] = 0.0f;
        blocks[place] = keep * blocks[place] + g * g;
    }
}

/* Cholesky factors of part blocks + damping diagonal; damping of each parameter is (damping x its own element of the
   diagonal + a floor). diagonal: (columns, stride), what was added. factors: as blocks, with inverted diagonals. */
kernel void factorise(
    global const float *blocks,
    uint stride,
    uint columns,
    float part,
    float damping,
    global const float *floors,
    global float *diagonal,
    global float *factors)
{
    const size_t splat = get_global_id(0), column = stride;
    float l[TRIANGLE];
    for (int i = 0; i < BLOCK; ++i) {
        const float added = damping * part * blocks[AT(i, i) * column + splat] + floors[i];
        diagonal[i * column + splat] = added;
        for (int j = 0; j <= i; ++j) {
            float value = part * blocks[AT(i, j) * column + splat];
            if (i == j)
                value += added;
            const float bound = value;
            for (int k = 0; k < j; ++k)
                value -= l[AT(i, k)] * l[AT(j, k)];
            l[AT(i, j)] = i == j ? sqrt(fmax(value, 1e-4f * bound)) : value / l[AT(j, j)];
        }
    }
    for (int i = 0; i < TRIANGLE; ++i)
        factors[i * column + splat] = l[i];
    for (uint i = BLOCK; i < columns; ++i) {
        const size_t place = (TRIANGLE + i - BLOCK) * column + splat;
        const float own = part * blocks[place];
        const float added = damping * own + floors[i];
        diagonal[i * column + splat] = added;
        factors[place] = own + added;
    }
}

/* result = the blocks' inverses times x. */
kernel void solve(global const float *factors, uint stride, uint columns, global const float *x, global float *result)
{
    const size_t splat = get_global_id(0), column = stride;
    float y[BLOCK];
    for (int i = 0; i < BLOCK; ++i) {
        float value = x[i * column + splat];
        for (int k = 0; k < i; ++k)
            value -= factors[AT(i, k) * column + splat] * y[k];
        y[i] = value / factors[AT(i, i) * column + splat];
    }
    for (int i = BLOCK - 1; i >= 0; --i) {
        float value = y[i];
        for (int k = i + 1; k < BLOCK; ++k)
            value -= factors[AT(k, i) * column + splat] * y[k];
        y[i] = value / factors[AT(i, i) * column + splat];
        result[i * column + splat] = y[i];
    }
    for (uint i = BLOCK; i < columns; ++i)
        result[i * column + splat] = x[i * column + splat] / factors[(TRIANGLE + i - BLOCK) * column + splat];
}

/* y += diagonal x. */
kernel void add_diagonal(global float *y, global const float *diagonal, global const float *x)
{
    const size_t i = get_global_id(0);
    y[i] += diagonal[i] * x[i];
}

/* Parameters move by a step, which is cut at `most` of its column; limits are the least and the greatest value. */
kernel void move(
    global float *parameters, uint stride, global const float *step, global const float4 *limits)
{
    const size_t i = get_global_id(1) * (size_t)stride + get_global_id(0);
    const float4 limit = limits[get_global_id(1)];
    const float cut = fmin(fmax(step[i], -limit.x), limit.x);
    if (cut != 0.0f && fabs(cut) < 1e30f)
        parameters[i] = fmin(fmax(parameters[i] + cut, limit.y), limit.z);
}

/* +1 or -1, a number a pixel and channel. */
kernel void signs(uint seed, global float *values)
{
    uint x = (uint)get_global_id(0) * 0x9E3779B9u + seed;
    x = (x ^ x >> 16) * 0x7FEB352Du;
    x = (x ^ x >> 15) * 0x846CA68Bu;
    x ^= x >> 16;
    values[get_global_id(0)] = x & 1u ? 1.0f : -1.0f;
}
