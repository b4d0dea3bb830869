/* The tokens of a stream, by vectors of WebAssembly: four lanes at a time, in the way of potr_cl/native's
 * bundles_tokens.c, which does what vectors cannot. Both give the same integers. */

#define decode_tokens decode_without_vectors
#include "bundles_tokens.c"
#undef decode_tokens

#if defined(__wasm_simd128__)

#include <wasm_simd128.h>

/* Of each set of four lanes which bytes of the next four words they take: 0 where a lane is not in it. */
#define LANE_OF(set, lane, rank) \
    (set) >> (lane) & 1 ? 4 * (rank) : 128, (set) >> (lane) & 1 ? 4 * (rank) + 1 : 128, 128, 128
#define RANK_1(set) ((set) & 1)
#define RANK_2(set) (RANK_1(set) + ((set) >> 1 & 1))
#define RANK_3(set) (RANK_2(set) + ((set) >> 2 & 1))
#define SET(set) { LANE_OF(set, 0, 0), LANE_OF(set, 1, RANK_1(set)), LANE_OF(set, 2, RANK_2(set)), LANE_OF(set, 3, RANK_3(set)) }
static const uint8_t words_of_sets[16][16] __attribute__((aligned(16))) = {
    SET(0), SET(1), SET(2), SET(3), SET(4), SET(5), SET(6), SET(7),
    SET(8), SET(9), SET(10), SET(11), SET(12), SET(13), SET(14), SET(15),
};

/* What the lanes of a stream look up. */
typedef struct {
    struct {
        const uint8_t *slots;
        const uint32_t *intervals;
    } rows[LARGEST_SIZE + 1]; /* those of the context of each expected size */
    v128_t weight;
} tables;

/* The token of a lane, and its interval into that lane of `found`. */
#define LOOK_UP(lane) \
    do { \
        const uint32_t size = (uint32_t)wasm_i32x4_extract_lane(expected, lane); \
        const uint32_t token = of->rows[size].slots[(uint32_t)wasm_i32x4_extract_lane(place, lane)]; \
        tokens[lane] = (uint8_t)token; \
        found = wasm_v128_load32_lane(of->rows[size].intervals + token, found, lane); \
    } while (0)

/* Takes the tokens of four lanes, of which `there` says which are to; gives those that need it a word. Returns their
 * sizes. */
static INLINE v128_t take_four(
    const tables *of, const int32_t *base, uint32_t *states, int32_t *recent, uint8_t *tokens, const uint8_t *words,
    size_t *read, v128_t there)
{
    const v128_t low12 = wasm_i32x4_const_splat(TOTAL - 1);
    const v128_t before = wasm_v128_load(recent), state = wasm_v128_load(states), place = wasm_v128_and(state, low12);
    v128_t expected = wasm_i32x4_add(wasm_v128_load(base), wasm_i32x4_mul(of->weight, before));
    expected = wasm_i32x4_max(wasm_i32x4_shr(expected, 8), wasm_i32x4_const_splat(0));
    expected = wasm_i32x4_min(expected, wasm_i32x4_const_splat(LARGEST_SIZE));
    v128_t found = wasm_i32x4_const_splat(0);
    LOOK_UP(0);
    LOOK_UP(1);
    LOOK_UP(2);
    LOOK_UP(3);
    const v128_t frequency = wasm_i32x4_add(wasm_v128_and(found, low12), wasm_i32x4_const_splat(1));
    const v128_t start = wasm_v128_and(wasm_u32x4_shr(found, PRECISION), low12);
    const v128_t size = wasm_u32x4_shr(found, 2 * PRECISION);
    v128_t next = wasm_i32x4_mul(frequency, wasm_u32x4_shr(state, PRECISION));
    next = wasm_i32x4_sub(wasm_i32x4_add(next, place), start);
    const v128_t low =
        wasm_v128_and(wasm_i32x4_eq(wasm_u32x4_shr(next, 16), wasm_i32x4_const_splat(0)), there);
    const uint32_t set = wasm_i32x4_bitmask(low);
    const v128_t taken = wasm_i8x16_swizzle(wasm_u32x4_load16x4(words + 2 * *read), wasm_v128_load(words_of_sets[set]));
    *read += (size_t)__builtin_popcount(set);
    next = wasm_v128_or(wasm_v128_bitselect(wasm_i32x4_shl(next, 16), next, low), taken);
    wasm_v128_store(states, wasm_v128_bitselect(next, state, there));
    wasm_v128_store(recent,
        wasm_i32x4_add(before, wasm_i32x4_sub(wasm_i32x4_shl(size, 1), wasm_i32x4_shr(before, 2))));
    return size;
}

/* A row, of the first `count` lanes. Returns how many words were read. */
static INLINE size_t take_row(
    const tables *of, const int32_t *base, uint32_t *states, int32_t *recent, uint8_t *tokens, int16_t *sizes,
    const uint8_t *words, size_t count)
{
    size_t read = 0;
    for (size_t lane = 0; lane < LANES; lane += 8) {
        v128_t four[2];
        for (size_t k = 0; k < 2; k++) {
            const size_t first = lane + 4 * k;
            const v128_t there = count == LANES
                ? wasm_i32x4_const_splat(-1)
                : wasm_i32x4_gt(wasm_i32x4_splat((int32_t)count - (int32_t)first), wasm_i32x4_const(0, 1, 2, 3));
            four[k] = take_four(of, base + first, states + first, recent + first, tokens + first, words, &read, there);
        }
        wasm_v128_store(sizes + lane, wasm_i16x8_narrow_i32x4(four[0], four[1]));
    }
    return read;
}

static int decode_by_vectors_of_four(
    const stream_model *model, reader *r, uint32_t *states, size_t lanes, size_t items, const rows_of_tokens *out)
{
    int32_t recent[LANES] = { 0 };
    tables of;
    of.weight = wasm_i32x4_splat(model->recent);
    for (size_t size = 0; size <= LARGEST_SIZE; size++) {
        of.rows[size].slots = model->slots + ((size_t)model->classes[size] << PRECISION);
        of.rows[size].intervals = model->intervals + ((size_t)model->classes[size] << 8);
    }
    const size_t steps = (items + lanes - 1) / lanes;
    for (size_t step = 0; step < steps; step++) {
        const size_t count = (items - step + steps - 1) / steps, first = step * LANES;
        const int32_t *const base = out->expected + first;
        uint8_t *const tokens = out->tokens + first;
        int16_t *const sizes = out->sizes + first;
        if (r->available - r->read >= LANES) {
            const uint8_t *const words = r->words + 2 * r->read;
            if (count == LANES)
                r->read += take_row(&of, base, states, recent, tokens, sizes, words, LANES);
            else
                r->read += take_row(&of, base, states, recent, tokens, sizes, words, count);
        } else if (last_rows(model, r, base, states, recent, tokens, sizes, count)) {
            return 1;
        }
        /* Lanes that are not there may count as large, which changes nothing. */
        if (model->alphabet > DIRECT
            && wasm_i8x16_bitmask(wasm_v128_or(wasm_v128_load(tokens), wasm_v128_load(tokens + 16)))
            && take_bits(r, states, count, tokens, out->extra + first))
            return 1;
    }
    return 0;
}

#endif

int decode_tokens(
    const stream_model *model, reader *r, uint32_t *states, size_t lanes, size_t items, const rows_of_tokens *out)
{
#if defined(__wasm_simd128__)
    if (model->by_vectors)
        return decode_by_vectors_of_four(model, r, states, lanes, items, out);
#endif
    return decode_without_vectors(model, r, states, lanes, items, out);
}
