/* Which splats reach into the picture of one view at least, and which into none, without a doubt:
 * potr_cl/model/splat_groups.py
   asks the same in double precision, of which this is a quick part. One splat a work-item.

   Macros: none.

   On GPUs: no macros. */

/* Of a coordinate's terms: many times what single precision loses on their way through a view. */
#define ROUNDING 1e-5f

/* What is found of a splat: no view sees it, one does, or rounding could decide it. */
enum { UNSEEN, SEEN, UNDECIDED };
/* Standard deviations are cut short beyond this (raster/activation.py), world units. */
#define LARGEST 1e12f

/* A view: where it is, and for x and for y the planes that bound its picture, and by how much it stretches splats:
   one whose along - low depth or high depth - along is less than -stretch times its reach is beside it. */
typedef struct {
    float rotation[9], translation[3];
    float low[2], high[2], stretch[2];
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
    const float largest = reach_of_one * fmax(fmax(scales[i], scales[stride + i]), scales[2 * stride + i]);
    /* A little less than it is, and a little more. */
    const float least = 0.999f * largest, most = 1.001f * largest;
    const float length = fabs(x) + fabs(y) + fabs(z);
    uchar found = UNSEEN;
    for (uint view = 0; view < views && found != SEEN; ++view) {
        global const Seer *seer = seers + view;
        global const float *r = seer->rotation, *t = seer->translation;
        const float depth = r[6] * x + r[7] * y + r[8] * z + t[2];
        const float slack = ROUNDING * (length + fabs(t[0]) + fabs(t[1]) + fabs(t[2]));
        /* What is no number is neither. */
        int inside = depth > near + slack, outside = depth < near - slack;
        for (int axis = 0; axis < 2; ++axis) {
            const float along = r[3 * axis] * x + r[3 * axis + 1] * y + r[3 * axis + 2] * z + t[axis];
            const float low = seer->low[axis], high = seer->high[axis];
            const float above = along - low * depth, below = high * depth - along;
            const float low_slack = (1.0f + fabs(low)) * slack, high_slack = (1.0f + fabs(high)) * slack;
            const float stretch = seer->stretch[axis];
            inside &= above > low_slack - least * stretch;
            inside &= below > high_slack - least * stretch;
            outside |= above < -low_slack - most * stretch;
            outside |= below < -high_slack - most * stretch;
        }
        found = inside ? SEEN : outside ? found : UNDECIDED;
    }
    seen[i] = found == UNSEEN && !(largest < LARGEST) ? UNDECIDED : found;
}
