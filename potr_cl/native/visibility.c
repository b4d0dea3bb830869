/* What a camera sees of a scene's points, and what colours are like from there (potr_cl/model/matter.py,
 * potr_cl/model/spherical_harmonics.py).
 *
 * Each operation is rounded by itself, in the order of the NumPy modules: the build forbids to fuse them. */

#include <math.h>

#include "potr_native.h"

enum { BLOCK = 256, DEGREE_3 = 15 };

/* The number of the cell, of 6 * cells * cells, in a direction of any finite length but 0. */
static INLINE int32_t cell_of(float x, float y, float z, int32_t cells)
{
    const float ax = fabsf(x), ay = fabsf(y), az = fabsf(z);
    const float wider = ax > ay ? ax : ay, largest = wider > az ? wider : az;
    const int along_x = ax == largest, along_z = !along_x && ay != largest;
    const float half = 0.5f * (float)cells, scale = half / (largest > 1e-30f ? largest : 1e-30f);
    const float across = (along_x ? y : x) * scale + half, down = (along_z ? y : z) * scale + half;
    int32_t u = across >= 0 ? (int32_t)across : 0, v = down >= 0 ? (int32_t)down : 0; /* not a number: 0 */
    u = u < cells - 1 ? u : cells - 1;
    v = v < cells - 1 ? v : cells - 1;
    const int32_t face = along_x ? x > 0 : along_z ? (z > 0) + 4 : (y > 0) + 2;
    return (face * cells + u) * cells + v;
}

/* How much of all directions points take up that are within `reach` of a place, each by its area.
 *
 * points: (3, n) and areas: (n). horizons: (6 * cells * cells) the distance of the nearest point in each cell of a cube
 * map around the place, INFINITY where there is none. */
POTR_WIDE
POTR_EXPORT double potr_horizons(
    const float *restrict points, const float *restrict areas, size_t n, const float *restrict place, float reach,
    int32_t cells, float *restrict horizons)
{
    float squared[BLOCK];
    int32_t at[BLOCK];
    double blocked = 0;
    for (int32_t k = 0; k < 6 * cells * cells; k++)
        horizons[k] = INFINITY;
    for (size_t start = 0; start < n; start += BLOCK) {
        const size_t some = n - start < BLOCK ? n - start : BLOCK;
        const float *const px = points + start, *const py = px + n, *const pz = py + n;
        for (size_t i = 0; i < some; i++) {
            const float x = px[i] - place[0], y = py[i] - place[1], z = pz[i] - place[2];
            squared[i] = x * x + y * y + z * z;
            at[i] = cell_of(x, y, z, cells);
        }
        for (size_t i = 0; i < some; i++) {
            if (squared[i] < reach * reach) {
                const float full = 12.566370614359172f * squared[i];
                const float part = areas[start + i] / (full > 1e-30f ? full : 1e-30f);
                blocked += part < 1.0f ? part : 1.0f;
            }
            const float distance = sqrtf(squared[i]);
            horizons[at[i]] = distance < horizons[at[i]] ? distance : horizons[at[i]];
        }
    }
    return blocked;
}

/* Which points, (n, 3), a camera sees that nothing of its surroundings hides: 1 or 0 for each.
 *
 * camera: its centre (3), rotation (3, 3), fx, fy, cx, cy, width, height and the nearest depth that is seen. */
POTR_EXPORT void potr_shown(
    const double *restrict points, size_t n, const double *restrict camera, int32_t cells,
    const float *restrict horizons, float *restrict shown)
{
    const double *const r = camera + 3, *const lens = camera + 12;
    for (size_t i = 0; i < n; i++) {
        const double dx = points[3 * i] - camera[0], dy = points[3 * i + 1] - camera[1];
        const double dz = points[3 * i + 2] - camera[2];
        const double x = r[0] * dx + r[1] * dy + r[2] * dz, y = r[3] * dx + r[4] * dy + r[5] * dz;
        const double z = r[6] * dx + r[7] * dy + r[8] * dz;
        const double u = lens[0] * x / z + lens[2], v = lens[1] * y / z + lens[3];
        const int inside = z > lens[6] && u > 0 && u < lens[4] && v > 0 && v < lens[5];
        const float horizon = 1.1f * horizons[cell_of((float)dx, (float)dy, (float)dz, cells)] + 0.02f;
        shown[i] = (float)(inside && sqrt(dx * dx + dy * dy + dz * dz) <= horizon);
    }
}

/* The squared deviation of colours from their mean over all directions, each in its own direction.
 *
 * rays: (n, 3), of any length. colours: (n, coefficients, 3) AC coefficients, of which there are 3, 8 or 15. */
POTR_WIDE
POTR_EXPORT void potr_energies(
    const double *restrict rays, size_t n, const float *restrict colours, size_t coefficients, float *restrict energies)
{
    for (size_t i = 0; i < n; i++) {
        const double rx = rays[3 * i], ry = rays[3 * i + 1], rz = rays[3 * i + 2];
        const double length = sqrt(rx * rx + ry * ry + rz * rz), divisor = length > 1e-300 ? length : 1e-300;
        const double x = rx / divisor, y = ry / divisor, z = rz / divisor, xx = x * x, yy = y * y, zz = z * z;
        const float basis[DEGREE_3] = {
            (float)(-0.4886025119029199 * y),
            (float)(0.4886025119029199 * z),
            (float)(-0.4886025119029199 * x),
            (float)(1.0925484305920792 * x * y),
            (float)(-1.0925484305920792 * y * z),
            (float)(0.31539156525252005 * (2 * zz - xx - yy)),
            (float)(-1.0925484305920792 * x * z),
            (float)(0.5462742152960396 * (xx - yy)),
            (float)(-0.5900435899266435 * y * (3 * xx - yy)),
            (float)(2.890611442640554 * x * y * z),
            (float)(-0.4570457994644658 * y * (4 * zz - xx - yy)),
            (float)(0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy)),
            (float)(-0.4570457994644658 * x * (4 * zz - xx - yy)),
            (float)(1.445305721320277 * z * (xx - yy)),
            (float)(-0.5900435899266435 * x * (xx - 3 * yy)),
        };
        const float *const own = colours + 3 * coefficients * i;
        float red = 0, green = 0, blue = 0;
        for (size_t m = 0; m < coefficients; m++) {
            red += basis[m] * own[3 * m];
            green += basis[m] * own[3 * m + 1];
            blue += basis[m] * own[3 * m + 2];
        }
        energies[i] = red * red + green * green + blue * blue;
    }
}
