/* Charges of cells that touch: energies of pairs of points on two cells, gradients and second derivatives; near.py says
   what for. A charge is at x = r + t eta n of a point of the mid-surface. With the gradients g_k of the shape functions
   N_k along the surface, dx = N_k du_k - t eta g_k (n . du_k). */
#include <math.h>
#include <string.h>

typedef struct {
    double r[3], n[3];       /* place and normal */
    double F[3], W[3];       /* the derivative by r, and its moment by t eta */
    double K[3][6];          /* second derivatives by r, and their first and second moment: xx, yy, zz, xy, xz, yz */
    double t;
} Point;

static const int AT[3][3] = {{0, 3, 4}, {3, 1, 5}, {4, 5, 2}};

/* T (3, k): shape functions and their derivatives; nodes (k, 3). g (3, k) gets the gradients along the surface. */
static void place(int k, const double *T, const double *nodes, double t, Point *p, double *g)
{
    double a[3][3] = {{0.0}};
    for (int d = 0; d < 3; ++d)
        for (int l = 0; l < k; ++l)
            for (int i = 0; i < 3; ++i)
                a[d][i] += T[d * k + l] * nodes[3 * l + i];
    const double *b = a[1], *c = a[2];
    double m[3] = {b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]};
    const double size = sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2]);
    memset(p, 0, sizeof *p);
    p->t = t;
    for (int i = 0; i < 3; ++i)
        p->r[i] = a[0][i], p->n[i] = m[i] / size;
    const double *n = p->n;
    for (int i = 0; i < 3; ++i) {
        const int j = (i + 1) % 3, h = (i + 2) % 3;
        const double first = (c[j] * n[h] - c[h] * n[j]) / size, second = (n[j] * b[h] - n[h] * b[j]) / size;
        for (int l = 0; l < k; ++l)
            g[i * k + l] = first * T[k + l] + second * T[2 * k + l];
    }
}

/* Add what a point's own derivatives are by the nodes of its cell: gradient (k, 3), and unless NULL H (3, k, 3, k). */
static void own(int k, const double *N, const Point *p, const double *g, double *gradient, double *H)
{
    double Wg[k], K1[3][k], K2[3][k];
    const double *n = p->n, on = p->W[0] * n[0] + p->W[1] * n[1] + p->W[2] * n[2];
    for (int l = 0; l < k; ++l)
        Wg[l] = p->W[0] * g[l] + p->W[1] * g[k + l] + p->W[2] * g[2 * k + l];
    for (int l = 0; l < k; ++l)
        for (int j = 0; j < 3; ++j)
            gradient[3 * l + j] += N[l] * p->F[j] - Wg[l] * n[j];
    if (!H)
        return;
    for (int i = 0; i < 3; ++i)
        for (int l = 0; l < k; ++l) {
            double first = 0.0, second = -on * g[i * k + l];
            for (int j = 0; j < 3; ++j) {
                first += p->K[1][AT[i][j]] * g[j * k + l];
                second += p->K[2][AT[i][j]] * g[j * k + l];
            }
            K1[i][l] = first, K2[i][l] = second;
        }
    for (int i = 0; i < 3; ++i)
        for (int m = 0; m < k; ++m) {
            double s[k];
            for (int l = 0; l < k; ++l)
                s[l] = n[i] * (g[m] * K2[0][l] + g[k + m] * K2[1][l] + g[2 * k + m] * K2[2][l]) - N[m] * K1[i][l] +
                       Wg[m] * g[i * k + l];
            for (int j = 0; j < 3; ++j) {
                double *row = H + ((i * k + m) * 3 + j) * k;
                const double c = N[m] * p->K[0][AT[i][j]] - n[i] * K1[j][m], d = n[i] * g[j * k + m], nj = n[j];
                for (int l = 0; l < k; ++l)
                    row[l] += c * N[l] + nj * s[l] + d * Wg[l];
            }
        }
}

/* The energy of `count` pairs of cells (count, 2); nodes (cells, k, 3). On the first of each pair are P points with the
   tables TL (P, 3, k), thickness tL (count, P), heights hL (P, L) and charges qL (count, P, L). On the second are M
   points for each of these, TR (P, M, 3, k), tR (count, P, M), hR (P, M, S), qR (count, P, M, S), or `same` ones for all:
   without the axis P. gradient (cells, k, 3) is added to; H (count, 3, 3, k, 3, k), unless NULL, gets the second
   derivatives by the first and first, first and second, second and second cell, with the component before the node. */
double near(int64_t count, const int64_t *pairs, int64_t k, const double *nodes, int64_t P, int64_t L, const double *TL,
            const double *tL, const double *hL, const double *qL, int64_t M, int64_t S, const double *TR,
            const double *tR, const double *hR, const double *qR, int64_t same, double *gradient, double *H)
{
    double energy = 0.0;
    const int64_t block = 9 * k * k;
    Point right[M];
    double gL[3 * k], gR[M * 3 * k], A[9 * k], B[9 * k];
    for (int64_t at = 0; at < count; ++at) {
        const double *left_nodes = nodes + 3 * k * pairs[2 * at], *right_nodes = nodes + 3 * k * pairs[2 * at + 1];
        double *left_gradient = gradient + 3 * k * pairs[2 * at], *right_gradient = gradient + 3 * k * pairs[2 * at + 1];
        double *HL = H ? H + 3 * block * at : 0, *HX = H ? HL + block : 0, *HR = H ? HX + block : 0;
        for (int64_t p = 0; p < P; ++p) {
            const int64_t first = same ? 0 : p * M, row = at * (same ? M : P * M) + first;
            if (p == 0 || !same)
                for (int64_t m = 0; m < M; ++m)
                    place(k, TR + (first + m) * 3 * k, right_nodes, tR[row + m], right + m, gR + 3 * k * m);
            Point left;
            place(k, TL + p * 3 * k, left_nodes, tL[at * P + p], &left, gL);
            if (H)
                memset(A, 0, sizeof A), memset(B, 0, sizeof B);
            for (int64_t m = 0; m < M; ++m) {
                Point *other = right + m;
                double X[4][6] = {{0.0}}; /* second derivatives, with moments by none, the left, the right, both heights */
                for (int64_t l = 0; l < L; ++l)
                    for (int64_t s = 0; s < S; ++s) {
                        const double q = qL[(at * P + p) * L + l] * qR[(row + m) * S + s];
                        const double z = left.t * hL[p * L + l], y = other->t * hR[(first + m) * S + s];
                        double d[3];
                        for (int i = 0; i < 3; ++i)
                            d[i] = left.r[i] + z * left.n[i] - other->r[i] - y * other->n[i];
                        const double inverse = 1.0 / (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
                        const double value = q * sqrt(inverse), slope = value * inverse;
                        energy += value;
                        for (int i = 0; i < 3; ++i) {
                            const double f = -slope * d[i];
                            left.F[i] += f, left.W[i] += z * f;
                            other->F[i] -= f, other->W[i] -= y * f;
                        }
                        if (!H)
                            continue;
                        const double bend = 3.0 * slope * inverse;
                        const double h[6] = {bend * d[0] * d[0] - slope, bend * d[1] * d[1] - slope,
                                             bend * d[2] * d[2] - slope, bend * d[0] * d[1],
                                             bend * d[0] * d[2],         bend * d[1] * d[2]};
                        for (int i = 0; i < 6; ++i) {
                            left.K[0][i] += h[i], left.K[1][i] += z * h[i], left.K[2][i] += z * z * h[i];
                            other->K[0][i] += h[i], other->K[1][i] += y * h[i], other->K[2][i] += y * y * h[i];
                            X[0][i] += h[i], X[1][i] += z * h[i], X[2][i] += y * h[i], X[3][i] += z * y * h[i];
                        }
                    }
                if (!H)
                    continue;
                const double *N = TR + (first + m) * 3 * k, *g = gR + 3 * k * m;
                for (int i = 0; i < 3; ++i) {
                    double a[k], b[k];
                    for (int64_t l = 0; l < k; ++l) {
                        a[l] = X[2][AT[i][0]] * g[l] + X[2][AT[i][1]] * g[k + l] + X[2][AT[i][2]] * g[2 * k + l];
                        b[l] = X[3][AT[i][0]] * g[l] + X[3][AT[i][1]] * g[k + l] + X[3][AT[i][2]] * g[2 * k + l];
                    }
                    for (int j = 0; j < 3; ++j) {
                        const double c = X[0][AT[i][j]], d = X[1][AT[i][j]], nj = other->n[j];
                        double *to = A + (3 * i + j) * k, *too = B + (3 * i + j) * k;
                        for (int64_t l = 0; l < k; ++l)
                            to[l] += c * N[l] - nj * a[l], too[l] += d * N[l] - nj * b[l];
                    }
                }
            }
            if (!same || p == P - 1)
                for (int64_t m = 0; m < M; ++m)
                    own((int)k, TR + (first + m) * 3 * k, right + m, gR + 3 * k * m, right_gradient, HR);
            own((int)k, TL + p * 3 * k, &left, gL, left_gradient, HL);
            for (int i = 0; i < 3 && H; ++i)
                for (int64_t l = 0; l < k; ++l)
                    for (int j = 0; j < 3; ++j) {
                        const double N = TL[p * 3 * k + l], *a = A + (3 * i + j) * k;
                        double *to = HX + ((i * k + l) * 3 + j) * k;
                        for (int64_t m = 0; m < k; ++m) {
                            double turned = 0.0;
                            for (int h = 0; h < 3; ++h)
                                turned += gL[h * k + l] * B[(3 * h + j) * k + m];
                            to[m] += left.n[i] * turned - N * a[m];
                        }
                    }
        }
    }
    return energy;
}
