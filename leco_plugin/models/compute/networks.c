/* Small networks for a CPU, in C: a gate's logits and a field's density, without gradients.
 * `native.py` compiles this file and calls it; the slow twins in torch are `models/gate.py: Gate`
 * and `models/field.py: HMoEField`.
 *
 * Points go through a network in blocks that stay in the cache of a core, one row a feature. All
 * matrices are as torch has them: [outputs, inputs].
 */
#include <math.h>
#include <string.h>

#include "routines.h"

#ifdef __AVX512F__ /* a register holds 16 values, and there are 32 of them in place of 16 */
#define LANES 16
#define ROWS 8
#else
#define LANES 8
#define ROWS 4
#endif
#define WIDEST 512 /* features that a block has room for */

typedef float Lanes __attribute__((vector_size(4 * LANES)));
typedef int Ints __attribute__((vector_size(4 * LANES)));
typedef float Block[WIDEST][BLOCK] __attribute__((aligned(64)));

enum { AS_IT_IS, RELU, ADDED }; /* ADDED | RELU is both, in that order */

static inline __attribute__((always_inline)) void
outputs_of(const float *weights, const float *biases, int inputs, const float (*in)[BLOCK],
           float (*out)[BLOCK], const int rows, int then)
{
    for (int b = 0; b < BLOCK; b += 3 * LANES) {
        Lanes sums[ROWS][3];
#pragma GCC unroll 8
        for (int r = 0; r < rows; r++)
#pragma GCC unroll 3
            for (int v = 0; v < 3; v++)
                sums[r][v] = (Lanes){0} + biases[r];
        for (int k = 0; k < inputs; k++) {
            const Lanes *x = (const Lanes *)&in[k][b];
#pragma GCC unroll 8
            for (int r = 0; r < rows; r++) {
                float weight = weights[(int64_t)r * inputs + k];
#pragma GCC unroll 3
                for (int v = 0; v < 3; v++)
                    sums[r][v] += weight * x[v];
            }
        }
#pragma GCC unroll 8
        for (int r = 0; r < rows; r++)
#pragma GCC unroll 3
            for (int v = 0; v < 3; v++) {
                Lanes *place = (Lanes *)&out[r][b] + v, value = sums[r][v];
                if (then & ADDED)
                    value += *place;
                if (then & RELU)
                    value = (Lanes)((Ints)value & ~(value <= 0)); /* keeps NaN */
                *place = value;
            }
    }
}

/* A linear layer; its outputs are added to what is there, cut off below zero, or kept. */
static void linear(const float *weights, const float *biases, int inputs, int outputs,
                   const float (*in)[BLOCK], float (*out)[BLOCK], int then)
{
    int o = 0;
#define FROM(COUNT) outputs_of(weights + (int64_t)o * inputs, biases + o, inputs, in, out + o, COUNT, then)
    for (; o + ROWS <= outputs; o += ROWS)
        FROM(ROWS);
    for (; o < outputs; o++)
        FROM(1);
#undef FROM
}

/* Sines and cosines of a row, to one unit of the last digit for angles up to some thousand: the
 * angle less a multiple of pi / 2, taken off in three parts, and the polynomials of Cephes. */
static void waves(const float *angles, float *sines, float *cosines)
{
    for (int b = 0; b < BLOCK; b++) {
        float turns = rintf(angles[b] * 0.636619772f);
        float x = ((angles[b] - turns * 1.5703125f) - turns * 4.837512969970703e-4f) -
                  turns * 7.549789954891882e-8f;
        float square = x * x;
        float sine = x + x * square *
                             (-1.6666654611e-1f +
                              square * (8.3321608736e-3f - square * 1.9515295891e-4f));
        float cosine = 1.0f - 0.5f * square +
                       square * square *
                           (4.166664568298827e-2f +
                            square * (-1.388731625493765e-3f + square * 2.443315711809948e-5f));
        int quarter = (int)turns;
        float s = quarter & 1 ? cosine : sine, c = quarter & 1 ? sine : cosine;
        sines[b] = quarter & 2 ? -s : s;
        cosines[b] = (quarter + 1) & 2 ? -c : c;
    }
}

/* x, sines, cosines: rows [3 + 6 octaves]; in between fresh ones octaves follow by doubling. */
void frequencies(const float *scales, int octaves, int fresh, float (*rows)[BLOCK])
{
    for (int octave = 0; octave < octaves; octave++)
        for (int axis = 0; axis < 3; axis++) {
            float *sines = rows[3 + 3 * octave + axis], *cosines = sines + 3 * octaves * BLOCK;
            if (octave % fresh == 0) {
                float angles[BLOCK];
                for (int b = 0; b < BLOCK; b++)
                    angles[b] = rows[axis][b] * scales[octave];
                waves(angles, sines, cosines);
                continue;
            }
            const float *sine = sines - 3 * BLOCK, *cosine = cosines - 3 * BLOCK;
            for (int b = 0; b < BLOCK; b++) {
                sines[b] = 2.0f * sine[b] * cosine[b];
                cosines[b] = 2.0f * cosine[b] * cosine[b] - 1.0f;
            }
        }
}

static void layer_norm(const float *scale, const float *shift, float epsilon, int width,
                       float (*rows)[BLOCK])
{
    float mean[BLOCK] = {0}, square[BLOCK] = {0};
    for (int k = 0; k < width; k++)
        for (int b = 0; b < BLOCK; b++)
            mean[b] += rows[k][b];
    for (int b = 0; b < BLOCK; b++)
        mean[b] /= width;
    for (int k = 0; k < width; k++)
        for (int b = 0; b < BLOCK; b++)
            square[b] += (rows[k][b] - mean[b]) * (rows[k][b] - mean[b]);
    for (int b = 0; b < BLOCK; b++)
        square[b] = 1.0f / sqrtf(square[b] / width + epsilon);
    for (int k = 0; k < width; k++)
        for (int b = 0; b < BLOCK; b++)
            rows[k][b] = (rows[k][b] - mean[b]) * square[b] * scale[k] + shift[k];
}

/* logits[points, outputs] of points `begin` to `end` of positions, in [-1, 1], whose coordinates
 * lie `stride` apart and whose points lie `next` apart.
 *
 * parts: weights and biases of the hidden layers, scale and shift of the norm, weights and biases
 * of the last layer. */
void gate_logits(const float *positions, const float *scales, const float *const *parts,
                 float *logits, int64_t begin, int64_t end, int64_t stride, int64_t next,
                 int octaves, int fresh, int layers, int width, int outputs, float epsilon)
{
    Block one, other;
    memset(one, 0, sizeof one);
    for (int64_t first = begin; first < end; first += BLOCK) {
        int count = in_block(first, end), inputs = 3 + 6 * octaves;
        float(*in)[BLOCK] = one, (*out)[BLOCK] = other;
        for (int axis = 0; axis < 3; axis++)
            for (int b = 0; b < count; b++)
                in[axis][b] = positions[axis * stride + (first + b) * next];
        frequencies(scales, octaves, fresh, in);
        for (int layer = 0; layer < layers; layer++) {
            float(*swap)[BLOCK] = in;
            linear(parts[2 * layer], parts[2 * layer + 1], inputs, width, in, out, RELU);
            in = out, out = swap, inputs = width;
        }
        const float *const *last = parts + 2 * layers;
        layer_norm(last[0], last[1], epsilon, width, in);
        linear(last[2], last[3], width, outputs, in, out, AS_IT_IS);
        for (int o = 0; o < outputs; o++)
            for (int b = 0; b < count; b++)
                logits[(first + b) * outputs + o] = out[o][b];
    }
}

/* hidden[points, width] and raw[points] densities of a field, of the places `begin` to `end` of
 * `order`, which names points in the order of their routes.
 *
 * features: [points, inputs] of the encoding. factors: [points] of the hidden features.
 * parts: weights and biases of the projection and of the density; then those of each expert's
 * layers. An expert adds to its input; one whose first part is null adds nothing. */
void field_densities(const float *features, const int64_t *order, const int64_t *routes,
                     const float *factors, const float *const *parts, float *hidden, float *raw,
                     int64_t begin, int64_t end, int inputs, int width, int layers)
{
    Block one, other, third;
    memset(one, 0, sizeof one);
    for (int64_t first = begin; first < end;) {
        int64_t route = routes[order[first]];
        int count = 1;
        while (count < BLOCK && first + count < end && routes[order[first + count]] == route)
            count++;
        for (int b = 0; b < count; b++)
            for (int k = 0; k < inputs; k++)
                one[k][b] = features[order[first + b] * inputs + k];
        linear(parts[0], parts[1], inputs, width, one, other, AS_IT_IS);
        const float *const *expert = parts + 4 + 2 * layers * route;
        if (expert[0]) {
            float(*in)[BLOCK] = other, (*out)[BLOCK] = third;
            for (int layer = 0; layer + 1 < layers; layer++) {
                linear(expert[2 * layer], expert[2 * layer + 1], width, width, in, out, RELU);
                in = out, out = in == third ? one : third;
            }
            linear(expert[2 * layers - 2], expert[2 * layers - 1], width, width, in, other, ADDED);
        }
        for (int b = 0; b < count; b++) {
            float *place = hidden + order[first + b] * width, factor = factors[order[first + b]];
            for (int k = 0; k < width; k++) {
                other[k][b] *= factor;
                place[k] = other[k][b];
            }
        }
        linear(parts[2], parts[3], width, 1, other, third, AS_IT_IS);
        for (int b = 0; b < count; b++)
            raw[order[first + b]] = third[0][b];
        first += count;
    }
}

/* Adds to rgb[rays, 3] the colours of `count` samples, whose numbers are `chosen`, by weight.
 *
 * hidden: [samples, width]. rays: [samples]. of_rays: [rays, units], the ray's share of the hidden
 * layer. parts: weights and biases of the hidden layer and of the last, before the sigmoid. */
void add_colors(const float *hidden, const float *weights, const int64_t *rays, const int *chosen,
                int count, const float *of_rays, const float *const *parts, float *rgb, int width,
                int units)
{
    Block one, other;
    memset(one, 0, sizeof one), memset(other, 0, sizeof other);
    for (int first = 0; first < count; first += BLOCK) {
        const int *block = chosen + first, size = in_block(first, count);
        for (int b = 0; b < size; b++) {
            const float *features = hidden + (int64_t)block[b] * width;
            const float *of_ray = of_rays + rays[block[b]] * units;
            for (int k = 0; k < width; k++)
                one[k][b] = features[k];
            for (int k = 0; k < units; k++)
                other[k][b] = of_ray[k];
        }
        linear(parts[0], parts[1], width, units, one, other, ADDED | RELU);
        linear(parts[2], parts[3], units, 3, other, one, AS_IT_IS);
        for (int b = 0; b < size; b++)
            for (int c = 0; c < 3; c++)
                rgb[3 * rays[block[b]] + c] += weights[block[b]] / (1.0f + expf(-one[c][b]));
    }
}
