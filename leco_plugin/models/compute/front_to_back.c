/* Rays from the front on a CPU, in C: kept intervals to pixels, without gradients. `native.py`
 * compiles this file and calls it; the slow twin in torch is `models/front_to_back.py`.
 *
 * Many rays are on their way at once. Each in turn has its next few samples asked, in one batch with
 * those of the others; a ray leaves when its samples end or no light is left.
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "routines.h"

#define CHUNK 2048   /* samples that are asked together; what is said of them stays in the cache */
#define MOST_ROUTES 512

/* As `front_to_back.py: in_c` fills it. */
typedef struct {
    const float *scales, *resolutions, *table, *center;
    const float *const *gate, *const *field, *const *color;
    const uint8_t *left; /* scene experts that were not dropped */
    float epsilon, half_extent, empty_odds;
    int octaves, fresh, gate_layers, gate_width, outputs;
    int levels, log2, features, width, layers, units, unbounded;
} Scene;

/* As `front_to_back.py: shade_natively` fills it. */
typedef struct {
    const float *origins, *directions, *of_rays, *ends; /* [rays, ...] */
    const int64_t *starts, *counts;                     /* [rays], of samples */
    const float *given_starts, *given_ends;             /* [samples] */
    float *rgb, *accumulation, *distance;               /* [rays, ...], zero at first */
    int64_t *asked;                                     /* [rays], zero at first: of samples */
    int64_t *ray_indices, *routes;                      /* [samples], as all that follow */
    float *t_starts, *t_ends, *weights, *sigmas, *logits;
    float least_light, visible, opaque;
    int at_once;
} Batch;

typedef struct {
    int64_t ray, next, last;
    float light;
} Front;

/* What is known of the samples of a chunk. */
typedef struct {
    int64_t samples[CHUNK], rays[CHUNK], routes[CHUNK], order[CHUNK];
    float mapped[3][CHUNK], unit[CHUNK][3], factors[CHUNK], raw[CHUNK], weights[CHUNK];
    int seen[CHUNK];
    float *encoded, *logits, *hidden;
} Chunk;

static void place(const Scene *scene, const Batch *batch, Chunk *chunk, int i)
{
    int64_t sample = chunk->samples[i], ray = chunk->rays[i];
    float middle = 0.5f * (batch->given_starts[sample] + batch->given_ends[sample]), scaled[3], far = 1.0f;
    for (int axis = 0; axis < 3; axis++) {
        float position = batch->origins[3 * ray + axis] + batch->directions[3 * ray + axis] * middle;
        scaled[axis] = (position - scene->center[axis]) / scene->half_extent;
        far = fmaxf(far, fabsf(scaled[axis]));
    }
    float shrunk = scene->unbounded ? (2.0f - 1.0f / far) / far * 0.5f : 1.0f;
    for (int axis = 0; axis < 3; axis++) {
        float mapped = scaled[axis] * shrunk;
        mapped = mapped > 1.0f ? 1.0f : mapped < -1.0f ? -1.0f : mapped; /* keeps NaN */
        chunk->mapped[axis][i] = mapped;
        chunk->unit[i][axis] = mapped * 0.5f + 0.5f;
    }
}

/* The expert of a sample, see `rendering.gate_values_and_routes`; its factor is one, or NaN. */
static void route(const Scene *scene, Chunk *chunk, int i)
{
    const float *logits = chunk->logits + (int64_t)i * scene->outputs;
    float odds = 0.0f;
    int best = 0;
    for (int o = 1; o < scene->outputs; o++) {
        odds += expf(logits[o] - logits[0]);
        if (scene->left[o - 1] && (!best || logits[o] > logits[best]))
            best = o;
    }
    chunk->routes[i] = odds < scene->empty_odds ? 0 : best;
    chunk->factors[i] = isnan(odds) ? NAN : 1.0f;
}

static void sort_by_route(Chunk *chunk, int count, int outputs)
{
    int places[MOST_ROUTES + 1] = {0};
    for (int i = 0; i < count; i++)
        places[chunk->routes[i] + 1]++;
    for (int o = 1; o < outputs; o++)
        places[o] += places[o - 1];
    for (int i = 0; i < count; i++)
        chunk->order[places[chunk->routes[i]]++] = i;
}

static void ask(const Scene *scene, const Batch *batch, Chunk *chunk, int count)
{
    for (int i = 0; i < count; i++)
        place(scene, batch, chunk, i);
    gate_logits(chunk->mapped[0], scene->scales, scene->gate, chunk->logits, 0, count, CHUNK, 1,
                scene->octaves, scene->fresh, scene->gate_layers, scene->gate_width,
                scene->outputs, scene->epsilon);
    for (int i = 0; i < count; i++)
        route(scene, chunk, i);
    sort_by_route(chunk, count, scene->outputs);
    hash_sums(chunk->unit[0], scene->resolutions, scene->table, chunk->encoded, 0, count,
              scene->levels, scene->log2, scene->features, 4);
    field_densities(chunk->encoded, chunk->order, chunk->routes, chunk->factors, scene->field,
                    chunk->hidden, chunk->raw, 0, count, scene->levels * scene->features,
                    scene->width, scene->layers);
}

/* Weighs the next samples of a ray, from number i of the chunk, and notes which of them are seen. */
static int weigh(const Scene *scene, const Batch *batch, Chunk *chunk, Front *front, int64_t stop,
                 int i, int seen)
{
    float half = scene->half_extent;
    for (; front->next < stop; front->next++, i++) {
        int64_t sample = front->next, ray = front->ray;
        float start = batch->given_starts[sample], end = batch->given_ends[sample];
        float sigma = expf(chunk->raw[i] - 1.0f);
        float absorbing = end >= batch->ends[ray] ? sigma + batch->opaque : sigma;
        float alpha = -expm1f(-absorbing * (end / half - start / half));
        float weight = front->light * alpha;
        front->light *= 1.0f - alpha;
        batch->accumulation[ray] += weight;
        batch->distance[ray] += weight * 0.5f * (start + end);
        batch->weights[sample] = chunk->weights[i] = weight;
        batch->sigmas[sample] = sigma;
        batch->routes[sample] = chunk->routes[i];
        memcpy(batch->logits + sample * scene->outputs,
               chunk->logits + (int64_t)i * scene->outputs, scene->outputs * sizeof(float));
        if (weight > batch->visible)
            chunk->seen[seen++] = i;
    }
    return seen;
}

/* Moves what was asked of rays `begin` to `end` together, to where those rays begin. */
static int64_t pack(const Scene *scene, const Batch *batch, int64_t begin, int64_t end)
{
    int64_t first = begin < end ? batch->starts[begin] : 0, to = first;
    for (int64_t ray = begin; ray < end; ray++) {
        int64_t from = batch->starts[ray], count = batch->asked[ray];
#define MOVE(OUT, IN, SIZE)                                                                        \
    memmove(batch->OUT + to * (SIZE), batch->IN + from * (SIZE), count * (SIZE) * sizeof *batch->OUT)
        MOVE(t_starts, given_starts, 1);
        MOVE(t_ends, given_ends, 1);
        MOVE(weights, weights, 1);
        MOVE(sigmas, sigmas, 1);
        MOVE(routes, routes, 1);
        MOVE(logits, logits, scene->outputs);
        for (int64_t i = to; i < to + count; i++)
            batch->ray_indices[i] = ray;
        to += count;
    }
    return to - first;
}

/* Renders rays `begin` to `end`. Returns how many of their samples were asked, or -1 where there is
 * no memory. */
int64_t front_to_back(const Scene *scene, const Batch *batch, int64_t begin, int64_t end)
{
    int row = scene->levels * scene->features + scene->outputs + scene->width, alive = 0;
    Chunk *chunk = malloc(sizeof *chunk + (int64_t)CHUNK * row * sizeof(float));
    Front *fronts = malloc(CHUNK * sizeof *fronts);
    if (!chunk || !fronts) {
        free(chunk), free(fronts);
        return -1;
    }
    chunk->encoded = (float *)(chunk + 1);
    chunk->logits = chunk->encoded + CHUNK * scene->levels * scene->features;
    chunk->hidden = chunk->logits + CHUNK * scene->outputs;
    for (int64_t next = begin; next < end || alive;) {
        for (; next < end && alive < CHUNK / batch->at_once; next++)
            if (batch->counts[next]) {
                int64_t first = batch->starts[next];
                fronts[alive++] = (Front){next, first, first + batch->counts[next], 1.0f};
            }
        int count = 0, seen = 0, left = 0;
        for (int f = 0; f < alive; f++)
            for (int64_t s = fronts[f].next; s < fronts[f].last && s < fronts[f].next + batch->at_once; s++) {
                chunk->samples[count] = s;
                chunk->rays[count++] = fronts[f].ray;
            }
        ask(scene, batch, chunk, count);
        for (int f = 0, i = 0; f < alive; f++) {
            Front front = fronts[f];
            int64_t stop = front.next + batch->at_once;
            stop = stop < front.last ? stop : front.last;
            int last = i + (int)(stop - front.next);
            seen = weigh(scene, batch, chunk, &front, stop, i, seen);
            i = last;
            batch->asked[front.ray] = stop - batch->starts[front.ray];
            if (stop < front.last && front.light >= batch->least_light)
                fronts[left++] = front;
        }
        alive = left;
        add_colors(chunk->hidden, chunk->weights, chunk->rays, chunk->seen, seen, batch->of_rays,
                   scene->color, batch->rgb, scene->width, scene->units);
    }
    free(chunk), free(fronts);
    return pack(scene, batch, begin, end);
}
