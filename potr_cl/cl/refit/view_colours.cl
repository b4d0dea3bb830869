/* From coefficients to the splats' colours in each view: the first half of the map from coefficients to pictures.

   Macros: LANES (splats a work-item), SH_COUNT; PICKED (1: each view has some splats only, in an order of its own, which
   `numbers` names. 0: all views have all).

   On GPUs: LANES=1 SH_COUNT=1,4,9,16 PICKED=0,1. */

#include "refit/view_colours.clh"

inline void to_rgb(const vfloat sums[3], vfloat *red, vfloat *green, vfloat *blue)
{
    *red = sums[0] + sums[1] - sums[2];
    *green = sums[0] + sums[2];
    *blue = sums[0] - sums[1] - sums[2];
}

/* R, G, B of what coefficients, or a direction, are in a view. */
inline void in_view(const vfloat *values, const VREAL *basis, vfloat *red, vfloat *green, vfloat *blue)
{
    vfloat sums[3] = {(vfloat)(0.0f), (vfloat)(0.0f), (vfloat)(0.0f)};
    for (int m = 0; m < SH_COUNT; ++m)
        for (int c = 0; c < 3; ++c)
            sums[c] = MAD(basis[m], values[3 * m + c], sums[c]);
    to_rgb(sums, red, green, blue);
}

#if LANES > 1
/* The same of a direction, whose other coefficients are 0: values[c][k] is that of the k-th one that may change. */
inline void change_in_view(
    const vfloat values[3][SH_COUNT],
    const Changing *changing,
    const VREAL *basis,
    vfloat *red,
    vfloat *green,
    vfloat *blue)
{
    vfloat sums[3];
    for (int c = 0; c < 3; ++c) {
        vfloat sum = (vfloat)(0.0f);
        for (uint k = 0; k < changing->counts[c]; ++k)
            sum = MAD(basis[changing->rows[c][k]], values[c][k], sum);
        sums[c] = sum;
    }
    to_rgb(sums, red, green, blue);
}
#endif

inline void store_colour(vfloat red, vfloat green, vfloat blue, size_t place, global float4 *colours)
{
#if LANES == 1
    colours[place] = (float4)(red, green, blue, 0.0f);
#else
    vfloat four[4];
    interleave(red, green, blue, (vfloat)(0.0f), four);
    for (int k = 0; k < 4; ++k)
        VSTORE(four[k], 4 * place + k, (global float *)colours);
#endif
}

/* A change of colours, times a unit, where the channels are free. */
inline void store_change(
    vfloat red, vfloat green, vfloat blue, float unit, global const uchar *free, size_t place, global float4 *colours)
{
    const vint kept = CONVERT_VINT(VLOAD(place, free));
    red = (kept & 1) != 0 ? red * unit : (vfloat)(0.0f);
    green = (kept & 2) != 0 ? green * unit : (vfloat)(0.0f);
    blue = (kept & 4) != 0 ? blue * unit : (vfloat)(0.0f);
    store_colour(red, green, blue, place, colours);
}

/* The splats' colours in each view of a set: of the coefficients themselves (direction == 0), cut at 0, which leave in
   `free` which channels are free: above 0; or their change along a direction, 0 where `free` says that the channel is
   cut. What views have lies `apart`; in `free` that of the first is at `first_free`. Work-item i of the second dimension
   does views i, i + get_global_size(1), … */
kernel void view_colours(
    global const float *coefficients,
    global const float *means,
    ulong stride,
    ulong apart,
    global const uint *numbers,
    global const SetView *views,
    uint view_count,
    int direction,
    float unit,
    global uchar *free,
    ulong first_free,
    global float4 *colours)
{
    free += first_free;
    const size_t index = get_global_id(0);
    vfloat values[3 * SH_COUNT];
#if !PICKED
    const size_t splat = index;
    for (int i = 0; i < 3 * SH_COUNT; ++i)
        values[i] = VLOAD(splat, coefficients + i * stride);
#endif
    for (uint number = get_global_id(1); number < view_count; number += get_global_size(1)) {
#if PICKED
#if LANES > 1
        uint splat[LANES];
        int there[LANES];
        if (!read_place(numbers + number * apart + LANES * index, splat, there))
            continue;
#else
        const uint splat = numbers[number * apart + index];
        if (splat == NO_SPLAT)
            continue;
#endif
        for (int i = 0; i < 3 * SH_COUNT; ++i)
            values[i] = LOAD_AT(splat, coefficients + i * stride);
#endif
        VREAL basis[SH_COUNT];
        basis_towards(means, stride, splat, &views[number].view, basis);
        vfloat red, green, blue;
        in_view(values, basis, &red, &green, &blue);
        const size_t place = number * apart / LANES + index;
        if (direction) {
            store_change(red, green, blue, unit, free, place, colours);
            continue;
        }
        red = fmin(red + 0.5f, (vfloat)(1e30f));
        green = fmin(green + 0.5f, (vfloat)(1e30f));
        blue = fmin(blue + 0.5f, (vfloat)(1e30f));
        const vfloat channels = (red > 0.0f ? (vfloat)(1.0f) : (vfloat)(0.0f)) +
            (green > 0.0f ? (vfloat)(2.0f) : (vfloat)(0.0f)) +
            (blue > 0.0f ? (vfloat)(4.0f) : (vfloat)(0.0f));
        VSTORE(CONVERT_VUCHAR(channels), place, free);
        store_colour(
            fmax(red, (vfloat)(0.0f)), fmax(green, (vfloat)(0.0f)), fmax(blue, (vfloat)(0.0f)), place, colours);
    }
}

#if LANES > 1 && !PICKED
/* What a direction adds to the splats' colours in some views on a CPU, as view_colours has it: its coefficients go
   through the memory once for all of them, and those that none of LANES splats may change are not looked at. */
kernel void colour_changes(
    global const float *coefficients,
    global const float *means,
    global const uint *active,
    ulong stride,
    ulong apart,
    global const SetView *views,
    uint view_count,
    float unit,
    global const uchar *free,
    ulong first_free,
    global float4 *colours)
{
    const size_t splat = get_global_id(0);
    Changing changing;
    changing_coefficients(active, stride, splat, &changing);
    vfloat values[3][SH_COUNT];
    for (int c = 0; c < 3; ++c)
        for (uint k = 0; k < changing.counts[c]; ++k)
            values[c][k] = VLOAD(splat, coefficients + (3 * changing.rows[c][k] + c) * stride);
    for (uint number = 0; number < view_count; ++number) {
        VREAL basis[SH_COUNT];
        basis_towards(means, stride, splat, &views[number].view, basis);
        vfloat red, green, blue;
        change_in_view(values, &changing, basis, &red, &green, &blue);
        store_change(red, green, blue, unit, free + first_free, number * apart / LANES + splat, colours);
    }
}
#endif
