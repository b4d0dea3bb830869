/* How the splats on screen change when their parameters change along a direction: chain.cl's steps in the order of the
   projection. A work-item does LANES splats; get_global_id(1) is the view's number. Both kernel families use it.

   The direction has a column of `stride` floats for each parameter, as the gradient of chain.cl. What comes of it are
   nine numbers for each splat and view, the counterparts of the nine sums of sums.clh, in three float4:

       the colour's three channels, d ln alpha;
       what multiplies U, V, U^2, U V in d ln alpha;
       what multiplies V^2; the rest is 0.

   What is not finite counts as 0.

   Macros:
       LANES, SH_COUNT                                   splats a work-item, coefficients of a channel;
       ANTIALIASED, LEAST_COMPENSATION_SQUARED, LOW_PASS,
       LOW_PASS_SQUARED                                  see project.cl. */

#define DOUBLE 0
#include "include/reals.clh"
#include "include/splat.clh"
#include "include/view_set.clh"
#include "include/sh_basis.clh"
#include "include/sh_slopes.clh"
#include "fit/projection.clh"

#ifndef ANTIALIASED
#define ANTIALIASED 0
#endif

#define LARGEST 1e30f
#define NUMBERS 9

kernel void splat_tangents(
    global const float *means,
    global const float *scales,
    global const float *quaternions,
    global const float *log2_opacities,
    global const float *sh,
    uint stride,
    global const SetView *views,
    global const float4 *colours,
    global const float *direction,
    global float4 *tangents)
{
    const size_t index = get_global_id(0);
    const size_t column = stride;
    const size_t place = get_global_id(1) * (column / LANES) + index;
    global const View *view = &views[get_global_id(1)].view;
    global const float *w = view->rotation;
    const vfloat qw = VLOAD(index, quaternions);
    const vfloat qx = VLOAD(index, quaternions + column);
    const vfloat qy = VLOAD(index, quaternions + 2 * column);
    const vfloat qz = VLOAD(index, quaternions + 3 * column);
    vfloat axes[9];
    axes_of(qw, qx, qy, qz, axes);
    const Projection p = projected(means, scales, column, index, axes, view);

    /* How the axes turn. Along the quaternion itself nothing changes. */
    vfloat dw = VLOAD(index, direction + 6 * column);
    vfloat dx = VLOAD(index, direction + 7 * column);
    vfloat dy = VLOAD(index, direction + 8 * column);
    vfloat dz = VLOAD(index, direction + 9 * column);
    const vfloat along = qw * dw + qx * dx + qy * dy + qz * dz;
    dw -= along * qw;
    dx -= along * qx;
    dy -= along * qy;
    dz -= along * qz;
    const vfloat d_axes[9] = {
        -4.0f * (qy * dy + qz * dz),
        2.0f * (dx * qy + qx * dy + dw * qz + qw * dz),
        2.0f * (dx * qz + qx * dz - dw * qy - qw * dy),
        2.0f * (dx * qy + qx * dy - dw * qz - qw * dz),
        -4.0f * (qx * dx + qz * dz),
        2.0f * (dy * qz + qy * dz + dw * qx + qw * dx),
        2.0f * (dx * qz + qx * dz + dw * qy + qw * dy),
        2.0f * (dy * qz + qy * dz - dw * qx - qw * dx),
        -4.0f * (qx * dx + qy * dy)};

    /* The centre. */
    const vfloat move[3] = {
        VLOAD(index, direction), VLOAD(index, direction + column), VLOAD(index, direction + 2 * column)};
    const vfloat d_depth = p.inverse_z * (w[6] * move[0] + w[7] * move[1] + w[8] * move[2]);
    const vfloat d_across = p.inverse_z * (w[0] * move[0] + w[1] * move[1] + w[2] * move[2]) - p.across * d_depth;
    const vfloat d_down = p.inverse_z * (w[3] * move[0] + w[4] * move[1] + w[5] * move[2]) - p.down * d_depth;
    const vfloat d_ratio_x = fabs(p.across) < view->limit_x ? d_across : (vfloat)(0.0f);
    const vfloat d_ratio_y = fabs(p.down) < view->limit_y ? d_down : (vfloat)(0.0f);
    const vfloat d_x = view->fx * d_across, d_y = view->fy * d_down;

    /* The ellipse. */
    const vfloat a = p.a, b = p.b, c = p.c;
    vfloat uu = (vfloat)(0.0f), uv = (vfloat)(0.0f), vv = (vfloat)(0.0f);
#if ANTIALIASED
    vfloat half_sharp = (vfloat)(0.0f), half_trace = (vfloat)(0.0f);
#endif
    for (int k = 0; k < 3; ++k) {
        vfloat d_turned[3];
        for (int i = 0; i < 3; ++i)
            d_turned[i] = w[3 * i] * d_axes[3 * k] + w[3 * i + 1] * d_axes[3 * k + 1] + w[3 * i + 2] * d_axes[3 * k + 2];
        const vfloat growth = VLOAD(index, direction + (3 + k) * column) - d_depth;
        const vfloat nearing = p.turned[3 * k + 2];
        const vfloat turned_x = p.along_x[k] * (d_turned[0] - p.ratio_x * d_turned[2] - d_ratio_x * nearing);
        const vfloat turned_y = p.along_y[k] * (d_turned[1] - p.ratio_y * d_turned[2] - d_ratio_y * nearing);
        const vint changes = axis_changes(&p, k);
        vfloat d_u = p.u[k] * growth + a * turned_x + b * turned_y, d_v = p.v[k] * growth + c * turned_y;
        d_u = changes ? d_u : (vfloat)(0.0f);
        d_v = changes ? d_v : (vfloat)(0.0f);
        uu += p.u[k] * d_u;
        uv += p.v[k] * d_u + p.u[k] * d_v;
        vv += p.v[k] * d_v;
#if ANTIALIASED
        const int i = (k + 1) % 3, j = (k + 2) % 3;
        const vfloat d_mx = changes ? p.mx[k] * growth + turned_x : (vfloat)(0.0f);
        const vfloat d_my = changes ? p.my[k] * growth + turned_y : (vfloat)(0.0f);
        half_sharp += (p.my[i] * p.n[j] - p.my[j] * p.n[i]) * d_mx + (p.n[i] * p.mx[j] - p.n[j] * p.mx[i]) * d_my;
        half_trace += p.mx[k] * d_mx + p.my[k] * d_my;
#endif
    }
    const float factor = 4.0f * LN2 * LN2;
    vfloat numbers[NUMBERS];
    /* log2 of the opacity changes with its logit by (1 - opacity) / ln 2. */
    numbers[3] = VLOAD(index, direction + 10 * column) * -expm1(LN2 * VLOAD(index, log2_opacities));
#if ANTIALIASED
    const vint loses = p.sharp / p.determinant > LEAST_COMPENSATION_SQUARED;
    const vfloat faded =
        half_sharp * (1.0f / p.sharp - 1.0f / p.determinant) - LOW_PASS * half_trace / p.determinant;
    numbers[3] += loses ? faded : (vfloat)(0.0f);
#endif
    numbers[4] = 2.0f * LN2 * (a * d_x + b * d_y);
    numbers[5] = 2.0f * LN2 * c * d_y;
    numbers[6] = factor * uu;
    numbers[7] = factor * uv;
    numbers[8] = factor * vv;

    /* The colour. Channels that are cut are 0, and stay so. Those of splats that are not drawn are unset: nobody looks at
       what is found of these. */
    const vfloat nearness = 1.0f / sqrt(p.away[0] * p.away[0] + p.away[1] * p.away[1] + p.away[2] * p.away[2]);
    const vfloat x = p.away[0] * nearness, y = p.away[1] * nearness, z = p.away[2] * nearness;
    const vfloat farther = move[0] * x + move[1] * y + move[2] * z;
    const vfloat turn[3] = {
        nearness * (move[0] - farther * x), nearness * (move[1] - farther * y), nearness * (move[2] - farther * z)};
#if LANES == 1
    const float4 own = colours[place];
    const float shown[3] = {own.x, own.y, own.z};
#else
    vfloat four[4], shown[3], rest;
    for (int k = 0; k < 4; ++k)
        four[k] = VLOAD(4 * place + k, (global const float *)colours);
    separate(four, &shown[0], &shown[1], &shown[2], &rest);
#endif
    vfloat basis[SH_COUNT];
    sh_basis(x, y, z, basis);
    for (int channel = 0; channel < 3; ++channel) {
        vfloat own_sh[SH_COUNT], slopes[3] = {(vfloat)(0.0f), (vfloat)(0.0f), (vfloat)(0.0f)};
        vfloat change = (vfloat)(0.0f);
        for (int m = 0; m < SH_COUNT; ++m) {
            const size_t coefficient = (3 * m + channel) * column;
            own_sh[m] = VLOAD(index, sh + coefficient);
            change = MAD(basis[m], VLOAD(index, direction + 11 * column + coefficient), change);
        }
        add_sh_slopes(x, y, z, own_sh, slopes);
        change += slopes[0] * turn[0] + slopes[1] * turn[1] + slopes[2] * turn[2];
        numbers[channel] = shown[channel] > 0.0f ? change : (vfloat)(0.0f);
    }
    for (int i = 0; i < NUMBERS; ++i)
        numbers[i] = fabs(numbers[i]) < LARGEST ? numbers[i] : (vfloat)(0.0f);

#if LANES == 1
    tangents[3 * place] = (float4)(numbers[0], numbers[1], numbers[2], numbers[3]);
    tangents[3 * place + 1] = (float4)(numbers[4], numbers[5], numbers[6], numbers[7]);
    tangents[3 * place + 2] = (float4)(numbers[8], 0.0f, 0.0f, 0.0f);
#else
    float columns[NUMBERS][LANES];
    for (int i = 0; i < NUMBERS; ++i)
        VSTORE(numbers[i], 0, columns[i]);
    for (int lane = 0; lane < LANES; ++lane) {
        const size_t splat = place * LANES + lane;
        tangents[3 * splat] = (float4)(columns[0][lane], columns[1][lane], columns[2][lane], columns[3][lane]);
        tangents[3 * splat + 1] = (float4)(columns[4][lane], columns[5][lane], columns[6][lane], columns[7][lane]);
        tangents[3 * splat + 2] = (float4)(columns[8][lane], 0.0f, 0.0f, 0.0f);
    }
#endif
}
