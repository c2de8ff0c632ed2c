/* Where the marker of a rigid chain is, and its derivatives: kbmaps.chains.parameters.linearised. */
#ifndef KBMAPS_CHAIN_H
#define KBMAPS_CHAIN_H
#include "common.h"
#include "vectors.h"

enum { AXES, POINTS, TANGENTS, FIXED_SLIDES, TIP_FRAME, SCALES, BENDS, CONSTANTS, FILTER_ARRAYS };
enum { ITERATIONS, SMALL_BEND, GATE, NOISE_MEMORY, LEAST_SQUARE, SMALL_ANGLE, REACH, CONSTANT_COUNT };
/* Numbers kept of each joint: effects of shifts (2) and tilts (2), the axis, a point of it, each a vector; its angle. */
enum { SHIFTED = 0, TILTED = 6, AXIS = 12, CENTRE = 15, JOINT_NUMBERS = 18 };

typedef struct {
    PyObject_HEAD
    index_t joints, size, active;
    Py_buffer arrays[FILTER_ARRAYS];
    index_t *places; /* of each parameter among the active ones, or -1 */
    double *scales, *bends; /* of the active ones */
} Filter;

#define GIVEN(self, which) ((const double *)(self)->arrays[which].buf)
#define CONSTANT(self, which) (GIVEN(self, CONSTANTS)[which])

/* Moves the frame (rotation, shift) by joint k at `angle`, and notes what its parameters do. */
INLINE void pass_joint(const Filter *self, index_t k, const double *change, double q, double *rotation, double *shift,
                       double *numbers)
{
    index_t d = self->joints;
    const double *tangents = GIVEN(self, TANGENTS) + 6 * k, *tilt = change + 6 + 2 * k, *move = change + 6 + 2 * d + 2 * k;
    double tilting[3], point[3], axis[3], turn[9], tilt_jacobian[9], motion[9], after[9], vector[3], moved[3];
    double angle = q + change[6 + 4 * d + k];
    for (int i = 0; i < 3; i++) {
        tilting[i] = tangents[2 * i] * tilt[0] + tangents[2 * i + 1] * tilt[1];
        point[i] = GIVEN(self, POINTS)[3 * k + i] + tangents[2 * i] * move[0] + tangents[2 * i + 1] * move[1];
    }
    exponential(tilting, CONSTANT(self, SMALL_ANGLE), turn, tilt_jacobian);
    times(turn, GIVEN(self, AXES) + 3 * k, axis);
    times(rotation, axis, numbers + AXIS);
    times(rotation, point, numbers + CENTRE);
    for (int i = 0; i < 3; i++)
        numbers[CENTRE + i] += shift[i];
    int slides = GIVEN(self, FIXED_SLIDES)[k] != 0.0;
    if (!slides) {
        rodrigues(axis, sin(angle), 1.0 - cos(angle), motion);
        product(rotation, motion, after);
    }
    for (int side = 0; side < 2; side++) {
        double tangent[3], turned[3], before_turned[3];
        column_of(tangents, 2, side, tangent);
        times(tilt_jacobian, tangent, turned);
        if (slides) {
            memset(numbers + SHIFTED + 3 * side, 0, 3 * sizeof(double));
            cross(turned, axis, vector);
            times(rotation, vector, moved);
            for (int i = 0; i < 3; i++)
                numbers[TILTED + 3 * side + i] = angle * moved[i];
            continue;
        }
        times(rotation, tangent, moved);
        times(after, tangent, vector);
        times(rotation, turned, before_turned);
        for (int i = 0; i < 3; i++)
            numbers[SHIFTED + 3 * side + i] = moved[i] - vector[i];
        times(after, turned, vector);
        for (int i = 0; i < 3; i++)
            numbers[TILTED + 3 * side + i] = before_turned[i] - vector[i];
    }
    if (slides) {
        for (int i = 0; i < 3; i++)
            shift[i] += angle * numbers[AXIS + i];
        return;
    }
    times(after, point, vector);
    for (int i = 0; i < 3; i++)
        shift[i] = numbers[CENTRE + i] - vector[i];
    memcpy(rotation, after, 9 * sizeof(double));
}

/* Writes the effect of one parameter on the marker, in its unit, if it is active. */
INLINE void set_column(const Filter *self, index_t parameter, const double *effect, double *jacobian)
{
    index_t place = self->places[parameter];
    for (int i = 0; i < 3 && place >= 0; i++)
        jacobian[i * self->active + place] = effect[i] * self->scales[place];
}

/* The frame (rotation, shift) before the first joint; the derivative (3, 3) of its turn. */
INLINE void begin_frame(const Filter *self, const double *change, double *rotation, double *shift, double *jacobian)
{
    exponential(change, CONSTANT(self, SMALL_ANGLE), rotation, jacobian);
    memcpy(shift, change + 3, 3 * sizeof(double));
}

/* Position x (3) of the marker in the frame (rotation, shift) after the last joint. */
INLINE void put_marker(const Filter *self, const double *change, const double *rotation, const double *shift, double *x)
{
    const double *tool = change + 6 + 5 * self->joints;
    double tip[3];
    for (int i = 0; i < 3; i++) {
        const double *row = GIVEN(self, TIP_FRAME) + 4 * i;
        tip[i] = row[3] + row[0] * tool[0] + row[1] * tool[1] + row[2] * tool[2];
    }
    times(rotation, tip, x);
    for (int i = 0; i < 3; i++)
        x[i] += shift[i];
}

/* Position (3) at q. */
INLINE void locate(const Filter *self, const double *change, const double *q, double *x)
{
    double rotation[9], shift[3], jacobian[9], numbers[JOINT_NUMBERS];
    begin_frame(self, change, rotation, shift, jacobian);
    for (index_t k = 0; k < self->joints; k++)
        pass_joint(self, k, change, q[k], rotation, shift, numbers);
    put_marker(self, change, rotation, shift, x);
}

/* Position (3) at q and its derivatives (3, active) by the change. `numbers` is working memory. */
INLINE void linearise(const Filter *self, const double *change, const double *q, double *numbers, double *x,
                      double *jacobian)
{
    index_t d = self->joints, tool = 6 + 5 * d;
    double base_jacobian[9], rotation[9], shift[3], effect[3], column[3], lever[3];
    const double *frame = GIVEN(self, TIP_FRAME), *kept;
    begin_frame(self, change, rotation, shift, base_jacobian);
    for (index_t k = 0; k < d; k++)
        pass_joint(self, k, change, q[k], rotation, shift, numbers + JOINT_NUMBERS * k);
    put_marker(self, change, rotation, shift, x);
    for (int i = 0; i < 3; i++)
        lever[i] = change[3 + i] - x[i];
    for (int j = 0; j < 3; j++) {
        double unit[3] = {j == 0, j == 1, j == 2};
        column_of(base_jacobian, 3, j, column);
        cross(lever, column, effect);
        set_column(self, j, effect, jacobian);
        set_column(self, 3 + j, unit, jacobian);
        column_of(frame, 4, j, column);
        times(rotation, column, effect);
        set_column(self, tool + j, effect, jacobian);
    }
    for (index_t k = 0; k < d; k++) {
        kept = numbers + JOINT_NUMBERS * k;
        int slides = GIVEN(self, FIXED_SLIDES)[k] != 0.0;
        for (int i = 0; i < 3; i++)
            lever[i] = kept[CENTRE + i] - x[i];
        for (int side = 0; side < 2; side++) {
            cross(lever, kept + TILTED + 3 * side, effect);
            set_column(self, 6 + 2 * k + side, slides ? kept + TILTED + 3 * side : effect, jacobian);
            set_column(self, 6 + 2 * d + 2 * k + side, kept + SHIFTED + 3 * side, jacobian);
        }
        cross(lever, kept + AXIS, effect);
        set_column(self, 6 + 4 * d + k, slides ? kept + AXIS : effect, jacobian);
    }
}

#endif
