/* Entities' matrices into the rows of a matrix of (3, 3) blocks; scatter.py says how these lie. */

typedef struct {
    double *values;
    const int32_t *starts; /* first block of every row */
    int32_t owned;         /* nodes */
} Rows;

/* Add a block, or its transpose, at nodes i, j; there is none (-1) at held nodes. */
static inline void add(const Rows *A, int32_t i, int32_t j, int32_t block, const double K[3][3], int transposed)
{
    if (block < 0)
        return;
    const int32_t *start = A->starts + i + (i >= A->owned || j >= A->owned ? A->owned : 0);
    const int64_t width = 3 * (int64_t)(start[1] - start[0]);
    double *to = A->values + 6 * (int64_t)start[0] + 3 * (int64_t)block;
    for (int c = 0; c < 3; ++c, to += width)
        for (int d = 0; d < 3; ++d)
            to[d] += transposed ? K[d][c] : K[c][d];
}

/* nodes (entities, functions); blocks (entities, functions, functions); K (entities, 9, pairs a <= b of functions):
   the symmetric parts 00 11 22 01 02 12 of the blocks, then their skew parts 01 02 12. */
void scatter_same(double *values, const int32_t *starts, int32_t owned, int64_t entities, int64_t functions,
                  const int32_t *nodes, const int32_t *blocks, const double *K)
{
    const Rows A = {values, starts, owned};
    const int64_t n = functions * (functions + 1) / 2;
    for (int64_t e = 0; e < entities; ++e, K += 9 * n, nodes += functions, blocks += functions * functions) {
        const double *k = K;
        for (int64_t a = 0; a < functions; ++a)
            for (int64_t b = a; b < functions; ++b, ++k) {
                const double block[3][3] = {{k[0], k[3 * n] + k[6 * n], k[4 * n] + k[7 * n]},
                                            {k[3 * n] - k[6 * n], k[n], k[5 * n] + k[8 * n]},
                                            {k[4 * n] - k[7 * n], k[5 * n] - k[8 * n], k[2 * n]}};
                add(&A, nodes[a], nodes[b], blocks[a * functions + b], block, 0);
                if (a < b)
                    add(&A, nodes[b], nodes[a], blocks[b * functions + a], block, 1);
            }
    }
}

/* here, there (entities, functions); blocks (entities, 2, functions, functions) at (here, there) and at (there, here);
   K (entities, 9, functions of here, functions of there), which is added with its transpose. */
void scatter_cross(double *values, const int32_t *starts, int32_t owned, int64_t entities, int64_t functions,
                   const int32_t *here, const int32_t *there, const int32_t *blocks, const double *K)
{
    const Rows A = {values, starts, owned};
    const int64_t n = functions * functions;
    for (int64_t e = 0; e < entities; ++e, K += 9 * n, here += functions, there += functions, blocks += 2 * n) {
        for (int64_t a = 0; a < functions; ++a)
            for (int64_t b = 0; b < functions; ++b) {
                const double *k = K + a * functions + b;
                const double block[3][3] = {
                    {k[0], k[n], k[2 * n]}, {k[3 * n], k[4 * n], k[5 * n]}, {k[6 * n], k[7 * n], k[8 * n]}};
                add(&A, here[a], there[b], blocks[a * functions + b], block, 0);
            }
        for (int64_t b = 0; b < functions; ++b) /* row by row here, too */
            for (int64_t a = 0; a < functions; ++a) {
                const double *k = K + a * functions + b;
                const double block[3][3] = {
                    {k[0], k[n], k[2 * n]}, {k[3 * n], k[4 * n], k[5 * n]}, {k[6 * n], k[7 * n], k[8 * n]}};
                add(&A, there[b], here[a], blocks[n + b * functions + a], block, 1);
            }
    }
}
