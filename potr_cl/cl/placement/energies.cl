/* How much splats' colours vary towards places: potr_cl/model/spherical_harmonics.py's energy. A target a work-item, the
   places along the second axis.

   Macros: SH_COUNT (coefficients of a channel: 9 or 16; must be given).

   On GPUs: SH_COUNT=4,9,16. */

#define REAL float
#define VREAL float
#define LITERAL(x) x##f
#include "include/sh_basis.clh"

/* colours: coefficient by coefficient but for the constant one, channel by channel, target by target. */
kernel void energies(
    global const float4 *places,
    global const float4 *targets,
    global const float *colours,
    uint count,
    global float *found)
{
    const size_t target = get_global_id(0), place = get_global_id(1);
    if (target >= count)
        return;
    const float4 ray = targets[target] - places[place];
    const float length = fmax(sqrt(ray.x * ray.x + ray.y * ray.y + ray.z * ray.z), 1e-30f);
    float basis[SH_COUNT], deviation[3] = {0.0f, 0.0f, 0.0f};
    sh_basis(ray.x / length, ray.y / length, ray.z / length, basis);
    for (int m = 1; m < SH_COUNT; ++m)
        for (int c = 0; c < 3; ++c)
            deviation[c] += basis[m] * colours[(size_t)(3 * (m - 1) + c) * count + target];
    found[place * count + target] =
        deviation[0] * deviation[0] + deviation[1] * deviation[1] + deviation[2] * deviation[2];
}
