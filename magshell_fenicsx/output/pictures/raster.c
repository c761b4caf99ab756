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

/* places: x to the right, y down, depth towards the eye. The results: the triangle in front, -1 without one; the
   weights of its second and third corner; the depth. */
void rasterise(const double *places, const int32_t *triangles, int64_t count, int32_t width, int32_t height,
               int32_t *index, float *second, float *third, float *depth)
{
    const double near = 1e-9;
    for (int64_t at = 0; at < (int64_t)width * height; at++) index[at] = -1, depth[at] = -INFINITY;
    for (int64_t t = 0; t < count; t++) {
        const double *a = places + 3 * triangles[3 * t], *b = places + 3 * triangles[3 * t + 1];
        const double *c = places + 3 * triangles[3 * t + 2];
        const double area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
        if (!(area > 1e-12 || area < -1e-12)) continue;
        int32_t left = -below(-least(a[0], b[0], c[0])), right = below(-least(-a[0], -b[0], -c[0]));
        int32_t top = -below(-least(a[1], b[1], c[1])), bottom = below(-least(-a[1], -b[1], -c[1]));
        if (left < 0) left = 0;
        if (top < 0) top = 0;
        if (right >= width) right = width - 1;
        if (bottom >= height) bottom = height - 1;
        const double over = 1 / area, vx = (c[1] - a[1]) * over, vy = -(c[0] - a[0]) * over;
        const double wx = -(b[1] - a[1]) * over, wy = (b[0] - a[0]) * over;
        const double db = b[2] - a[2], dc = c[2] - a[2];
        for (int32_t y = top; y <= bottom; y++) {
            const double v = (y - a[1]) * vy - a[0] * vx, w = (y - a[1]) * wy - a[0] * wx;
            int32_t first = left, last = right;
            narrow(v + near, vx, &first, &last);
            narrow(w + near, wx, &first, &last);
            narrow(1 + near - v - w, -vx - wx, &first, &last);
            const double z0 = a[2] + v * db + w * dc, rise = vx * db + wx * dc;
            for (int64_t x = first, at = (int64_t)y * width + first; x <= last; x++, at++) {
                const float z = (float)(z0 + x * rise);
                if (z > depth[at]) {
                    depth[at] = z, index[at] = (int32_t)t;
                    second[at] = (float)(v + x * vx), third[at] = (float)(w + x * wx);
                }
            }
        }
    }
}

/* Colours of values at the points, times the light, on pixels of finer x finer of the above; each has four bytes.
   facing: cosines between normals and the direction to the eye. table: colours, of low first and high last. */
void paint(const int32_t *triangles, const int32_t *index, const float *second, const float *third, int32_t width,
           int32_t height, int32_t finer, const float *values, const float *facing, float darkest, float low,
           float high, const float *table, int32_t colours, uint8_t *image)
{
    for (int32_t y = 0; y < height; y++)
        for (int32_t x = 0; x < width; x++, image += 4) {
            float sum[3] = {0, 0, 0};
            int32_t covered = 0;
            for (int32_t j = 0; j < finer; j++)
                for (int32_t i = 0; i < finer; i++) {
                    const int64_t at = ((int64_t)y * finer + j) * width * finer + (int64_t)x * finer + i;
                    if (index[at] < 0) continue;
                    const int32_t *p = triangles + 3 * (int64_t)index[at];
                    const float v = second[at], w = third[at], u = 1 - v - w;
                    const float value = u * values[p[0]] + v * values[p[1]] + w * values[p[2]];
                    const float away = 1 - (u * facing[p[0]] + v * facing[p[1]] + w * facing[p[2]]);
                    const float light = away > 0 ? 1 - darkest * away * away : 1;
                    const float place = (value - low) / (high - low) * (colours - 1) + 0.5f;
                    const int32_t k = !(place > 0) ? 0 : place >= colours ? colours - 1 : (int32_t)place;
                    for (int c = 0; c < 3; c++) sum[c] += light * table[3 * k + c];
                    covered++;
                }
            for (int c = 0; c < 3; c++) image[c] = covered ? (uint8_t)(255 * sum[c] / covered + 0.5f) : 255;
            image[3] = (uint8_t)(255 * covered / (finer * finer));
        }
}
