/* Gradients of small networks for a CPU, in C: of a gate's logits, of a field's densities, of the
 * colours of rays. `native.py` compiles this file, `learned.py` calls it; the slow twin is what
 * torch differentiates.
 *
 * Points go through in blocks, one row a point; what the forward pass has computed is computed
 * again, which costs less than to keep it. Rows of features and of matrices are padded with zeros to
 * a multiple of PADDED values. A layer has three parts: its weights [outputs, inputs], the same
 * turned, its biases; and two of gradients, to which is added: those of weights and biases.
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "routines.h"

#define PADDED 16
#define ROWS 6
#ifdef __AVX512F__
#define LANES 16
#define ACROSS 4
#else
#define LANES 8
#define ACROSS 2
#endif

typedef float Lanes __attribute__((vector_size(4 * LANES), aligned(4)));
typedef const float *const *Parts;

/* Sums over k of a(row, k) b[k][column], of some rows and columns, added to what is there. */
static inline __attribute__((always_inline)) void
add_tile(const float *a, int64_t a_row, int64_t a_next, const float *b, int b_row, float *out,
         int out_row, int inner, const int rows, const int across)
{
    Lanes sums[ROWS][ACROSS];
#pragma GCC unroll 6
    for (int r = 0; r < rows; r++)
#pragma GCC unroll 4
        for (int v = 0; v < across; v++)
            sums[r][v] = *(const Lanes *)(out + r * out_row + v * LANES);
    for (int k = 0; k < inner; k++) {
        Lanes values[ACROSS];
#pragma GCC unroll 4
        for (int v = 0; v < across; v++)
            values[v] = *(const Lanes *)(b + k * b_row + v * LANES);
#pragma GCC unroll 6
        for (int r = 0; r < rows; r++) {
            float factor = a[r * a_row + k * a_next];
#pragma GCC unroll 4
            for (int v = 0; v < across; v++)
                sums[r][v] += factor * values[v];
        }
    }
#pragma GCC unroll 6
    for (int r = 0; r < rows; r++)
#pragma GCC unroll 4
        for (int v = 0; v < across; v++)
            *(Lanes *)(out + r * out_row + v * LANES) = sums[r][v];
}

static inline __attribute__((always_inline)) void
add_columns(const float *a, int64_t a_row, int64_t a_next, const float *b, int b_row, float *out,
            int out_row, int rows, int inner, const int across)
{
    int r = 0;
    for (; r + ROWS <= rows; r += ROWS)
        add_tile(a + r * a_row, a_row, a_next, b, b_row, out + r * out_row, out_row, inner, ROWS, across);
    for (; r < rows; r++)
        add_tile(a + r * a_row, a_row, a_next, b, b_row, out + r * out_row, out_row, inner, 1, across);
}

/* out[rows, columns] += a b, where a(row, k) lies at row * a_row + k * a_next. */
static void add_product(const float *a, int64_t a_row, int64_t a_next, const float *b, int b_row,
                        float *out, int out_row, int rows, int inner, int columns)
{
    int c = 0;
    for (; c + ACROSS * LANES <= columns; c += ACROSS * LANES)
        add_columns(a, a_row, a_next, b + c, b_row, out + c, out_row, rows, inner, ACROSS);
    for (; c < columns; c += LANES)
        add_columns(a, a_row, a_next, b + c, b_row, out + c, out_row, rows, inner, 1);
}

static int padded(int size) { return (size + PADDED - 1) / PADDED * PADDED; }

/* out[count, outputs] of a layer; all that is padded. */
static void layer_of(Parts layer, const float *in, int inputs, float *out, int outputs, int count,
                     int cut_off)
{
    for (int b = 0; b < count; b++)
        memcpy(out + b * outputs, layer[2], outputs * sizeof *out);
    add_product(in, inputs, 1, layer[1], outputs, out, outputs, count, inputs, outputs);
    for (int i = 0; cut_off && i < count * outputs; i++)
        out[i] = out[i] <= 0.0f ? 0.0f : out[i]; /* keeps NaN */
}

/* From the gradient given[count, outputs] of a layer: that of its parts, and of its input where
 * that is wanted, added to what is there. Of the outputs the first `known` are no padding. */
static void layer_back(Parts layer, float *const *found, const float *given, int outputs, int known,
                       const float *in, int inputs, float *of_in, int count)
{
    for (int b = 0; b < count; b++)
        for (int o = 0; o < known; o++)
            found[1][o] += given[b * outputs + o];
    add_product(given, 1, outputs, in, inputs, found[0], inputs, known, count, inputs);
    if (of_in)
        add_product(given, outputs, 1, layer[0], inputs, of_in, inputs, count, known, inputs);
}

/* Where a hidden layer was cut off, no gradient passes. */
static void cut_off(float *given, const float *hidden, int64_t values)
{
    for (int64_t i = 0; i < values; i++)
        given[i] = hidden[i] <= 0.0f ? 0.0f : given[i];
}

/* Through the norm of in[count, row], of which `width` values are no padding. On return `given` is
 * the gradient of `in`. */
static void norm_back(const float *scale, const float *shift, float epsilon, float *of_scale,
                      float *of_shift, float *normed, float *given, const float *in, int width,
                      int row, int count, int forward)
{
    for (int b = 0; b < count; b++) {
        const float *x = in + b * row;
        float *n = normed + b * row, *g = given + b * row, mean = 0.0f, square = 0.0f;
#pragma omp simd reduction(+ : mean)
        for (int k = 0; k < width; k++)
            mean += x[k];
        mean /= width;
#pragma omp simd reduction(+ : square)
        for (int k = 0; k < width; k++)
            square += (x[k] - mean) * (x[k] - mean);
        float over = 1.0f / sqrtf(square / width + epsilon), sum = 0.0f, along = 0.0f;
        if (forward) { /* what the last layer is given */
            for (int k = 0; k < width; k++)
                n[k] = (x[k] - mean) * over * scale[k] + shift[k];
            continue;
        }
#pragma omp simd reduction(+ : sum, along)
        for (int k = 0; k < width; k++) {
            n[k] = (x[k] - mean) * over;
            of_scale[k] += g[k] * n[k];
            of_shift[k] += g[k];
            g[k] *= scale[k];
            sum += g[k];
            along += g[k] * n[k];
        }
        for (int k = 0; k < width; k++)
            g[k] = over * (g[k] - sum / width - n[k] * along / width);
    }
}

/* Gradients of a gate's parts from given[points, outputs] of its logits, of points `begin` to
 * `end`. Positions, scales and sizes are those of `gate_logits`; parts are those of the hidden
 * layers, scale and shift of the norm, those of the last layer. Returns -1 where there is no
 * memory. */
int gate_gradients(const float *positions, const float *scales, Parts parts, const float *given,
                   float *const *found, int64_t begin, int64_t end, int64_t stride, int64_t next,
                   int octaves, int fresh, int layers, int width, int outputs, float epsilon)
{
    int known = 3 + 6 * octaves, inputs = padded(known), row = padded(width), last = padded(outputs);
    int64_t each = (int64_t)BLOCK * row;
    float *waves = calloc((int64_t)known * BLOCK + BLOCK * inputs + (layers + 2) * each + BLOCK * last, sizeof *waves);
    if (!waves)
        return -1;
    float *in = waves + known * BLOCK, *hidden = in + BLOCK * inputs, *one = hidden + layers * each;
    float *other = one + each, *logits = other + each;
    Parts norm = parts + 3 * layers, head = norm + 2;
    float *const *of_norm = found + 2 * layers;
    for (int64_t first = begin; first < end; first += BLOCK) {
        int count = in_block(first, end);
        for (int axis = 0; axis < 3; axis++)
            for (int b = 0; b < count; b++)
                waves[axis * BLOCK + b] = positions[axis * stride + (first + b) * next];
        frequencies(scales, octaves, fresh, (float(*)[BLOCK])waves);
        for (int k = 0; k < known; k++)
            for (int b = 0; b < count; b++)
                in[b * inputs + k] = waves[k * BLOCK + b];
        for (int i = 0; i < layers; i++)
            layer_of(parts + 3 * i, i ? hidden + (i - 1) * each : in, i ? row : inputs,
                     hidden + i * each, row, count, 1);
        for (int b = 0; b < count; b++)
            memcpy(logits + b * last, given + (first + b) * outputs, outputs * sizeof *given);
        const float *features = hidden + (layers - 1) * each;
        norm_back(norm[0], norm[1], epsilon, of_norm[0], of_norm[1], other, one, features, width,
                  row, count, 1);
        memset(one, 0, each * sizeof *one);
        layer_back(head, of_norm + 2, logits, last, outputs, other, row, one, count);
        norm_back(norm[0], norm[1], epsilon, of_norm[0], of_norm[1], other, one, features, width,
                  row, count, 0);
        for (int i = layers - 1; i >= 0; i--) {
            float *swap = one;
            cut_off(one, hidden + i * each, (int64_t)count * row);
            memset(other, 0, each * sizeof *other);
            layer_back(parts + 3 * i, found + 2 * i, one, row, width, i ? hidden + (i - 1) * each : in,
                       i ? row : inputs, i ? other : NULL, count);
            one = other, other = swap;
        }
    }
    free(waves);
    return 0;
}

/* Gradients of a field's encoded features [points, inputs] and factors [points], and of its parts,
 * from those of its hidden features [points, width] and of its raw densities [points], at the places
 * `begin` to `end` of `order`; see `field_densities`. Parts are those of the projection, of the
 * density, of the layers of each expert; null for those of an expert that adds nothing. Returns -1
 * where there is no memory. */
int field_gradients(const float *features, const int64_t *order, const int64_t *routes,
                    const float *factors, Parts parts, const float *of_hidden, const float *of_raw,
                    float *of_features, float *of_factors, float *const *found, int64_t begin,
                    int64_t end, int known, int width, int layers)
{
    int inputs = padded(known), row = padded(width);
    int64_t each = (int64_t)BLOCK * row;
    float *in = calloc(2 * (int64_t)BLOCK * inputs + (layers + 4) * each, sizeof *in);
    if (!in)
        return -1;
    float *of_in = in + BLOCK * inputs, *hidden = of_in + BLOCK * inputs;
    float *added = hidden + layers * each, *of_projected = added + each, *one = of_projected + each;
    float *other = one + each;
    for (int64_t first = begin; first < end;) {
        int64_t route = routes[order[first]];
        int count = 1;
        while (count < BLOCK && first + count < end && routes[order[first + count]] == route)
            count++;
        Parts expert = parts + 6 + 3 * layers * route;
        float *const *of_expert = found + 4 + 2 * layers * route;
        for (int b = 0; b < count; b++)
            memcpy(in + b * inputs, features + order[first + b] * known, known * sizeof *in);
        layer_of(parts, in, inputs, hidden, row, count, 0); /* hidden is the projection at first */
        memset(added, 0, each * sizeof *added);
        if (expert[0]) {
            for (int i = 0; i + 1 < layers; i++)
                layer_of(expert + 3 * i, hidden + i * each, row, hidden + (i + 1) * each, row, count, 1);
            layer_of(expert + 3 * layers - 3, hidden + (layers - 1) * each, row, added, row, count, 0);
        }
        for (int b = 0; b < count; b++) {
            int64_t point = order[first + b];
            const float *given = of_hidden + point * width, *density = parts[3];
            const float *projected = hidden + b * row, *more = added + b * row;
            float *back = of_projected + b * row, *of_density = found[2];
            float raw = of_raw[point], factor = factors[point], sum = 0.0f;
#pragma omp simd reduction(+ : sum)
            for (int k = 0; k < width; k++) {
                float value = projected[k] + more[k], gradient = given[k] + raw * density[k];
                of_density[k] += raw * factor * value;
                sum += gradient * value;
                back[k] = gradient * factor;
            }
            found[3][0] += raw;
            of_factors[point] = sum;
        }
        if (expert[0]) {
            memcpy(one, of_projected, each * sizeof *one);
            for (int i = layers - 1; i >= 0; i--) {
                float *swap = one, *to = i ? other : of_projected;
                if (i)
                    memset(other, 0, each * sizeof *other);
                layer_back(expert + 3 * i, of_expert + 2 * i, one, row, width, hidden + i * each, row, to, count);
                if (i)
                    cut_off(other, hidden + i * each, (int64_t)count * row);
                one = other, other = swap;
            }
        }
        memset(of_in, 0, (int64_t)BLOCK * inputs * sizeof *of_in);
        layer_back(parts, found, of_projected, row, width, in, inputs, of_in, count);
        for (int b = 0; b < count; b++)
            memcpy(of_features + order[first + b] * known, of_in + b * inputs, known * sizeof *in);
        first += count;
    }
    free(in);
    return 0;
}

/* Gradients from those of colours rgb[rays, 3] that `add_colors` has summed up: of the hidden
 * features [samples, width], the weights [samples], what each ray gives [rays, units], and the two
 * layers of colour. Returns -1 where there is no memory. */
int color_gradients(const float *hidden, const float *weights, const int64_t *rays, const int *chosen,
                    int count, const float *of_rays, Parts parts, const float *of_rgb, float *of_hidden,
                    float *of_weights, float *of_of_rays, float *const *found, int width, int units)
{
    int row = padded(width), across = padded(units);
    float *in = calloc((int64_t)BLOCK * (2 * row + 2 * across + 2 * PADDED), sizeof *in);
    if (!in)
        return -1;
    float *of_in = in + BLOCK * row, *layer = of_in + BLOCK * row, *of_layer = layer + BLOCK * across;
    float *out = of_layer + BLOCK * across, *of_out = out + BLOCK * PADDED;
    for (int first = 0; first < count; first += BLOCK) {
        const int *block = chosen + first;
        int size = in_block(first, count);
        for (int b = 0; b < size; b++) {
            memcpy(in + b * row, hidden + (int64_t)block[b] * width, width * sizeof *in);
            memcpy(layer + b * across, parts[2], across * sizeof *in);
            const float *of_ray = of_rays + rays[block[b]] * units;
            for (int k = 0; k < units; k++)
                layer[b * across + k] += of_ray[k];
        }
        add_product(in, row, 1, parts[1], across, layer, across, size, row, across);
        for (int i = 0; i < size * across; i++)
            layer[i] = layer[i] <= 0.0f ? 0.0f : layer[i];
        layer_of(parts + 3, layer, across, out, PADDED, size, 0);
        for (int b = 0; b < size; b++) {
            float sum = 0.0f;
            for (int c = 0; c < 3; c++) {
                float color = 1.0f / (1.0f + expf(-out[b * PADDED + c]));
                float given = of_rgb[3 * rays[block[b]] + c];
                sum += given * color;
                of_out[b * PADDED + c] = given * weights[block[b]] * color * (1.0f - color);
            }
            of_weights[block[b]] = sum;
        }
        memset(of_layer, 0, (int64_t)BLOCK * across * sizeof *in);
        memset(of_in, 0, (int64_t)BLOCK * row * sizeof *in);
        layer_back(parts + 3, found + 2, of_out, PADDED, 3, layer, across, of_layer, size);
        cut_off(of_layer, layer, (int64_t)size * across);
        layer_back(parts, found, of_layer, across, units, in, row, of_in, size);
        for (int b = 0; b < size; b++) {
            float *of_ray = of_of_rays + rays[block[b]] * units;
            for (int k = 0; k < units; k++)
                of_ray[k] += of_layer[b * across + k];
            memcpy(of_hidden + (int64_t)block[b] * width, of_in + b * row, width * sizeof *in);
        }
    }
    free(in);
    return 0;
}
