/* Colours rounded to the steps of their splats, one coefficient after another: each makes up for those before it.

   The coefficients of a splat that a round does not touch are still free: the re-fit solves for them again after it.

   Macros: LANES (splats a work-item), SH_COUNT (coefficients of a channel).

   On GPUs: LANES=1 SH_COUNT=1,4,9,16. */

#include "refit/coefficients.clh"

/* Added to the diagonal of a block, as a part of its mean: what no view tells apart is not moved far. */
#define DAMPING 1e-2f
/* Added besides, in weighted squared error: far below what a coefficient is worth, and far above what the blocks' fixed
   points are wrong by. Without it, blocks of splats that hardly show are not positive, and values explode. */
#define FLOOR 1e-3f

/* Of the splats of a round, those that are due: their number in the order of rounds is at most `turn`. */
inline vint due_lanes(global const int *turns, size_t index, int turn)
{
    return VLOAD(index, turns) <= turn;
}

/* The nearest whole number of steps; 0 instead of one step where that saves more bits than the error that it adds is worth.

   `value` is in steps, `squared` is what a squared error of one step costs, `to_zero` what it saves to have 0. */
inline vfloat cheap_level(vfloat value, vfloat squared, float to_zero)
{
    const vfloat nearest = floor(value + 0.5f);
    const vfloat size = fabs(nearest), off = fabs(value) - size;
    /* (off + 1)^2 - off^2 */
    const vfloat more = squared * (2.0f * off + 1.0f);
    return size > 0.5f && size < 1.5f && more < to_zero ? (vfloat)(0.0f) : nearest;
}

/* Rounds the AC coefficients of the splats that are due, from the last to the first: what is still free of the splat's
   channel, the constant coefficient at the end, goes to where the splat's colours change least by its own block of the
   normal equations. Coefficients that were rounded are not active any more.

   A launch does channel c: a work-item that did all three would hold the addresses of all blocks' elements in registers
   beside the factorisation, more than any GPU has. Flags of all channels share words.

   steps: of AC coefficients, one a splat. to_zero: a weighted squared error, see cheap_level. */
kernel NARROW void round_ac(
    global float *coefficients,
    global const float *blocks,
    global uint *active,
    global const int *turns,
    global const float *steps,
    ulong stride,
    int turn,
    float to_zero,
    int c)
{
    ARRAY(factor, TRIANGLE);
    ARRAY(pivots, SH_COUNT);
    ARRAY(free, SH_COUNT);
    ARRAY(error, SH_COUNT);
    const size_t index = get_global_id(0);
    const vint due = due_lanes(turns, index, turn);
    if (!VANY(due))
        return;
    const vfloat step = VLOAD(index, steps);
    vfloat trace = (vfloat)(0.0f);
    UNROLL
    for (int i = 0; i < SH_COUNT; ++i)
        trace += VLOAD(index, blocks + AT(i, i) * stride);
    const float length = c == 1 ? 2.0f : 3.0f;
    const vfloat more = trace * (DAMPING * length / SH_COUNT) + FLOOR;
    UNROLL
    for (int j = 0; j < SH_COUNT; ++j)
        free[OWN(j)] = active_lanes(active, stride, index, 3 * j + c);
    /* U with U^T U = block, row by row; rows of what is not free are empty. `pivots` are squares of U's diagonal,
       and what stands beside the diagonal is divided by it. */
    UNROLL
    for (int j = 0; j < SH_COUNT; ++j) {
        const vfloat diagonal = MAD((vfloat)(length), VLOAD(index, blocks + AT(j, j) * stride), more);
        vfloat pivot = diagonal;
        UNROLL
        for (int i = 0; i < j; ++i)
            pivot = MAD(-pivots[OWN(i)] * factor[OWN(AT(i, j))], factor[OWN(AT(i, j))], pivot);
        pivots[OWN(j)] = fmax(pivot, more) * free[OWN(j)];
        const vfloat inverse = pivots[OWN(j)] > 0.0f ? 1.0f / pivots[OWN(j)] : (vfloat)(0.0f);
        UNROLL
        for (int k = j + 1; k < SH_COUNT; ++k) {
            vfloat sum = length * VLOAD(index, blocks + AT(j, k) * stride);
            UNROLL
            for (int i = 0; i < j; ++i)
                sum = MAD(-pivots[OWN(i)] * factor[OWN(AT(i, j))], factor[OWN(AT(i, k))], sum);
            factor[OWN(AT(j, k))] = sum * inverse * free[OWN(k)];
        }
    }
    UNROLL
    for (int j = SH_COUNT - 1; j >= 0; --j) {
        const size_t column = 3 * j + c;
        const vfloat was = VLOAD(index, coefficients + column * stride);
        vfloat wanted = was;
        UNROLL
        for (int k = j + 1; k < SH_COUNT; ++k)
            wanted = MAD(factor[OWN(AT(j, k))], error[OWN(k)], wanted);
        vfloat held = wanted;
        /* What no view shows is left as it is, though it costs nothing. */
        const vfloat squared = trace > 0.0f ? pivots[OWN(j)] * step * step : (vfloat)(1e30f);
        if (j)
            held = step * cheap_level(wanted / step, squared, to_zero);
        const vint changed = due && free[OWN(j)] > 0.0f && fabs(held) < 1e30f;
        held = changed ? held : was;
        error[OWN(j)] = was - held;
        VSTORE(held, index, coefficients + column * stride);
        int lanes[LANES];
        VSTORE(due, 0, lanes);
        for (int lane = 0; lane < LANES; ++lane)
            if (j && lanes[lane])
                active[(column / 24) * stride + index * LANES + lane] &= ~(1u << (column % 24));
    }
}

/* Rounds the constant coefficients of the splats that are due to the nearest whole number of steps. */
kernel void round_constant(
    global float *coefficients,
    global uint *active,
    global const int *turns,
    global const float *steps,
    ulong stride,
    int turn)
{
    const size_t index = get_global_id(0);
    const vint due = due_lanes(turns, index, turn);
    if (!VANY(due))
        return;
    const vfloat step = VLOAD(index, steps);
    for (int c = 0; c < 3; ++c) {
        const vfloat was = VLOAD(index, coefficients + c * stride);
        const vfloat held = step * floor(was / step + 0.5f);
        const vint changed = due && active_lanes(active, stride, index, c) > 0.0f && fabs(held) < 1e30f;
        VSTORE(changed ? held : was, index, coefficients + c * stride);
        int lanes[LANES];
        VSTORE(due, 0, lanes);
        for (int lane = 0; lane < LANES; ++lane)
            if (lanes[lane])
                active[index * LANES + lane] &= ~(1u << c);
    }
}
