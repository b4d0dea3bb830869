/* Bundles (docs/format.md): the tokens of a stream, row by row.
 *
 * The loops stand twice: in plain C, and for processors with vectors of 512 bits, which look up the tokens of sixteen
 * lanes at a time. Both give the same integers. */

#include <string.h>

#include "bundles_tokens.h"

/* Not on Windows, where compilers put such vectors on a stack that is not aligned for them. */
#if defined(__x86_64__) && defined(__GNUC__) && !defined(_WIN32) \
    && (defined(__clang__) ? __clang_major__ >= 10 : __GNUC__ >= 9)
#define VECTORS 1
#include <immintrin.h>
#else
#define VECTORS 0
#endif

/* Gives each of `count` states that is below 2^16 a word. Returns 0, or 1 if there are too few words. */
static int renormalise(reader *r, uint32_t *states, size_t count)
{
    for (size_t i = 0; i < count; i++)
        if (states[i] < LOWEST) {
            if (r->read == r->available)
                return 1;
            uint16_t word;
            memcpy(&word, r->words + 2 * r->read++, 2);
            states[i] = states[i] << 16 | word;
        }
    return 0;
}

/* The bits beside the tokens of a row. Bits beyond those of a level are lost: the caller knows that there are none. */
static int take_bits(reader *r, uint32_t *states, size_t count, const uint8_t *tokens, mapped_level *extra)
{
    memset(extra, 0, count * sizeof *extra);
    for (unsigned shift = 0;; shift += CHUNK) {
        int more = 0;
        for (size_t i = 0; i < count; i++) {
            const unsigned all = extra_bits(tokens[i]);
            if (all <= shift)
                continue;
            const unsigned bits = all - shift < CHUNK ? all - shift : CHUNK;
            extra[i] |= (mapped_level)(states[i] & ((1u << bits) - 1)) << shift;
            states[i] >>= bits;
            more = 1;
        }
        if (!more)
            return 0;
        if (renormalise(r, states, count))
            return 1;
    }
}

/* A row of tokens whose expected sizes are known: of the first `count` of some lanes. What the others find is not used,
 * and their states are left alone. Words are read without asking whether there are more: `count` of them at least are
 * there. Returns how many were read.
 *
 * Whether a state takes a word is as good as chance, and processors foretell such branches wrongly: so every lane is
 * given the next word, and only those that need it go on to the one after. */
static INLINE size_t row_of_tokens(
    const stream_model *model, const uint8_t *restrict expected, const uint8_t *restrict words,
    uint32_t *restrict states, int32_t *restrict recent, uint8_t *restrict tokens, int16_t *restrict sizes,
    size_t count, size_t lanes)
{
    uint32_t found[LANES], next[LANES], place[LANES];
    uint16_t low[LANES] = { 0 };
    const uint8_t *const classes = model->classes, *const slots = model->slots;
    const uint32_t *const intervals = model->intervals;
    const int16_t *const size_of = model->sizes;
    for (size_t i = 0; i < lanes; i++)
        place[i] = states[i] & (TOTAL - 1);
    for (size_t i = 0; i < lanes; i++) {
        const uint32_t context = classes[expected[i]];
        const uint32_t token = slots[context << PRECISION | place[i]];
        found[i] = intervals[context << 8 | token];
        tokens[i] = (uint8_t)token;
        sizes[i] = size_of[token];
    }
    for (size_t i = 0; i < lanes; i++)
        next[i] = frequency_of(found[i]) * (states[i] >> PRECISION) + place[i] - start_of(found[i]);
    for (size_t i = count; i < lanes; i++)
        next[i] = states[i];
    size_t read = 0;
    for (size_t i = 0; i < count; i++) {
        memcpy(&low[i], words + 2 * read, 2);
        read += next[i] < LOWEST;
    }
    for (size_t i = 0; i < lanes; i++)
        states[i] = next[i] < LOWEST ? next[i] << 16 | low[i] : next[i];
    for (size_t i = 0; i < lanes; i++)
        recent[i] += 2 * sizes[i] - (recent[i] >> 2);
    return read;
}

static INLINE void expected_sizes(
    const int32_t *restrict base, int32_t weight, const int32_t *restrict recent, uint8_t *restrict expected,
    size_t count)
{
    for (size_t i = 0; i < count; i++) {
        const int32_t size = (base[i] + weight * recent[i]) >> 8;
        expected[i] = (uint8_t)(size < 0 ? 0 : size > LARGEST_SIZE ? LARGEST_SIZE : size);
    }
}

/* A row near the end of the words: a lane at a time, with a word to spare or one that must not be needed. Returns 0, or
 * 1 if there are too few words. */
static int last_rows(
    const stream_model *model, reader *r, const int32_t *base, uint32_t *states, int32_t *recent, uint8_t *tokens,
    int16_t *sizes, size_t count)
{
    static const uint8_t none[2] = { 0, 0 };
    uint8_t expected[LANES];
    expected_sizes(base, model->recent, recent, expected, count);
    for (size_t i = 0; i < count; i++) {
        const int left = r->available > r->read;
        const size_t needed = row_of_tokens(model, expected + i, left ? r->words + 2 * r->read : none, states + i,
            recent + i, tokens + i, sizes + i, 1, 1);
        if (needed && !left)
            return 1;
        r->read += needed;
    }
    return 0;
}

static INLINE int any_large(const uint8_t *tokens, size_t count)
{
    uint8_t any = 0;
    for (size_t i = 0; i < count; i++)
        any |= tokens[i];
    return any & DIRECT;
}

POTR_WIDE
static int decode_plainly(
    const stream_model *model, reader *r, uint32_t *states, size_t lanes, size_t items, const rows_of_tokens *out)
{
    int32_t recent[LANES] = { 0 };
    const size_t steps = (items + lanes - 1) / lanes;
    for (size_t step = 0; step < steps; step++) {
        const size_t count = (items - step + steps - 1) / steps, first = step * LANES;
        const int32_t *const base = out->expected + first;
        uint8_t *const tokens = out->tokens + first;
        int16_t *const sizes = out->sizes + first;
        if (r->available - r->read >= LANES) {
            const uint8_t *const words = r->words + 2 * r->read;
            uint8_t expected[LANES];
            expected_sizes(base, model->recent, recent, expected, LANES);
            if (count == LANES)
                r->read += row_of_tokens(model, expected, words, states, recent, tokens, sizes, LANES, LANES);
            else
                r->read += row_of_tokens(model, expected, words, states, recent, tokens, sizes, count, LANES);
        } else if (last_rows(model, r, base, states, recent, tokens, sizes, count)) {
            return 1;
        }
        if (model->alphabet > DIRECT && any_large(tokens, count)
            && take_bits(r, states, count, tokens, out->extra + first))
            return 1;
    }
    return 0;
}

#if VECTORS

#define OF_512 __attribute__((target("avx512f,avx512bw,avx512dq,avx512vl,avx512vbmi")))

/* Sixteen lanes. */
typedef struct {
    __m512i state, recent;
} half_row;

/* What vectors and single lanes hand each other. */
typedef struct {
    uint32_t slots[LANES], cells[LANES];
} lookups;

/* The token of a lane, and its interval. */
OF_512 static INLINE __m128i look_up(const stream_model *model, const lookups *of, size_t lane, uint8_t *tokens)
{
    const uint32_t token = model->slots[of->slots[lane]];
    tokens[lane] = (uint8_t)token;
    return _mm_cvtsi32_si128((int)model->intervals[of->cells[lane] | token]);
}

/* Those of four lanes. They are put together in registers: a wide load of what was stored piece by piece would wait for
 * all of it to reach the cache. */
OF_512 static INLINE __m128i look_up_four(const stream_model *model, const lookups *of, size_t lane, uint8_t *tokens)
{
    const __m128i a = look_up(model, of, lane, tokens), b = look_up(model, of, lane + 1, tokens);
    const __m128i c = look_up(model, of, lane + 2, tokens), d = look_up(model, of, lane + 3, tokens);
    return _mm_unpacklo_epi64(_mm_unpacklo_epi32(a, b), _mm_unpacklo_epi32(c, d));
}

OF_512 static INLINE __m512i look_up_half(const stream_model *model, const lookups *of, size_t lane, uint8_t *tokens)
{
    const __m256i low = _mm256_set_m128i(look_up_four(model, of, lane + 4, tokens), look_up_four(model, of, lane, tokens));
    const __m256i high =
        _mm256_set_m128i(look_up_four(model, of, lane + 12, tokens), look_up_four(model, of, lane + 8, tokens));
    return _mm512_inserti64x4(_mm512_castsi256_si512(low), high, 1);
}

OF_512 static INLINE __m128i expected_of_half(const int32_t *base, __m512i weight, __m512i recent)
{
    const __m512i sum = _mm512_add_epi32(_mm512_loadu_si512(base), _mm512_mullo_epi32(weight, recent));
    return _mm512_cvtusepi32_epi8(_mm512_max_epi32(_mm512_srai_epi32(sum, 8), _mm512_setzero_si512()));
}

OF_512 static INLINE void places_of_half(__m128i context_bytes, __m512i state, uint32_t *slots, uint32_t *cells)
{
    const __m512i context = _mm512_cvtepu8_epi32(context_bytes);
    const __m512i place = _mm512_and_si512(state, _mm512_set1_epi32(TOTAL - 1));
    _mm512_storeu_si512(slots, _mm512_or_si512(_mm512_slli_epi32(context, PRECISION), place));
    _mm512_storeu_si512(cells, _mm512_slli_epi32(context, 8));
}

/* Takes the tokens of the lanes that `there` has; gives those that need it a word. Returns how many were read. */
OF_512 static INLINE size_t take_half(
    half_row *row, __m512i found, const uint8_t *words, __mmask16 there, int16_t *sizes)
{
    const __m512i low12 = _mm512_set1_epi32(TOTAL - 1);
    const __m512i place = _mm512_and_si512(row->state, low12);
    const __m512i frequency = _mm512_add_epi32(_mm512_and_si512(found, low12), _mm512_set1_epi32(1));
    const __m512i start = _mm512_and_si512(_mm512_srli_epi32(found, PRECISION), low12);
    const __m512i size = _mm512_srli_epi32(found, 2 * PRECISION);
    __m512i next = _mm512_mullo_epi32(frequency, _mm512_srli_epi32(row->state, PRECISION));
    next = _mm512_sub_epi32(_mm512_add_epi32(next, place), start);
    const __mmask16 low = _mm512_mask_cmplt_epu32_mask(there, next, _mm512_set1_epi32(LOWEST));
    const __m512i read = _mm512_cvtepu16_epi32(_mm256_loadu_si256((const void *)words));
    const __m512i taken = _mm512_or_si512(_mm512_slli_epi32(next, 16), _mm512_maskz_expand_epi32(low, read));
    row->state = _mm512_mask_mov_epi32(row->state, there, _mm512_mask_mov_epi32(next, low, taken));
    row->recent = _mm512_add_epi32(
        row->recent, _mm512_sub_epi32(_mm512_slli_epi32(size, 1), _mm512_srai_epi32(row->recent, 2)));
    _mm256_storeu_si256((void *)sizes, _mm512_cvtepi32_epi16(size));
    return (size_t)__builtin_popcount(low);
}

/* Contexts of 32 expected sizes. */
OF_512 static INLINE __m256i contexts_of(const __m512i *classes, __m128i first, __m128i second)
{
    const __m512i sizes = _mm512_castsi256_si512(_mm256_set_m128i(second, first));
    const __m512i below = _mm512_permutex2var_epi8(classes[0], sizes, classes[1]);
    const __m512i above = _mm512_permutex2var_epi8(classes[2], sizes, classes[3]);
    return _mm512_castsi512_si256(_mm512_mask_mov_epi8(below, _mm512_movepi8_mask(sizes), above));
}

OF_512 static int decode_by_vectors(
    const stream_model *model, reader *r, uint32_t *states, size_t lanes, size_t items, const rows_of_tokens *out)
{
    const size_t steps = (items + lanes - 1) / lanes;
    const __m512i weight = _mm512_set1_epi32(model->recent);
    const __m512i classes[4] = { _mm512_loadu_si512(model->classes), _mm512_loadu_si512(model->classes + 64),
        _mm512_loadu_si512(model->classes + 128), _mm512_loadu_si512(model->classes + 192) };
    half_row a, b;
    a.recent = b.recent = _mm512_setzero_si512();
    a.state = _mm512_loadu_si512(states);
    b.state = _mm512_loadu_si512(states + 16);
    for (size_t step = 0; step < steps; step++) {
        const size_t count = (items - step + steps - 1) / steps, first = step * LANES;
        const int32_t *const base = out->expected + first;
        uint8_t *const tokens = out->tokens + first;
        int16_t *const sizes = out->sizes + first;
        int large = 0;
        if (r->available - r->read >= LANES) {
            const uint32_t there = (uint32_t)((UINT64_C(1) << count) - 1);
            const __m256i contexts = contexts_of(classes, expected_of_half(base, weight, a.recent),
                expected_of_half(base + 16, weight, b.recent));
            lookups of;
            places_of_half(_mm256_castsi256_si128(contexts), a.state, of.slots, of.cells);
            places_of_half(_mm256_extracti128_si256(contexts, 1), b.state, of.slots + 16, of.cells + 16);
            const __m512i of_a = look_up_half(model, &of, 0, tokens), of_b = look_up_half(model, &of, 16, tokens);
            r->read += take_half(&a, of_a, r->words + 2 * r->read, (__mmask16)there, sizes);
            r->read += take_half(&b, of_b, r->words + 2 * r->read, (__mmask16)(there >> 16), sizes + 16);
            if (model->alphabet > DIRECT)
                large = (_mm256_movepi8_mask(_mm256_loadu_si256((const void *)tokens)) & there) != 0;
            if (!large)
                continue;
        }
        int32_t recent[LANES];
        _mm512_storeu_si512(states, a.state);
        _mm512_storeu_si512(states + 16, b.state);
        if (!large) {
            _mm512_storeu_si512(recent, a.recent);
            _mm512_storeu_si512(recent + 16, b.recent);
            if (last_rows(model, r, base, states, recent, tokens, sizes, count))
                return 1;
            a.recent = _mm512_loadu_si512(recent);
            b.recent = _mm512_loadu_si512(recent + 16);
        }
        if (any_large(tokens, count) && take_bits(r, states, count, tokens, out->extra + first))
            return 1;
        a.state = _mm512_loadu_si512(states);
        b.state = _mm512_loadu_si512(states + 16);
    }
    _mm512_storeu_si512(states, a.state);
    _mm512_storeu_si512(states + 16, b.state);
    return 0;
}

#endif

POTR_EXPORT int potr_bundles_vectors(void)
{
#if VECTORS
    return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512dq")
        && __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512vbmi");
#else
    return 0;
#endif
}

int decode_tokens(
    const stream_model *model, reader *r, uint32_t *states, size_t lanes, size_t items, const rows_of_tokens *out)
{
#if VECTORS
    if (model->by_vectors)
        return decode_by_vectors(model, r, states, lanes, items, out);
#endif
    return decode_plainly(model, r, states, lanes, items, out);
}
