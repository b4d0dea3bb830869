/* 64-bit integers with the bits that they need: all of a run with as many as the longest of them. Two's complement.

   Integers may be the columns of a table that lies in rows: number i of them is then in row i % rows. A run is RUN values
   of so many bits, the first one in the lowest bits of its words of 16 bits: as many words as a value has bits. Where
   runs begin is known of every RUNS-th.

   On GPUs: no macros. */

#define RUN 16
#define RUNS 4

inline size_t place_of(size_t i, ulong rows, ulong stride)
{
    return rows == 1 ? i : i % rows * stride + i / rows;
}

/* The bits that each of a run's values needs, 0 to 64. A run a work-item. */
kernel void widths_of(
    global const long *values, ulong start, ulong count, ulong rows, ulong stride, global uchar *widths)
{
    const size_t run = get_global_id(0), first = RUN * run;
    if (first >= count)
        return;
    long any = 0;
    ulong bits = 0;
    for (uint k = 0; k < RUN && first + k < count; ++k) {
        const long value = values[start + place_of(first + k, rows, stride)];
        any |= value;
        bits |= (ulong)(value ^ (value >> 63));
    }
    widths[run] = any ? (uchar)(65 - clz(bits)) : (uchar)0;
}

inline size_t begin_of(size_t run, global const uchar *widths, global const ulong *starts)
{
    size_t begin = starts[run / RUNS];
    for (size_t before = run / RUNS * RUNS; before < run; ++before)
        begin += widths[before];
    return begin;
}

/* A run a work-item. */
kernel void narrow(
    global const long *values,
    ulong start,
    ulong count,
    ulong rows,
    ulong stride,
    global const uchar *widths,
    global const ulong *starts,
    global ushort *words)
{
    const size_t run = get_global_id(0), first = RUN * run;
    if (first >= count || widths[run] == 0)
        return;
    const uint width = widths[run];
    global ushort *word = words + begin_of(run, widths, starts);
    ulong waiting = 0;
    uint bits = 0; /* of those, always fewer than a word has */
    for (uint k = 0; k < RUN; ++k) {
        ulong value = first + k < count ? (ulong)values[start + place_of(first + k, rows, stride)] : 0;
        for (uint left = width; left;) {
            const uint some = min(left, 32u);
            waiting |= (value & (ulong)(0xffffffffu >> (32 - some))) << bits;
            value >>= some;
            left -= some;
            for (bits += some; bits >= 16; bits -= 16) {
                *word++ = (ushort)waiting;
                waiting >>= 16;
            }
        }
    }
}

/* A value a work-item. */
kernel void widen(
    global long *values,
    ulong count,
    ulong rows,
    ulong stride,
    global const uchar *widths,
    global const ulong *starts,
    global const ushort *words)
{
    const size_t i = get_global_id(0);
    if (i >= count)
        return;
    const uint width = widths[i / RUN];
    ulong value = 0;
    if (width) {
        const uint bit = i % RUN * width;
        global const ushort *word = words + begin_of(i / RUN, widths, starts) + bit / 16;
        value = *word++ >> bit % 16;
        for (uint known = 16 - bit % 16; known < width; known += 16)
            value |= (ulong)*word++ << known;
        value = (ulong)((long)(value << (64 - width)) >> (64 - width));
    }
    values[place_of(i, rows, stride)] = (long)value;
}
