/* kbmaps._kernels.Net: kbmaps.contraction.NumpyNet */
#include "common.h"

enum { HALF_PHASES, MIX, SLIDES, PLANES, NET_ARRAYS };
/* From so many rows on a block of COLUMNS is quicker, even if not full, than row by row. */
enum { FEWEST_IN_BLOCK = 5 };
/* Doubles of working memory that are taken from the stack: enough for a row at seven joints. */
enum { ON_STACK = 1024 };

typedef struct {
    PyObject_HEAD
    index_t joints, split, left, right, outputs;
    Py_buffer arrays[NET_ARRAYS];
    PyObject *check_q, *check_x, *empty;
} Net;

#define ARRAY(self, which) ((double *)(self)->arrays[which].buf)

/* Control points of the joints begin..end, at most `most`; 0 where they are more. */
static index_t half_size(const Net *net, index_t begin, index_t end, index_t most)
{
    index_t size = 1;
    for (index_t k = begin; k < end; k++) {
        index_t functions = ARRAY(net, SLIDES)[k] != 0.0 ? 2 : 3;
        if (size > most / functions)
            return 0;
        size *= functions;
    }
    return size;
}

/* Three entries a joint of values (or, for derivative = 1, slopes) of its basis functions, `lanes` apart. */
INLINE void joint_weights(const Net *net, const double *q, int derivative, index_t lanes, double *weights)
{
    index_t d = net->joints;
    for (index_t k = 0; k < d; k++) {
        double first = ARRAY(net, HALF_PHASES)[k], second = ARRAY(net, HALF_PHASES)[d + k];
        const double *mix = ARRAY(net, MIX) + 9 * k;
        double products[3] = {0.0, 0.0, 0.0};
        if (ARRAY(net, SLIDES)[k] != 0.0) {
            double span = 2.0 * second, share = (q[k] - 2.0 * first) / span;
            products[0] = derivative ? -1.0 / span : 1.0 - share;
            products[1] = derivative ? 1.0 / span : share;
        } else if (derivative) {
            products[0] = 0.5 * sin(q[k] - 2.0 * first);
            products[1] = 0.5 * sin(q[k] - (first + second));
            products[2] = 0.5 * sin(q[k] - 2.0 * second);
        } else {
            double u = sin(0.5 * q[k] - first), v = sin(0.5 * q[k] - second);
            products[0] = u * u, products[1] = u * v, products[2] = v * v;
        }
        for (int j = 0; j < 3; j++)
            weights[(3 * k + j) * lanes] = products[0] * mix[j] + products[1] * mix[3 + j] + products[2] * mix[6 + j];
    }
}

/* Kronecker product of the weights of the joints begin..end, for each lane; grown in place, from the last joint. */
INLINE void kronecker(const Net *net, const double *restrict weights, index_t begin, index_t end, index_t lanes,
                      double *restrict out)
{
    index_t size = 1;
    for (index_t n = 0; n < lanes; n++)
        out[n] = 1.0;
    for (index_t k = end; k-- > begin;) {
        index_t functions = ARRAY(net, SLIDES)[k] != 0.0 ? 2 : 3;
        const double *factors = weights + 3 * k * lanes;
        for (index_t j = functions; j-- > 0;) /* what the others are made from comes last */
            for (index_t i = 0; i < size; i++)
                for (index_t n = 0; n < lanes; n++)
                    out[(j * size + i) * lanes + n] = factors[j * lanes + n] * out[i * lanes + n];
        size *= functions;
    }
}

/* Working memory for one call of the functions below with n rows: `few` where that will do. NULL: there is none. */
static double *working_memory(const Net *net, index_t n, double few[ON_STACK])
{
    index_t lanes = n < FEWEST_IN_BLOCK ? 1 : COLUMNS, halves = net->left + net->right;
    index_t doubles = (9 * net->joints + 2 * halves) * lanes + net->outputs * halves;
    return doubles <= ON_STACK ? few : malloc((size_t)doubles * sizeof(double));
}

/* The outputs of up to COLUMNS rows at once: row n is column n of all that stands in scratch. */
INLINE void outputs_of_block(const Net *net, const double *q, index_t n, index_t begin, index_t end, double *scratch,
                             double *out)
{
    double *weights = scratch, *left = weights + 3 * net->joints * COLUMNS, *right = left + net->left * COLUMNS;
    memset(weights, 0, (size_t)(3 * net->joints * COLUMNS) * sizeof(double));
    for (index_t i = 0; i < n; i++)
        joint_weights(net, q + i * net->joints, 0, COLUMNS, weights + i);
    kronecker(net, weights, 0, net->split, COLUMNS, left);
    kronecker(net, weights, net->split, net->joints, COLUMNS, right);
    for (index_t o = begin; o < end; o++) {
        double sums[COLUMNS] = {0.0}, by_right[COLUMNS];
        for (index_t l = 0; l < net->left; l++) {
            const double *row = ARRAY(net, PLANES) + (o * net->left + l) * net->right;
            combine_columns(right, net->right, COLUMNS, row, by_right);
            for (int j = 0; j < COLUMNS; j++)
                sums[j] += left[l * COLUMNS + j] * by_right[j];
        }
        for (index_t i = 0; i < n; i++)
            out[i * (end - begin) + o - begin] = sums[i];
    }
}

INLINE void outputs_of_one(const Net *net, const double *q, index_t begin, index_t end, double *scratch, double *out)
{
    double *weights = scratch, *left = weights + 3 * net->joints, *right = left + net->left, *sum = right + net->right;
    joint_weights(net, q, 0, 1, weights);
    kronecker(net, weights, 0, net->split, 1, left);
    kronecker(net, weights, net->split, net->joints, 1, right);
    for (index_t o = begin; o < end; o++) {
        combine(ARRAY(net, PLANES) + o * net->left * net->right, net->left, net->right, left, sum);
        *out++ = dot(sum, right, net->right);
    }
}

FAST static void outputs_of(const Net *net, const double *q, index_t n, index_t begin, index_t end, double *scratch,
                            double *out)
{
    index_t d = net->joints, outputs = end - begin, done = 0;
    while (n - done >= FEWEST_IN_BLOCK) {
        index_t count = n - done < COLUMNS ? n - done : COLUMNS;
        outputs_of_block(net, q + done * d, count, begin, end, scratch, out + done * outputs);
        done += count;
    }
    for (; done < n; done++)
        outputs_of_one(net, q + done * d, begin, end, scratch, out + done * outputs);
}

FAST static void derivatives_of(const Net *net, const double *q, index_t n, index_t begin, index_t end,
                                double *scratch, double *out)
{
    index_t d = net->joints, plane = net->left * net->right, count = end - begin;
    double *weights = scratch, *slopes = weights + 3 * d, *varied = slopes + 3 * d;
    double *left = varied + 3 * d, *right = left + net->left, *half = right + net->right;
    double *by_left = half + net->left + net->right, *by_right = by_left + net->outputs * net->left;
    for (index_t i = 0; i < n; i++, q += d, out += count * d) {
        joint_weights(net, q, 0, 1, weights);
        joint_weights(net, q, 1, 1, slopes);
        kronecker(net, weights, 0, net->split, 1, left);
        kronecker(net, weights, net->split, d, 1, right);
        for (index_t o = 0; o < count; o++) {
            const double *rows = ARRAY(net, PLANES) + (begin + o) * plane;
            combine(rows, net->left, net->right, left, by_right + o * net->right);
            for (index_t l = 0; l < net->left; l++)
                by_left[o * net->left + l] = dot(rows + l * net->right, right, net->right);
        }
        for (index_t k = 0; k < d; k++) {
            memcpy(varied, weights, (size_t)(3 * d) * sizeof(double));
            memcpy(varied + 3 * k, slopes + 3 * k, 3 * sizeof(double));
            int on_left = k < net->split;
            index_t size = on_left ? net->left : net->right;
            const double *rest = on_left ? by_left : by_right;
            kronecker(net, varied, on_left ? 0 : net->split, on_left ? net->split : d, 1, half);
            for (index_t o = 0; o < count; o++)
                out[o * d + k] = dot(rest + o * size, half, size);
        }
    }
}

FAST static void learn_from(const Net *net, const double *q, const double *targets, const index_t *order, index_t n,
                            const double *mu0, double *scratch)
{
    index_t left_size = net->left, right_size = net->right;
    double *weights = scratch, *left = weights + 3 * net->joints, *right = left + left_size, *sum = right + right_size;
    for (index_t i = 0; i < n; i++) {
        index_t pair = order == NULL ? i : order[i];
        joint_weights(net, q + pair * net->joints, 0, 1, weights);
        kronecker(net, weights, 0, net->split, 1, left);
        kronecker(net, weights, net->split, net->joints, 1, right);
        double mu = mu0[i] / (dot(left, left, left_size) * dot(right, right, right_size));
        for (index_t o = 0; o < net->outputs; o++) {
            double *rows = ARRAY(net, PLANES) + o * left_size * right_size;
            combine(rows, left_size, right_size, left, sum);
            /* Ulbrich et al. 2009, eq. (20) */
            double error = mu * (targets[pair * net->outputs + o] - dot(sum, right, right_size));
            for (index_t l = 0; l < left_size; l++) {
                double *restrict row = rows + l * right_size, factor = error * left[l];
                for (index_t r = 0; r < right_size; r++)
                    row[r] += factor * right[r];
            }
        }
    }
}

static PyObject *net_new(PyTypeObject *type, PyObject *args, PyObject *Py_UNUSED(keywords))
{
    PyObject *given[NET_ARRAYS], *check_q, *check_x, *empty;
    if (!PyArg_ParseTuple(args, "OOOOOOO", &given[0], &given[1], &given[2], &given[3], &check_q, &check_x, &empty))
        return NULL;
    Net *net = (Net *)((allocfunc)PyType_GetSlot(type, Py_tp_alloc))(type, 0);
    if (net == NULL)
        return NULL;
    net->check_q = Py_NewRef(check_q), net->check_x = Py_NewRef(check_x), net->empty = Py_NewRef(empty);
    index_t d = PyObject_Length(given[SLIDES]);
    index_t elements[NET_ARRAYS] = {2 * d, 9 * d, d, -1};
    if (d < 1 || !take_all(given, net->arrays, elements, NET_ARRAYS)) {
        if (!PyErr_Occurred())
            PyErr_SetString(PyExc_TypeError, "a net needs a joint");
        Py_DECREF(net);
        return NULL;
    }
    index_t points = net->arrays[PLANES].len / (index_t)sizeof(double);
    net->joints = d, net->split = d / 2;
    net->left = half_size(net, 0, net->split, points);
    net->right = net->left == 0 ? 0 : half_size(net, net->split, d, points / net->left);
    if (net->right == 0 || points % (net->left * net->right) != 0) {
        PyErr_Format(PyExc_TypeError, "a net of %zd joints cannot have %zd control points", d, points);
        Py_DECREF(net);
        return NULL;
    }
    net->outputs = points / (net->left * net->right);
    return (PyObject *)net;
}

static void net_dealloc(Net *net)
{
    PyTypeObject *type = Py_TYPE((PyObject *)net);
    release_all(net->arrays, NET_ARRAYS);
    Py_XDECREF(net->check_q), Py_XDECREF(net->check_x), Py_XDECREF(net->empty);
    ((freefunc)PyType_GetSlot(type, Py_tp_free))(net);
    Py_DECREF(type);
}

typedef void evaluation(const Net *, const double *, index_t, index_t, index_t, double *, double *);

/* Runs an evaluation for (q, begin, end) that gives (end - begin) x `columns` numbers a row, without the GIL for rows. */
static PyObject *evaluated(Net *net, PyObject *const *args, index_t count, evaluation *evaluate, index_t columns)
{
    Py_buffer q, result;
    if (count != 3)
        return PyErr_Format(PyExc_TypeError, "three arguments are needed: q, begin, end");
    index_t begin = PyLong_AsSsize_t(args[1]), end = PyLong_AsSsize_t(args[2]);
    if (PyErr_Occurred() || begin < 0 || end > net->outputs || end <= begin)
        return PyErr_Format(PyExc_TypeError, "begin, end must lie within the %zd outputs", net->outputs);
    if (!take(args[0], net->check_q, net->joints, 1, &q))
        return NULL;
    index_t n = q.ndim == 1 ? 1 : q.shape[0], outputs = end - begin;
    PyObject *shape = q.ndim == 1 ? (columns > 0 ? Py_BuildValue("(nn)", outputs, columns) : PyLong_FromSsize_t(outputs))
                                  : (columns > 0 ? Py_BuildValue("(nnn)", n, outputs, columns)
                                                 : Py_BuildValue("(nn)", n, outputs));
    PyObject *out = shape == NULL ? NULL : PyObject_CallFunctionObjArgs(net->empty, shape, NULL);
    Py_XDECREF(shape);
    double few[ON_STACK], *scratch = working_memory(net, n, few);
    if (out != NULL && scratch == NULL)
        PyErr_NoMemory();
    index_t bytes = n * outputs * (columns > 0 ? columns : 1) * (index_t)sizeof(double);
    if (out == NULL || scratch == NULL || PyObject_GetBuffer(out, &result, PyBUF_WRITABLE) != 0) {
        Py_XDECREF(out);
        out = NULL;
    } else if (result.len != bytes) {
        PyErr_SetString(PyExc_TypeError, "what is to hold the results has another size");
        PyBuffer_Release(&result);
        Py_DECREF(out);
        out = NULL;
    } else {
        PyThreadState *thread = n > 1 ? PyEval_SaveThread() : NULL;
        evaluate(net, q.buf, n, begin, end, scratch, result.buf);
        if (thread != NULL)
            PyEval_RestoreThread(thread);
        PyBuffer_Release(&result);
    }
    if (scratch != few)
        free(scratch);
    PyBuffer_Release(&q);
    return out;
}

static PyObject *net_outputs(Net *net, PyObject *const *args, index_t count)
{
    return evaluated(net, args, count, outputs_of, 0);
}

static PyObject *net_derivatives(Net *net, PyObject *const *args, index_t count)
{
    return evaluated(net, args, count, derivatives_of, net->joints);
}

static PyObject *learned(Net *net, const Py_buffer *q, const Py_buffer *x, const index_t *order, index_t n,
                         const double *mu0)
{
    double few[ON_STACK], *scratch = working_memory(net, 1, few);
    if (scratch == NULL)
        return PyErr_NoMemory();
    PyThreadState *thread = n > 1 ? PyEval_SaveThread() : NULL;
    learn_from(net, q->buf, x->buf, order, n, mu0, scratch);
    if (thread != NULL)
        PyEval_RestoreThread(thread);
    if (scratch != few)
        free(scratch);
    Py_RETURN_NONE;
}

/* step(q, x, mu0) */
static PyObject *net_step(Net *net, PyObject *const *args, index_t count)
{
    Py_buffer q, x;
    double mu0 = count == 3 ? PyFloat_AsDouble(args[2]) : -1.0;
    if (mu0 < 0.0 || net->arrays[PLANES].readonly)
        return PyErr_Format(PyExc_TypeError, "a step needs q, x and mu0, and a net that may be written");
    if (!take(args[0], net->check_q, net->joints, 0, &q))
        return NULL;
    PyObject *done = NULL;
    if (take(args[1], net->check_x, net->outputs, 0, &x)) {
        done = learned(net, &q, &x, NULL, 1, &mu0);
        PyBuffer_Release(&x);
    }
    PyBuffer_Release(&q);
    return done;
}

/* 1 for a vector of whole numbers of the size of index_t, each from 0 to n - 1. */
static int is_order(const Py_buffer *view, index_t n)
{
    if (view->ndim != 1 || view->itemsize != (index_t)sizeof(index_t) || view->format == NULL ||
        strlen(view->format) != 1 || strchr("lqn", view->format[0]) == NULL)
        return 0;
    const index_t *order = view->buf;
    for (index_t i = 0; i < view->shape[0]; i++)
        if (order[i] < 0 || order[i] >= n)
            return 0;
    return 1;
}

/* replay(q, x, order, mu0): rows (n, joints) and (n, outputs), and for each step its index (Py_ssize_t) and mu0. */
static PyObject *net_replay(Net *net, PyObject *const *args, index_t count)
{
    if (count != 4 || net->arrays[PLANES].readonly)
        return PyErr_Format(PyExc_TypeError, "a replay needs q, x, order and mu0, and a net that may be written");
    Py_buffer views[3], order;
    index_t elements[3] = {-1, -1, -1};
    PyObject *taken[3] = {args[0], args[1], args[3]};
    if (!take_all(taken, views, elements, 3))
        return NULL;
    PyObject *done = NULL;
    if (PyObject_GetBuffer(args[2], &order, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT) == 0) {
        index_t n = views[0].ndim == 2 ? views[0].shape[0] : 0;
        if (!has_rows(&views[0], n, net->joints) || !has_rows(&views[1], n, net->outputs) || !is_order(&order, n))
            PyErr_Format(PyExc_TypeError, "a replay needs rows of %zd and %zd numbers, and indices of them",
                         net->joints, net->outputs);
        else if (views[2].len != order.shape[0] * (index_t)sizeof(double))
            PyErr_SetString(PyExc_TypeError, "a replay needs one mu0 for each index");
        else
            done = learned(net, &views[0], &views[1], order.buf, order.shape[0], views[2].buf);
        PyBuffer_Release(&order);
    }
    release_all(views, 3);
    return done;
}

static PyMethodDef net_methods[] = {
    {"outputs", (PyCFunction)(void (*)(void))net_outputs, METH_FASTCALL, NULL},
    {"derivatives", (PyCFunction)(void (*)(void))net_derivatives, METH_FASTCALL, NULL},
    {"step", (PyCFunction)(void (*)(void))net_step, METH_FASTCALL, NULL},
    {"replay", (PyCFunction)(void (*)(void))net_replay, METH_FASTCALL, NULL},
    {NULL, NULL, 0, NULL},
};

static PyType_Slot net_slots[] = {
    {Py_tp_new, net_new}, {Py_tp_dealloc, net_dealloc}, {Py_tp_methods, net_methods}, {0, NULL}};

PyType_Spec net_spec = {
    "kbmaps._kernels.Net", sizeof(Net), 0, Py_TPFLAGS_DEFAULT | Py_TPFLAGS_IMMUTABLETYPE, net_slots};
