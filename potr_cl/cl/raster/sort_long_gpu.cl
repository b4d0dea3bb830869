/* The depth order of long lists of tiles, for GPUs, by merging: many work-groups a list, where sort_gpu.cl has one. Keys
   differ from each other, so the order is the same.

   sort_pieces sorts pieces of PIECE keys. Each launch of merge_pieces then makes runs twice as long: a work-group finds
   the keys of one piece of what comes out (merge path: Odeh, Green, Mwassi, Shmueli, Birk: "Merge Path - Parallel Merging
   Made Simple", 2012). The lists go to and fro between `keys` and `others`.

   Macros: PIECE (a power of two; must be given).

   On GPUs: PIECE:2048. */

#include "include/group.clh"

#define GROUP 256

/* A piece of a list: where the list begins among the keys and among the others, how long it is, and where in it the
   piece begins. */
typedef struct {
    uint keys, others, length, start;
} Piece;

kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void sort_pieces(global const Piece *pieces, global ulong *keys)
{
    local ulong own[PIECE];
    const Piece piece = pieces[GROUP_ID(0)];
    const uint lid = get_local_id(0), n = min(piece.length - piece.start, (uint)PIECE);
    keys += piece.keys + piece.start;
    for (uint i = lid; i < PIECE; i += GROUP)
        own[i] = i < n ? keys[i] : ULONG_MAX;
    /* A bitonic network; each merge begins with a mirrored step. */
    for (uint size = 1; size < PIECE; size *= 2)
        for (uint reach = size; reach > 0; reach /= 2) {
            barrier(CLK_LOCAL_MEM_FENCE);
            for (uint i = lid; i < PIECE / 2; i += GROUP) {
                const uint low = 2 * i - (i & (reach - 1));
                const uint high = reach == size ? low ^ (2 * reach - 1) : low + reach;
                const ulong first = own[low], second = own[high];
                if (first > second) {
                    own[low] = second;
                    own[high] = first;
                }
            }
        }
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint i = lid; i < n; i += GROUP)
        keys[i] = own[i];
}

/* How many of the first `together` keys of both runs, merged, come from the first one. */
inline uint of_first(global const ulong *first, uint first_length, global const ulong *second, uint second_length,
    uint together)
{
    uint low = together > second_length ? together - second_length : 0, high = min(together, first_length);
    while (low < high) {
        const uint middle = (low + high) / 2;
        if (first[middle] < second[together - 1 - middle])
            low = middle + 1;
        else
            high = middle;
    }
    return low;
}

/* How many keys of a sorted run are less. */
inline uint less(local const ulong *run, uint length, ulong key)
{
    uint low = 0, high = length;
    while (low < high) {
        const uint middle = (low + high) / 2;
        if (run[middle] < key)
            low = middle + 1;
        else
            high = middle;
    }
    return low;
}

/* Merges runs of `size` keys, a multiple of PIECE, in pairs. */
kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void merge_pieces(global const Piece *pieces, global ulong *keys, global ulong *others, uint size, uint from_keys)
{
    local ulong own[PIECE];
    local uint taken[2];
    const Piece piece = pieces[GROUP_ID(0)];
    const uint lid = get_local_id(0), n = min(piece.length - piece.start, (uint)PIECE);
    global const ulong *from = from_keys ? keys + piece.keys : others + piece.others;
    global ulong *to = from_keys ? others + piece.others : keys + piece.keys;
    const uint base = piece.start / size / 2 * size * 2;
    const uint middle = min(base + size, piece.length), end = min(middle + size, piece.length);
    global const ulong *first = from + base, *second = from + middle;
    const uint before = piece.start - base;
    if (lid < 2)
        taken[lid] = of_first(first, middle - base, second, end - middle, before + lid * n);
    barrier(CLK_LOCAL_MEM_FENCE);
    const uint firsts = taken[1] - taken[0], seconds = n - firsts;
    first += taken[0];
    second += before - taken[0];
    for (uint i = lid; i < n; i += GROUP)
        own[i] = i < firsts ? first[i] : second[i - firsts];
    barrier(CLK_LOCAL_MEM_FENCE);
    to += piece.start;
    for (uint i = lid; i < n; i += GROUP) {
        const ulong key = own[i];
        const uint place = i < firsts ? i + less(own + firsts, seconds, key) : i - firsts + less(own, firsts, key);
        to[place] = key;
    }
}

/* The lower half of each key, the splat's number, to where the list lies. */
kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void take_pieces(
    global const Piece *pieces,
    global const ulong *keys,
    global const ulong *others,
    uint from_keys,
    global uint *intersections)
{
    const Piece piece = pieces[GROUP_ID(0)];
    const uint n = min(piece.length - piece.start, (uint)PIECE);
    global const ulong *from = from_keys ? keys + piece.keys : others + piece.others;
    for (uint i = get_local_id(0); i < n; i += GROUP)
        intersections[piece.keys + piece.start + i] = (uint)from[piece.start + i];
}
