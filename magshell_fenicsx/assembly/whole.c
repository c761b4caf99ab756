/* Products of (3, 3) blocks, stored row by row, with a vector: memory bounds them, so each entry is read once. */
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#define FAST __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define FAST
#endif

typedef double eight __attribute__((vector_size(64), aligned(8)));
typedef float eight_floats __attribute__((vector_size(32), aligned(4)));

/* y (rows, 3) from values (blocks, 3, 3) at columns (blocks,), where `starts` (rows + 1,) says where rows begin; x
   (columns, 9) has each node's three numbers three times. */
#define PRODUCT(name, number, vector)                                                                                      \
    FAST void name(int64_t rows, const int32_t *starts, const int32_t *columns, const number *values, const double *x,     \
                   double *y)                                                                                              \
    {                                                                                                                      \
        for (int64_t row = 0; row < rows; ++row) {                                                                         \
            eight sum[2] = {{0.0}, {0.0}}; /* two: one need not wait for the other */                                      \
            double last[2] = {0.0, 0.0};                                                                                   \
            for (int64_t at = starts[row]; at < starts[row + 1]; ++at) {                                                   \
                const number *block = values + 9 * at;                                                                     \
                const double *with = x + 9 * (int64_t)columns[at];                                                         \
                sum[at & 1] += __builtin_convertvector(*(const vector *)block, eight) * *(const eight *)with;              \
                last[at & 1] += block[8] * with[8];                                                                        \
            }                                                                                                              \
            sum[0] += sum[1];                                                                                              \
            y[3 * row] = sum[0][0] + sum[0][1] + sum[0][2];                                                                \
            y[3 * row + 1] = sum[0][3] + sum[0][4] + sum[0][5];                                                            \
            y[3 * row + 2] = sum[0][6] + sum[0][7] + last[0] + last[1];                                                    \
        }                                                                                                                  \
    }

PRODUCT(of_doubles, double, eight)
PRODUCT(of_floats, float, eight_floats)
