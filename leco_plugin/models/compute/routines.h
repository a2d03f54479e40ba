/* What the files in C call of each other. */
#include <stdint.h>

#define BLOCK 48 /* points that go through a network together */

static inline int in_block(int64_t first, int64_t last)
{
    return last - first < BLOCK ? (int)(last - first) : BLOCK;
}

void frequencies(const float *scales, int octaves, int fresh, float (*rows)[BLOCK]);

void hash_sums(const float *positions, const float *resolutions, const float *table, float *out,
               int64_t begin, int64_t end, int levels, int log2, int features, int corners);

void gate_logits(const float *positions, const float *scales, const float *const *parts,
                 float *logits, int64_t begin, int64_t end, int64_t stride, int64_t next,
                 int octaves, int fresh, int layers, int width, int outputs, float epsilon);

void field_densities(const float *features, const int64_t *order, const int64_t *routes,
                     const float *factors, const float *const *parts, float *hidden, float *raw,
                     int64_t begin, int64_t end, int inputs, int width, int layers);

void add_colors(const float *hidden, const float *weights, const int64_t *rays, const int *chosen,
                int count, const float *of_rays, const float *const *parts, float *rgb, int width,
                int units);
