/* Half the derivative of 0.8 L1 + 0.2 (1 - SSIM), as 3D Gaussian Splatting has it, by each value of a picture: for
   photographs.py. A work-item does one channel of one pixel: get_global_id(0) counts channels along a row,
   get_global_id(1) rows, get_global_id(2) views. Pictures are continued with zeros beyond their borders.

   Plain on purpose: windows are summed up in two dimensions.

   Macros: none. */

#define RADIUS 5
#define C1 1e-4f
#define C2 9e-4f

/* The window's weight along one axis: a Gaussian of sigma 1.5 on 11 pixels. */
float weight_of(int distance)
{
    return exp(-(float)(distance * distance) / 4.5f) / 3.7592326f;
}

/* What SSIM changes by with the window's mean of x, of x squared, and of x times y: three floats for each value. */
kernel void moments(int width, int height, global const float *shown, global const float *target, global float *moments)
{
    const int i = get_global_id(0), row = get_global_id(1), view = get_global_id(2);
    if (i >= 3 * width)
        return;
    const int column = i / 3, channel = i % 3;
    float x = 0.0f, y = 0.0f, xx = 0.0f, yy = 0.0f, xy = 0.0f;
    for (int v = max(row - RADIUS, 0); v <= min(row + RADIUS, height - 1); ++v) {
        const float weight = weight_of(v - row);
        for (int u = max(column - RADIUS, 0); u <= min(column + RADIUS, width - 1); ++u) {
            const size_t at = 3 * ((size_t)(view * height + v) * width + u) + channel;
            const float w = weight * weight_of(u - column);
            const float a = clamp(shown[at], 0.0f, 1.0f), b = target[at];
            x += w * a;
            y += w * b;
            xx += w * a * a;
            yy += w * b * b;
            xy += w * a * b;
        }
    }
    const float a1 = 2.0f * x * y + C1, a2 = 2.0f * (xy - x * y) + C2;
    const float b1 = x * x + y * y + C1, b2 = xx - x * x + yy - y * y + C2;
    const float both = b1 * b2, s = a1 * a2 / both;
    const size_t at = 3 * (3 * (size_t)(view * height + row) * width + i);
    moments[at] = 2.0f * (y * (a2 - a1) / both - x * s / b1 + x * s / b2);
    moments[at + 1] = -s / b2;
    moments[at + 2] = 2.0f * a1 / both;
}

/* part: of SSIM in the loss. */
kernel void differences(
    int width,
    int height,
    global const float *shown,
    global const float *target,
    global const float *moments,
    float part,
    global float *result)
{
    const int i = get_global_id(0), row = get_global_id(1), view = get_global_id(2);
    if (i >= 3 * width)
        return;
    const int column = i / 3, channel = i % 3;
    const size_t own = 3 * (size_t)(view * height + row) * width + i;
    const float x = shown[own], y = target[own];
    float similar = 0.0f;
    for (int v = max(row - RADIUS, 0); v <= min(row + RADIUS, height - 1); ++v) {
        const float weight = weight_of(v - row);
        for (int u = max(column - RADIUS, 0); u <= min(column + RADIUS, width - 1); ++u) {
            const size_t at = 3 * (3 * ((size_t)(view * height + v) * width + u) + channel);
            const float w = weight * weight_of(u - column);
            similar += w * (moments[at] + 2.0f * x * moments[at + 1] + y * moments[at + 2]);
        }
    }
    const float sign_of = x > y ? 1.0f : x < y ? -1.0f : 0.0f;
    result[own] = 0.5f * ((1.0f - part) * sign_of - part * similar);
}
