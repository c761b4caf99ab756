/* Products of (3, 3) blocks, stored row by row, with a vector: memory bounds them, so each entry is read once. */

typedef double eight __attribute__((vector_size(64), aligned(8)));
typedef float eight_floats __attribute__((vector_size(32), aligned(4)));

/* y (rows, 3) from values (blocks, 3, 3) at columns (blocks,), where `starts` (rows + 1,) says where rows begin; x
   (columns, 9) has each node's three numbers three times. */
#define PRODUCT(name, number, vector)                                                                                      \
    INLINE void name##_one(const number *block, const double *with, eight *sum, double *last)                       \
    {                                                                                                                      \
        *sum += __builtin_convertvector(*(const vector *)block, eight) * *(const eight *)with;                             \
        *last += block[8] * with[8];                                                                                       \
    }                                                                                                                      \
    FAST void name(int64_t rows, const int32_t *starts, const int32_t *columns, const number *values, const double *x,     \
                   double *y)                                                                                              \
    {                                                                                                                      \
        for (int64_t row = 0; row < rows; ++row) {                                                                         \
            eight sum = {0.0}, other = {0.0}; /* two: one need not wait for the other */                                   \
            double last = 0.0, last_other = 0.0;                                                                           \
            int64_t at = starts[row];                                                                                      \
            for (; at + 1 < starts[row + 1]; at += 2) {                                                                    \
                name##_one(values + 9 * at, x + 9 * (int64_t)columns[at], &sum, &last);                                    \
                name##_one(values + 9 * (at + 1), x + 9 * (int64_t)columns[at + 1], &other, &last_other);                  \
            }                                                                                                              \
            if (at < starts[row + 1])                                                                                      \
                name##_one(values + 9 * at, x + 9 * (int64_t)columns[at], &sum, &last);                                    \
            sum += other;                                                                                                  \
            y[3 * row] = sum[0] + sum[1] + sum[2];                                                                         \
            y[3 * row + 1] = sum[3] + sum[4] + sum[5];                                                                     \
            y[3 * row + 2] = sum[6] + sum[7] + last + last_other;                                                          \
        }                                                                                                                  \
    }

PRODUCT(of_doubles, double, eight)
PRODUCT(of_floats, float, eight_floats)
