/* Which rule each pair of cells that are apart has. Compiled behind pairs.c. */

/* The number of the rule of each pair of a cell from `first` to `last` with any of n, where `apart` (own, n) is not 0; -1
   of the others. nodes (n, k, 3), centre (n, 3), normal (n, 3), radius (n,). Rules have the rates `least` (rules,): the
   first one that a pair of cells reaches is taken, the last one by those with none. The return value is 1 if two are too
   near each other, within h or with a rate below `worst`. */
FAST int64_t rules(int64_t n, int64_t first, int64_t last, int64_t k, const double *nodes, const double *centre,
                   const double *normal, const double *radius, const uint8_t *apart, double h, double space,
                   double above, double flat, int64_t count, const double *least, double worst, int8_t *found)
{
    for (int64_t c = first; c < last; ++c)
        for (int64_t d = 0; d < n; ++d) {
            int8_t *to = found + (c - first) * n + d;
            *to = -1;
            if (!apart[(c - first) * n + d])
                continue;
            double between[3], gap = 0.0;
            for (int i = 0; i < 3; ++i)
                between[i] = centre[3 * d + i] - centre[3 * c + i], gap += between[i] * between[i];
            gap = sqrt(gap) - radius[c] - radius[d] - h;
            const double size = 2.0 * fmax(radius[c], radius[d]);
            if (gap < size) {
                double nearest = INFINITY;
                for (int64_t a = 0; a < k; ++a) {
                    const double *x = nodes + 3 * (k * d + a);
                    double away[3] = {x[0] - centre[3 * c], x[1] - centre[3 * c + 1], x[2] - centre[3 * c + 2]};
                    double across = 0.0, square = 0.0;
                    for (int i = 0; i < 3; ++i)
                        across += away[i] * normal[3 * c + i], square += away[i] * away[i];
                    if (fabs(across) < h && square - across * across < above * above * radius[c] * radius[c])
                        return 1;
                    for (int64_t b = 0; b < k; ++b) {
                        const double *y = nodes + 3 * (k * c + b);
                        const double distance = (x[0] - y[0]) * (x[0] - y[0]) + (x[1] - y[1]) * (x[1] - y[1]) +
                                                (x[2] - y[2]) * (x[2] - y[2]);
                        nearest = fmin(nearest, distance);
                    }
                }
                nearest = sqrt(nearest);
                gap = fmax(gap, fmax(nearest - h, nearest / 2.0));
            }
            const double rate = fmax(gap / size, space);
            if (!(rate >= worst))
                return 1;
            double up = 0.0, down = 0.0, square = 0.0;
            for (int i = 0; i < 3; ++i) {
                up += between[i] * normal[3 * c + i], down += between[i] * normal[3 * d + i];
                square += between[i] * between[i];
            }
            const double seen = fmax(up * up, down * down) < flat * flat * square ? sqrt(rate * (1.0 + rate)) : rate;
            int64_t which = 0;
            while (which < count - 1 && seen < least[which])
                ++which;
            *to = (int8_t)which;
        }
    return 0;
}
