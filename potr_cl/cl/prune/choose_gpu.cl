/* The choice of the pruning controller on the device: which splats go in an iteration. The rules are those of
   stages/pruning/schedule.py, which is its twin on the host.

   Candidates go by ascending score, up to and including the one with which their importances reach the iteration's
   budget. The score of that one is found digit by digit, from histograms of the candidates' importances over 8 bits of
   the score at a time. Importances are integers (totals.clh), so that no sum depends on the order of its terms.

   Macros: INT64_ATOMICS (see totals.clh).

   On GPUs: INT64_ATOMICS=0,1. */

#include "include/group.clh"
#include "include/totals.clh"
#include "prune/removal.clh"

/* How many values a digit of a key has, and how many digits a key has. */
#define DIGIT 256
#define DIGITS 4

/* A splat's key is its score as an unsigned integer that sorts like the score. Two values mean something else. */
#define GOES_AT_ONCE 0u
#define STAYS 0xFFFFFFFFu
#define LAST_KEY 0xFFFFFFFEu

/* What the kernels of an iteration hand on: a histogram for each digit, of which each bin is a total of two words; CUT
   words of what is known after each digit; the number of splats that go. */
typedef struct {
    uint histograms[2048]; /* DIGITS * HISTOGRAM */
    uint cuts[16]; /* DIGITS * CUT */
    uint gone;
} State;
#define HISTOGRAM (2 * DIGIT)
#define CUT 4

inline uint ordered(float score)
{
    const uint bits = as_uint(score);
    return clamp(bits & 0x80000000u ? ~bits : bits | 0x80000000u, GOES_AT_ONCE + 1, LAST_KEY);
}

inline long total_at(global const uint *words)
{
    return (long)((ulong)words[1] << 32 | words[0]);
}

/* m(x) of the paper, "The mapping function". */
inline float mapping(float x, float a)
{
    return x >= 0.0f ? x : (sqrt(1.0f - 2.0f * a * x) - 1.0f) / a;
}

/* Adds a candidate's importance to a bin of the work-group's own histogram. */
inline void add_local(volatile local uint *bin, ulong importance)
{
    const uint low = (uint)importance, before = atomic_add(bin, low);
    const uint high = (uint)(importance >> 32) + (before + low < before);
    if (high)
        atomic_add(bin + 1, high);
}

/* What is noted of a splat that goes. */
typedef struct {
    uint iteration, key;
    float effect, importance;
} Removed;

/* The leading digits of the last key that goes, and what is left of the budget for the keys that begin with them. */
typedef struct {
    uint digits;
    ulong rest;
} Cut;

/* Finds one digit more of the last key that goes: the first bin with which the budget is reached. Every work-group
   finds it for itself; the first one leaves it in the state for the next digit. */
inline Cut next_cut(
    global State *state, int digit, uint remaining, uint lid, local ulong *sums, volatile local uint *found)
{
    global const uint *bin = state->histograms + digit * HISTOGRAM + 2 * lid;
    sums[lid] = (ulong)bin[1] << 32 | bin[0];
    if (lid == 0)
        *found = DIGIT - 1;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint step = 1; step < DIGIT; step *= 2) {
        const ulong below = lid >= step ? sums[lid - step] : 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        sums[lid] += below;
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    global const uint *former = state->cuts + (digit - 1) * CUT;
    ulong budget = (sums[DIGIT - 1] + remaining - 1) / remaining;
    uint digits = 0;
    if (digit > 0) {
        digits = former[0];
        budget = (ulong)former[2] << 32 | former[1];
    }
    const ulong before = lid > 0 ? sums[lid - 1] : 0;
    if (before < budget && sums[lid] >= budget)
        *found = lid;
    barrier(CLK_LOCAL_MEM_FENCE);
    Cut cut;
    cut.digits = digits << 8 | *found;
    cut.rest = budget - (*found > 0 ? sums[*found - 1] : 0);
    if (GROUP_ID(0) == 0 && lid == 0) {
        global uint *now = state->cuts + digit * CUT;
        now[0] = cut.digits;
        now[1] = (uint)cut.rest;
        now[2] = (uint)(cut.rest >> 32);
    }
    return cut;
}

/* Adds a work-group's histogram to that of all work-groups. */
inline void merge(global State *state, int digit, local const uint *bins, uint lid)
{
    const ulong sum = (ulong)bins[2 * lid + 1] << 32 | bins[2 * lid];
    add_fixed(state->histograms + digit * HISTOGRAM + 2 * lid, (long)sum);
}

/* Finds every splat's smoothed effect and key, and the histogram of the keys' first digit. */
kernel __attribute__((reqd_work_group_size(DIGIT, 1, 1)))
void rank(
    uint splats,
    global const uint *totals,
    global uchar *alive,
    global const uchar *spared,
    float effect_unit,
    float weight,
    float limit,
    float a,
    global float *smoothed,
    global uint *keys,
    global State *state)
{
    local uint bins[2 * DIGIT];
    const uint i = get_global_id(0), lid = get_local_id(0);
    bins[2 * lid] = bins[2 * lid + 1] = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    uint key = STAYS;
    ulong importance = 0;
    if (i < splats && alive[i] == SPLAT_JUST_REMOVED)
        alive[i] = SPLAT_REMOVED;
    if (i < splats && alive[i] == SPLAT_ALIVE) {
        global const uint *total = totals + TOTAL_WORDS * (size_t)i;
        importance = (ulong)max(total_at(total + 2), 0L);
        const float newest = convert_float_rte(total_at(total)) * effect_unit;
        /* In the first iteration the weight is 1. */
        const float mean = weight == 1.0f ? newest : smoothed[i] + (newest - smoothed[i]) / weight;
        smoothed[i] = mean;
        if (mean < limit && !spared[i])
            key = importance == 0 && mean == 0.0f ? GOES_AT_ONCE
                                                  : ordered(limit > 0.0f ? mapping(mean / limit, a) : mean);
    }
    if (i < splats)
        keys[i] = key;
    if (key != STAYS && importance > 0)
        add_local(bins + 2 * (key >> 24), importance);
    barrier(CLK_LOCAL_MEM_FENCE);
    merge(state, 0, bins, lid);
}

/* Finds the histogram of another digit, of those keys that begin like the last one that goes. */
kernel __attribute__((reqd_work_group_size(DIGIT, 1, 1)))
void refine(
    uint splats,
    global const uint *totals,
    global const uint *keys,
    int digit,
    uint remaining,
    global State *state)
{
    local uint bins[2 * DIGIT];
    local ulong sums[DIGIT];
    local uint found;
    const uint i = get_global_id(0), lid = get_local_id(0);
    bins[2 * lid] = bins[2 * lid + 1] = 0;
    const Cut cut = next_cut(state, digit - 1, remaining, lid, sums, &found);
    const uint key = i < splats ? keys[i] : STAYS;
    const int shift = 8 * (DIGITS - digit);
    if (key != STAYS && key >> shift == cut.digits) {
        const long importance = total_at(totals + TOTAL_WORDS * (size_t)i + 2);
        if (importance > 0)
            add_local(bins + 2 * (key >> (shift - 8) & (DIGIT - 1)), (ulong)importance);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    merge(state, digit, bins, lid);
}

/* Marks the splats that go as just removed, notes when they went and at what cost, and counts them. */
kernel __attribute__((reqd_work_group_size(DIGIT, 1, 1)))
void mark(
    uint splats,
    global const uint *totals,
    global const uint *keys,
    float effect_unit,
    float importance_unit,
    uint iteration,
    uint remaining,
    global uchar *alive,
    global Removed *removed,
    global State *state)
{
    local ulong sums[DIGIT];
    local uint found, gone;
    const uint i = get_global_id(0), lid = get_local_id(0);
    if (lid == 0)
        gone = 0;
    const Cut cut = next_cut(state, DIGITS - 1, remaining, lid, sums, &found);
    const uint last = remaining > 1 ? min(cut.digits, LAST_KEY) : LAST_KEY;
    if (i < splats && keys[i] <= last) {
        global const uint *total = totals + TOTAL_WORDS * (size_t)i;
        alive[i] = SPLAT_JUST_REMOVED;
        removed[i].iteration = iteration;
        removed[i].key = keys[i];
        removed[i].effect = convert_float_rte(total_at(total)) * effect_unit;
        removed[i].importance = convert_float_rte(total_at(total + 2)) * importance_unit;
        atomic_inc(&gone);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    if (lid == 0 && gone > 0)
        atomic_add(&state->gone, gone);
}
