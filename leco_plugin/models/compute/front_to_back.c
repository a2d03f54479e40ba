/* Rays from the front on a CPU, in C: kept intervals to pixels, without gradients. `native.py`
 * compiles this file and calls it; the slow twin in torch is `models/front_to_back.py`.
 *
 * Many rays are on their way at once. Each in turn has its next few samples asked, in one batch with
 * those of the others: some first, the others where those are not faint. A ray leaves when its
 * samples end or no light is left.
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "routines.h"

#define CHUNK 2048   /* samples that are asked together; what is said of them stays in the cache */
#define MOST_ROUTES 512
#define NOT_ASKED (-1)

/* As `front_to_back.py: in_c` fills it. */
typedef struct {
    const float *scales, *resolutions, *table, *center;
    const float *const *gate, *const *field, *const *color;
    const uint8_t *left; /* scene experts that were not dropped */
    float epsilon, half_extent, empty_odds;
    int octaves, fresh, gate_layers, gate_width;
    int outputs; /* of the gate; 0 does not ask it, and the first scene expert has all samples */
    int levels, log2, features, width, layers, units, unbounded;
} Scene;

/* As `front_to_back.py: shade_natively` fills it. */
typedef struct {
    const float *origins, *directions, *of_rays, *ends; /* [rays, ...] */
    const int64_t *starts, *counts;                     /* [rays], of samples */
    const float *given_starts, *given_ends;             /* [samples] */
    const uint8_t *first;                               /* [samples], which are asked first */
    float *rgb, *accumulation, *distance;               /* [rays, ...], zero at first */
    int64_t *asked;                                     /* [rays], zero at first: of samples */
    int64_t *ray_indices, *routes;                      /* [samples], as all that follow */
    float *t_starts, *t_ends, *weights, *sigmas;
    float least_light, visible, opaque, faint;
    int at_once;
} Batch;

typedef struct {
    int64_t ray, next, last;
    float light;
    int lit; /* whether its last sample is not faint */
} Front;

/* What is known of the samples of a chunk. */
typedef struct {
    int64_t samples[CHUNK], rays[CHUNK], routes[CHUNK], order[CHUNK];
    float mapped[3][CHUNK], unit[CHUNK][3], factors[CHUNK], raw[CHUNK];
    float sigmas[CHUNK], alphas[CHUNK], weights[CHUNK];
    int seen[CHUNK], lit[CHUNK]; /* lit: whether a sample, without the backdrop, is not faint */
    int places[CHUNK];           /* where the next samples of each ray are, or NOT_ASKED */
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

static void sort_by_route(Chunk *chunk, int begin, int end, int outputs)
{
    int places[MOST_ROUTES + 1] = {begin};
    for (int i = begin; i < end; i++)
        places[chunk->routes[i] + 1]++;
    for (int o = 1; o < outputs; o++)
        places[o] += places[o - 1];
    for (int i = begin; i < end; i++)
        chunk->order[places[chunk->routes[i]]++] = i;
}

/* What absorbs light at the samples from number `begin` to `end` of the chunk. */
static void ask(const Scene *scene, const Batch *batch, Chunk *chunk, int begin, int end)
{
    for (int i = begin; i < end; i++)
        place(scene, batch, chunk, i);
    if (scene->outputs) {
        gate_logits(chunk->mapped[0], scene->scales, scene->gate, chunk->logits, begin, end, CHUNK,
                    1, scene->octaves, scene->fresh, scene->gate_layers, scene->gate_width,
                    scene->outputs, scene->epsilon);
        for (int i = begin; i < end; i++)
            route(scene, chunk, i);
        sort_by_route(chunk, begin, end, scene->outputs);
    } else
        for (int i = begin; i < end; i++)
            chunk->routes[i] = 1, chunk->factors[i] = 1.0f, chunk->order[i] = i;
    hash_sums(chunk->unit[0], scene->resolutions, scene->table, chunk->encoded, begin, end,
              scene->levels, scene->log2, scene->features, 4);
    field_densities(chunk->encoded, chunk->order, chunk->routes, chunk->factors, scene->field,
                    chunk->hidden, chunk->raw, begin, end, scene->levels * scene->features,
                    scene->width, scene->layers);
    for (int i = begin; i < end; i++) {
        int64_t sample = chunk->samples[i];
        float from = batch->given_starts[sample], to = batch->given_ends[sample];
        float length = to / scene->half_extent - from / scene->half_extent;
        float sigma = chunk->sigmas[i] = expf(chunk->raw[i] - 1.0f), alpha = -expm1f(-sigma * length);
        int is_backdrop = to >= batch->ends[chunk->rays[i]];
        chunk->lit[i] = !(alpha < batch->faint);
        chunk->alphas[i] = is_backdrop ? -expm1f(-(sigma + batch->opaque) * length) : alpha;
    }
}

static int add(Chunk *chunk, int64_t sample, int64_t ray, int count)
{
    chunk->samples[count] = sample;
    chunk->rays[count] = ray;
    return count;
}

/* How many of a ray's samples come next. */
static int length_of(const Batch *batch, const Front *front)
{
    int64_t left = front->last - front->next;
    return left < batch->at_once ? (int)left : batch->at_once;
}

/* Asks of the next samples of each ray those that come first, and then those with a neighbour that
 * is not faint. Not asking needs a sample before and one after it: both ends of a stretch come first,
 * and so does the last of an even number of samples. */
static void ask_next(const Scene *scene, const Batch *batch, Chunk *chunk, Front *fronts, int alive)
{
    int count = 0;
    for (int f = 0; f < alive; f++) {
        int *places = chunk->places + f * batch->at_once, length = length_of(batch, fronts + f);
        for (int k = 0; k < length; k++) {
            int64_t sample = fronts[f].next + k;
            places[k] = batch->first[sample] ? add(chunk, sample, fronts[f].ray, count++) : NOT_ASKED;
        }
    }
    ask(scene, batch, chunk, 0, count);
    int begin = count;
    for (int f = 0; f < alive; f++) {
        int *places = chunk->places + f * batch->at_once, length = length_of(batch, fronts + f);
        for (int k = 0; k < length; k++) {
            int64_t sample = fronts[f].next + k;
            if (batch->first[sample])
                fronts[f].lit = chunk->lit[places[k]];
            else if (fronts[f].lit || chunk->lit[places[k + 1]])
                places[k] = add(chunk, sample, fronts[f].ray, count++);
        }
    }
    ask(scene, batch, chunk, begin, count);
}

/* Weighs a sample of a ray, number i of the chunk, and notes whether it is seen. */
static int weigh(const Batch *batch, Chunk *chunk, Front *front, int i, int seen)
{
    int64_t sample = chunk->samples[i], ray = front->ray;
    int64_t to = batch->starts[ray] + batch->asked[ray]++;
    float start = batch->given_starts[sample], end = batch->given_ends[sample];
    float weight = front->light * chunk->alphas[i];
    front->light *= 1.0f - chunk->alphas[i];
    batch->accumulation[ray] += weight;
    batch->distance[ray] += weight * 0.5f * (start + end);
    batch->t_starts[to] = start;
    batch->t_ends[to] = end;
    batch->weights[to] = chunk->weights[i] = weight;
    batch->sigmas[to] = chunk->sigmas[i];
    batch->routes[to] = chunk->routes[i];
    if (weight > batch->visible)
        chunk->seen[seen++] = i;
    return seen;
}

/* Moves what was asked of rays `begin` to `end` together, to where those rays begin. */
static int64_t pack(const Batch *batch, int64_t begin, int64_t end)
{
    int64_t first = begin < end ? batch->starts[begin] : 0, to = first;
    for (int64_t ray = begin; ray < end; ray++) {
        int64_t from = batch->starts[ray], count = batch->asked[ray];
#define MOVE(OUT) memmove(batch->OUT + to, batch->OUT + from, count * sizeof *batch->OUT)
        MOVE(t_starts);
        MOVE(t_ends);
        MOVE(weights);
        MOVE(sigmas);
        MOVE(routes);
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
                fronts[alive++] = (Front){next, first, first + batch->counts[next], 1.0f, 0};
            }
        int seen = 0, left = 0;
        ask_next(scene, batch, chunk, fronts, alive);
        for (int f = 0; f < alive; f++) {
            Front front = fronts[f];
            int *places = chunk->places + f * batch->at_once, length = length_of(batch, &front);
            for (int k = 0; k < length; k++)
                if (places[k] != NOT_ASKED)
                    seen = weigh(batch, chunk, &front, places[k], seen);
            front.next += length;
            if (front.next < front.last && front.light >= batch->least_light)
                fronts[left++] = front;
        }
        alive = left;
        add_colors(chunk->hidden, chunk->weights, chunk->rays, chunk->seen, seen, batch->of_rays,
                   scene->color, batch->rgb, scene->width, scene->units);
    }
    free(chunk), free(fronts);
    return pack(batch, begin, end);
}
