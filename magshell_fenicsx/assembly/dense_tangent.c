/* Products of (3, 3) blocks, stored row by row, with a vector: memory bounds them, so each entry is read once. */
#include <stdlib.h>

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

PRODUCT(multiply_doubles, double, eight)
PRODUCT(multiply_floats, float, eight_floats)

/* y (rows, 3) from a symmetric matrix of floats, with the blocks on and above its diagonal only, in each row that on it
   first, and x (rows, 3). The third number of a node is apart from eight others, which fill a line of the cache. */
FAST void multiply_upper(int64_t rows, const int32_t *starts, const int32_t *columns, const float *values, const double *x,
                   double *y)
{
    typedef double line __attribute__((vector_size(64)));
    line *of_x = aligned_alloc(64, 64 * rows), *of_y = aligned_alloc(64, 64 * rows);
    double *third = malloc(8 * rows);
    for (int64_t i = 0; i < rows; ++i) {
        const double *v = x + 3 * i;
        of_x[i] = (line){v[0], v[1], v[2], v[0], v[1], v[2], v[0], v[1]}, of_y[i] = (line){0.0}, third[i] = 0.0;
    }
    for (int64_t row = 0; row < rows; ++row) {
        const double *v = x + 3 * row;
        const line mine = {v[0], v[0], v[0], v[1], v[1], v[1], v[2], v[2]};
        line sum = {0.0};
        double last = 0.0;
        for (int64_t at = starts[row]; at < starts[row + 1]; ++at) {
            const float *block = values + 9 * at;
            const int64_t column = columns[at];
            const line entries = __builtin_convertvector(*(const eight_floats *)block, line);
            sum += entries * of_x[column], last += block[8] * x[3 * column + 2];
            if (column != row)
                of_y[column] += entries * mine, third[column] += block[8] * v[2];
        }
        of_y[row] += (line){sum[0] + sum[1] + sum[2], sum[3] + sum[4] + sum[5]};
        third[row] += sum[6] + sum[7] + last;
    }
    for (int64_t i = 0; i < rows; ++i) {
        y[3 * i] = of_y[i][0] + of_y[i][3] + of_y[i][6], y[3 * i + 1] = of_y[i][1] + of_y[i][4] + of_y[i][7];
        y[3 * i + 2] = of_y[i][2] + of_y[i][5] + third[i];
    }
    free(of_x), free(of_y), free(third);
}
