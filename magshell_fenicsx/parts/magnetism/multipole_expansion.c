/* Which rule each pair of cells that are apart has, and multipoles of boxes far from each other. Compiled behind pairs.c. */

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

/* Add G M of boxes `other` to L of boxes `one`, for pairs (count,); G (.., size): row after row (one for each number of M)
   the first `ends` (n,), all that are not zero; M and L (boxes, n, width). Of width 1, LANES successive pairs with one G go
   through at once. */
FAST void translate(int64_t count, const int64_t *one, const int64_t *other, const int64_t *which, int64_t n,
                    const int64_t *ends, int64_t size, int64_t width, const double *G, const double *M, double *L)
{
    v m[n], l[n];
    for (int64_t at = 0, lanes; at < count; at += lanes) {
        const double *g = G + which[at] * size;
        lanes = 1;
        if (width > 1) {
            for (int64_t j = 0; j < n; g += ends[j++])
                for (int64_t i = 0; i < ends[j]; ++i)
                    for (int64_t k = 0; k < width; ++k)
                        L[(one[at] * n + i) * width + k] += g[i] * M[(other[at] * n + j) * width + k];
            continue;
        }
        while (lanes < LANES && at + lanes < count && which[at + lanes] == which[at])
            ++lanes;
        memset(m, 0, sizeof m), memset(l, 0, sizeof l);
        for (int64_t c = 0; c < lanes; ++c)
            for (int64_t j = 0; j < n; ++j)
                m[j][c] = M[other[at + c] * n + j];
        for (int64_t j = 0; j < n; g += ends[j++])
            for (int64_t i = 0; i < ends[j]; ++i)
                l[i] += g[i] * m[j];
        for (int64_t c = 0; c < lanes; ++c)
            for (int64_t i = 0; i < n; ++i)
                L[one[at + c] * n + i] += l[i][c];
    }
}
