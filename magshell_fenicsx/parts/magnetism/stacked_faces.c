/* Faces of cells that lie close above each other; stacked_faces.py says what for. Each point of the first cell sees the second in
   polar coordinates about its foot. Compiled behind pairs.c. */
#define GAUSS 24                  /* points of the longest of Gauss's rules that are at hand */
#define MOST (3 * GAUSS * GAUSS)  /* points that a place sees of a cell at most */
#define STEPS 4                   /* to a foot */
#define TINY 1e-12

/* Monomials of both coordinates of the reference triangle up to a degree, and their derivatives. */
INLINE void monomials(int degree, v x, v y, v *f, v *fx, v *fy)
{
    int at = 1, before = 0;
    f[0] = 1.0 + (v){0.0};
    if (fx)
        fx[0] = fy[0] = (v){0.0};
    for (int n = 1; n <= degree; before += n, ++n)
        for (int j = 0; j <= n; ++j, ++at) {
            f[at] = j < n ? x * f[before + j] : y * f[before + j - 1];
            if (!fx)
                continue;
            fx[at] = j < n ? (double)(n - j) * f[before + j] : (v){0.0};
            fy[at] = j > 0 ? (double)j * f[before + j - 1] : (v){0.0};
        }
}

typedef struct {
    int64_t count;
    double x[MOST + LANES], y[MOST + LANES], w[MOST + LANES];
} Fan;

/* Points of Gauss's rule for what has its pole at a height of pi/2 over an interval. */
INLINE int enough(double precision, double length)
{
    if (!(precision < 1.0))
        return 2;
    const int n = 2 + (int)ceil(-log(precision) / (2.0 * asinh(M_PI / length)));
    return n < GAUSS ? n : GAUSS;
}

/* The reference triangle from a foot (2,) on it or beside it, at a height s, with the metric of both tangents there. It is
   the sum of the triangles between the foot and a side, with a negative weight where that is behind it. */
static void fan(const double *one, const double *two, const double *foot, double s, const double *gauss,
                double precision, Fan *to)
{
    static const int ENDS[3][2] = {{1, 2}, {2, 0}, {0, 1}};
    double E = 0.0, F = 0.0, G = 0.0, V[3][2];
    for (int i = 0; i < 3; ++i)
        E += one[i] * one[i], F += one[i] * two[i], G += two[i] * two[i];
    const double a = sqrt(E), b = F / a, c = sqrt(G - b * b);
    for (int i = 0; i < 3; ++i) {
        const double x = (i == 1) - foot[0], y = (i == 2) - foot[1];
        V[i][0] = a * x + b * y, V[i][1] = c * y;
    }
    to->count = 0;
    for (int side = 0; side < 3; ++side) {
        const double *A = V[ENDS[side][0]], *B = V[ENDS[side][1]];
        double along[2] = {B[0] - A[0], B[1] - A[1]};
        const double size = hypot(along[0], along[1]);
        along[0] /= size, along[1] /= size;
        const double off = A[0] * along[1] - A[1] * along[0], p = fabs(off);
        if (p < TINY * size)
            continue;
        const double P = hypot(p, s);
        const double from = asinh((A[0] * along[0] + A[1] * along[1]) / P);
        const double turn = asinh((B[0] * along[0] + B[1] * along[1]) / P) - from;
        const int rays = enough(precision * P / p, turn);
        for (int i = 0; i < rays; ++i) {
            const double *rule = gauss + rays * (rays - 1), t = P * sinh(from + turn * rule[2 * i]);
            const double R = hypot(p, t), top = asinh(R / s);
            const double angle = off * hypot(P, t) / (R * R) * turn * rule[2 * i + 1];
            const double X = (off * along[1] + t * along[0]) / R, Y = (t * along[1] - off * along[0]) / R;
            const int n = enough(precision, top);
            for (int j = 0; j < n; ++j) {
                const double *radial = gauss + n * (n - 1) + 2 * j, e = exp(top * radial[0]);
                const double r = s * (e - 1.0 / e) / 2.0, dr = s * (e + 1.0 / e) / 2.0 * top * radial[1];
                const double y = r * Y / c;
                to->x[to->count] = foot[0] + (r * X - b * y) / a, to->y[to->count] = foot[1] + y;
                to->w[to->count++] = angle * r * dr / (a * c);
            }
        }
    }
    if (!to->count)
        to->x[0] = foot[0], to->y[0] = foot[1], to->w[0] = 0.0, to->count = 1;
    for (int64_t at = to->count; at % LANES; ++at)
        to->x[at] = to->x[0], to->y[at] = to->y[0], to->w[at] = 0.0;
}

/* What all pairs have: k nodes of a cell, its shape functions from monomials up to `degree`, charges and thickness of each
   cell from those up to `of_charges` (cells, .., S) and (cells, ..), heights over the thickness (S,); P points of the first
   cell with T (P, 3, k), X (P, 2) and weights; Gauss's rules one after the other; h, and in parts of it how deep the first
   layer of a face is, how near to a face that comes at least, and how near mid-surfaces are in each other. */
typedef struct {
    int64_t k, degree;
    const double *shape;
    int64_t of_charges, S;
    const double *charges, *thickness, *heights;
    int64_t P;
    const double *T, *X, *weights, *gauss;
    double h, depth, least, inside, precision;
} Cells;

/* The number of monomials of charges and of the thickness. */
INLINE int number_of(const Cells *all)
{
    return (int)((all->of_charges + 1) * (all->of_charges + 2) / 2);
}

/* A polynomial (.., step) of lanes. */
INLINE void polynomial(int count, int64_t step, const double *of, const v *f, v *value)
{
    memset(value, 0, step * sizeof *value);
    for (int i = 0; i < count; ++i)
        for (int64_t s = 0; s < step; ++s)
            value[s] += of[i * step + s] * f[i];
}

/* Place, tangents (3, 3) and normal (3,) of a cell. */
INLINE void surface(int k, const v *T, const double *nodes, double a[3][3], double *n)
{
    memset(a, 0, 9 * sizeof(double));
    for (int d = 0; d < 3; ++d)
        for (int l = 0; l < k; ++l)
            for (int i = 0; i < 3; ++i)
                a[d][i] += T[d * k + l][0] * nodes[3 * l + i];
    for (int i = 0; i < 3; ++i)
        n[i] = a[1][(i + 1) % 3] * a[2][(i + 2) % 3] - a[1][(i + 2) % 3] * a[2][(i + 1) % 3];
    const double size = sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]);
    for (int i = 0; i < 3; ++i)
        n[i] /= size;
}

INLINE double dot(const double *a, const double *b)
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/* The foot (2,) of a place on a cell with monomials (.., 3), or on what it would be beyond its sides; a and n as of
   `surface` there. */
INLINE void foot_of(const Cells *all, const double *of, const double *x, double *foot, double a[3][3], double *n)
{
    const int k = (int)all->k;
    v T[3 * k];
    for (int step = 0;; ++step) {
        monomials((int)all->degree, foot[0] + (v){0.0}, foot[1] + (v){0.0}, T, T + k, T + 2 * k);
        surface(k, T, of, a, n);
        if (step == STEPS)
            return;
        const double off[3] = {x[0] - a[0][0], x[1] - a[0][1], x[2] - a[0][2]};
        const double E = dot(a[1], a[1]), F = dot(a[1], a[2]), G = dot(a[2], a[2]), D = E * G - F * F;
        const double one = dot(a[1], off), two = dot(a[2], off);
        foot[0] += (G * one - F * two) / D, foot[1] += (E * two - F * one) / D;
    }
}

/* What a point of the first cell (k, 3), with T there, sees of the second, by its monomials. `inward` gets 1 where the normal
   leads away from the second, else -1, and `shift` how far the charges are moved that way, so that their first layer is just
   outside of the second. The return value is 1 if both are in each other. */
static int seen(const Cells *all, const v *T, const double *first, const double *second, double t,
                int64_t other, Fan *to, double *inward, double *shift)
{
    const int count = number_of(all);
    double a[3][3], n[3], b[3][3], m[3], x[3], foot[2] = {1.0 / 3.0, 1.0 / 3.0};
    surface((int)all->k, T, first, a, n);
    foot_of(all, second, a[0], foot, b, m);
    for (int i = 0; i < 3; ++i)
        x[i] = a[0][i] - b[0][i];
    const double up = dot(x, m) < 0.0 ? -1.0 : 1.0, away = dot(x, n) < 0.0 ? -1.0 : 1.0;
    for (int i = 0; i < 3; ++i)
        x[i] = a[0][i] - away * fabs(t) / 2.0 * n[i];
    foot_of(all, second, x, foot, b, m);
    for (int i = 0; i < 3; ++i)
        x[i] -= b[0][i];
    v f[count], thick;
    monomials((int)all->of_charges, foot[0] + (v){0.0}, foot[1] + (v){0.0}, f, 0, 0);
    polynomial(count, 1, all->thickness + other * count, f, &thick);
    const double gap = up * dot(x, m) - fabs(thick[0]) / 2.0, least = all->least * all->h;
    const double layer = gap + all->depth * all->h;
    const int over = foot[0] > 0.0 && foot[1] > 0.0 && foot[0] + foot[1] < 1.0;
    if (over && gap < -all->inside * all->h)
        return 1;
    *inward = away, *shift = over && layer < least ? least - layer : 0.0;
    fan(b[1], b[2], foot, fmax(fabs(layer + *shift), least), all->gauss, all->precision, to);
    return 0;
}

/* Charges (S + 2,) of a point of the first cell, and their heights over its thickness t, from those of its layers (S,): the
   face that is near the other cell is in three layers below it, from where it is extrapolated. */
INLINE void layered(const Cells *all, v *q, double t, double inward, double shift, double *heights)
{
    const int S = (int)all->S, near = inward * t < 0.0 ? 0 : 1;
    for (int s = 0; s < S; ++s)
        heights[s] = all->heights[s] + inward * shift / t;
    for (int j = 0; j < 3; ++j) {
        const int s = j ? S - 1 + j : near;
        heights[s] = all->heights[near] + inward * (shift + (j + 1) * all->depth * all->h) / t;
        q[s] = (j == 1 ? -1.0 : j ? 1.0 / 3.0 : 3.0) * q[near];
    }
}

INLINE double total(const v *x)
{
    double sum = 0.0;
    for (int c = 0; c < LANES; ++c)
        sum += (*x)[c];
    return sum;
}

/* The monomials (k, 3) of a cell from its nodes. */
INLINE void of_monomials(const Cells *all, const double *nodes, double *of)
{
    const int k = (int)all->k;
    memset(of, 0, 3 * k * sizeof *of);
    for (int i = 0; i < k; ++i)
        for (int l = 0; l < k; ++l)
            for (int c = 0; c < 3; ++c)
                of[3 * i + c] += all->shape[i * k + l] * nodes[3 * l + c];
}

/* From derivatives by monomials (k, 3) those by nodes, added. */
INLINE void back(const Cells *all, const v *of, double *to)
{
    const int k = (int)all->k;
    for (int i = 0; i < k; ++i)
        for (int c = 0; c < 3; ++c) {
            const double by = total(of + 3 * i + c);
            for (int l = 0; l < k; ++l)
                to[3 * l + c] += all->shape[i * k + l] * by;
        }
}

/* The same of second derivatives (a <= b, 3, 3). */
INLINE void back_twice(const Cells *all, const v *of, double *to)
{
    const int k = (int)all->k;
    double full[k][k][9], half[k][k][9];
    for (int i = 0; i < k; ++i)
        for (int j = i; j < k; ++j)
            for (int c = 0; c < 9; ++c, ++of)
                full[j][i][3 * (c % 3) + c / 3] = full[i][j][c] = total(of);
    memset(half, 0, sizeof half);
    for (int i = 0; i < k; ++i)
        for (int l = 0; l < k; ++l)
            for (int j = 0; j < k; ++j)
                for (int c = 0; c < 9; ++c)
                    half[l][j][c] += all->shape[i * k + l] * full[i][j][c];
    for (int l = 0; l < k; ++l)
        for (int m = l; m < k; ++m, to += 9)
            for (int j = 0; j < k; ++j)
                for (int c = 0; c < 9; ++c)
                    to[c] += all->shape[j * k + m] * half[l][j][c];
}

/* The energy of pairs of cells (count, 2); see `pairs`. It is no number if two are in each other. */
FAST double close_pairs(const Cells *all, int64_t count, const int64_t *both, const double *nodes, double *gradient,
                  double factor, double *onto, double *blocks, const int32_t *where, int64_t columns,
                  const int64_t *row_of, const int64_t *column_of, const double *turn, int64_t modelled)
{
    const int k = (int)all->k, half = 9 * k * (k + 1) / 2, bent = onto != 0, S = (int)all->S, L = S + 2;
    const int number = number_of(all);
    double energy = 0.0, H[bent ? 9 * k * k : 1], heights[L];
    v XL[3 * k], XR[3 * k], GL[3 * k], GR[3 * k], TL[3 * k], TR[3 * k], A[9 * k], B[9 * k], q[L], of_right[S], f[number];
    v HL[bent ? half : 1], HR[bent ? half : 1], HX[bent ? 9 * k * k : 1], X[24], sum, thick;
    Fan points;
    for (int64_t pair = 0; pair < count; ++pair) {
        const int64_t one = both[2 * pair], other = both[2 * pair + 1];
        const double *first = nodes + 3 * k * one;
        double second[3 * k];
        of_monomials(all, nodes + 3 * k * other, second);
        spread(3 * k, first, XL), spread(3 * k, second, XR);
        memset(&sum, 0, sizeof sum), memset(GL, 0, sizeof GL), memset(GR, 0, sizeof GR);
        memset(HL, 0, sizeof HL), memset(HR, 0, sizeof HR), memset(HX, 0, sizeof HX);
        for (int64_t p = 0; p < all->P; ++p) {
            Point left, right;
            spread(3 * k, all->T + 3 * k * p, TL);
            place(k, TL, XL, bent, &left);
            monomials((int)all->of_charges, all->X[2 * p] + (v){0.0}, all->X[2 * p + 1] + (v){0.0}, f, 0, 0);
            polynomial(number, S, all->charges + one * number * S, f, q);
            polynomial(number, 1, all->thickness + one * number, f, &left.t);
            double inward, shift;
            if (seen(all, TL, first, second, left.t[0], other, &points, &inward, &shift))
                return NAN;
            for (int s = 0; s < S; ++s)
                q[s] *= all->weights[p];
            layered(all, q, left.t[0], inward, shift, heights);
            memset(A, 0, sizeof A), memset(B, 0, sizeof B);
            for (int64_t at = 0; at < points.count; at += LANES) {
                v x, y, w;
                memcpy(&x, points.x + at, sizeof x), memcpy(&y, points.y + at, sizeof y);
                memcpy(&w, points.w + at, sizeof w);
                monomials((int)all->degree, x, y, TR, TR + k, TR + 2 * k);
                place(k, TR, XR, bent, &right);
                monomials((int)all->of_charges, x, y, f, 0, 0);
                polynomial(number, S, all->charges + other * number * S, f, of_right);
                polynomial(number, 1, all->thickness + other * number, f, &thick);
                right.t = thick;
                for (int s = 0; s < S; ++s)
                    of_right[s] *= w;
                if (S == 2 && !bent)
                    between(4, 2, 0, &left, q, heights, &right, of_right, all->heights, &sum, X);
                else if (S == 2)
                    between(4, 2, 1, &left, q, heights, &right, of_right, all->heights, &sum, X);
                else
                    between(L, S, bent, &left, q, heights, &right, of_right, all->heights, &sum, X);
                own(k, TR, &right, GR, bent ? HR : 0);
                if (bent)
                    mixed(k, TR, &right, X, A, B);
            }
            own(k, TL, &left, GL, bent ? HL : 0);
            if (bent)
                mix(k, TL, &left, A, B, HX);
        }
        energy += total(&sum);
        for (int l = 0; l < 3 * k; ++l)
            gradient[3 * k * one + l] += total(GL + l);
        back(all, GR, gradient + 3 * k * other);
        if (!bent)
            continue;
        for (int l = 0; l < half; ++l)
            onto[half * one + l] += total(HL + l);
        back_twice(all, HR, onto + half * other);
        memset(H, 0, sizeof H);
        for (int row = 0; row < 9 * k; ++row)
            for (int i = 0; i < k; ++i) {
                const double of = factor * total(HX + row * k + i);
                for (int l = 0; l < k; ++l)
                    H[row * k + l] += of * all->shape[i * k + l];
            }
        put(k, H, one, other, blocks, where, columns, row_of, column_of, turn + 9 * (one / modelled),
            turn + 9 * (other / modelled));
    }
    return energy;
}

/* What the points of the first cell of a pair see of the second: how many points each (P,), their places (P, most, 2) and
   weights (P, most), and `inward` and `shift` (P,); the rest is left as it is. The return value is 1 if both are in each other. */
int64_t seen_of(const Cells *all, int64_t one, int64_t other, const double *nodes, int64_t most, int64_t *count,
                double *x, double *w, double *inward, double *shift)
{
    const int k = (int)all->k, number = number_of(all);
    Fan points;
    double second[3 * k];
    of_monomials(all, nodes + 3 * k * other, second);
    for (int64_t p = 0; p < all->P; ++p) {
        v T[3 * k], f[number], t;
        spread(3 * k, all->T + 3 * k * p, T);
        monomials((int)all->of_charges, all->X[2 * p] + (v){0.0}, all->X[2 * p + 1] + (v){0.0}, f, 0, 0);
        polynomial(number, 1, all->thickness + one * number, f, &t);
        if (seen(all, T, nodes + 3 * k * one, second, t[0], other, &points, inward + p, shift + p))
            return 1;
        count[p] = points.count;
        for (int64_t m = 0; m < points.count; ++m) {
            x[2 * (p * most + m)] = points.x[m], x[2 * (p * most + m) + 1] = points.y[m];
            w[p * most + m] = points.w[m];
        }
    }
    return 0;
}
