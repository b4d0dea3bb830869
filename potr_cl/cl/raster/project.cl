/* Projects every splat into each view of a set, and finds the colour of those that can be seen. A work-item does LANES
   splats; get_global_id(1) is the view's number. Both kernel families use it.

   The splats' parameters come as a structure of arrays, each `stride` splats long. They are already activated: standard
   deviations, unit quaternions, log2 of the opacity. Padding splats have a log2 opacity of -INFINITY.

   Macros:
       LANES          see lanes.clh; 1 on GPUs;
       SH_COUNT       see sh.clh;
       NEAR           splats whose depth is at or below it are not drawn, in world units;
       SQUARE_EXTENT  1: a splat is drawn only in the tiles that the original's square of three standard deviations
                      touches; 0: wherever its alpha reaches 1/255;
       ANTIALIASED    1: what the low-pass filter adds to a splat's area it takes from its opacity, which is multiplied
                      by sqrt(det S / det(S + LOW_PASS I)), S the covariance on screen; 0, the default: it does not;
       LEAST_COMPENSATION_SQUARED  the least value under that root; must be given if ANTIALIASED;
       LOW_PASS, LOW_PASS_SQUARED  square pixels added to a splat's variances on screen, and their square;
       PICKED         1: only the splats that `numbers` names are projected, `picked` of them, of a scene that is
                      `whole_stride` long; what is found lies in their order. Each view's numbers begin `apart` behind
                      those of the view before it; NO_SPLAT among them is drawn nowhere. 0, the default: all.

   On GPUs: LANES=1 SH_COUNT=1,4,9,16 NEAR=0.2f SQUARE_EXTENT=0,1 PICKED=-,1 ANTIALIASED=-,1
       (LEAST_COMPENSATION_SQUARED=2.5e-5f) LOW_PASS=-,0.1f (LOW_PASS_SQUARED=0.01f). */

#include "include/lanes.clh"
#include "include/splat.clh"
#include "include/places.clh"
#include "include/view_set.clh"
#include "include/sh.clh"

#ifndef ANTIALIASED
#define ANTIALIASED 0
#endif
#ifndef LOW_PASS
#define LOW_PASS 0.3f
#define LOW_PASS_SQUARED 0.09f
#endif

/* sqrt(log2(e) / 2): turns exp(-q / 2) into exp2(-q'). */
#define EXPONENT_SCALE 0.84932180f
/* Projected axes are cut to so many pixels, which is far more than any image has. The fourth power is still finite. */
#define AXIS_LIMIT 1e8f

/* The half-open range of tiles along one axis of `size` pixels, in whole numbers: those with a pixel centre within
   reach of the position which also, with the square extent, touch the square around it. The original's pixel centres
   have whole coordinates, half a pixel less than here. */
inline void tile_range(vfloat position, vfloat reach, vfloat radius, int size, vfloat *first, vfloat *end)
{
    const float tiles = (size + TILE - 1) / TILE;
    vfloat first_pixel = ceil(position - reach - 0.5f);
    vfloat last_pixel = floor(position + reach - 0.5f);
    vint none = first_pixel > last_pixel || last_pixel < 0.0f || first_pixel >= (float)size;
    *first = floor(fmin(fmax(first_pixel, 0.0f), (float)size) / TILE);
    *end = floor(fmin(fmax(last_pixel, 0.0f), (float)(size - 1)) / TILE) + 1.0f;
#if SQUARE_EXTENT
    *first = fmax(*first, floor(fmin(fmax(position - 0.5f - radius, 0.0f), (float)size) / TILE));
    *end = fmin(*end, floor(fmin(fmax(position - 0.5f + radius + (TILE - 1), 0.0f), tiles * TILE) / TILE));
#endif
    *end = none ? *first : *end;
}

kernel void project(
    global const float *means,
    global const float *scales,
    global const float *quaternions,
    global const float *log2_opacities,
    global const float *sh,
    uint stride,
    uint whole_stride,
    global const uint *numbers,
    uint picked,
    uint apart,
    global const SetView *views,
    global float4 *shapes,
    global float4 *colours,
    global ushort4 *bounds)
{
    global const View *view = &views[get_global_id(1)].view;
    shapes += 2 * (size_t)stride * get_global_id(1);
    colours += (size_t)stride * get_global_id(1);
    bounds += (size_t)stride * get_global_id(1);
    const size_t place = get_global_id(0); /* of the results */
#if PICKED && LANES > 1
    const size_t column = whole_stride;
    numbers += (size_t)apart * get_global_id(1);
    uint index[LANES];
    float opacities[LANES];
    for (int lane = 0; lane < LANES; ++lane) {
        const size_t one = place * LANES + lane;
        const uint number = numbers[min(one, (size_t)picked - 1)];
        index[lane] = number == NO_SPLAT ? 0 : number;
        opacities[lane] = one < picked && number != NO_SPLAT ? log2_opacities[index[lane]] : -INFINITY;
    }
    vfloat lo = VLOAD(0, opacities);
#elif PICKED
    const size_t column = whole_stride; /* a parameter's columns lie so far apart */
    const uint number = numbers[(size_t)apart * get_global_id(1) + min(place, (size_t)picked - 1)];
    const size_t index = number == NO_SPLAT ? 0 : number;
    vfloat lo = place < picked && number != NO_SPLAT ? log2_opacities[index] : -INFINITY;
#else
    const size_t column = stride;
    const size_t index = place;
    vfloat lo = VLOAD(index, log2_opacities);
#endif
    /* The camera centre is subtracted first: both are large where a scene is far from the origin, their difference is
       not. */
    vfloat dx = (LOAD_AT(index, means) - view->camera_centre_high[0]) - view->camera_centre_low[0];
    vfloat dy = (LOAD_AT(index, means + column) - view->camera_centre_high[1]) - view->camera_centre_low[1];
    vfloat dz = (LOAD_AT(index, means + 2 * column) - view->camera_centre_high[2]) - view->camera_centre_low[2];
    global const float *w = view->rotation;
    vfloat tx = w[0] * dx + w[1] * dy + w[2] * dz;
    vfloat ty = w[3] * dx + w[4] * dy + w[5] * dz;
    vfloat tz = w[6] * dx + w[7] * dy + w[8] * dz;
    vint drawn = (tz > NEAR) && (lo >= LOG2_ALPHA_MIN);

    vfloat inverse_z = 1.0f / tz;
    vfloat ratio_x = tx * inverse_z;
    vfloat ratio_y = ty * inverse_z;
    vfloat x = view->fx * ratio_x + view->cx;
    vfloat y = view->fy * ratio_y + view->cy;
    ratio_x = fmin(fmax(ratio_x, -view->limit_x), view->limit_x);
    ratio_y = fmin(fmax(ratio_y, -view->limit_y), view->limit_y);

    /* The ellipse's axes on screen: the rotation's columns times the scales, through the view's rotation and the
       Jacobian. */
    vfloat qw = LOAD_AT(index, quaternions);
    vfloat qx = LOAD_AT(index, quaternions + column);
    vfloat qy = LOAD_AT(index, quaternions + 2 * column);
    vfloat qz = LOAD_AT(index, quaternions + 3 * column);
    vfloat axes[9] = {
        1.0f - 2.0f * (qy * qy + qz * qz), 2.0f * (qx * qy + qw * qz), 2.0f * (qx * qz - qw * qy),
        2.0f * (qx * qy - qw * qz), 1.0f - 2.0f * (qx * qx + qz * qz), 2.0f * (qy * qz + qw * qx),
        2.0f * (qx * qz + qw * qy), 2.0f * (qy * qz - qw * qx), 1.0f - 2.0f * (qx * qx + qy * qy)};
    vfloat mx[3], my[3];
    for (int k = 0; k < 3; ++k) {
        vfloat *axis = axes + 3 * k;
        vfloat ux = w[0] * axis[0] + w[1] * axis[1] + w[2] * axis[2];
        vfloat uy = w[3] * axis[0] + w[4] * axis[1] + w[5] * axis[2];
        vfloat uz = w[6] * axis[0] + w[7] * axis[1] + w[8] * axis[2];
        vfloat scale = LOAD_AT(index, scales + k * column) * inverse_z;
        mx[k] = view->fx * scale * (ux - ratio_x * uz);
        my[k] = view->fy * scale * (uy - ratio_y * uz);
        vfloat shrink = fmin(AXIS_LIMIT / fmax(fmax(fabs(mx[k]), fabs(my[k])), 1.0f), 1.0f);
        mx[k] *= shrink;
        my[k] *= shrink;
    }
    /* The covariance with the dilation. Its determinant comes from Lagrange's identity, a sum of squares that cannot
       cancel. */
    vfloat sxx = mx[0] * mx[0] + mx[1] * mx[1] + mx[2] * mx[2];
    vfloat sxy = mx[0] * my[0] + mx[1] * my[1] + mx[2] * my[2];
    vfloat syy = my[0] * my[0] + my[1] * my[1] + my[2] * my[2];
    vfloat n0 = mx[1] * my[2] - mx[2] * my[1];
    vfloat n1 = mx[2] * my[0] - mx[0] * my[2];
    vfloat n2 = mx[0] * my[1] - mx[1] * my[0];
    vfloat determinant = n0 * n0 + n1 * n1 + n2 * n2 + LOW_PASS * (sxx + syy) + LOW_PASS_SQUARED;
#if ANTIALIASED
    vfloat kept = (n0 * n0 + n1 * n1 + n2 * n2) / determinant;
    lo += 0.5f * log2(fmax(kept, LEAST_COMPENSATION_SQUARED));
    drawn = drawn && (lo >= LOG2_ALPHA_MIN);
#endif
    sxx += LOW_PASS;
    syy += LOW_PASS;

    vfloat a = EXPONENT_SCALE * sqrt(syy / determinant);
    vfloat b = -a * (sxy / syy);
    vfloat c = EXPONENT_SCALE / sqrt(syy);
    drawn = drawn && (fabs(x) + fabs(y) + a + fabs(b) + c < 1e30f);

    vfloat radius = 0.0f;
#if SQUARE_EXTENT
    vfloat half_trace = 0.5f * (sxx + syy);
    vfloat half_gap = 0.5f * (sxx - syy);
    radius = ceil(3.0f * sqrt(half_trace + sqrt(fmax(half_gap * half_gap + sxy * sxy, 0.1f))));
#endif
    vfloat level = fmax(lo - LOG2_ALPHA_MIN, 0.0f) + LEVEL_SLACK;
    vfloat reach_x = sqrt(level * sxx) / EXPONENT_SCALE + PIXEL_SLACK + RELATIVE_SLACK * fabs(x);
    vfloat reach_y = sqrt(level * syy) / EXPONENT_SCALE + PIXEL_SLACK + RELATIVE_SLACK * fabs(y);
    vfloat first_column, end_column, first_row, end_row;
    tile_range(x, reach_x, radius, view->width, &first_column, &end_column);
    tile_range(y, reach_y, radius, view->height, &first_row, &end_row);
    drawn = drawn && (first_column < end_column) && (first_row < end_row);

    vfloat rgb[3] = {(vfloat)(0.0f), (vfloat)(0.0f), (vfloat)(0.0f)};
    if (VANY(drawn)) {
        vfloat inverse_length = 1.0f / sqrt(dx * dx + dy * dy + dz * dz);
        sh_colour(sh, column, index, dx * inverse_length, dy * inverse_length, dz * inverse_length, rgb);
    }

#if LANES == 1
    shapes[2 * place] = (float4)(x, y, a, b);
    shapes[2 * place + 1] = (float4)(c, lo, tz, 0.0f);
    ushort4 tiles = (ushort4)(0);
    if (drawn)
        tiles = (ushort4)((ushort)first_column, (ushort)end_column, (ushort)first_row, (ushort)end_row);
    bounds[place] = tiles;
    if (drawn)
        colours[place] = (float4)(rgb[0], rgb[1], rgb[2], 0.0f);
#else
    vfloat zero = 0.0f;
    float columns[14][LANES];
    vfloat values[14] = {
        x, y, a, b, c, lo, tz, rgb[0], rgb[1], rgb[2],
        drawn ? first_column : zero, drawn ? end_column : zero, drawn ? first_row : zero, drawn ? end_row : zero};
    for (int k = 0; k < 14; ++k)
        VSTORE(values[k], 0, columns[k]);
    for (int lane = 0; lane < LANES; ++lane) {
        size_t splat = place * LANES + lane;
        shapes[2 * splat] = (float4)(columns[0][lane], columns[1][lane], columns[2][lane], columns[3][lane]);
        shapes[2 * splat + 1] = (float4)(columns[4][lane], columns[5][lane], columns[6][lane], 0.0f);
        colours[splat] = (float4)(columns[7][lane], columns[8][lane], columns[9][lane], 0.0f);
        bounds[splat] = (ushort4)(
            (ushort)columns[10][lane], (ushort)columns[11][lane], (ushort)columns[12][lane], (ushort)columns[13][lane]);
    }
#endif
}
