/* From the sums of sums.clh to the derivatives with respect to the splats' parameters: the projection's steps
   (raster/project.cl) in the opposite order. A work-item does LANES splats, and all views of a set one after the other.
   Both kernel families use it.

   gradient += the derivatives, a column of `stride` floats for each parameter: 3 of the centre, 3 of the scales'
   logarithms, 4 of the unit quaternion, 1 of the opacity's logit, and 3 SH_COUNT of the SH coefficients, coefficient by
   coefficient, channel by channel. The totals of each view are multiplied by its element of `factors`, and become zero.

   What is not finite counts as 0, and splats that have no sums keep what they have.

   Macros:
       LANES, SH_COUNT                                   splats a work-item, coefficients of a channel;
       ANTIALIASED, LEAST_COMPENSATION_SQUARED, LOW_PASS,
       LOW_PASS_SQUARED                                  see project.cl.

   On GPUs: LANES=1 SH_COUNT=1,4,9,16 ANTIALIASED=-,1 (LEAST_COMPENSATION_SQUARED=2.5e-5f) LOW_PASS=-,0.1f
       (LOW_PASS_SQUARED=0.01f). */

#include "include/reals.clh"
#include "include/registers.clh"
#include "include/splat.clh"
#include "include/view_set.clh"
#include "include/sh_basis.clh"
#include "include/sh_slopes.clh"

#include "fit/projection.clh"

#ifndef ANTIALIASED
#define ANTIALIASED 0
#endif

#define SUMS 9
#define LARGEST 1e30f

/* Takes the totals of LANES splats, times a factor, and sets them to 0. Returns in which lanes any was not 0. */
inline vint take_totals(global long *totals, float factor, vfloat *sums)
{
#if LANES == 1
    long any = 0;
    for (int i = 0; i < SUMS; ++i)
        any |= totals[i];
    if (!any)
        return 0;
    for (int i = 0; i < SUMS; ++i) {
        sums[i] = (float)totals[i] * factor;
        totals[i] = 0;
    }
    return 1;
#else
    float values[SUMS][LANES], taken[LANES];
    int some = 0;
    for (int lane = 0; lane < LANES; ++lane) {
        global long *mine = totals + SUMS * lane;
        long any = 0;
        for (int i = 0; i < SUMS; ++i)
            any |= mine[i];
        taken[lane] = any != 0;
        some |= any != 0;
        for (int i = 0; i < SUMS; ++i) {
            /* In two parts of 32 bits: conversions of 64 are calls on some CPU runtimes. */
            const long high = (mine[i] + (1l << 30)) >> 31;
            values[i][lane] = MAD((float)(int)high, 0x1p31f, (float)(int)(mine[i] - (high << 31))) * factor;
            mine[i] = 0;
        }
    }
    if (!some)
        return (vint)(0);
    for (int i = 0; i < SUMS; ++i)
        sums[i] = VLOAD(0, values[i]);
    return VLOAD(0, taken) > 0.0f;
#endif
}

/* Adds to a column what is finite, in those lanes that have sums. */
inline void add_to(global float *column, size_t index, vint seen, vfloat value)
{
    const vfloat kept = seen && fabs(value) < LARGEST ? value : (vfloat)(0.0f);
    VSTORE(VLOAD(index, column) + kept, index, column);
}

kernel NARROW void chain(
    global const float *means,
    global const float *scales,
    global const float *quaternions,
    global const float *log2_opacities,
    global const float *sh,
    uint stride,
    global const SetView *views,
    uint view_count,
    global const float4 *colours,
    global const float *factors,
    global long *totals,
    global float *gradient)
{
    const size_t index = get_global_id(0);
    const size_t column = stride;
    const vfloat qw = VLOAD(index, quaternions);
    const vfloat qx = VLOAD(index, quaternions + column);
    const vfloat qy = VLOAD(index, quaternions + 2 * column);
    const vfloat qz = VLOAD(index, quaternions + 3 * column);
    vfloat axes[9];
    axes_of(qw, qx, qy, qz, axes);
    vfloat by_axes[9];
    for (int i = 0; i < 9; ++i)
        by_axes[i] = (vfloat)(0.0f);
    vint seen_ever = (vint)(0);

    for (uint number = 0; number < view_count; ++number) {
        const size_t place = (size_t)number * (stride / LANES) + index;
        vfloat sums[SUMS];
        const vint seen = take_totals(totals + (size_t)SUMS * LANES * place, factors[number], sums);
        if (!VANY(seen))
            continue;
        seen_ever = seen_ever || seen;
        global const View *view = &views[number].view;

        const Projection p = projected(means, scales, column, index, axes, view);
        global const float *w = view->rotation;
        const vfloat a = p.a, b = p.b, c = p.c, inverse_z = p.inverse_z;

        /* The centre on screen, and the covariance: L^T M L, where M has the sums of e U^2, e U V and e V^2, and
           L = (a b; 0 c), which takes (mx, my) to (u, v). */
        const vfloat by_x = 2.0f * LN2 * a * sums[4];
        const vfloat by_y = 2.0f * LN2 * (b * sums[4] + c * sums[5]);
        const float factor = 4.0f * LN2 * LN2;
        const vfloat uu = factor * sums[6], uv = factor * sums[7], vv = factor * sums[8];
#if ANTIALIASED
        const vint loses = p.sharp / p.determinant > LEAST_COMPENSATION_SQUARED;
        const vfloat by_sharp = loses ? sums[3] * (1.0f / p.sharp - 1.0f / p.determinant) : (vfloat)(0.0f);
        const vfloat by_trace = loses ? -LOW_PASS * sums[3] / p.determinant : (vfloat)(0.0f);
#endif
        vfloat by_ratio_x = (vfloat)(0.0f), by_ratio_y = (vfloat)(0.0f), by_size = (vfloat)(0.0f);
        for (int k = 0; k < 3; ++k) {
            const vfloat by_u = uu * p.u[k] + uv * p.v[k], by_v = uv * p.u[k] + vv * p.v[k];
            vfloat by_mx = a * by_u, by_my = b * by_u + c * by_v;
            vfloat by_scale = by_u * p.u[k] + by_v * p.v[k];
#if ANTIALIASED
            const int i = (k + 1) % 3, j = (k + 2) % 3;
            const vfloat more_x = by_sharp * (p.my[i] * p.n[j] - p.my[j] * p.n[i]) + by_trace * p.mx[k];
            const vfloat more_y = by_sharp * (p.n[i] * p.mx[j] - p.n[j] * p.mx[i]) + by_trace * p.my[k];
            by_mx += more_x;
            by_my += more_y;
            by_scale += more_x * p.mx[k] + more_y * p.my[k];
#endif
            const vint kept = axis_changes(&p, k);
            by_mx = kept ? by_mx : (vfloat)(0.0f);
            by_my = kept ? by_my : (vfloat)(0.0f);
            by_scale = kept ? by_scale : (vfloat)(0.0f);
            by_size += by_scale;
            add_to(gradient + (3 + k) * column, index, seen, by_scale);
            const vfloat of_x = by_mx * p.along_x[k], of_y = by_my * p.along_y[k];
            const vfloat of_z = -(p.ratio_x * of_x + p.ratio_y * of_y);
            by_ratio_x -= of_x * p.turned[3 * k + 2];
            by_ratio_y -= of_y * p.turned[3 * k + 2];
            for (int i = 0; i < 3; ++i) {
                const vfloat value = w[i] * of_x + w[3 + i] * of_y + w[6 + i] * of_z;
                by_axes[3 * k + i] += seen ? value : (vfloat)(0.0f);
            }
        }

        const vfloat free_x = fabs(p.across) < view->limit_x ? by_ratio_x : (vfloat)(0.0f);
        const vfloat free_y = fabs(p.down) < view->limit_y ? by_ratio_y : (vfloat)(0.0f);
        const vfloat by_tx = inverse_z * (view->fx * by_x + free_x);
        const vfloat by_ty = inverse_z * (view->fy * by_y + free_y);
        const vfloat by_tz =
            -inverse_z * ((view->fx * by_x + free_x) * p.across + (view->fy * by_y + free_y) * p.down + by_size);

        /* The colour: its coefficients, and the direction that it is seen from. Channels that are cut are 0. */
        vfloat channels[3] = {sums[0], sums[1], sums[2]};
#if LANES == 1
        const float4 colour = colours[place];
        channels[0] = colour.x > 0.0f ? channels[0] : 0.0f;
        channels[1] = colour.y > 0.0f ? channels[1] : 0.0f;
        channels[2] = colour.z > 0.0f ? channels[2] : 0.0f;
#else
        vfloat four[4], red, green, blue, rest;
        for (int k = 0; k < 4; ++k)
            four[k] = VLOAD(4 * place + k, (global const float *)colours);
        separate(four, &red, &green, &blue, &rest);
        channels[0] = red > 0.0f ? channels[0] : (vfloat)(0.0f);
        channels[1] = green > 0.0f ? channels[1] : (vfloat)(0.0f);
        channels[2] = blue > 0.0f ? channels[2] : (vfloat)(0.0f);
#endif
        const vfloat nearness = 1.0f / sqrt(p.away[0] * p.away[0] + p.away[1] * p.away[1] + p.away[2] * p.away[2]);
        const vfloat x = p.away[0] * nearness, y = p.away[1] * nearness, z = p.away[2] * nearness;
        vfloat basis[SH_COUNT], by_basis[SH_COUNT];
        sh_basis(x, y, z, basis);
        for (int m = 0; m < SH_COUNT; ++m) {
            by_basis[m] = (vfloat)(0.0f);
            for (int channel = 0; channel < 3; ++channel) {
                const size_t coefficient = (3 * m + channel) * column;
                by_basis[m] = MAD(VLOAD(index, sh + coefficient), channels[channel], by_basis[m]);
                add_to(gradient + 11 * column + coefficient, index, seen, basis[m] * channels[channel]);
            }
        }
        vfloat slopes[3] = {(vfloat)(0.0f), (vfloat)(0.0f), (vfloat)(0.0f)};
        add_sh_slopes(x, y, z, by_basis, slopes);
        const vfloat away = slopes[0] * x + slopes[1] * y + slopes[2] * z;
        const vfloat across_sight[3] = {
            nearness * (slopes[0] - away * x), nearness * (slopes[1] - away * y), nearness * (slopes[2] - away * z)};
        for (int i = 0; i < 3; ++i)
            add_to(
                gradient + i * column, index, seen,
                w[i] * by_tx + w[3 + i] * by_ty + w[6 + i] * by_tz + across_sight[i]);

        /* log2 of the opacity changes with its logit by (1 - opacity) / ln 2. */
        add_to(gradient + 10 * column, index, seen, sums[3] * -expm1(LN2 * VLOAD(index, log2_opacities)));
    }
    if (!VANY(seen_ever))
        return;

    const vfloat xy = by_axes[1] + by_axes[3], xz = by_axes[2] + by_axes[6], yz = by_axes[5] + by_axes[7];
    const vfloat around_z = by_axes[1] - by_axes[3], around_y = by_axes[6] - by_axes[2];
    const vfloat around_x = by_axes[5] - by_axes[7];
    const vfloat by_q[4] = {
        2.0f * (qz * around_z + qy * around_y + qx * around_x),
        2.0f * (qy * xy + qz * xz + qw * around_x - 2.0f * qx * (by_axes[4] + by_axes[8])),
        2.0f * (qx * xy + qz * yz + qw * around_y - 2.0f * qy * (by_axes[0] + by_axes[8])),
        2.0f * (qx * xz + qy * yz + qw * around_z - 2.0f * qz * (by_axes[0] + by_axes[4]))};
    /* Along the quaternion itself nothing changes. */
    const vfloat along = qw * by_q[0] + qx * by_q[1] + qy * by_q[2] + qz * by_q[3];
    add_to(gradient + 6 * column, index, seen_ever, by_q[0] - along * qw);
    add_to(gradient + 7 * column, index, seen_ever, by_q[1] - along * qx);
    add_to(gradient + 8 * column, index, seen_ever, by_q[2] - along * qy);
    add_to(gradient + 9 * column, index, seen_ever, by_q[3] - along * qz);
}
