/* 64-bit integers with the bytes that they need: all of a run with as many as the longest of them. Two's complement. */

#define RUN 64

/* The bytes that each of a run's values needs, 0 to 8. A run a work-item. */
kernel void widths_of(global const long *values, ulong start, ulong count, global uchar *widths)
{
    const size_t run = get_global_id(0), first = RUN * run;
    if (first >= count)
        return;
    long any = 0;
    ulong bits = 0;
    for (uint k = 0; k < RUN && first + k < count; ++k) {
        const long value = values[start + first + k];
        any |= value;
        bits |= (ulong)(value ^ (value >> 63));
    }
    widths[run] = any ? (uchar)((64 - clz(bits)) / 8 + 1) : (uchar)0;
}

kernel void narrow(
    global const long *values,
    ulong start,
    ulong count,
    global const uchar *widths,
    global const ulong *starts,
    global uchar *bytes)
{
    const size_t i = get_global_id(0);
    if (i >= count)
        return;
    const uint width = widths[i / RUN];
    const size_t place = starts[i / RUN] + width * (i % RUN);
    const ulong value = (ulong)values[start + i];
    for (uint k = 0; k < width; ++k)
        bytes[place + k] = (uchar)(value >> (8 * k));
}

kernel void widen(
    global long *values,
    ulong count,
    global const uchar *widths,
    global const ulong *starts,
    global const uchar *bytes)
{
    const size_t i = get_global_id(0);
    if (i >= count)
        return;
    const uint width = widths[i / RUN];
    const size_t place = starts[i / RUN] + width * (i % RUN);
    ulong value = 0;
    for (uint k = 0; k < width; ++k)
        value |= (ulong)bytes[place + k] << (8 * k);
    const uint above = width ? 64 - 8 * width : 0;
    values[i] = (long)(value << above) >> above;
}
