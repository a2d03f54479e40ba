/* Hash grids for a CPU, in C. `native.py` compiles this file and calls it; the slow twins in torch
 * are `models/encodings.py: HashEncoding` and `studio/hash_encoding.py: CpuHashEncoding`.
 *
 * A level of a table has 2^log2 rows of `features` values. A point lies in a cell of a level; the
 * rows of the cell's corners are hashed (Instant-NGP, eq. 4) and summed by weight. With 4 corners
 * the weights are those of a tetrahedron, with 8 they are trilinear.
 */
#include <math.h>
#include <stdint.h>

#define PRIME_Y 2654435761u
#define PRIME_Z 805459861u
#define BLOCK 64 /* points whose rows are all asked for before the first is used */
#define MOST_CORNERS 8

typedef struct {
    uint32_t rows[BLOCK * MOST_CORNERS];
    float weights[BLOCK * MOST_CORNERS];
} Corners;

typedef struct {
    float x, y, z;            /* place in the cell, from 0 to 1 */
    uint32_t low_x, low_y, low_z; /* the lower corner, times the primes */
} Place;

static inline Place place_of(const float *position, float resolution)
{
    Place p;
    float x = position[0] * resolution, y = position[1] * resolution, z = position[2] * resolution;
    float low_x = floorf(x), low_y = floorf(y), low_z = floorf(z);
    p.x = x - low_x;
    p.y = y - low_y;
    p.z = z - low_z;
    p.low_x = (uint32_t)(int32_t)low_x;
    p.low_y = (uint32_t)(int32_t)low_y * PRIME_Y;
    p.low_z = (uint32_t)(int32_t)low_z * PRIME_Z;
    return p;
}

/* The cell is cut into six tetrahedra by the order of x, y and z in it: from the lowest corner a
 * walk goes along the axis of the largest, the middle one, the smallest. */
static inline void tetrahedron(Place p, uint32_t mask, uint32_t *rows, float *weights)
{
    uint32_t along_x = p.low_x ^ (p.low_x + 1u), along_y = p.low_y ^ (p.low_y + PRIME_Y),
             along_z = p.low_z ^ (p.low_z + PRIME_Z);
    uint32_t first = p.low_x ^ p.low_y ^ p.low_z, last = first ^ along_x ^ along_y ^ along_z;
    int x_over_y = p.x >= p.y, y_over_z = p.y >= p.z, x_over_z = p.x >= p.z;
    uint32_t largest = x_over_y && x_over_z ? along_x : y_over_z ? along_y : along_z;
    uint32_t smallest = x_over_z && y_over_z ? along_z : x_over_y ? along_y : along_x;
    float most = fmaxf(fmaxf(p.x, p.y), p.z), least = fminf(fminf(p.x, p.y), p.z);
    float middle = p.x + p.y + p.z - most - least;
    rows[0] = first & mask, weights[0] = 1.0f - most;
    rows[1] = (first ^ largest) & mask, weights[1] = most - middle;
    rows[2] = (last ^ smallest) & mask, weights[2] = middle - least;
    rows[3] = last & mask, weights[3] = least;
}

static inline void cube(Place p, uint32_t mask, uint32_t *rows, float *weights)
{
    for (int corner = 0; corner < 8; corner++) {
        int up_x = corner & 1, up_y = corner >> 1 & 1, up_z = corner >> 2;
        uint32_t row = (p.low_x + (up_x ? 1u : 0u)) ^ (p.low_y + (up_y ? PRIME_Y : 0u)) ^
                       (p.low_z + (up_z ? PRIME_Z : 0u));
        rows[corner] = row & mask;
        weights[corner] = (up_x ? p.x : 1.0f - p.x) * (up_y ? p.y : 1.0f - p.y) *
                          (up_z ? p.z : 1.0f - p.z);
    }
}

static inline void corners_of(const float *positions, int count, float resolution, uint32_t mask,
                              int corners, const float *level, int features, Corners *found)
{
    for (int i = 0; i < count; i++) {
        Place p = place_of(positions + 3 * i, resolution);
        uint32_t *rows = found->rows + corners * i;
        if (corners == 4)
            tetrahedron(p, mask, rows, found->weights + corners * i);
        else
            cube(p, mask, rows, found->weights + corners * i);
        for (int k = 0; k < corners; k++)
            __builtin_prefetch(level + (int64_t)rows[k] * features, 1);
    }
}

static inline int in_block(int64_t first, int64_t last)
{
    return last - first < BLOCK ? (int)(last - first) : BLOCK;
}

static inline void sums(const float *positions, const float *resolutions, const float *table,
                        float *out, int64_t begin, int64_t end, int levels, int log2, int features,
                        int corners)
{
    Corners found;
    for (int64_t block = begin; block < end; block += BLOCK)
        for (int level = 0; level < levels; level++) {
            const float *rows = table + ((int64_t)level << log2) * features;
            int count = in_block(block, end);
            corners_of(positions + 3 * block, count, resolutions[level], (1u << log2) - 1, corners,
                       rows, features, &found);
            for (int i = 0; i < count; i++) {
                float *sum = out + ((block + i) * levels + level) * features;
                for (int f = 0; f < features; f++) {
                    float total = 0.0f;
                    for (int k = corners * i; k < corners * (i + 1); k++)
                        total += found.weights[k] * rows[(int64_t)found.rows[k] * features + f];
                    sum[f] = total;
                }
            }
        }
}

static inline void gradients(const float *positions, const float *resolutions,
                             const float *gradient, float *table, int64_t points, int begin,
                             int end, int levels, int log2, int features, int corners)
{
    Corners found;
    for (int level = begin; level < end; level++)
        for (int64_t block = 0; block < points; block += BLOCK) {
            float *rows = table + ((int64_t)level << log2) * features;
            int count = in_block(block, points);
            corners_of(positions + 3 * block, count, resolutions[level], (1u << log2) - 1, corners,
                       rows, features, &found);
            for (int i = 0; i < count; i++) {
                const float *given = gradient + ((block + i) * levels + level) * features;
                for (int k = corners * i; k < corners * (i + 1); k++)
                    for (int f = 0; f < features; f++)
                        rows[(int64_t)found.rows[k] * features + f] += found.weights[k] * given[f];
            }
        }
}

/* Sizes that a compiler knows are three times as fast. */
#define FOR_KNOWN_SIZES(CALL)                                                                      \
    if (features == 2 && corners == 4) CALL(2, 4);                                                 \
    else if (features == 2 && corners == 8) CALL(2, 8);                                            \
    else if (corners == 4) CALL(features, 4);                                                      \
    else CALL(features, 8)

/* Weighted sums out[points, levels * features] of points `begin` to `end` of positions[points, 3],
 * in [0, 1], from table[levels * 2^log2, features]. */
void hash_sums(const float *positions, const float *resolutions, const float *table, float *out,
               int64_t begin, int64_t end, int levels, int log2, int features, int corners)
{
#define SUMS(F, C) sums(positions, resolutions, table, out, begin, end, levels, log2, F, C)
    FOR_KNOWN_SIZES(SUMS);
}

/* Adds to table[levels * 2^log2, features], from level `begin` to `end`, what the gradient
 * [points, levels * features] of the sums gives. */
void hash_gradients(const float *positions, const float *resolutions, const float *gradient,
                    float *table, int64_t points, int begin, int end, int levels, int log2,
                    int features, int corners)
{
#define GRADIENTS(F, C)                                                                            \
    gradients(positions, resolutions, gradient, table, points, begin, end, levels, log2, F, C)
    FOR_KNOWN_SIZES(GRADIENTS);
}
