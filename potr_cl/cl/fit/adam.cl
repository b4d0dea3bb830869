/* A step of Adam (Kingma and Ba, 2015), one parameter of one splat a work-item: get_global_id(1) is the parameter's
   column. Both kernel families use it.

   The columns from first_sh on are SH coefficients, which go to the rasterizer's `sh` as they are; for the others see
   activate().

   A parameter whose gradient was always 0 stays what it was, whatever the limits are. The gradient becomes 0.

   Macros: none.

   On GPUs: no macros. */

/* steps: for each column the length of a step, which is multiplied by `part`, and the least and the greatest value that
   it may reach.
   averages: of each parameter over the last steps: the newest value counts `newest` in it.
   debias_mean, debias_square: what the moments are multiplied by because they began at 0. */
kernel void adam(
    global float *parameters,
    global float *gradient,
    global float *means,
    global float *squares,
    global float *averages,
    global float *sh,
    uint splats,
    uint stride,
    uint first_sh,
    global const float4 *steps,
    float part,
    float decay_mean,
    float decay_square,
    float newest,
    float debias_mean,
    float debias_square)
{
    const size_t splat = get_global_id(0);
    if (splat >= splats)
        return;
    const size_t i = get_global_id(1) * (size_t)stride + splat;
    const float4 step = steps[get_global_id(1)];
    /* All is read before anything is written: so these wait for memory together, and not one behind the other. */
    const float g = gradient[i], former_mean = means[i], former_square = squares[i];
    const float former = parameters[i], average = averages[i];
    gradient[i] = 0.0f;
    const float mean = decay_mean * former_mean + (1.0f - decay_mean) * g;
    const float square = decay_square * former_square + (1.0f - decay_square) * g * g;
    means[i] = mean;
    squares[i] = square;
    if (mean == 0.0f || !(square > 0.0f))
        return; /* and the average is what the parameter is */
    const float value = former - part * step.x * (mean * debias_mean) / sqrt(square * debias_square);
    const bool taken = fabs(value) < 1e30f;
    const float kept = taken ? fmin(fmax(value, step.y), step.z) : former;
    if (taken) {
        parameters[i] = kept;
        if (get_global_id(1) >= first_sh)
            sh[i - first_sh * (size_t)stride] = kept;
    }
    averages[i] = average + newest * (kept - average);
}

/* Parameters as the projection takes them (raster/project.cl), one splat a work-item: the scales' exponentials, unit
   quaternions, log2 of the opacities.

   sf_scale, sf_rotation, sf_opacity: where they are above 0, the parameters are rounded on the way, as a file would
   have them: levels of 1 / sf_scale, but at least zero_scale of them; imaginary parts of a quaternion in steps by the
   splat's largest scale; logits in steps from least_logit on. */
kernel void activate(
    global const float *parameters,
    uint splats,
    uint stride,
    uint sh_columns,
    float largest_scale,
    float sf_scale,
    float zero_scale,
    float sf_rotation,
    float sf_opacity,
    float least_logit,
    global float *means,
    global float *scales,
    global float *quaternions,
    global float *log2_opacities,
    global float *sh)
{
    const size_t splat = get_global_id(0), column = stride;
    if (splat >= splats)
        return;
    global const float *own = parameters + splat;
    float largest_level = 1.0f;
    for (int i = 0; i < 3; ++i) {
        means[i * column + splat] = own[i * column];
        float scale = fmin(exp(fmin(own[(3 + i) * column], 80.0f)), largest_scale);
        if (sf_scale > 0.0f) {
            const float level = floor(scale * sf_scale + 0.5f);
            largest_level = fmax(largest_level, level);
            scale = fmax(level, zero_scale) / sf_scale;
        }
        scales[i * column + splat] = scale;
    }
    float length = 0.0f;
    for (int i = 6; i < 10; ++i)
        length += own[i * column] * own[i * column];
    length = sqrt(length);
    float turned[4];
    for (int i = 0; i < 4; ++i)
        turned[i] = length > 1e-15f ? own[(6 + i) * column] / length : i == 0;
    if (sf_rotation > 0.0f) {
        const float factor = sqrt(largest_level) * sf_rotation, sign = turned[0] < 0.0f ? -1.0f : 1.0f;
        float rest = 1.0f, squared = 0.0f;
        for (int i = 1; i < 4; ++i) {
            turned[i] = floor(sign * turned[i] * factor + 0.5f) / factor;
            rest -= turned[i] * turned[i];
            squared += turned[i] * turned[i];
        }
        turned[0] = sqrt(fmax(rest, 0.0f));
        if (rest < 0.0f) /* the imaginary parts alone are longer than 1 */
            for (int i = 1; i < 4; ++i)
                turned[i] /= sqrt(squared);
    }
    for (int i = 0; i < 4; ++i)
        quaternions[i * column + splat] = turned[i];
    float logit = own[10 * column];
    if (sf_opacity > 0.0f)
        logit = floor(fmax(logit - least_logit, 0.0f) * sf_opacity + 0.5f) / sf_opacity + least_logit;
    log2_opacities[splat] = (fmin(logit, 0.0f) - log1p(exp(-fabs(logit)))) * 1.44269504f;
    for (uint i = 0; i < sh_columns; ++i)
        sh[i * column + splat] = own[(11 + i) * column];
}
