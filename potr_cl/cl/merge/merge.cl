/* Splats that are left take over removed ones near them: potr_cl/stages/merging/merged.py. Splats are columns as a
   scene's on the device, see raster/project.cl. A splat, or a group of some, a work-item.

   Macros: none.

   On GPUs: no macros. */

/* Neighbours along a curve on either side that may take over a splat. */
#define NEAR 4
/* They may be so far from it, in parts of both's sizes; what a squared difference of constant coefficients counts. */
#define FAR 30.0f
#define COLOUR 3.0f
/* The least opacity that is drawn: what is fainter is no matter. */
#define DRAWN (1.0f / 255)
/* What removed splats of a group have to show of what it shows; or what it may show of what is usual, at most. */
#define MISSED 0.7f
#define HARDLY_SHOWN 0.05f
/* What a splat counts that no view shows, as a part of one of the same size and opacity that is shown as usual. */
#define UNSEEN 0.1f
/* The most that many faint splats become together. */
#define OPACITY 0.995f
/* Scales are no smaller, so that their squares are numbers; nor is one that was merged, as a part of its largest. */
#define LEAST 1e-17f
#define THIN 3e-4f
#define SWEEPS 6

inline float3 column3(global const float *columns, uint stride, uint splat)
{
    return (float3)(columns[splat], columns[(size_t)stride + splat], columns[2 * (size_t)stride + splat]);
}

/* Of an ellipsoid where it is seen as large as can be, but for a factor. */
inline float area(float3 scales)
{
    const float larger = fmax(scales.x, scales.y), smaller = fmin(scales.x, scales.y);
    return fmax(larger, scales.z) * fmax(smaller, fmin(larger, scales.z));
}

inline float squared(float3 v)
{
    return v.x * v.x + v.y * v.y + v.z * v.z;
}

/* What each splat covers. */
kernel void covers(uint stride, global const float *scales, global const float *log2_opacities, uint count,
    global float *found)
{
    const uint splat = get_global_id(0);
    if (splat >= count)
        return;
    const float opacity = exp2(log2_opacities[splat]);
    found[splat] = opacity < DRAWN ? 0.0f : opacity * area(fmax(column3(scales, stride, splat), LEAST));
}

/* Whether removed splats have a better neighbour on a curve than they had so far: the cost of it, and its group.
   curve: splats that are left; gone: removed ones; places: how many of those that are left come before each. */
kernel void nearest(uint stride, global const float *means, global const float *scales, global const float *sh,
    global const uint *curve, uint left, global const uint *gone, global const uint *places, uint count,
    global float *least, global uint *groups)
{
    const uint number = get_global_id(0);
    if (number >= count)
        return;
    const uint splat = gone[number];
    const float3 mean = column3(means, stride, splat), colour = column3(sh, stride, splat);
    const float own = squared(fmax(column3(scales, stride, splat), LEAST));
    float best = least[splat];
    uint found = groups[splat];
    for (int k = -NEAR; k < NEAR; ++k) {
        const uint other = curve[clamp((long)places[number] + k, 0L, (long)left - 1)];
        const float size = (own + squared(fmax(column3(scales, stride, other), LEAST))) / 3;
        const float apart = squared(column3(means, stride, other) - mean) / size;
        const float cost = apart + COLOUR * squared(column3(sh, stride, other) - colour);
        if (apart <= FAR * FAR && cost < best) {
            best = cost;
            found = groups[other];
        }
    }
    least[splat] = best;
    groups[splat] = found;
}

/* One rotation of Jacobi's method, of the symmetric matrix with a_pp, a_qq, a_pq, and a_pr, a_qr; axis: about which the
   quaternion turns with it. */
inline void turn(float *pp, float *qq, float *pq, float *pr, float *qr, float4 *quaternion, float4 axis)
{
    if (!(fabs(*pq) > 1e-37f))
        return;
    const float theta = (*qq - *pp) / (2 * *pq);
    const float t = copysign(1.0f, theta) / (fabs(theta) + sqrt(theta * theta + 1));
    const float c = 1 / sqrt(t * t + 1), s = t * c;
    *pp -= t * *pq;
    *qq += t * *pq;
    *pq = 0.0f;
    const float p = *pr, q = *qr;
    *pr = c * p - s * q;
    *qr = s * p + c * q;
    const float up = sqrt((1 + c) / 2);
    const float4 r = axis * (s / (2 * up)), l = *quaternion; /* w, x, y, z in .w, .x, .y, .z */
    *quaternion = (float4)(up * l.xyz + l.w * r.xyz + cross(l.xyz, r.xyz),
        l.w * up - l.x * r.x - l.y * r.y - l.z * r.z);
}

/* What groups are together: centre, logarithms of scales, quaternion w, x, y, z, and logit of the opacity, in columns
   of count; whether they are merged; and what each member counts there. Group g has the splats starts[g] to
   starts[g + 1]; kept is what views show of that which is left. */
kernel void merge_shapes(uint stride, global const float *means, global const float *scales,
    global const float *quaternions, global const float *covered, global const float *importance,
    global const float *kept, float usual, global const uint *starts, uint count, global float *weights,
    global uint *merged, global float *found)
{
    const uint group = get_global_id(0);
    if (group >= count)
        return;
    const uint first = starts[group], end = starts[group + 1];
    float shown = 0.0f, cover = 0.0f;
    for (uint k = first; k < end; ++k) {
        shown += importance[k];
        cover += covered[k];
    }
    const float total = shown + UNSEEN * usual * cover;
    const bool missed = shown - kept[group] > MISSED * shown || shown < HARDLY_SHOWN * usual * cover;
    merged[group] = missed && total > 0.0f;
    if (!merged[group])
        return;
    const float3 from = column3(means, stride, first);
    float3 middle = (float3)(0.0f);
    for (uint k = first; k < end; ++k) {
        weights[k] = (importance[k] + UNSEEN * usual * covered[k]) / total;
        middle += weights[k] * (column3(means, stride, k) - from);
    }
    float xx = 0.0f, yy = 0.0f, zz = 0.0f, xy = 0.0f, xz = 0.0f, yz = 0.0f;
    for (uint k = first; k < end; ++k) {
        const float w = quaternions[k], x = quaternions[(size_t)stride + k];
        const float y = quaternions[2 * (size_t)stride + k], z = quaternions[3 * (size_t)stride + k];
        const float3 size = fmax(column3(scales, stride, k), LEAST);
        const float3 off = column3(means, stride, k) - from - middle;
        const float3 a = size.x * (float3)(1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y));
        const float3 b = size.y * (float3)(2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x));
        const float3 c = size.z * (float3)(2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y));
        const float weight = weights[k];
        xx += weight * (a.x * a.x + b.x * b.x + c.x * c.x + off.x * off.x);
        yy += weight * (a.y * a.y + b.y * b.y + c.y * c.y + off.y * off.y);
        zz += weight * (a.z * a.z + b.z * b.z + c.z * c.z + off.z * off.z);
        xy += weight * (a.x * a.y + b.x * b.y + c.x * c.y + off.x * off.y);
        xz += weight * (a.x * a.z + b.x * b.z + c.x * c.z + off.x * off.z);
        yz += weight * (a.y * a.z + b.y * b.z + c.y * c.z + off.y * off.z);
    }
    float4 rotation = (float4)(0.0f, 0.0f, 0.0f, 1.0f);
    for (int sweep = 0; sweep < SWEEPS; ++sweep) {
        turn(&xx, &yy, &xy, &xz, &yz, &rotation, (float4)(0.0f, 0.0f, -1.0f, 0.0f));
        turn(&xx, &zz, &xz, &xy, &yz, &rotation, (float4)(0.0f, 1.0f, 0.0f, 0.0f));
        turn(&yy, &zz, &yz, &xy, &xz, &rotation, (float4)(-1.0f, 0.0f, 0.0f, 0.0f));
    }
    float3 size = sqrt(fmax((float3)(xx, yy, zz), LEAST * LEAST));
    size = fmax(size, THIN * fmax(fmax(size.x, size.y), size.z));
    const float opacity = clamp(cover / area(size), DRAWN, OPACITY);
    rotation /= sqrt(dot(rotation, rotation));
    middle += from;
    const float values[11] = {middle.x, middle.y, middle.z, log(size.x), log(size.y), log(size.z), rotation.w,
        rotation.x, rotation.y, rotation.z, log(opacity / (1 - opacity))};
    for (int k = 0; k < 11; ++k)
        found[k * (size_t)count + group] = values[k];
}

/* One coefficient of a channel of groups that are merged, in columns of count; the coefficients are the second axis. */
kernel void merge_colours(uint stride, global const float *sh, global const float *weights, global const uint *merged,
    global const uint *starts, uint count, global float *found)
{
    const size_t group = get_global_id(0), coefficient = get_global_id(1);
    if (group >= count || !merged[group])
        return;
    float sum = 0.0f;
    for (uint k = starts[group]; k < starts[group + 1]; ++k)
        sum += weights[k] * sh[coefficient * stride + k];
    found[coefficient * count + group] = sum;
}
