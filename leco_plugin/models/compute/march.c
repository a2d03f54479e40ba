/* The march of rays through the cells of a frozen gate, on a CPU, in C.
 * `samplers/kernels/native_march.py` calls it; the slow twin in torch is `samplers/marching.py:
 * march` with the questions of `samplers/cells/cache.py: CellCache`.
 */
#include <math.h>
#include <stdint.h>

#define RUN 16   /* candidates in a row that one coarse question is about */
#define BRICK 4  /* fine cells along a coarse one */
#define UNIFORM 2
#define FINE_EMPTY 64
#define FINE_OCCUPIED 65

/* As `native_march.py` has it. */
typedef struct {
    const float *coordinates;  /* [2, 3, rays] origins and directions */
    const float *numbers;      /* [5, rays] t_min, first and count, n_linear and t_switch */
    const float *powers;       /* of a growing step, or null */
    const int64_t *rooms;      /* [rays], where those of a ray have room */
    const void *coarse;        /* of 16 or 32 bits */
    const int32_t *first_plane;
    const uint8_t *bricks, *clearance;
    const int8_t *planes;      /* [5, planes] */
    const float *frame;        /* scale, shift [3], center [3], half extent */
    int64_t *ray_indices;
    float *t_starts, *t_ends;
    uint8_t *open;             /* whether the gate has to decide */
    float step_size;
    int rays, all_planes, resolution, contracted, wide;
} March;

typedef struct {
    float origin[3], direction[3], t_min, first, n_linear, t_switch, speed;
    int count;
} Ray;

static Ray ray_at(const March *march, int64_t i)
{
    Ray ray = {.speed = 0.0f};
    for (int axis = 0; axis < 3; axis++) {
        ray.origin[axis] = march->coordinates[axis * (int64_t)march->rays + i];
        ray.direction[axis] = march->coordinates[(3 + axis) * (int64_t)march->rays + i];
        ray.speed = fmaxf(ray.speed, fabsf(ray.direction[axis]));
    }
    ray.t_min = march->numbers[i];
    ray.first = march->numbers[march->rays + i];
    ray.count = (int)march->numbers[2 * march->rays + i];
    ray.n_linear = march->numbers[3 * march->rays + i];
    ray.t_switch = march->numbers[4 * march->rays + i];
    return ray;
}

/* As `edges.candidate_edges`, of a candidate counted from the ray's first one. */
static inline float edge(const March *march, const Ray *ray, int candidate)
{
    float step = ray->first + candidate;
    if (!march->powers || step <= ray->n_linear)
        return ray->t_min + step * march->step_size;
    return ray->t_switch * march->powers[(int)(step - ray->n_linear)];
}

/* As `CellCache._cells`: coordinates in coarse cells, the border included. */
static inline void cells_of(const March *march, const float *position, float *cells)
{
    const float *frame = march->frame;
    float mapped[3] = {position[0], position[1], position[2]}, far = 1.0f;
    if (march->contracted) {
        for (int axis = 0; axis < 3; axis++) {
            mapped[axis] = (mapped[axis] - frame[4 + axis]) / frame[7];
            far = fmaxf(far, fabsf(mapped[axis]));
        }
        for (int axis = 0; axis < 3; axis++)
            mapped[axis] *= (2.0f - 1.0f / far) / far * 0.5f;
    }
    for (int axis = 0; axis < 3; axis++) {
        float cell = frame[1 + axis] + mapped[axis] * frame[0];
        cells[axis] = fminf(fmaxf(cell, 0.0f), march->resolution + 1.5f);
    }
}

/* As `CellCache.near` of one cube. */
static inline int is_near(const March *march, const float *position, float radius)
{
    const float *frame = march->frame;
    int width = 2 * march->resolution, index = 0;
    float cells[3], aside = 0.0f, stretch = frame[0];
    cells_of(march, position, cells);
    for (int axis = 0; axis < 3; axis++) {
        float half = 2.0f * cells[axis] - 2.0f;
        float inner = floorf(fminf(fmaxf(half, 0.0f), width - 1.0f));
        aside = fmaxf(aside, fabsf(half - inner - 0.5f));
        index = index * width + (int)inner;
    }
    if (march->contracted) {
        float distance = 0.0f;
        for (int axis = 0; axis < 3; axis++)
            distance = fmaxf(distance, fabsf(position[axis] - frame[4 + axis]));
        float inner = fmaxf((distance - radius) / frame[7], 1.5f);
        stretch *= 0.5f / frame[7] * (4.0f * inner - 3.0f) / (inner * inner);
    }
    int clear = march->clearance[index >> 1] >> (index & 1) * 4 & 15;
    return radius * stretch * 2.0f + aside + 0.5f >= clear;
}

enum { NO, YES, OPEN };

/* As `CellCache.decide` of one position. */
static inline int decide(const March *march, const float *position)
{
    int width = march->resolution + 2, coarse = 0, fine = 0;
    float cells[3], within[3];
    cells_of(march, position, cells);
    for (int axis = 0; axis < 3; axis++) {
        float parts = cells[axis] * BRICK;
        int corner = (int)parts;
        within[axis] = 2.0f * (parts - corner) - 1.0f;
        coarse = coarse * width + corner / BRICK;
        fine = fine * BRICK + corner % BRICK;
    }
    int64_t brick = march->wide ? ((const int32_t *)march->coarse)[coarse]
                                : ((const int16_t *)march->coarse)[coarse];
    int known = march->bricks[(brick + UNIFORM) * BRICK * BRICK * BRICK + fine];
    if (known >= FINE_EMPTY)
        return known == FINE_OCCUPIED;
    const int8_t *plane = march->planes + march->first_plane[brick] + known;
    float height = plane[0];
    for (int axis = 0; axis < 3; axis++)
        height += plane[(1 + axis) * (int64_t)march->all_planes] * within[axis];
    return fabsf(height) <= plane[4 * (int64_t)march->all_planes] ? OPEN : height > 0.0f;
}

static inline void place(const Ray *ray, float middle, float *position)
{
    for (int axis = 0; axis < 3; axis++)
        position[axis] = ray->origin[axis] + ray->direction[axis] * middle;
}

/* Packs the candidates of rays `begin` to `end` that are kept or open, from where the first of these
 * rays has room on, and returns how many there are. */
int64_t march_cells(const March *march, int64_t begin, int64_t end)
{
    int64_t first = march->rooms[begin], to = first;
    float position[3];
    for (int64_t i = begin; i < end; i++) {
        Ray ray = ray_at(march, i);
        for (int run = 0; run < ray.count; run += RUN) {
            int last = run + RUN < ray.count ? run + RUN : ray.count;
            float t_start = edge(march, &ray, run), t_last = edge(march, &ray, last);
            place(&ray, 0.5f * (t_start + t_last), position);
            if (!is_near(march, position, (t_last - t_start) * 0.5f * ray.speed))
                continue;
            for (int candidate = run; candidate < last; candidate++) {
                float t_end = edge(march, &ray, candidate + 1);
                place(&ray, 0.5f * (t_start + t_end), position);
                int answer = decide(march, position);
                if (answer != NO) {
                    march->ray_indices[to] = i;
                    march->t_starts[to] = t_start;
                    march->t_ends[to] = t_end;
                    march->open[to++] = answer == OPEN;
                }
                t_start = t_end;
            }
        }
    }
    return to - first;
}
