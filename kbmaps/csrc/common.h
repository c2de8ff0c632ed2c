/* What the compiled loops of kbmaps share.
 *
 * The loops are those that run for every pair or every query. Each has a NumPy twin (named at its head) that the same
 * tests run on; what the formulas mean stands there. Arrays come through the buffer protocol and the limited API, so
 * this needs no NumPy headers and one build serves every Python from 3.11 on. Arrays are float64 in C order.
 */
#ifndef KBMAPS_COMMON_H
#define KBMAPS_COMMON_H
#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030B0000
#include <Python.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

/* One body, compiled for plain x86-64 and for processors with AVX and FMA; the loader picks. */
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__) && defined(__GLIBC__)
#define FAST __attribute__((target_clones("fma", "default")))
#else
#define FAST
#endif
#define INLINE static inline __attribute__((always_inline))

typedef Py_ssize_t index_t;

/* ---- arrays ---------------------------------------------------------------------------------------------------- */

/* A view of float64 in C order; 0 and no exception where the object is anything else. */
static inline int plain(PyObject *object, Py_buffer *view)
{
    if (PyObject_GetBuffer(object, view, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT) != 0) {
        PyErr_Clear();
        return 0;
    }
    if (view->format != NULL && strcmp(view->format, "d") == 0)
        return 1;
    PyBuffer_Release(view);
    return 0;
}

static inline int all_finite(const double *values, index_t count)
{
    double sum = 0.0;
    for (index_t i = 0; i < count; i++)
        sum += values[i] * 0.0;
    return sum == 0.0;
}

/* 1 for a vector (width,), or rows (n, width) where those are allowed, of finite numbers. */
static inline int fits(const Py_buffer *view, index_t width, int rows_too)
{
    int shaped = (view->ndim == 1 && view->shape[0] == width) ||
                 (rows_too && view->ndim == 2 && view->shape[1] == width);
    return shaped && all_finite(view->buf, view->len / (index_t)sizeof(double));
}

/* 1 for rows (n, width). */
static inline int has_rows(const Py_buffer *view, index_t n, index_t width)
{
    return view->ndim == 2 && view->shape[0] == n && view->shape[1] == width;
}

/* The object as such a view: itself where it already is one, else what `check` makes of it, which may raise. */
static inline int take(PyObject *object, PyObject *check, index_t width, int rows_too, Py_buffer *view)
{
    if (plain(object, view)) {
        if (fits(view, width, rows_too))
            return 1;
        PyBuffer_Release(view);
    }
    PyObject *checked = PyObject_CallFunctionObjArgs(check, object, NULL);
    if (checked == NULL)
        return 0;
    int usable = plain(checked, view);
    Py_DECREF(checked);
    if (usable && fits(view, width, rows_too))
        return 1;
    if (usable)
        PyBuffer_Release(view);
    PyErr_SetString(PyExc_TypeError, "the check must return finite float64 in C order");
    return 0;
}

/* Views of `count` arrays of given numbers of elements (-1: any); all or none. */
static inline int take_all(PyObject *const *objects, Py_buffer *views, const index_t *elements, int count)
{
    for (int i = 0; i < count; i++) {
        int usable = plain(objects[i], &views[i]);
        if (usable && (elements[i] < 0 || views[i].len == elements[i] * (index_t)sizeof(double)))
            continue;
        PyErr_Format(PyExc_TypeError, "array %d must be float64 in C order, of the right size", i);
        for (int j = usable ? i : i - 1; j >= 0; j--)
            PyBuffer_Release(&views[j]);
        return 0;
    }
    return 1;
}

static inline void release_all(Py_buffer *views, int count)
{
    for (int i = 0; i < count; i++)
        if (views[i].obj != NULL)
            PyBuffer_Release(&views[i]);
}

/* ---- small linear algebra -------------------------------------------------------------------------------------- */

enum { COLUMNS = 16 };

/* out (COLUMNS) = factors (count) @ the first columns of rows (count, width). So few that the compiler keeps the sums in
 * registers, and two of each, since one sum waits for itself. */
INLINE void combine_columns(const double *restrict rows, index_t count, index_t width, const double *restrict factors,
                            double *restrict out)
{
    double even[COLUMNS] = {0.0}, odd[COLUMNS] = {0.0};
    index_t i = 0;
    for (; i + 2 <= count; i += 2, rows += 2 * width)
        for (int j = 0; j < COLUMNS; j++)
            even[j] += factors[i] * rows[j], odd[j] += factors[i + 1] * rows[width + j];
    if (i < count)
        for (int j = 0; j < COLUMNS; j++)
            even[j] += factors[i] * rows[j];
    for (int j = 0; j < COLUMNS; j++)
        out[j] = even[j] + odd[j];
}

/* out (width) = factors (count) @ rows (count, width) */
INLINE void combine(const double *restrict rows, index_t count, index_t width, const double *restrict factors,
                    double *restrict out)
{
    index_t j = 0;
    for (; j + COLUMNS <= width; j += COLUMNS)
        combine_columns(rows + j, count, width, factors, out + j);
    for (; j < width; j++) {
        double even = 0.0, odd = 0.0;
        index_t i = 0;
        for (; i + 2 <= count; i += 2)
            even += factors[i] * rows[i * width + j], odd += factors[i + 1] * rows[(i + 1) * width + j];
        out[j] = even + odd + (i < count ? factors[i] * rows[i * width + j] : 0.0);
    }
}

INLINE double dot(const double *a, const double *b, index_t count)
{
    double s[4] = {0.0, 0.0, 0.0, 0.0};
    index_t i = 0;
    for (; i + 4 <= count; i += 4)
        for (int j = 0; j < 4; j++)
            s[j] += a[i + j] * b[i + j];
    for (; i < count; i++)
        s[0] += a[i] * b[i];
    return (s[0] + s[1]) + (s[2] + s[3]);
}

#endif
