/* The places of cells that are nearest to points; nearest.py says what for. All vectors have four components, the last one
   zero where the thickness is no unknown; cells are polynomials of both coordinates of the reference triangle. */
#include <math.h>
#include <string.h>

#define DEGREE 8          /* of cells at most */
#define ROUNDS 30         /* Newton's steps at most */
#define EXACT 1e-10       /* after a smaller step, in the reference cell, the place is exact: steps converge quadratically */
#define INWARDS 1e-17     /* a smaller change of a barycentric coordinate leads to no side */
#define FLAT 1e-3         /* of the determinant of a plane's Hessian: below it the step takes the plane's */
#define ON_SIDE 1e-12     /* a barycentric coordinate that is zero */
#define BELOW 0.5         /* the sine of an angle between a surface and the way from a place to a point that is above it */
#define BOUNDS 6          /* numbers of a cell */

typedef double v __attribute__((vector_size(32), aligned(8)));

INLINE double dot(const v *a, const v *b)
{
    const v c = *a * *b;
    return c[0] + c[1] + c[2] + c[3];
}

/* A polynomial at a place X (2,), with its derivatives by the first coordinate, the second, and both twice. */
INLINE void jets(int degree, const v *of, const double *X, v *y)
{
    double x[3][DEGREE + 1], z[3][DEGREE + 1]; /* powers and their derivatives */
    for (int n = 0; n <= degree; ++n) {
        x[0][n] = n ? x[0][n - 1] * X[0] : 1.0, z[0][n] = n ? z[0][n - 1] * X[1] : 1.0;
        for (int d = 1; d < 3; ++d)
            x[d][n] = n ? n * x[d - 1][n - 1] : 0.0, z[d][n] = n ? n * z[d - 1][n - 1] : 0.0;
    }
    memset(y, 0, 6 * sizeof *y);
    for (int n = 0; n <= degree; ++n)
        for (int j = 0; j <= n; ++j, ++of) {
            y[0] += *of * (x[0][n - j] * z[0][j]);
            y[1] += *of * (x[1][n - j] * z[0][j]), y[2] += *of * (x[0][n - j] * z[1][j]);
            y[3] += *of * (x[2][n - j] * z[0][j]), y[4] += *of * (x[1][n - j] * z[1][j]);
            y[5] += *of * (x[0][n - j] * z[2][j]);
        }
}

/* Gradient g (2,) and Hessian A (xx, xy, yy) of half the square of the distance, see `slopes`, with that of a plane where it
   is not convex; y (6,) are the jets there, `off` the point less the place, with its length last. The distance is returned. */
INLINE double convex(int degree, const v *of, const v *x, const double *X, v *y, v *off, double *g, double *A)
{
    static const v SIGNS = {1.0, 1.0, 1.0, -1.0};
    jets(degree, of, X, y);
    *off = *x - y[0];
    const double length = sqrt((*off)[0] * (*off)[0] + (*off)[1] * (*off)[1] + (*off)[2] * (*off)[2]);
    const double distance = length + (*off)[3];
    (*off)[3] = length;
    g[0] = -dot(off, y + 1), g[1] = -dot(off, y + 2);
    const v z1 = y[1] * SIGNS, z2 = y[2] * SIGNS;
    const double E = dot(y + 1, &z1), F = dot(y + 1, &z2), G = dot(y + 2, &z2);
    A[0] = E - dot(off, y + 3), A[1] = F - dot(off, y + 4), A[2] = G - dot(off, y + 5);
    if (A[0] * A[2] - A[1] * A[1] < FLAT * (E * G - F * F) || A[0] + A[2] <= 0.0)
        A[0] = E, A[1] = F, A[2] = G;
    return distance;
}

/* The directions (2, 2) as columns in which a place can move, see `Places`, and Newton's step (2,) in these.

   From a side or a corner a place goes inside if Newton's step does; else along a side if the distance falls there. */
INLINE void freed(const double *X, const double *g, const double *A, double *free, double *step)
{
    static const double CORNERS[3][2] = {{0.0, 0.0}, {1.0, 0.0}, {0.0, 1.0}};
    const double det = A[0] * A[2] - A[1] * A[1];
    step[0] = -(A[2] * g[0] - A[1] * g[1]) / det, step[1] = -(A[0] * g[1] - A[1] * g[0]) / det;
    const double coordinates[3] = {1.0 - (X[0] + X[1]), X[0], X[1]}, inward[3] = {-step[0] - step[1], step[0], step[1]};
    int on[3], sides = 0, out = 0;
    for (int i = 0; i < 3; ++i)
        on[i] = coordinates[i] <= ON_SIDE, sides += on[i], out |= on[i] && inward[i] < 0.0;
    free[0] = free[3] = 1.0, free[1] = free[2] = 0.0;
    if (!out)
        return;
    double best = 0.0, way[2] = {0.0, 0.0}, far = 0.0;
    for (int from = 0; from < 3; ++from)
        for (int to = 0; to < 3; ++to) {
            const int side = 3 - from - to; /* the ways from a corner, or along a side */
            if (to == from || !on[side] || (sides == 1 ? from > to : on[from]))
                continue;
            const double a = CORNERS[to][0] - CORNERS[from][0], b = CORNERS[to][1] - CORNERS[from][1];
            const double slope = g[0] * a + g[1] * b, bend = A[0] * a * a + 2.0 * A[1] * a * b + A[2] * b * b;
            const double gain = slope < 0.0 ? slope * slope / bend : 0.0;
            if (sides == 1 || (gain > 0.0 && gain >= best))
                best = gain, way[0] = a, way[1] = b, far = -slope / bend;
        }
    free[0] = way[0], free[2] = way[1], free[3] = 0.0;
    step[0] = far * way[0], step[1] = far * way[1];
}

/* The place X (2,) of a cell that is nearest to a point, near the given one: Newton's method for half the square of the
   distance, in the sides of the triangle where these are in the way. The distance is returned, `way` (3,) is the direction
   from there to the point, `above` whether that is above the surface. */
INLINE double nearest_in(int degree, const v *of, const v *x, double *X, double *free, double *way, uint8_t *above)
{
    double g[2], A[3], step[2], distance;
    v y[6], off;
    for (int round = 0, moving = 1;; ++round) {
        distance = convex(degree, of, x, X, y, &off, g, A);
        freed(X, g, A, free, step);
        if (!moving || round == ROUNDS)
            break;
        const double change[3] = {-step[0] - step[1], step[0], step[1]};
        double at[3] = {1.0 - (X[0] + X[1]), X[0], X[1]}, part = 1.0;
        int side = -1;
        for (int i = 0; i < 3; ++i) {
            const double room = change[i] < -INWARDS ? -at[i] / change[i] : INFINITY;
            if (room <= 1.0 && (side < 0 || room < part))
                part = room, side = i;
        }
        at[1] = X[0] + part * step[0], at[2] = X[1] + part * step[1], at[0] = 1.0 - (at[1] + at[2]);
        for (int i = 0; i < 3; ++i)
            at[i] = i == side || fabs(at[i]) < ON_SIDE ? 0.0 : at[i];
        const double all = at[0] + at[1] + at[2], before[2] = {X[0], X[1]};
        X[1] = at[2] / all, X[0] = at[0] ? at[1] / all : 1.0 - X[1]; /* exactly on the side */
        moving = !(fabs(X[0] - before[0]) <= EXACT && fabs(X[1] - before[1]) <= EXACT);
    }
    double high = 0.0, size = 0.0;
    for (int i = 0; i < 3; ++i) {
        const int j = (i + 1) % 3, k = (i + 2) % 3;
        const double normal = y[1][j] * y[2][k] - y[1][k] * y[2][j];
        way[i] = off[i] / fmax(off[3], 1e-300);
        high += way[i] * normal, size += normal * normal;
    }
    *above = fabs(high) > BELOW * sqrt(size);
    return distance;
}

/* The number of a lattice's place that is nearest to a point, of places (3, count); the square of its distance. */
INLINE int64_t nearest_of(int64_t count, const double *places, const double *x, double *least)
{
    double away[count];
    for (int64_t m = 0; m < count; ++m) {
        const double a = places[m] - x[0], b = places[count + m] - x[1], c = places[2 * count + m] - x[2];
        away[m] = a * a + b * b + c * c;
    }
    int64_t best = 0;
    for (int64_t m = 1; m < count; ++m)
        best = away[m] < away[best] ? m : best;
    *least = away[best];
    return best;
}

/* Cells of a degree by their monomials (cells, .., 4), with the places (cells, 3, count) of a coarse lattice and of a fine
   one, which is X (count, 2). Bounds are centre and radius of a sphere around each, and what no place of it is farther than
   from all those of the lattices. Those of the undeformed surface are of its monomials. */
typedef struct {
    int64_t degree, coarse_count, count;
    const double *of, *undeformed, *coarse, *fine, *X, *bounds;
} Cells;

/* The places nearest to points x (.., 4) that are nearer than `within`: of each pair of a cell with points order[first] to
   order[first + number - 1], near them by less than a `reach` of mid-surfaces, which in pairs that `is_bounded` is at
   most the limit of each point. Where cells are near in the surface, places count that are below their points and
   farther than `apart` mean thicknesses from x0 undeformed, of which the last components, of points with the other
   sign, are half. Their number is returned. */
FAST int64_t nearest(const Cells *all, int64_t pairs, const int64_t *cell, const int64_t *first, const int64_t *number,
                     const uint8_t *near, const uint8_t *is_bounded, const double *limits,
                     const int64_t *order, const double *x, const double *x0, double reach_of_all,
                     double within, double apart, int64_t *point, int64_t *pair, double *X, double *free,
                     double *distance, double *way, uint8_t *above)
{
    const int degree = (int)all->degree;
    const int64_t k = (all->degree + 1) * (all->degree + 2) / 2;
    int64_t found = 0;
    for (int64_t p = 0; p < pairs; ++p) {
        const double *bounds = all->bounds + BOUNDS * cell[p];
        const v *of = (const v *)all->of + k * cell[p], *undeformed = (const v *)all->undeformed + k * cell[p];
        for (int64_t n = first[p]; n < first[p] + number[p]; ++n) {
            const double reach = is_bounded[p] ? fmin(reach_of_all, limits[order[n]]) : reach_of_all;
            const double *at = x + 4 * order[n], away[3] = {at[0] - bounds[0], at[1] - bounds[1], at[2] - bounds[2]};
            const double far = reach + bounds[3];
            if (away[0] * away[0] + away[1] * away[1] + away[2] * away[2] >= far * far)
                continue;
            double least, *place = X + 2 * found;
            nearest_of(all->coarse_count, all->coarse + 3 * all->coarse_count * cell[p], at, &least);
            if (!(sqrt(least) < reach + bounds[4]))
                continue;
            const int64_t start = nearest_of(all->count, all->fine + 3 * all->count * cell[p], at, &least);
            if (!(sqrt(least) < reach + bounds[5]))
                continue;
            place[0] = all->X[2 * start], place[1] = all->X[2 * start + 1];
            distance[found] = nearest_in(degree, of, (const v *)at, place, free + 4 * found, way + 3 * found, above + found);
            if (!(distance[found] < within))
                continue;
            if (near[p]) {
                v y[6];
                jets(degree, undeformed, place, y);
                const v off = *((const v *)x0 + order[n]) - y[0];
                const double far_off = off[0] * off[0] + off[1] * off[1] + off[2] * off[2];
                if (!above[found] || far_off <= apart * apart * off[3] * off[3])
                    continue;
            }
            point[found] = order[n], pair[found++] = p;
        }
    }
    return found;
}

/* Places x (count, 4) of points with shape functions (count, k) in cells that have nodes (.., k) at r (.., 4). */
FAST void places(int64_t count, int64_t k, const int64_t *cell, const int64_t *nodes, const double *shape, const double *r,
                 double *x)
{
    for (int64_t n = 0; n < count; ++n) {
        v sum = {0.0};
        for (int64_t i = 0; i < k; ++i)
            sum += *((const v *)r + nodes[k * cell[n] + i]) * shape[k * n + i];
        *((v *)x + n) = sum;
    }
}
