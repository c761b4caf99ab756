/* Charges on pairs of cells: energies of pairs of points, gradients and second derivatives; pairs.py says what for. A
   charge is at x = r + t eta n of a point of the mid-surface. With the shape functions N_k, their derivatives N_k,a and
   the dual basis a^a of the surface, dx = N_k du_k - t eta a^a N_k,a (n . du_k). LANES pairs go through at once. */
#include <math.h>
#include <string.h>

#define LANES 8
#define SUMS 24

typedef double v __attribute__((vector_size(8 * LANES)));
typedef int64_t whole __attribute__((vector_size(8 * LANES)));

typedef struct {
    v r[3], n[3], up[2][3];  /* place, normal and dual basis */
    v F[3], W[3];            /* SUMS numbers: the derivative by r, and its moment by t eta, */
    v K[3][6];               /* second derivatives by r, and their first and second moment: xx, yy, zz, xy, xz, yz */
    v t;
} Point;

static const int AT[3][3] = {{0, 3, 4}, {3, 1, 5}, {4, 5, 2}}; /* of entry (i, j) among xx, yy, zz, xy, xz, yz */

/* 1/sqrt(x): two steps of Householder's method, of third order, from the halved exponent. */
INLINE void inverse_root(const v *x, v *y)
{
    whole bits;
    memcpy(&bits, x, sizeof bits);
    bits = 0x5fe6eb50c7b537a9 - (bits >> 1);
    memcpy(y, &bits, sizeof bits);
    for (int i = 0; i < 2; ++i) {
        const v one = *x * *y * *y;
        *y *= 1.875 - one * (1.25 - 0.375 * one);
    }
}

INLINE void cross(const v *a, const v *b, v *c)
{
    c[0] = a[1] * b[2] - a[2] * b[1], c[1] = a[2] * b[0] - a[0] * b[2], c[2] = a[0] * b[1] - a[1] * b[0];
}

/* T (3, k): shape functions and their derivatives; nodes (k, 3). Second derivatives are set to zero if `bent`. */
INLINE void place(int k, const v *T, const v *nodes, int bent, Point *p)
{
    v a[3][3];
    memset(a, 0, sizeof a);
    for (int l = 0; l < k; ++l)
        for (int d = 0; d < 3; ++d)
            for (int i = 0; i < 3; ++i)
                a[d][i] += T[d * k + l] * nodes[3 * l + i];
    v m[3], size;
    cross(a[1], a[2], m);
    const v square = m[0] * m[0] + m[1] * m[1] + m[2] * m[2];
    inverse_root(&square, &size);
    memset(p->F, 0, sizeof p->F), memset(p->W, 0, sizeof p->W);
    if (bent)
        memset(p->K, 0, sizeof p->K);
    for (int i = 0; i < 3; ++i)
        p->r[i] = a[0][i], p->n[i] = m[i] * size;
    cross(a[2], p->n, p->up[0]), cross(p->n, a[1], p->up[1]);
    for (int i = 0; i < 3; ++i)
        p->up[0][i] *= size, p->up[1][i] *= size;
}

/* A symmetric matrix (6,) times a vector. */
INLINE void times(const v *K, const v *x, v *y)
{
    for (int i = 0; i < 3; ++i)
        y[i] = K[AT[i][0]] * x[0] + K[AT[i][1]] * x[1] + K[AT[i][2]] * x[2];
}

/* Add what a point's own derivatives are by the nodes of its cell: gradient (k, 3), and unless NULL H (a <= b, 3, 3). */
INLINE void own(int k, const v *T, const Point *p, v *gradient, v *H)
{
    const v *n = p->n;
    v c[2][3];
    for (int a = 0; a < 2; ++a) {
        const v along = p->W[0] * p->up[a][0] + p->W[1] * p->up[a][1] + p->W[2] * p->up[a][2];
        for (int i = 0; i < 3; ++i)
            c[a][i] = -along * n[i];
    }
    for (int l = 0; l < k; ++l)
        for (int i = 0; i < 3; ++i)
            gradient[3 * l + i] += T[l] * p->F[i] + T[k + l] * c[0][i] + T[2 * k + l] * c[1][i];
    if (!H)
        return;
    v g[k][3], first[k][3], second[k][3], turned[k], M[k][9];
    const v on = p->W[0] * n[0] + p->W[1] * n[1] + p->W[2] * n[2];
    for (int l = 0; l < k; ++l) {
        for (int i = 0; i < 3; ++i)
            g[l][i] = T[k + l] * p->up[0][i] + T[2 * k + l] * p->up[1][i];
        times(p->K[1], g[l], first[l]), times(p->K[2], g[l], second[l]);
        turned[l] = p->W[0] * g[l][0] + p->W[1] * g[l][1] + p->W[2] * g[l][2];
        for (int i = 0; i < 3; ++i) {
            second[l][i] -= on * g[l][i];
            for (int j = 0; j < 3; ++j)
                M[l][3 * i + j] = T[l] * p->K[0][AT[i][j]] - first[l][i] * n[j];
        }
    }
    for (int l = 0; l < k; ++l)
        for (int m = l; m < k; ++m, H += 9) {
            const v S = g[l][0] * second[m][0] + g[l][1] * second[m][1] + g[l][2] * second[m][2];
            v y[3];
            for (int j = 0; j < 3; ++j)
                y[j] = S * n[j] + g[l][j] * turned[m] - first[l][j] * T[m];
            for (int i = 0; i < 3; ++i) {
                const v z = turned[l] * g[m][i];
                for (int j = 0; j < 3; ++j)
                    H[3 * i + j] += T[l] * M[m][3 * i + j] + n[i] * y[j] + z * n[j];
            }
        }
}

/* Values of LANES elements `at`, `step` apart. */
INLINE void gather(const double *x, int64_t step, const int64_t *at, v *y)
{
    for (int c = 0; c < LANES; ++c)
        (*y)[c] = x[step * at[c]];
}

/* n numbers, the same in all lanes. */
INLINE void spread(int n, const double *x, v *y)
{
    for (int i = 0; i < n; ++i)
        y[i] = x[i] + (v){0.0};
}

/* The energy of the charges q (L,) at one point and p (S,) at another, at heights hL and hR over the thickness. The
   derivatives by both points are added to these; with `bent` the second ones too. X (4, 6) gets the second derivatives
   by one place and the other, and their moments by the left height, the right one, and both. */
INLINE void between(int64_t L, int64_t S, int bent, Point *left, const v *q, const double *hL, Point *right, const v *p,
                    const double *hR, v *energy, v *X)
{
    v apart[3], F[3], W[3], sum;
    memset(F, 0, sizeof F), memset(W, 0, sizeof W), memset(&sum, 0, sizeof sum);
    if (bent)
        memset(X, 0, 24 * sizeof *X);
    for (int i = 0; i < 3; ++i)
        apart[i] = left->r[i] - right->r[i];
    for (int64_t l = 0; l < L; ++l) {
        const v z = left->t * hL[l];
        v from[3], f[3], h[2][6];
        memset(f, 0, sizeof f), memset(h, 0, sizeof h);
        for (int i = 0; i < 3; ++i)
            from[i] = apart[i] + z * left->n[i];
        for (int64_t s = 0; s < S; ++s) {
            const v y = right->t * hR[s];
            v d[3], root;
            for (int i = 0; i < 3; ++i)
                d[i] = from[i] - y * right->n[i];
            const v square = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
            inverse_root(&square, &root);
            const v value = q[l] * p[s] * root, inverse = root * root, slope = value * inverse;
            sum += value;
            for (int i = 0; i < 3; ++i) {
                const v g = slope * d[i];
                f[i] -= g, W[i] += y * g;
            }
            if (!bent)
                continue;
            const v bend = 3.0 * slope * inverse;
            const v each[6] = {bend * d[0] * d[0] - slope, bend * d[1] * d[1] - slope, bend * d[2] * d[2] - slope,
                               bend * d[0] * d[1],         bend * d[0] * d[2],         bend * d[1] * d[2]};
            for (int i = 0; i < 6; ++i) {
                const v moment = y * each[i];
                h[0][i] += each[i], h[1][i] += moment, right->K[2][i] += y * moment;
            }
        }
        for (int i = 0; i < 3; ++i)
            F[i] += f[i], left->W[i] += z * f[i];
        for (int i = 0; i < 6 && bent; ++i) {
            const v first = z * h[0][i];
            left->K[1][i] += first, left->K[2][i] += z * first;
            X[i] += h[0][i], X[6 + i] += first, X[12 + i] += h[1][i], X[18 + i] += z * h[1][i];
        }
    }
    *energy += sum;
    for (int i = 0; i < 3; ++i)
        left->F[i] += F[i], right->F[i] -= F[i], right->W[i] += W[i];
    for (int i = 0; i < 6 && bent; ++i)
        left->K[0][i] += X[i], right->K[0][i] += X[i], right->K[1][i] += X[12 + i];
}

/* Add to A and B (9 k,) what X of `between` is by the nodes of the right cell, T (3, k). */
INLINE void mixed(int k, const v *T, const Point *right, const v *X, v *A, v *B)
{
    v a[2][3], b[2][3];
    for (int e = 0; e < 2; ++e)
        times(X + 12, right->up[e], a[e]), times(X + 18, right->up[e], b[e]);
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
            const v n = right->n[j], a0 = X[AT[i][j]], a1 = a[0][i] * n, a2 = a[1][i] * n;
            const v b0 = X[6 + AT[i][j]], b1 = b[0][i] * n, b2 = b[1][i] * n;
            v *one = A + (3 * i + j) * k, *other = B + (3 * i + j) * k;
            for (int l = 0; l < k; ++l) {
                one[l] += a0 * T[l] - a1 * T[k + l] - a2 * T[2 * k + l];
                other[l] += b0 * T[l] - b1 * T[k + l] - b2 * T[2 * k + l];
            }
        }
}

/* Add to HX (3 k, 3 k) what A and B are by the nodes of the left cell. */
INLINE void mix(int k, const v *T, const Point *left, const v *A, const v *B, v *HX)
{
    v C[2][3 * k];
    for (int e = 0; e < 2; ++e)
        for (int l = 0; l < 3 * k; ++l)
            C[e][l] = left->up[e][0] * B[l] + left->up[e][1] * B[3 * k + l] + left->up[e][2] * B[6 * k + l];
    for (int l = 0; l < k; ++l)
        for (int m = 0; m < 3 * k; ++m) {
            const v turned = T[k + l] * C[0][m] + T[2 * k + l] * C[1][m];
            for (int i = 0; i < 3; ++i)
                HX[(3 * l + i) * 3 * k + m] += left->n[i] * turned - T[l] * A[3 * i * k + m];
        }
}

/* Add the second derivatives H (k, 3, 3, k) by the nodes of two cells to blocks; see `pairs`. */
INLINE void put(int k, const double *H, int64_t one, int64_t other, double *blocks, const int32_t *where,
                int64_t columns, const int64_t *row_of, const int64_t *column_of, const double *first,
                const double *second)
{
    for (int l = 0; l < k; ++l)
        for (int m = 0; m < k; ++m) {
            const int64_t a = row_of[k * one + l], b = row_of[k * other + m];
            const int64_t i0 = column_of[k * one + l], j0 = column_of[k * other + m];
            double h[3][3];
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j)
                    h[i][j] = H[(3 * l + i) * 3 * k + j * k + m];
            for (int i = 0; i < 3 && a >= 0; ++i)
                for (int j = 0; j < 3; ++j)
                    blocks[9 * where[a * columns + j0] + 3 * i + j] +=
                        h[i][0] * second[j] + h[i][1] * second[3 + j] + h[i][2] * second[6 + j];
            for (int j = 0; j < 3 && b >= 0; ++j)
                for (int i = 0; i < 3; ++i)
                    blocks[9 * where[b * columns + i0] + 3 * j + i] +=
                        h[0][j] * first[i] + h[1][j] * first[3 + i] + h[2][j] * first[6 + i];
        }
}

/* Add the derivatives of a point of LANES elements to the sums of those (.., SUMS), `step` apart; `idle` ones are left out. */
INLINE void sum_up(const Point *p, int bent, int64_t idle, const int64_t *at, int64_t step, double *sums)
{
    const v *each = p->F;
    for (int c = 0; c < LANES - idle; ++c)
        for (int i = 0; i < (bent ? SUMS : 6); ++i)
            sums[step * at[c] + i] += each[i][c];
}

/* The energy of the first `counted` of `count` pairs of cells (count, 2), a multiple of LANES of which the last `idle`
   are none; nodes (cells, k, 3). On the first of each pair are P points with the tables TL (P, 3, k), heights hL (P, L),
   thickness tL (rows, P) and charges qL (rows, P, L), in the row eL (count,); the derivatives at its points are added to
   sL (rows, P, SUMS). On the second are M points for each of these, TR (P, M, 3, k), hR (P, M, S), tR (rows, P, M),
   qR (rows, P, M, S), eR; their derivatives are added to gradient (cells, k, 3) and `onto`, see `own`. Or `same` ones
   for all: without the axis P, and added to sR (rows, M, SUMS). Unless `onto` is NULL, second derivatives by the nodes of
   both cells times `factor` are added to blocks (.., 3, 3), to that with the number in `where` (rows, columns): in the row
   row_of (cells, k) if that is not negative, and the column column_of (cells, k) of the node that a copy is the image of
   by turn (copies, 3, 3); each copy has `modelled` cells. */
FAST double pairs(int64_t count, int64_t counted, int64_t idle, const int64_t *both, int64_t nodes_of_cell,
                  const double *nodes, int64_t P, int64_t L, const double *TL, const double *hL, const double *tL,
                  const double *qL, double *sL, const int64_t *eL, int64_t M, int64_t S, const double *TR,
                  const double *hR, const double *tR, const double *qR, double *sR, const int64_t *eR, int64_t same,
                  double *gradient, double factor, double *onto, double *blocks, const int32_t *where, int64_t columns,
                  const int64_t *row_of, const int64_t *column_of, const double *turn, int64_t modelled)
{
    const int k = (int)nodes_of_cell, half = 9 * k * (k + 1) / 2, bent = onto != 0;
    const int64_t all = same ? M : P * M;
    double energy = 0.0;
    Point points[same ? M : 1];
    v QR[same ? M * S : S], XL[3 * k], XR[3 * k], GR[3 * k], A[9 * k], B[9 * k];
    v T[3 * k], first[3 * k], HR[bent && !same ? half : 1], HX[bent ? 9 * k * k : 1];
    for (int64_t at = 0; at < count; at += LANES) {
        v sum, live, q[L];
        memset(&sum, 0, sizeof sum), memset(GR, 0, sizeof GR);
        memset(HR, 0, sizeof HR), memset(HX, 0, sizeof HX);
        int64_t left_cell[LANES], right_cell[LANES];
        const int64_t none = at + LANES == count ? idle : 0;
        for (int c = 0; c < LANES; ++c) {
            left_cell[c] = both[2 * (at + c)], right_cell[c] = both[2 * (at + c) + 1];
            live[c] = c < LANES - none ? 1.0 : 0.0;
        }
        for (int l = 0; l < 3 * k; ++l)
            gather(nodes + l, 3 * k, left_cell, XL + l), gather(nodes + l, 3 * k, right_cell, XR + l);
        if (same)
            for (int64_t m = 0; m < M; ++m) {
                spread(3 * k, TR + m * 3 * k, T);
                place(k, T, XR, bent, points + m);
                gather(tR + m, M, eR + at, &points[m].t);
                for (int64_t s = 0; s < S; ++s)
                    gather(qR + m * S + s, M * S, eR + at, QR + m * S + s);
            }
        for (int64_t p = 0; p < P; ++p) {
            Point left;
            spread(3 * k, TL + p * 3 * k, first);
            place(k, first, XL, bent, &left);
            gather(tL + p, P, eL + at, &left.t);
            for (int64_t l = 0; l < L; ++l) {
                gather(qL + p * L + l, P * L, eL + at, q + l);
                q[l] *= live;
            }
            if (bent)
                memset(A, 0, sizeof A), memset(B, 0, sizeof B);
            for (int64_t m = 0; m < M; ++m) {
                const int64_t row = same ? m : p * M + m;
                Point *right = same ? points + m : points;
                v *charges = same ? QR + m * S : QR, X[24];
                const double *from = hL + p * L, *to = hR + row * S;
                if (!same || bent)
                    spread(3 * k, TR + row * 3 * k, T);
                if (!same) {
                    place(k, T, XR, bent, right);
                    gather(tR + row, all, eR + at, &right->t);
                    for (int64_t s = 0; s < S; ++s)
                        gather(qR + row * S + s, all * S, eR + at, charges + s);
                }
                if (L == 2 && S == 2 && !bent)
                    between(2, 2, 0, &left, q, from, right, charges, to, &sum, X);
                else if (L == 2 && S == 2)
                    between(2, 2, 1, &left, q, from, right, charges, to, &sum, X);
                else
                    between(L, S, bent, &left, q, from, right, charges, to, &sum, X);
                if (!same)
                    own(k, T, right, GR, bent ? HR : 0);
                if (!bent)
                    continue;
                mixed(k, T, right, X, A, B);
            }
            sum_up(&left, bent, none, eL + at, P * SUMS, sL + p * SUMS);
            if (!bent)
                continue;
            mix(k, first, &left, A, B, HX);
        }
        for (int64_t m = 0; m < M && same; ++m)
            sum_up(points + m, bent, none, eR + at, M * SUMS, sR + m * SUMS);
        for (int c = 0; c < LANES - none; ++c) {
            energy += at + c < counted ? sum[c] : 0.0;
            double *to = gradient + 3 * k * right_cell[c];
            for (int l = 0; l < 3 * k && !same; ++l)
                to[l] += GR[l][c];
            if (!bent)
                continue;
            to = onto + half * right_cell[c];
            for (int l = 0; l < half && !same; ++l)
                to[l] += HR[l][c];
            double cross_block[9 * k * k];
            for (int l = 0; l < 9 * k * k; ++l)
                cross_block[l] = factor * HX[l][c];
            const int64_t one = left_cell[c], other = right_cell[c];
            put(k, cross_block, one, other, blocks, where, columns, row_of, column_of, turn + 9 * (one / modelled),
                turn + 9 * (other / modelled));
        }
    }
    return energy;
}

/* What sums (count, P, SUMS) of derivatives at points of elements in cells (count,) add to gradient (cells, k, 3) and,
   unless NULL, to `onto` (cells, a <= b, 3, 3); count is a multiple of LANES, the last `idle` are none. */
FAST void points(int64_t count, int64_t idle, const int64_t *cells, int64_t nodes_of_cell, const double *nodes, int64_t P,
                 const double *T, const double *sums, double *gradient, double *onto)
{
    const int k = (int)nodes_of_cell, half = 9 * k * (k + 1) / 2;
    v X[3 * k], G[3 * k], H[onto ? half : 1];
    for (int64_t at = 0; at < count; at += LANES) {
        int64_t of[LANES];
        const int64_t none = at + LANES == count ? idle : 0;
        for (int c = 0; c < LANES; ++c)
            of[c] = c < LANES - none ? at + c : at;
        for (int l = 0; l < 3 * k; ++l)
            gather(nodes + l, 3 * k, cells + at, X + l);
        memset(G, 0, sizeof G), memset(H, 0, sizeof H);
        for (int64_t p = 0; p < P; ++p) {
            Point point;
            v each_of[3 * k];
            spread(3 * k, T + p * 3 * k, each_of);
            place(k, each_of, X, onto != 0, &point);
            v *each = point.F;
            for (int i = 0; i < (onto ? SUMS : 6); ++i)
                gather(sums + p * SUMS + i, P * SUMS, of, each + i);
            own(k, each_of, &point, G, onto ? H : 0);
        }
        for (int c = 0; c < LANES - none; ++c) {
            for (int l = 0; l < 3 * k; ++l)
                gradient[3 * k * cells[at + c] + l] += G[l][c];
            for (int l = 0; l < half && onto; ++l)
                onto[half * cells[at + c] + l] += H[l][c];
        }
    }
}
