/* Vectors and 3 x 3 matrices in C order. */
#ifndef KBMAPS_VECTORS_H
#define KBMAPS_VECTORS_H
#include "common.h"

INLINE void times(const double *m, const double *v, double *out)
{
    for (int i = 0; i < 3; i++)
        out[i] = m[3 * i] * v[0] + m[3 * i + 1] * v[1] + m[3 * i + 2] * v[2];
}

INLINE void product(const double *a, const double *b, double *out)
{
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            out[3 * i + j] = a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j];
}

INLINE void cross(const double *a, const double *b, double *out)
{
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

INLINE void column_of(const double *m, int columns, int column, double *out)
{
    for (int i = 0; i < 3; i++)
        out[i] = m[columns * i + column];
}

/* 1 + a [v]x + b [v]x^2 */
INLINE void rodrigues(const double *v, double a, double b, double *out)
{
    double square = v[0] * v[0] + v[1] * v[1] + v[2] * v[2];
    double skew[9] = {0.0, -v[2], v[1], v[2], 0.0, -v[0], -v[1], v[0], 0.0};
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            out[3 * i + j] = (i == j) + a * skew[3 * i + j] + b * (v[i] * v[j] - (i == j) * square);
}

/* The rotation of a rotation vector and its left Jacobian. */
INLINE void exponential(const double *v, double small_angle, double *rotation, double *jacobian)
{
    double square = v[0] * v[0] + v[1] * v[1] + v[2] * v[2], angle = sqrt(square), sine, cosine, rest;
    if (angle < small_angle) {
        sine = 1.0 - square / 6.0, cosine = 0.5 - square / 24.0, rest = 1.0 / 6.0 - square / 120.0;
    } else {
        sine = sin(angle) / angle, cosine = (1.0 - cos(angle)) / square, rest = (1.0 - sine) / square;
    }
    rodrigues(v, sine, cosine, rotation);
    rodrigues(v, cosine, rest, jacobian);
}

/* Gauss-Jordan with row pivots, as LAPACK would; 0 for a singular matrix. */
static inline int inverse(const double *matrix, double *out)
{
    double m[9];
    memcpy(m, matrix, sizeof m);
    for (int i = 0; i < 9; i++)
        out[i] = i % 4 == 0;
    for (int k = 0; k < 3; k++) {
        int pivot = k;
        for (int i = k + 1; i < 3; i++)
            if (fabs(m[3 * i + k]) > fabs(m[3 * pivot + k]))
                pivot = i;
        double head = m[3 * pivot + k];
        if (head == 0.0)
            return 0;
        for (int j = 0; j < 3; j++) {
            double a = m[3 * pivot + j], b = out[3 * pivot + j];
            m[3 * pivot + j] = m[3 * k + j], out[3 * pivot + j] = out[3 * k + j];
            m[3 * k + j] = a / head, out[3 * k + j] = b / head;
        }
        for (int i = 0; i < 3; i++) {
            double factor = m[3 * i + k];
            for (int j = 0; j < 3 && i != k; j++) {
                m[3 * i + j] -= factor * m[3 * k + j];
                out[3 * i + j] -= factor * out[3 * k + j];
            }
        }
    }
    return 1;
}

#endif
