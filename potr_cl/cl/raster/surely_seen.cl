/* Which splats reach into the picture of one view at least, without a doubt: potr_cl/model/unseen.py asks the same in
   double precision, of which this is a quick part. One splat a work-item.

   Macros: none. */

/* Of a coordinate's terms: many times what single precision loses on their way through a view. */
#define ROUNDING 1e-5f

/* A view: where it is, and the planes that bound its picture, for x and for y: along - low depth and
   along - high depth are the distances from them, times the root of 1 + low^2 and of 1 + high^2. */
typedef struct {
    float rotation[9], translation[3];
    float low[2], high[2], low_length[2], high_length[2];
} Seer;

kernel void surely_seen(
    ulong splats,
    ulong stride,
    global const float *means,
    global const float *scales,
    global const Seer *seers,
    uint views,
    float near,
    float reach_of_one,
    global uchar *seen)
{
    const size_t i = get_global_id(0);
    if (i >= splats)
        return;
    const float x = means[i], y = means[stride + i], z = means[2 * stride + i];
    /* A little less than it is. */
    const float reach = 0.999f * reach_of_one * fmax(fmax(scales[i], scales[stride + i]), scales[2 * stride + i]);
    const float length = fabs(x) + fabs(y) + fabs(z);
    uchar found = 0;
    for (uint view = 0; view < views && !found; ++view) {
        global const Seer *seer = seers + view;
        global const float *r = seer->rotation, *t = seer->translation;
        const float depth = r[6] * x + r[7] * y + r[8] * z + t[2];
        const float slack = ROUNDING * (length + fabs(t[0]) + fabs(t[1]) + fabs(t[2]));
        int inside = depth > near + slack;
        for (int axis = 0; axis < 2; ++axis) {
            const float along = r[3 * axis] * x + r[3 * axis + 1] * y + r[3 * axis + 2] * z + t[axis];
            const float low = seer->low[axis], high = seer->high[axis];
            inside &= along - low * depth > (1.0f + fabs(low)) * slack - reach * seer->low_length[axis];
            inside &= along - high * depth < reach * seer->high_length[axis] - (1.0f + fabs(high)) * slack;
        }
        found = inside != 0;
    }
    seen[i] = found;
}
