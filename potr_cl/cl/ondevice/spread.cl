/* Values of a bundle, packed by the host, to the columns of the scene's parameters, which are 0 before. Nothing is
   computed, so every device gives the bits that the host gives. A work-item does one splat, and one AC coefficient that is
   not 0. Both kernel families use it.

   The packed values are 11 columns of BUNDLE floats: scales, quaternions, logarithm of the opacity, R, G, B of DC; then
   the coefficients, 4 words each: coefficient * BUNDLE + splat, R, G, B.

   Columns of parameters are `stride` long, and the bundle's splats begin at `first`.

   Macros:
       BUNDLE  splats of a bundle.

   On GPUs: BUNDLE=8192. */

kernel void spread(
    global const uint *packed,
    uint splats,
    uint items,
    uint first,
    uint stride,
    global uint *scales,
    global uint *quaternions,
    global uint *log2_opacities,
    global uint *sh)
{
    const size_t number = get_global_id(0);
    if (number < splats) {
        global const uint *value = packed + number;
        const size_t splat = first + number;
        for (uint column = 0; column < 3; ++column)
            scales[column * (size_t)stride + splat] = value[column * BUNDLE];
        for (uint column = 0; column < 4; ++column)
            quaternions[column * (size_t)stride + splat] = value[(3 + column) * BUNDLE];
        log2_opacities[splat] = value[7 * BUNDLE];
        for (uint channel = 0; channel < 3; ++channel)
            sh[channel * (size_t)stride + splat] = value[(8 + channel) * BUNDLE];
    }
    if (number < items) {
        const uint4 item = vload4(number, packed + 11 * BUNDLE);
        global uint *to = sh + 3 * (item.x / BUNDLE) * (size_t)stride + first + item.x % BUNDLE;
        to[0] = item.y;
        to[stride] = item.z;
        to[2 * (size_t)stride] = item.w;
    }
}
