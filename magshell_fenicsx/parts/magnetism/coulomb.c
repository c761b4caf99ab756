/* Energies of pairs of charges, their gradients and second derivatives; coulomb.py says what for. */
#include <math.h>

/* Of charges q at x (m, 3) with charges p at y (n, 3): the sum of q p/|x - y|, its gradient g (m, 3) by each x, and,
   unless K is NULL, its second derivatives H (m, 3, 3) by each x and K (3 m, 3 n) by x and y. g and H are added to. */
double coulomb(int64_t m, const double *x, const double *q, int64_t n, const double *y, const double *p, double *g,
               double *H, double *K)
{
    double energy = 0.0;
    for (int64_t i = 0; i < m; ++i) {
        const double *xi = x + 3 * i;
        double sum[3] = {0.0}, second[6] = {0.0};
        for (int64_t j = 0; j < n; ++j) {
            const double *yj = y + 3 * j;
            const double d[3] = {xi[0] - yj[0], xi[1] - yj[1], xi[2] - yj[2]};
            const double inverse = 1.0 / (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
            const double value = q[i] * p[j] * sqrt(inverse), slope = value * inverse;
            energy += value;
            for (int a = 0; a < 3; ++a)
                sum[a] -= slope * d[a];
            if (!K)
                continue;
            const double bend = 3.0 * slope * inverse;
            const double h[6] = {bend * d[0] * d[0] - slope, bend * d[1] * d[1] - slope, bend * d[2] * d[2] - slope,
                                 bend * d[0] * d[1],         bend * d[0] * d[2],         bend * d[1] * d[2]};
            for (int a = 0; a < 6; ++a)
                second[a] += h[a];
            double *row = K + 9 * i * n + 3 * j;
            row[0] = -h[0], row[1] = -h[3], row[2] = -h[4];
            row += 3 * n;
            row[0] = -h[3], row[1] = -h[1], row[2] = -h[5];
            row += 3 * n;
            row[0] = -h[4], row[1] = -h[5], row[2] = -h[2];
        }
        for (int a = 0; a < 3; ++a)
            g[3 * i + a] += sum[a];
        if (K) {
            const int of[9] = {0, 3, 4, 3, 1, 5, 4, 5, 2};
            for (int a = 0; a < 9; ++a)
                H[9 * i + a] += second[of[a]];
        }
    }
    return energy;
}
