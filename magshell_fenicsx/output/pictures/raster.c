/* Which of the triangles is in front at each pixel, and where in it; pixel centres are at integers. */

#include <math.h>

static int32_t below(double x) { int32_t i = (int32_t)x; return x < i ? i - 1 : i; }

static double least(double a, double b, double c) { double m = a < b ? a : b; return m < c ? m : c; }

/* Narrows the pixels from left to right to those where start + x * rise is not negative. */
static void narrow(double start, double rise, int32_t *left, int32_t *right)
{
    if (rise == 0) {
        if (start < 0) *right = *left - 1;
        return;
    }
    const double end = -start / rise;
    if (rise > 0 && end > *left) *left = end > *right ? *right + 1 : -below(-end);
    if (rise < 0 && end < *right) *right = end < *left ? *left - 1 : below(end);
}

/* Where a triangle is in front: at (x, y) its second and third corner have the weights v0 + x vx + y vy and w0 + ... */
struct weights { double v0, vx, vy, w0, wx, wy; };

/* The weights in a triangle of projected places; 0 where it is seen edgewise. */
static int weights_of(const double *places, const int32_t *corners, struct weights *found)
{
    const double *a = places + 3 * corners[0], *b = places + 3 * corners[1], *c = places + 3 * corners[2];
    const double area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
    if (!(area > 1e-12 || area < -1e-12)) return 0;
    const double over = 1 / area;
    found->vx = (c[1] - a[1]) * over, found->vy = -(c[0] - a[0]) * over;
    found->wx = -(b[1] - a[1]) * over, found->wy = (b[0] - a[0]) * over;
    found->v0 = -a[0] * found->vx - a[1] * found->vy, found->w0 = -a[0] * found->wx - a[1] * found->wy;
    return 1;
}

/* places: x to the right, y down, depth towards the eye. The results: the triangle in front, -1 without one, and its
   depth. */
void rasterise(const double *places, const int32_t *triangles, int64_t count, int32_t width, int32_t height,
               int32_t *restrict index, float *restrict depth)
{
    const double near = 1e-9;
    for (int64_t at = 0; at < (int64_t)width * height; at++) index[at] = -1, depth[at] = -INFINITY;
    for (int64_t t = 0; t < count; t++) {
        const double *a = places + 3 * triangles[3 * t], *b = places + 3 * triangles[3 * t + 1];
        const double *c = places + 3 * triangles[3 * t + 2];
        struct weights it;
        if (!weights_of(places, triangles + 3 * t, &it)) continue;
        int32_t left = -below(-least(a[0], b[0], c[0])), right = below(-least(-a[0], -b[0], -c[0]));
        int32_t top = -below(-least(a[1], b[1], c[1])), bottom = below(-least(-a[1], -b[1], -c[1]));
        if (left < 0) left = 0;
        if (top < 0) top = 0;
        if (right >= width) right = width - 1;
        if (bottom >= height) bottom = height - 1;
        const double db = b[2] - a[2], dc = c[2] - a[2];
        for (int32_t y = top; y <= bottom; y++) {
            const double v = it.v0 + y * it.vy, w = it.w0 + y * it.wy;
            int32_t first = left, last = right;
            narrow(v + near, it.vx, &first, &last);
            narrow(w + near, it.wx, &first, &last);
            narrow(1 + near - v - w, -it.vx - it.wx, &first, &last);
            const double rise = it.vx * db + it.wx * dc;
            const float start = (float)(a[2] + v * db + w * dc + first * rise), step = (float)rise;
            int32_t *const row = index + (int64_t)y * width + first;
            float *const front = depth + (int64_t)y * width + first;
            for (int32_t i = 0; i <= last - first; i++) { /* without a branch: for several pixels at once */
                const float z = start + (float)i * step;
                const int nearer = z > front[i];
                front[i] = nearer ? z : front[i];
                row[i] = nearer ? (int32_t)t : row[i];
            }
        }
    }
}

/* The light at a place: ambient, and what its normal has of the way to the lamp. The side that is seen is lit, so the
   normal's sign does not matter. eye, lamp: cosines between normal and the ways there; one: those of a face towards the
   eye, which has the colours themselves. */
static float light_of(float eye, float lamp, float one, float relief, float rim)
{
    const float facing = eye < 0 ? -eye : eye, away = facing < 1 ? 1 - facing : 0;
    const float turned = one - (eye < 0 ? -lamp : lamp);
    return 1 - relief * turned / (1 + (turned > 0 ? turned : 0) / 2) - rim * away * away; /* no face is black */
}

/* Colours of values at the points, in their light, on pixels of finer x finer of the above; each has four bytes.
   eye, lamp: see light_of. table: colours, of low first and high last. */
void paint(const double *places, const int32_t *triangles, const int32_t *index, int32_t width, int32_t height,
           int32_t finer, const float *values, const float *eye, const float *lamp, float one, float relief, float rim,
           float low, float high, const float *table, int32_t colours, uint8_t *image)
{
    int32_t last = -1;
    struct weights it = {0, 0, 0, 0, 0, 0};
    for (int32_t y = 0; y < height; y++)
        for (int32_t x = 0; x < width; x++, image += 4) {
            float sum[3] = {0, 0, 0};
            int32_t covered = 0;
            for (int32_t j = 0; j < finer; j++)
                for (int32_t i = 0; i < finer; i++) {
                    const int32_t right = x * finer + i, down = y * finer + j;
                    const int32_t t = index[(int64_t)down * width * finer + right];
                    if (t < 0) continue;
                    const int32_t *p = triangles + 3 * (int64_t)t;
                    if (t != last) weights_of(places, p, &it), last = t;
                    const float v = (float)(it.v0 + right * it.vx + down * it.vy);
                    const float w = (float)(it.w0 + right * it.wx + down * it.wy), u = 1 - v - w;
                    const float value = u * values[p[0]] + v * values[p[1]] + w * values[p[2]];
                    const float light = light_of(u * eye[p[0]] + v * eye[p[1]] + w * eye[p[2]],
                                                 u * lamp[p[0]] + v * lamp[p[1]] + w * lamp[p[2]], one, relief, rim);
                    const float place = (value - low) / (high - low) * (colours - 1) + 0.5f;
                    const int32_t k = !(place > 0) ? 0 : place >= colours ? colours - 1 : (int32_t)place;
                    const float *const colour = table + 3 * k;
                    float most = 1e-6f;
                    for (int c = 0; c < 3; c++) most = colour[c] > most ? colour[c] : most;
                    const float lit = light < 0 ? 0 : light * most > 1 ? 1 / most : light; /* no colour becomes another */
                    for (int c = 0; c < 3; c++) sum[c] += lit * colour[c];
                    covered++;
                }
            for (int c = 0; c < 3; c++) image[c] = covered ? (uint8_t)(255 * sum[c] / covered + 0.5f) : 255;
            image[3] = (uint8_t)(255 * covered / (finer * finer));
        }
}
