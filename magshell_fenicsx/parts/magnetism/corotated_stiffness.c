/* Second derivatives of charges by nodes, turned with these; turned.py says what for. LANES blocks go through at once. */
#include <string.h>

#define LANES 8

typedef double v __attribute__((vector_size(8 * LANES)));

/* Values of LANES elements `at`, `step` apart. */
INLINE void gather(const double *x, int64_t step, const int64_t *at, v *y)
{
    for (int c = 0; c < LANES; ++c)
        (*y)[c] = x[step * at[c]];
}

/* The matrix of a rotation from its quaternion (4,) of any size, scalar last. */
INLINE void rotation(const v *q, v R[3][3])
{
    const v s = 2.0 / (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    const v x = s * q[0], y = s * q[1], z = s * q[2];
    R[0][0] = 1.0 - y * q[1] - z * q[2], R[1][1] = 1.0 - x * q[0] - z * q[2], R[2][2] = 1.0 - x * q[0] - y * q[1];
    R[0][1] = x * q[1] - z * q[3], R[1][0] = x * q[1] + z * q[3], R[0][2] = x * q[2] + y * q[3];
    R[2][0] = x * q[2] - y * q[3], R[1][2] = y * q[2] - x * q[3], R[2][1] = y * q[2] + x * q[3];
}

/* Y = R X R^T; X is added to `before` and Y to `after` where `live`. */
INLINE void turn(const v R[3][3], const v *X, const v *live, v *Y, v *before, v *after)
{
    for (int i = 0; i < 3; ++i) {
        v row[3];
        for (int j = 0; j < 3; ++j) {
            row[j] = R[i][0] * X[j] + R[i][1] * X[3 + j] + R[i][2] * X[6 + j];
            before[3 * i + j] += *live * X[3 * i + j];
        }
        for (int j = 0; j < 3; ++j) {
            Y[3 * i + j] = row[0] * R[j][0] + row[1] * R[j][1] + row[2] * R[j][2];
            after[3 * i + j] += *live * Y[3 * i + j];
        }
    }
}

/* Blocks (.., 3, 3) of nodes `number` (rows,) and `columns`, turned by the mean of both nodes' rotations q (.., 4); of each
   row those `which`, from `starts` (rows + 1,) on, of which those from `first` (rows,) on go into `turned`, from `onto`
   (rows + 1,) on. Those of an image, unless NULL, are added with a sign, by its change Q (3, 3) of the nodes that it is of.
   The block of a node with itself gets what makes the sum of a row turn with its node, as in a rotation of all. */
FAST void turn_blocks(int64_t rows, const int32_t *starts, const int32_t *which, const int32_t *columns,
                      const double *blocks, const double *of_image, double sign, const double *Q, const int64_t *number,
                      const double *q, const int32_t *first, const int32_t *onto, float *turned)
{
    const double det = Q[0] * (Q[4] * Q[8] - Q[5] * Q[7]) - Q[1] * (Q[3] * Q[8] - Q[5] * Q[6]) +
                       Q[2] * (Q[3] * Q[7] - Q[4] * Q[6]);
    for (int64_t row = 0; row < rows; ++row) {
        const double *mine = q + 4 * number[row];
        v before[9], after[9], own[4], R[3][3];
        float *to = turned + 9 * ((int64_t)onto[row] - first[row]);
        int64_t diagonal = -1;
        memset(before, 0, sizeof before), memset(after, 0, sizeof after);
        for (int i = 0; i < 4; ++i)
            own[i] = mine[i] + (v){0.0};
        for (int64_t at = starts[row]; at < starts[row + 1]; at += LANES) {
            int64_t block[LANES], column[LANES];
            v live, X[9], Y[9], Z[9], other[4], seen[4];
            for (int c = 0; c < LANES; ++c) {
                const int there = at + c < starts[row + 1];
                block[c] = which[there ? at + c : at], column[c] = columns[block[c]], live[c] = there;
                if (there && column[c] == number[row])
                    diagonal = at + c;
            }
            for (int i = 0; i < 4; ++i)
                gather(q + i, 4, column, other + i);
            for (int image = 0; image < 1 + (of_image != 0); ++image) {
                const double *from = image ? of_image : blocks;
                for (int i = 0; i < 9; ++i)
                    gather(from + i, 9, block, X + i);
                memcpy(seen, other, sizeof seen);
                if (image) {
                    for (int i = 0; i < 3; ++i) {
                        seen[i] = det * (Q[3 * i] * other[0] + Q[3 * i + 1] * other[1] + Q[3 * i + 2] * other[2]);
                        for (int j = 0; j < 3; ++j)
                            Z[3 * i + j] = X[3 * i] * Q[3 * j] + X[3 * i + 1] * Q[3 * j + 1] + X[3 * i + 2] * Q[3 * j + 2];
                    }
                    memcpy(X, Z, sizeof X);
                }
                const v along = own[0] * seen[0] + own[1] * seen[1] + own[2] * seen[2] + own[3] * seen[3];
                const v way = 1.0 + 2.0 * __builtin_convertvector(along < 0.0, v);
                for (int i = 0; i < 4; ++i)
                    seen[i] = own[i] + way * seen[i];
                rotation(seen, R);
                turn(R, X, &live, image ? Z : Y, before, after);
                for (int i = 0; i < 3 && image; ++i)
                    for (int j = 0; j < 3; ++j)
                        Y[3 * i + j] += sign * (Z[3 * i] * Q[j] + Z[3 * i + 1] * Q[3 + j] + Z[3 * i + 2] * Q[6 + j]);
            }
            for (int c = 0; c < LANES && at + c < starts[row + 1]; ++c)
                for (int i = 0; i < 9 && at + c >= first[row]; ++i)
                    to[9 * (at + c) + i] = (float)Y[i][c];
        }
        if (diagonal < 0)
            continue;
        v sum[9], none, rest[9];
        memset(rest, 0, sizeof rest), memset(&none, 0, sizeof none);
        rotation(own, R);
        for (int i = 0; i < 9; ++i)
            for (int c = 1; c < LANES; ++c)
                before[i][0] += before[i][c], after[i][0] += after[i][c];
        turn(R, before, &none, sum, rest, rest);
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) {
                const double one = sum[3 * i + j][0] - after[3 * i + j][0], two = sum[3 * j + i][0] - after[3 * j + i][0];
                to[9 * diagonal + 3 * i + j] += (float)((one + two) / 2.0);
            }
    }
}
