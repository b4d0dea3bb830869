/* Bundles that threads share out among themselves: each takes the next that nobody has taken, until none are left, so that
 * nobody has to tell it more than to begin. To wait for an interpreter that others want too takes longer than a bundle. */

#if !defined(_WIN32)
#define _POSIX_C_SOURCE 199309L
#include <time.h>
#else
#include <windows.h>
#endif

#include "bundles_values.h"

#if defined(_MSC_VER) && !defined(__clang__)
#include <intrin.h>
#define ADD_ONE(counter) ((uint64_t)_InterlockedExchangeAdd64((volatile __int64 *)(counter), 1))
#define LOOK(number) ((uint64_t)_InterlockedOr64((volatile __int64 *)(number), 0))
#define LOOK_AT_32(number) ((int32_t)_InterlockedOr((volatile long *)(number), 0))
#define SET_32(number, value) (void)_InterlockedExchange((volatile long *)(number), (long)(value))
#define REPLACE(number, old, value) \
    (_InterlockedCompareExchange64((volatile __int64 *)(number), (__int64)(value), (__int64)(old)) == (__int64)(old))
#else
#define ADD_ONE(counter) __atomic_fetch_add(counter, 1, __ATOMIC_RELAXED)
#define LOOK(number) __atomic_load_n(number, __ATOMIC_ACQUIRE)
#define LOOK_AT_32(number) __atomic_load_n(number, __ATOMIC_ACQUIRE)
#define SET_32(number, value) __atomic_store_n(number, value, __ATOMIC_RELEASE)
#define REPLACE(number, old, value) __sync_bool_compare_and_swap(number, old, value)
#endif

/* What threads share. */
typedef struct {
    const bundled_file *file;
    scene_values *values; /* (rooms) where bundles go; bundle b to number b mod rooms */
    int32_t *said;        /* (bundles) below 0 until a bundle is done; then what potr_bundles_values has said, and from
                             bit 8 on the section at fault */
    uint64_t rooms, bundles;
    uint64_t next;  /* bundle that nobody has taken */
    uint64_t limit; /* bundles from there on wait until there is room for them */
    uint64_t end;   /* bundles from there on need not be done: one is damaged, or nobody wants them any more */
    int32_t sections, rotating;
} bundle_share;

static void rest(void)
{
#if defined(_WIN32)
    if (!SwitchToThread())
        Sleep(0);
#else
    const struct timespec some = { 0, 20000 };
    nanosleep(&some, NULL);
#endif
}

/* A thread's share of the bundles, at most `most` of them; `w` is of this thread alone, of any content. Returns whether
 * there may be more. */
POTR_EXPORT int potr_bundles_share(bundle_share *share, work *w, uint64_t most)
{
    potr_bundles_begin(w);
    for (uint64_t done = 0; done < most; done++) {
        const uint64_t bundle = ADD_ONE(&share->next);
        while (bundle < LOOK(&share->end) && bundle >= LOOK(&share->limit))
            rest();
        /* Those before the damaged one that comes first are all done, whoever finds it. */
        if (bundle >= LOOK(&share->end))
            return 0;
        scene_values *const values = &share->values[bundle % share->rooms];
        if (values->items)
            values->begin = bundle * BUNDLE;
        int section = 0;
        const int said =
            potr_bundles_values(share->file, bundle, share->sections, share->rotating, w, values, &section);
        if (said != FINE && said != BEYOND_TABLE)
            for (uint64_t end = LOOK(&share->end); bundle < end; end = LOOK(&share->end))
                if (REPLACE(&share->end, end, bundle))
                    break;
        SET_32(&share->said[bundle], said | section << 8);
    }
    return 1;
}

/* What is said of a bundle; below 0 if it is not done after a while. */
POTR_EXPORT int32_t potr_bundles_wait(const bundle_share *share, uint64_t bundle)
{
    for (int round = 0; round < 1000; round++) {
        const int32_t said = LOOK_AT_32(&share->said[bundle]);
        if (said >= 0)
            return said;
        rest();
    }
    return -1;
}
