/* A step of Adam (Kingma and Ba, 2015), one parameter of one splat a work-item: get_global_id(1) is the parameter's
   column. Both kernel families use it.

   The columns from first_sh on are SH coefficients, which go to the rasterizer's `sh` as they are; for the others see
   activate().

   A parameter whose gradient was always 0 stays what it was, whatever the limits are. The gradient becomes 0.

   Macros: none. */

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
    const float g = gradient[i];
    gradient[i] = 0.0f;
    const float mean = decay_mean * means[i] + (1.0f - decay_mean) * g;
    const float square = decay_square * squares[i] + (1.0f - decay_square) * g * g;
    means[i] = mean;
    squares[i] = square;
    if (mean == 0.0f || !(square > 0.0f))
        return; /* and the average is what the parameter is */
    const float value = parameters[i] - part * step.x * (mean * debias_mean) / sqrt(square * debias_square);
    if (fabs(value) < 1e30f) {
        const float kept = fmin(fmax(value, step.y), step.z);
        parameters[i] = kept;
        if (get_global_id(1) >= first_sh)
            sh[i - first_sh * (size_t)stride] = kept;
    }
    averages[i] += newest * (parameters[i] - averages[i]);
}

/* Parameters as the projection takes them (raster/project.cl), one splat a work-item: the scales' exponentials, unit
   quaternions, log2 of the opacities. */
kernel void activate(
    global const float *parameters,
    uint splats,
    uint stride,
    uint sh_columns,
    float largest_scale,
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
    for (int i = 0; i < 3; ++i) {
        means[i * column + splat] = own[i * column];
        scales[i * column + splat] = fmin(exp(fmin(own[(3 + i) * column], 80.0f)), largest_scale);
    }
    float length = 0.0f;
    for (int i = 6; i < 10; ++i)
        length += own[i * column] * own[i * column];
    length = sqrt(length);
    for (int i = 0; i < 4; ++i)
        quaternions[i * column + splat] = length > 1e-15f ? own[(6 + i) * column] / length : i == 0;
    const float logit = own[10 * column];
    log2_opacities[splat] = (fmin(logit, 0.0f) - log1p(exp(-fabs(logit)))) * 1.44269504f;
    for (uint i = 0; i < sh_columns; ++i)
        sh[i * column + splat] = own[(11 + i) * column];
}
