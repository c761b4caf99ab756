/* Products of (3, 3) blocks, stored row by row, with a vector: memory bounds them, so each entry is read once. */
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#define FAST __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define FAST
#endif

typedef double eight __attribute__((vector_size(64), aligned(8)));

/* y (rows, 3) from values (blocks, 3, 3) at columns (blocks,), where `starts` (rows + 1,) says where rows begin; x
   (columns, 9) has each node's three numbers three times. */
FAST void of_blocks(int64_t rows, const int32_t *starts, const int32_t *columns, const double *values, const double *x,
                double *y)
{
    for (int64_t row = 0; row < rows; ++row) {
        eight sum[2] = {{0.0}, {0.0}};
        double last[2] = {0.0, 0.0};
        for (int64_t at = starts[row]; at < starts[row + 1]; ++at) {
            const double *block = values + 9 * at, *with = x + 9 * (int64_t)columns[at];
            const int way = at & 1; /* two sums: one need not wait for the other */
            sum[way] += *(const eight *)block * *(const eight *)with;
            last[way] += block[8] * with[8];
        }
        sum[0] += sum[1];
        y[3 * row] = sum[0][0] + sum[0][1] + sum[0][2];
        y[3 * row + 1] = sum[0][3] + sum[0][4] + sum[0][5];
        y[3 * row + 2] = sum[0][6] + sum[0][7] + last[0] + last[1];
    }
}
