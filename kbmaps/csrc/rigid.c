/* kbmaps._kernels.RigidFilter: the loops of kbmaps.chains.rigid_filter and of kbmaps.chains.parameters. */
#include "chain.h"

typedef struct {
    double variance, distance, bend;
    double precision[9];
} Update;

typedef struct {
    double *numbers, *jacobian, *gains, *step, *present, *row, *change;
    const double *origin; /* where to linearise (size), or NULL: at `change` */
} Work;

static size_t work_size(const Filter *self)
{
    return (size_t)(JOINT_NUMBERS * self->joints + 9 * self->active + self->size);
}

static Work divided(const Filter *self, double *memory, const double *origin)
{
    Work work;
    index_t p = self->active;
    work.numbers = memory;
    work.jacobian = work.numbers + JOINT_NUMBERS * self->joints;
    work.gains = work.jacobian + 3 * p;
    work.step = work.gains + 3 * p;
    work.present = work.step + p;
    work.row = work.present + p;
    work.change = work.row + p;
    work.origin = origin;
    return work;
}

/* work.change = change + scales * step */
INLINE void move(const Filter *self, const double *change, const double *step, double *out)
{
    for (index_t i = 0; i < self->size; i++) {
        index_t place = self->places[i];
        out[i] = change[i] + (place >= 0 ? self->scales[place] * step[place] : 0.0);
    }
}

/* RigidFilter._curvature */
INLINE double curvature(const Filter *self, const double *covariance, const Work *work)
{
    index_t p = self->active;
    double square = 0.0;
    for (int c = 0; c < 3; c++) {
        for (index_t i = 0; i < p; i++)
            work->step[i] = work->jacobian[c * p + i] * self->bends[i];
        combine(covariance, p, p, work->step, work->row);
        square += dot(work->row, work->step, p);
    }
    double share = square / 3.0 / CONSTANT(self, REACH);
    return 0.25 * share * share;
}

/* RigidFilter._update at work.change, to which work.present led; 0 if it is singular. */
INLINE int make_update(const Filter *self, const double *covariance, const double *q, const double *x,
                       double noise_square, double weight, const Work *work, Update *update)
{
    index_t p = self->active;
    double position[3], innovation[3], weighted[3], matrix[9], moved = 0.0, turn = 0.0;
    linearise(self, work->origin == NULL ? work->change : work->origin, q, work->numbers, position, work->jacobian);
    if (work->origin != NULL)
        locate(self, work->change, q, position);
    update->variance = noise_square + curvature(self, covariance, work);
    for (int c = 0; c < 3; c++) {
        combine(covariance, p, p, work->jacobian + c * p, work->gains + c * p);
        innovation[c] = x[c] - position[c] + dot(work->jacobian + c * p, work->present, p);
    }
    for (int a = 0; a < 3; a++)
        for (int b = 0; b < 3; b++)
            matrix[3 * a + b] = dot(work->jacobian + a * p, work->gains + b * p, p) +
                                (a == b) * update->variance / weight;
    if (!inverse(matrix, update->precision))
        return 0;
    times(update->precision, innovation, weighted);
    update->distance = dot(innovation, weighted, 3);
    for (index_t i = 0; i < p; i++) {
        work->step[i] = work->gains[i] * weighted[0] + work->gains[p + i] * weighted[1] +
                        work->gains[2 * p + i] * weighted[2];
        work->row[i] = work->step[i] - work->present[i];
        double turned = work->row[i] * self->scales[i] * self->bends[i];
        turn += turned * turned;
    }
    for (int c = 0; c < 3; c++) {
        double way = dot(work->jacobian + c * p, work->row, p);
        moved += way * way;
    }
    update->bend = sqrt(turn) * sqrt(moved);
    return 1;
}

/* RigidFilter._learn_one; 0 if the innovation's covariance is singular, and then nothing has changed. */
FAST static int learn_pair(const Filter *self, double *change, double *covariance, const double *q, const double *x,
                           double sigma, double *noise_square, double *coordinates, const Work *work)
{
    index_t p = self->active;
    Update update;
    double square = isnan(sigma) ? *noise_square : sigma * sigma, gate = CONSTANT(self, GATE);
    memset(work->present, 0, (size_t)p * sizeof(double));
    memcpy(work->change, change, (size_t)self->size * sizeof(double));
    if (!make_update(self, covariance, q, x, square, 1.0, work, &update))
        return 0;
    double distance = update.distance < gate ? update.distance : gate;
    double weight = distance > 0.0 ? distance / update.distance : 1.0;
    if (weight < 1.0 && !make_update(self, covariance, q, x, square, weight, work, &update))
        return 0;
    for (int i = 0; i < CONSTANT(self, ITERATIONS); i++) {
        if (update.bend <= CONSTANT(self, SMALL_BEND) * sqrt(update.variance))
            break;
        move(self, change, work->step, work->change);
        memcpy(work->present, work->step, (size_t)p * sizeof(double));
        if (!make_update(self, covariance, q, x, square, weight, work, &update))
            return 0;
    }
    move(self, change, work->step, work->change);
    memcpy(change, work->change, (size_t)self->size * sizeof(double));
    for (index_t i = 0; i < p; i++) {
        double pull[3], *row = covariance + i * p;
        double gain[3] = {work->gains[i], work->gains[p + i], work->gains[2 * p + i]};
        for (int c = 0; c < 3; c++)
            pull[c] = gain[0] * update.precision[c] + gain[1] * update.precision[3 + c] + gain[2] * update.precision[6 + c];
        for (index_t j = 0; j < p; j++)
            row[j] -= pull[0] * work->gains[j] + pull[1] * work->gains[p + j] + pull[2] * work->gains[2 * p + j];
    }
    if (isnan(sigma)) {
        double trace = update.precision[0] + update.precision[4] + update.precision[8];
        double share = *noise_square * trace / 3.0, total = *coordinates + 3.0 * share * share;
        double estimate = *noise_square * (1.0 + share * (distance - 3.0) / total);
        *noise_square = estimate > CONSTANT(self, LEAST_SQUARE) ? estimate : CONSTANT(self, LEAST_SQUARE);
        *coordinates = total < CONSTANT(self, NOISE_MEMORY) ? total : CONSTANT(self, NOISE_MEMORY);
    }
    return 1;
}

/* The view of where to linearise, empty for None; 0 and an exception where it is neither. */
INLINE int take_origin(const Filter *self, PyObject *object, Py_buffer *view)
{
    memset(view, 0, sizeof *view);
    return object == Py_None || take_all(&object, view, &self->size, 1);
}

/* learn(change, covariance, q, x, sigma, origin, noise_square, coordinates) -> (pairs learnt, noise_square, coordinates) */
static PyObject *filter_learn(Filter *self, PyObject *const *args, index_t count)
{
    Py_buffer views[6];
    index_t p = self->active, elements[5] = {self->size, p * p, -1, -1, -1};
    if (count != 8)
        return PyErr_Format(PyExc_TypeError, "eight arguments are needed");
    double noise_square = PyFloat_AsDouble(args[6]), coordinates = PyFloat_AsDouble(args[7]);
    if (PyErr_Occurred() || !take_origin(self, args[5], &views[5]))
        return NULL;
    if (!take_all(args, views, elements, 5)) {
        release_all(views + 5, 1);
        return NULL;
    }
    index_t n = views[4].len / (index_t)sizeof(double), done = 0;
    double *memory = malloc(work_size(self) * sizeof(double));
    int sound = views[2].len == self->joints * views[4].len && views[3].len == 3 * views[4].len &&
                !views[0].readonly && !views[1].readonly;
    if (memory == NULL) {
        PyErr_NoMemory();
    } else if (!sound) {
        PyErr_SetString(PyExc_TypeError, "q, x and sigma must be of one length, and the state writable");
    } else {
        Work work = divided(self, memory, views[5].buf);
        const double *q = views[2].buf, *x = views[3].buf, *sigma = views[4].buf;
        PyThreadState *thread = n > 1 ? PyEval_SaveThread() : NULL;
        while (done < n && learn_pair(self, views[0].buf, views[1].buf, q + done * self->joints, x + 3 * done,
                                      sigma[done], &noise_square, &coordinates, &work))
            done++;
        if (thread != NULL)
            PyEval_RestoreThread(thread);
    }
    free(memory);
    release_all(views, 6);
    return PyErr_Occurred() ? NULL : Py_BuildValue("(ndd)", done, noise_square, coordinates);
}

/* A vector (width,) of float64 in C order whose sum is finite, as kbmaps.arrays.vector wants it; 0 for anything else. */
INLINE int plain_vector(PyObject *object, index_t width, Py_buffer *view)
{
    if (!plain(object, view))
        return 0;
    double sum = 0.0;
    if (view->ndim == 1 && view->shape[0] == width)
        for (index_t i = 0; i < width; i++)
            sum += ((const double *)view->buf)[i];
    else
        sum = NAN;
    if (isfinite(sum))
        return 1;
    PyBuffer_Release(view); /* which sets its obj to NULL */
    return 0;
}

/* What a sigma stands for: NaN for None, a positive finite float as it is, 0 for anything else. */
INLINE double plain_sigma(PyObject *sigma)
{
    if (sigma == Py_None)
        return NAN;
    double value = PyFloat_Check(sigma) ? PyFloat_AsDouble(sigma) : 0.0;
    return value > 0.0 && isfinite(value) ? value : 0.0;
}

/* learn_one(change, covariance, row, q, x, sigma, origin, noise_square, coordinates) -> (noise_square, coordinates)
 *
 * Writes the pair to row (d + 4). None, and nothing has changed, where it is not float64 as it should be, or the
 * innovation's covariance singular: the way over kbmaps.pairs.checked_pairs and learn converts it, or says what is wrong. */
static PyObject *filter_learn_one(Filter *self, PyObject *const *args, index_t count)
{
    enum { CHANGE, COVARIANCE, ROW, ORIGIN, Q, X, VIEWS };
    Py_buffer views[VIEWS];
    index_t p = self->active, d = self->joints, elements[ORIGIN] = {self->size, p * p, d + 4};
    if (count != 9)
        return PyErr_Format(PyExc_TypeError, "nine arguments are needed");
    double sigma = plain_sigma(args[5]), noise_square = PyFloat_AsDouble(args[7]), coordinates = PyFloat_AsDouble(args[8]);
    if (PyErr_Occurred())
        return NULL;
    memset(views, 0, sizeof views);
    int usable = sigma != 0.0 && plain_vector(args[3], d, &views[Q]) && plain_vector(args[4], 3, &views[X]), learnt = 0;
    if (usable && take_origin(self, args[6], &views[ORIGIN]) && take_all(args, views, elements, ORIGIN)) {
        double *memory = malloc(work_size(self) * sizeof(double)), *row = views[ROW].buf;
        const double *q = views[Q].buf, *x = views[X].buf;
        if (memory == NULL) {
            PyErr_NoMemory();
        } else if (views[CHANGE].readonly || views[COVARIANCE].readonly || views[ROW].readonly) {
            PyErr_SetString(PyExc_TypeError, "the state and the row must be writable");
        } else {
            Work work = divided(self, memory, views[ORIGIN].buf);
            learnt = learn_pair(self, views[CHANGE].buf, views[COVARIANCE].buf, q, x, sigma, &noise_square, &coordinates,
                                &work);
        }
        if (learnt) {
            memcpy(row, q, (size_t)d * sizeof(double));
            memcpy(row + d, x, 3 * sizeof(double));
            row[d + 3] = sigma;
        }
        free(memory);
    }
    release_all(views, VIEWS);
    if (PyErr_Occurred())
        return NULL;
    if (!learnt)
        Py_RETURN_NONE;
    return Py_BuildValue("(dd)", noise_square, coordinates);
}

/* Positions (n, 3) at q (n, d) and, unless that is NULL, derivatives (n, 3, active). */
FAST static void linearise_rows(const Filter *self, const double *change, const double *q, index_t n, double *numbers,
                                double *x, double *jacobian)
{
    for (index_t i = 0; i < n; i++, q += self->joints, x += 3)
        if (jacobian == NULL)
            locate(self, change, q, x);
        else
            linearise(self, change, q, numbers, x, jacobian + 3 * self->active * i);
}

/* linearise(change, q, x, jacobian) writes positions to x (n, 3), and derivatives to jacobian (n, 3, active) or None. */
static PyObject *filter_linearise(Filter *self, PyObject *const *args, index_t count)
{
    Py_buffer views[4];
    index_t elements[4] = {self->size, -1, -1, -1};
    if (count != 4)
        return PyErr_Format(PyExc_TypeError, "four arguments are needed");
    int wanted = args[3] != Py_None, given = wanted ? 4 : 3;
    if (!take_all(args, views, elements, given))
        return NULL;
    index_t n = views[2].len / (3 * (index_t)sizeof(double));
    double *numbers = malloc((size_t)(JOINT_NUMBERS * self->joints) * sizeof(double));
    int sound = views[2].len == 3 * n * (index_t)sizeof(double) && 3 * views[1].len == self->joints * views[2].len &&
                !views[2].readonly && (!wanted || (views[3].len == self->active * views[2].len && !views[3].readonly));
    if (numbers == NULL) {
        PyErr_NoMemory();
    } else if (!sound) {
        PyErr_SetString(PyExc_TypeError, "q, x and jacobian must be of one length, and the last two writable");
    } else {
        PyThreadState *thread = n > 1 ? PyEval_SaveThread() : NULL;
        linearise_rows(self, views[0].buf, views[1].buf, n, numbers, views[2].buf, wanted ? views[3].buf : NULL);
        if (thread != NULL)
            PyEval_RestoreThread(thread);
    }
    free(numbers);
    release_all(views, given);
    if (PyErr_Occurred())
        return NULL;
    Py_RETURN_NONE;
}

static int find_active(Filter *self)
{
    self->places = malloc((size_t)self->size * sizeof(index_t));
    self->scales = malloc((size_t)self->size * sizeof(double));
    self->bends = malloc((size_t)self->size * sizeof(double));
    if (self->places == NULL || self->scales == NULL || self->bends == NULL)
        return 0;
    for (index_t i = 0; i < self->size; i++) {
        double scale = GIVEN(self, SCALES)[i];
        self->places[i] = scale > 0.0 ? self->active : -1;
        if (scale > 0.0) {
            self->scales[self->active] = scale;
            self->bends[self->active++] = GIVEN(self, BENDS)[i];
        }
    }
    return 1;
}

static PyObject *filter_new(PyTypeObject *type, PyObject *args, PyObject *Py_UNUSED(keywords))
{
    PyObject *given[FILTER_ARRAYS];
    if (!PyArg_ParseTuple(args, "OOOOOOOO", &given[0], &given[1], &given[2], &given[3], &given[4], &given[5], &given[6],
                          &given[7]))
        return NULL;
    Filter *self = (Filter *)((allocfunc)PyType_GetSlot(type, Py_tp_alloc))(type, 0);
    if (self == NULL)
        return NULL;
    index_t d = PyObject_Length(given[FIXED_SLIDES]);
    self->joints = d, self->size = 9 + 5 * d;
    index_t elements[FILTER_ARRAYS] = {3 * d, 3 * d, 6 * d, d, 16, self->size, self->size, CONSTANT_COUNT};
    if (d < 0 || !take_all(given, self->arrays, elements, FILTER_ARRAYS)) {
        Py_DECREF(self);
        return NULL;
    }
    if (!find_active(self)) {
        Py_DECREF(self);
        return PyErr_NoMemory();
    }
    return (PyObject *)self;
}

static void filter_dealloc(Filter *self)
{
    PyTypeObject *type = Py_TYPE((PyObject *)self);
    release_all(self->arrays, FILTER_ARRAYS);
    free(self->places), free(self->scales), free(self->bends);
    ((freefunc)PyType_GetSlot(type, Py_tp_free))(self);
    Py_DECREF(type);
}

static PyMethodDef filter_methods[] = {
    {"learn", (PyCFunction)(void (*)(void))filter_learn, METH_FASTCALL, NULL},
    {"learn_one", (PyCFunction)(void (*)(void))filter_learn_one, METH_FASTCALL, NULL},
    {"linearise", (PyCFunction)(void (*)(void))filter_linearise, METH_FASTCALL, NULL},
    {NULL, NULL, 0, NULL},
};

static PyType_Slot filter_slots[] = {
    {Py_tp_new, filter_new}, {Py_tp_dealloc, filter_dealloc}, {Py_tp_methods, filter_methods}, {0, NULL}};

PyType_Spec filter_spec = {
    "kbmaps._kernels.RigidFilter", sizeof(Filter), 0, Py_TPFLAGS_DEFAULT | Py_TPFLAGS_IMMUTABLETYPE, filter_slots};
