/* The numbers of the splats of some groups that are in a given state, ascending. A work-group looks at CHUNK splats:
   count_wanted finds how many of them are wanted, and write_wanted puts their numbers behind those of the work-groups
   before it. Both kernel families use it. count_wanted does so for several choices of groups, one after another in
   `wanted` and in `counts`: the second dimension of work-groups.

   Macros: none.

   On GPUs: no macros. */

#include "include/group.clh"

#define GROUP 256
#define ROUNDS 16
#define CHUNK (GROUP * ROUNDS)

/* Whether a splat is wanted: groups[i] is the group of splat i, wanted[g] is 1 if the splats of group g are, and
   states[i] must be `state`, if `by_state` says so. */
inline uint is_wanted(
    global const uint *groups,
    global const uchar *wanted,
    global const uchar *states,
    int by_state,
    uint state,
    size_t i)
{
    return wanted[groups[i]] && (!by_state || states[i] == state);
}

kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void count_wanted(
    global const uint *groups,
    global const uchar *wanted,
    global const uchar *states,
    int by_state,
    uint state,
    uint splats,
    uint group_count,
    global uint *counts)
{
    local uint sum;
    const uint lid = get_local_id(0);
    wanted += (size_t)GROUP_ID(1) * group_count;
    counts += (size_t)GROUP_ID(1) * get_num_groups(0);
    if (lid == 0)
        sum = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    uint mine = 0;
    for (uint round = 0; round < ROUNDS; ++round) {
        const size_t splat = GROUP_ID(0) * CHUNK + round * GROUP + lid;
        if (splat < splats)
            mine += is_wanted(groups, wanted, states, by_state, state, splat);
    }
    if (mine > 0)
        atomic_add(&sum, mine);
    barrier(CLK_LOCAL_MEM_FENCE);
    if (lid == 0)
        counts[GROUP_ID(0)] = sum;
}

/* starts[w] is where the numbers of work-group w begin, `first` places further on. Of several choices of groups it is
   that of number `choice`. */
kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void write_wanted(
    global const uint *groups,
    global const uchar *wanted,
    global const uchar *states,
    int by_state,
    uint state,
    uint splats,
    uint group_count,
    uint choice,
    global const uint *starts,
    uint first,
    global uint *numbers)
{
    local uint sums[GROUP];
    const uint lid = get_local_id(0);
    wanted += (size_t)choice * group_count;
    uint start = first + starts[(size_t)choice * get_num_groups(0) + GROUP_ID(0)];
    for (uint round = 0; round < ROUNDS; ++round) {
        const size_t splat = GROUP_ID(0) * CHUNK + round * GROUP + lid;
        const uint flag = splat < splats ? is_wanted(groups, wanted, states, by_state, state, splat) : 0;
        sums[lid] = flag;
        barrier(CLK_LOCAL_MEM_FENCE);
        for (uint step = 1; step < GROUP; step *= 2) {
            const uint before = lid >= step ? sums[lid - step] : 0;
            barrier(CLK_LOCAL_MEM_FENCE);
            sums[lid] += before;
            barrier(CLK_LOCAL_MEM_FENCE);
        }
        if (flag)
            numbers[start + sums[lid] - 1] = (uint)splat;
        start += sums[GROUP - 1];
        barrier(CLK_LOCAL_MEM_FENCE);
    }
}
