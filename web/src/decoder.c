/* What WebAssembly adds to the decoder's C (potr_cl/native): a block's sections as JavaScript hands them over, and
 * values that nobody looks up. JavaScript has checked all sizes and reserved all memory; nothing here allocates.
 *
 * There is one block at a time, and one bundle's values at a time: `potr_out` says where they stand. */

#include <math.h>
#include <string.h>

#include "bundles_values.h"
#include "prediction.h"
#include "steps.h"

/* A linker that optimises all at once would fetch libc's, which ask the host for random numbers. Nobody calls these, but
 * all three must be here: with one of them missing libc's come, and are there twice. */
unsigned long __stack_chk_guard;
void __init_ssp(void *entropy)
{
    (void)entropy;
}
_Noreturn void __stack_chk_fail(void)
{
    __builtin_trap();
}

#define EXPORT(name) __attribute__((export_name(#name))) name

/* Of the native path, which Python calls without headers. */
int potr_bundles_table(const uint16_t *, size_t, size_t, const int16_t *, uint8_t *, uint32_t *);
int potr_octree_levels(const uint8_t *, size_t, const uint8_t *, size_t, int, int, void *, uint64_t *, uint64_t *);
size_t potr_octree_cut(void);
size_t potr_octree_cuts(
    const uint8_t *, size_t, const uint8_t *, int, const void *, uint64_t, uint64_t, const uint64_t *, uint64_t, size_t,
    void *);
void potr_octree_leaves(
    const uint8_t *, const uint8_t *, int, const void *, const void *, const uint8_t *, const uint64_t *, const void *,
    uint64_t *);
int potr_octree_padding(const uint64_t *, const uint8_t *);
void potr_octree_centres(
    const void *, const void *, const uint64_t *, const uint64_t *, const uint64_t *, const uint8_t *, const double *,
    const double *, const void *);

/* Of the quantisers (docs/format.md, "Values"). */
enum { UNIFORM, BALANCED };
/* Levels whose values are looked up. */
enum { LOOKED_UP = 1 << 13 };
enum { COEFFICIENTS = 16 };

typedef struct {
    int32_t quantiser, coefficients;
    float sf_scale, sf_rotation, sf_opacity;
} rules;

static rules of_block, of_tables;
static bundled_file file;
static scene_values values;
static work room;

/* Tables by class of steps, and by level. */
static float sf_dc[2 * CLASSES], sf_ac[2 * CLASSES];
static uint64_t steps_of_class[2 * CLASSES], inverse_of_class[2 * CLASSES];
static float scale_table[LOOKED_UP], opacity_table[LOOKED_UP];

/* Values of a bundle, splat by splat. */
static float log_scales[3 * BUNDLE], quaternions[4 * BUNDLE], logits[BUNDLE], sh[3 * COEFFICIENTS * BUNDLE];
static float dc[3 * BUNDLE];

void *EXPORT(potr_out)(int which)
{
    return which == 0 ? log_scales : which == 1 ? quaternions : which == 2 ? logits : sh;
}

/* The natural logarithm of codec/logarithm.py: the same bits everywhere. */
static float natural_logarithm(float x)
{
    if (x == 0x1.bacb4ap+25f)
        return 0x1.1e0696p+4f;
    double mantissa = x;
    uint64_t bits;
    memcpy(&bits, &mantissa, sizeof bits);
    int exponent = (int)(bits >> 52) - 1022;
    bits = (bits & ((UINT64_C(1) << 52) - 1)) | UINT64_C(1022) << 52;
    memcpy(&mantissa, &bits, sizeof bits);
    if (mantissa < 0.7071067811865476) {
        mantissa += mantissa;
        exponent--;
    }
    const double t = (mantissa - 1) / (mantissa + 1), square = t * t;
    double total = 1.0 / 21;
    for (int k = 9; k >= 0; k--) {
        total *= square;
        total += 1.0 / (2 * k + 1);
    }
    total *= t;
    total += total;
    return (float)(exponent * 0.6931471805599453 + total);
}

static float log_scale(level x)
{
    const float wide = (float)x;
    return natural_logarithm((wide > 0.25f ? wide : 0.25f) / of_block.sf_scale);
}

static float logit(level x)
{
    if (of_block.quantiser == BALANCED)
        return (float)x / of_block.sf_opacity + -8.0f;
    float opacity = ((float)x + 0.25f) / of_block.sf_opacity;
    if (opacity > 0x1.fffffep-1f)
        opacity = 0x1.fffffep-1f;
    return natural_logarithm(opacity / (1 - opacity));
}

/* Begins a block. of_dc, of_ac: scale factors. coefficients: SH coefficients of a channel that are wanted. */
void EXPORT(potr_begin)(
    double splats, int quantiser, int coefficients, float of_scale, float of_rotation, float of_opacity, float of_dc,
    float of_ac)
{
    static const float octave[4] = { 1, 0x1.306fep+0f, 0x1.6a09e6p+0f, 0x1.ae89fap+0f };
    static const uint64_t whole[4] = { 65536, 77936, 92682, 110218 };
    memset(&file, 0, sizeof file);
    file.splats = (uint64_t)splats;
    const rules now = { quantiser, coefficients, of_scale, of_rotation, of_opacity };
    of_block = now;
    for (int k = -CLASSES; k < CLASSES; k++) {
        const uint32_t bits = (uint32_t)(127 + (k >> 2)) << 23;
        float power;
        memcpy(&power, &bits, sizeof power);
        sf_dc[k + CLASSES] = of_dc * (octave[k & 3] * power);
        sf_ac[k + CLASSES] = of_ac * (octave[k & 3] * power);
        const uint64_t up = whole[k & 3], down = whole[-k & 3];
        inverse_of_class[k + CLASSES] = k >= 0 ? up << (k >> 2) : up >> -(k >> 2);
        steps_of_class[k + CLASSES] = -k >= 0 ? down << (-k >> 2) : down >> -(-k >> 2);
    }
    if (memcmp(&of_tables, &now, sizeof now)) /* blocks of a file have the same */
        for (int x = 0; x < LOOKED_UP; x++) {
            scale_table[x] = log_scale(x);
            opacity_table[x] = logit(x);
        }
    of_tables = now;
    potr_bundles_begin(&room);
}

/* A stream of bundles. numbers: its terms' weights, that of recent sizes, the constant, biases. classes: (256).
 * frequencies: (contexts, alphabet). sizes: (alphabet). slots: (4096 contexts + 3). intervals: (256 contexts).
 * Returns 0, or 1 where frequencies do not add up. */
int EXPORT(potr_stream)(
    int number, const int32_t *numbers, int terms, int biases, const uint8_t *classes, const uint16_t *frequencies,
    int contexts, int alphabet, const int16_t *sizes, uint8_t *slots, uint32_t *intervals)
{
    stream_model *const model = &file.streams[number];
    model->classes = classes;
    model->slots = slots;
    model->intervals = intervals;
    model->sizes = sizes;
    for (int k = 0; k < terms; k++)
        model->weights[k] = numbers[k];
    model->recent = numbers[terms];
    model->constant = numbers[terms + 1];
    for (int k = 0; k < biases; k++)
        model->biases[k] = numbers[terms + 2 + k];
    model->alphabet = alphabet;
    model->by_vectors = 1;
    for (int token = 0; token < alphabet; token++)
        model->by_vectors &= sizes[token] <= LARGEST_SIZE;
    return potr_bundles_table(frequencies, (size_t)contexts, (size_t)alphabet, sizes, slots, intervals);
}

/* A section of bundles. counts: u32 words of each of `bundles`. starts: (bundles + 1), to be filled. states: of the
 * lanes, where it begins a chain. */
void EXPORT(potr_section)(
    int number, const uint8_t *words, const uint8_t *counts, int bundles, uint64_t *starts, const uint32_t *states)
{
    starts[0] = 0;
    for (int b = 0; b < bundles; b++) {
        uint32_t count;
        memcpy(&count, counts + 4 * b, sizeof count);
        starts[b + 1] = starts[b] + count;
    }
    file.words[number] = words;
    file.starts[number] = starts;
    if (number == OPACITY)
        file.states = states;
    if (number == ROTATION)
        file.rotation_states = states;
}

/* Steps of colours. raw: the section, of some size. Returns 0, or 1 if they are impossible. */
int EXPORT(potr_steps)(const uint8_t *raw, uint32_t size)
{
    colour_steps *const to = &file.steps;
    if (size < 50 || raw[0] > 40 || raw[1] > 40 || raw[5])
        return 1;
    if (size - 50 != (file.splats + (UINT64_C(1) << raw[0]) - 1) >> raw[0])
        return 1;
    int16_t numbers[22];
    memcpy(numbers, raw + 6, sizeof numbers);
    to->groups = (const int8_t *)raw + 50;
    to->group_bits = raw[0];
    to->knot_shift = raw[1];
    to->first_knot = raw[2];
    for (int k = 0; k < 2; k++) {
        to->powers[k] = raw[3 + k];
        to->offsets[k] = numbers[k];
    }
    for (int k = 0; k < 3; k++)
        to->scales[k] = numbers[2 + k];
    for (int k = 0; k < KNOTS; k++)
        to->knots[k] = numbers[5 + k];
    return 0;
}

/* Coefficients of a bundle's splats to `sh`: those of `dc`, and those that are not 0. */
static void spread(size_t splats, size_t steps)
{
    const size_t all = 3 * (size_t)of_block.coefficients;
    memset(sh, 0, splats * all * sizeof *sh);
    for (size_t i = 0; i < splats; i++)
        for (size_t c = 0; c < 3; c++)
            sh[i * all + c] = dc[c * BUNDLE + i];
    for (size_t band = 0; band < 3; band++) {
        const uint16_t *const places = room.places[band];
        const level *const ys = room.channels[band][0], *const cos = room.channels[band][1], *const cgs = room.channels[band][2];
        for (size_t i = 0; i < room.items[band]; i++) {
            const size_t place = places[i], splat = place % LANES * steps + place / LANES;
            const level y = ys[i], co = cos[i], cg = cgs[i], rest = y - cg;
            const float divisor = sf_ac[room.ac_classes[place]];
            float *const to = sh + splat * all + 3 * ((band + 1) * (band + 1) + room.coefficients[band][i]);
            to[0] = (float)(rest + co) / divisor;
            to[1] = (float)(y + cg) / divisor;
            to[2] = (float)(rest - co) / divisor;
        }
    }
}

/* A bundle's values: of so many sections of the chain that begins with opacities, and of rotations. Returns what
 * potr_bundles_levels does, and from bit 8 on the section at fault. */
int EXPORT(potr_bundle)(int bundle, int sections)
{
    memset(&values, 0, sizeof values);
    values.log_scales = log_scales;
    values.quaternions = quaternions;
    values.logits = logits;
    values.dc = dc;
    values.scale_table = scale_table;
    values.opacity_table = opacity_table;
    values.scale_levels = values.opacity_levels = LOOKED_UP;
    values.sf_dc = sf_dc;
    values.sf_ac = sf_ac;
    values.step = steps_of_class;
    values.inverse = inverse_of_class;
    values.sf_rotation = of_block.sf_rotation;
    values.begin = (uint64_t)bundle * BUNDLE;
    values.stride = BUNDLE;
    int section = 0;
    const int said = potr_bundles_values(&file, (uint64_t)bundle, sections, 1, &room, &values, &section);
    if (said != FINE && said != BEYOND_TABLE)
        return said | section << 8;
    const size_t splats = splats_of(&file, (uint64_t)bundle), steps = steps_of(splats);
    if (said == BEYOND_TABLE)
        for (size_t i = 0; i < splats; i++) {
            const size_t place = i % steps * LANES + i / steps;
            logits[i] = logit(room.opacity[place]);
            for (size_t axis = 0; axis < 3; axis++)
                log_scales[3 * i + axis] = log_scale(room.scales[axis][place]);
        }
    spread(splats, steps);
    return FINE;
}

#if defined(POTR_WIDE_LEVELS)

/* Plain streams (docs/format.md): where each stream's planes begin, and how many there are. */
enum { PLAIN_SCALE = 1, PLAIN_ROTATION = 4, PLAIN_SH = 7 };
static struct {
    const uint8_t *planes;
    int32_t width;
} plain[PLAIN_SH + 3 * COEFFICIENTS];
static uint64_t sums[3];

/* A stream of the block, from the first one on. */
void EXPORT(potr_plain_stream)(int number, const uint8_t *planes, int width)
{
    plain[number].planes = planes;
    plain[number].width = width;
    memset(sums, 0, sizeof sums);
}

static level plain_integer(size_t stream, size_t splat)
{
    uint64_t u = 0;
    for (int p = 0; p < plain[stream].width; p++)
        u |= (uint64_t)plain[stream].planes[(size_t)p * (size_t)file.splats + splat] << 8 * p;
    return stream < PLAIN_ROTATION ? (level)u : (level)((u >> 1) ^ (0 - (u & 1)));
}

static void to_rgb(uint64_t y, uint64_t co, uint64_t cg, float divisor, float *rgb)
{
    const uint64_t rest = y - cg;
    rgb[0] = (float)(level)(rest + co) / divisor;
    rgb[1] = (float)(level)(y + cg) / divisor;
    rgb[2] = (float)(level)(rest - co) / divisor;
}

/* Values of n splats, at most LANES, of the plain coder; pieces follow each other. */
static void plain_piece(size_t first, size_t n, size_t to)
{
    level scales[3][LANES], opacities[LANES];
    uint8_t of_dc[LANES], of_ac[LANES];
    memset(of_dc, CLASSES, sizeof of_dc);
    memset(of_ac, CLASSES, sizeof of_ac);
    for (size_t i = 0; i < n; i++) {
        opacities[i] = plain_integer(0, first + i);
        logits[to + i] = logit(opacities[i]);
        level largest = 1;
        for (size_t axis = 0; axis < 3; axis++) {
            const level x = scales[axis][i] = plain_integer(PLAIN_SCALE + axis, first + i);
            log_scales[3 * (to + i) + axis] = log_scale(x);
            largest = x > largest ? x : largest;
        }
        const float factor =
            of_block.quantiser == BALANCED ? sqrtf((float)largest) * of_block.sf_rotation : of_block.sf_rotation;
        float rest = 1, *const turned = quaternions + 4 * (to + i);
        for (size_t axis = 0; axis < 3; axis++) {
            const float part = (float)plain_integer(PLAIN_ROTATION + axis, first + i) / factor;
            turned[1 + axis] = part;
            rest -= part * part;
        }
        turned[0] = sqrtf(rest > 0 ? rest : 0);
    }
    if (file.steps.groups) {
        const level *const axes[3] = { scales[0], scales[1], scales[2] };
        find_classes(&file.steps, room.logarithms, axes, opacities, first, 1, n, of_dc, of_ac);
    }
    for (size_t i = 0; i < n; i++)
        for (size_t m = 0; m < (size_t)of_block.coefficients; m++) {
            uint64_t channels[3];
            for (size_t c = 0; c < 3; c++) {
                channels[c] = (uint64_t)plain_integer(PLAIN_SH + 3 * m + c, first + i);
                if (m == 0)
                    channels[c] = sums[c] += channels[c];
            }
            const float divisor = m ? sf_ac[of_ac[i]] : sf_dc[of_dc[i]];
            to_rgb(channels[0], channels[1], channels[2], divisor,
                sh + 3 * ((to + i) * (size_t)of_block.coefficients + m));
        }
}

/* The values of a bundle's splats, of bundles that follow each other. */
void EXPORT(potr_plain_bundle)(int bundle)
{
    const size_t first = (size_t)bundle * BUNDLE, splats = splats_of(&file, (uint64_t)bundle);
    for (size_t i = 0; i < splats; i += LANES)
        plain_piece(first + i, splats - i < LANES ? splats - i : LANES, i);
}

#endif

/* Positions. Of the tree that is looked at: */
enum { DEEPEST = 52 };
static struct {
    uint64_t nodes[DEEPEST + 2], children[DEEPEST + 2];
} tree;
static uint64_t leaves_of[2], counts[DEEPEST + 1], ranks[DEEPEST + 1], cuts[1024];
static struct {
    float *means;
    uint64_t *cells;
    uint8_t *levels, *tails;
} leaves;

/* Finds a tree sound. Returns where the numbers of its lone leaves and of its crowded ones stand (two doubles), or 0. */
const double *EXPORT(potr_tree)(
    const uint8_t *occupancy, size_t cells, const uint8_t *several, size_t bytes, int depth, int crowded_root)
{
    static double numbers[2];
    if (potr_octree_levels(occupancy, cells, several, bytes, depth, crowded_root, &tree, leaves_of, leaves_of + 1))
        return 0;
    numbers[0] = (double)leaves_of[0];
    numbers[1] = (double)leaves_of[1];
    return numbers;
}

/* The tree's leaves. multiplicities: as many as there are crowded leaves. means: (splats, 3). cells: (splats, 3), or 0
 * where the tree has at most 32 levels. of_leaves: (2, splats). Returns where the numbers of tails of each length stand
 * (53 u64), or 0 where there are not as many splats. */
const uint64_t *EXPORT(potr_leaves)(
    const uint8_t *occupancy, size_t cells, const uint8_t *several, int depth, const uint8_t *leaf_levels,
    const uint64_t *multiplicities, size_t splats, float *means, uint64_t *wide_cells, uint8_t *of_leaves)
{
    const size_t cut = potr_octree_cut() / sizeof *cuts;
    leaves.means = means;
    leaves.cells = wide_cells;
    leaves.levels = of_leaves;
    leaves.tails = of_leaves + splats;
    if (2 * cut > sizeof cuts / sizeof *cuts
        || potr_octree_cuts(
               occupancy, cells, several, depth, &tree, leaves_of[0], leaves_of[1], multiplicities, splats, 1, cuts) != 1)
        return 0;
    potr_octree_leaves(occupancy, several, depth, cuts, cuts + cut, leaf_levels, multiplicities, &leaves, counts);
    return counts;
}

/* Whether the tails' padding is wrong. */
int EXPORT(potr_padding)(const uint8_t *tails)
{
    return potr_octree_padding(counts, tails);
}

/* The centres of the leaves that were found. cube: x, y, z of the origin, side. box: smallest x, y, z, largest x, y, z.
 * Returns 0; 1 where one is not finite, 2 where one lies outside of the box. */
int EXPORT(potr_centres)(
    const uint64_t *multiplicities, const uint8_t *tails, const double *cube, int depth, const float *box, size_t splats)
{
    const size_t cut = potr_octree_cut() / sizeof *cuts;
    double sides[DEEPEST + 1];
    uint64_t longer = 0;
    double power = 1;
    for (int l = 0; l <= depth; l++, power /= 2)
        sides[l] = cube[3] * power;
    for (int t = DEEPEST; t >= 0; t--) {
        ranks[t] = longer;
        longer += counts[t];
    }
    potr_octree_centres(cuts, cuts + cut, counts, ranks, multiplicities, tails, sides, cube, &leaves);
    int inside = 1, finite = 1;
    for (size_t i = 0; i < 3 * splats; i++) {
        const float x = leaves.means[i];
        inside &= (x >= box[i % 3]) & (x <= box[3 + i % 3]);
        finite &= x - x == 0;
    }
    return !finite ? 1 : inside ? 0 : 2;
}
