/* The whole way of a still scan in C, for the benchmark alone: what `add_scan` does for the cuboid model, written for gcc
 * as one would write it there. Points in the sensor's frame are placed with their covariance (eq. 1), tested, bounded by
 * cells; the tiles that they touch are found before any cell is written; then cells are updated in the points' order, and
 * each tile's changed cells are marked. Left out: sequence numbers of the levels above, and all that Python does. */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>

enum { BLOCK = 256, SIDE = 64, SLOT = SIDE * SIDE, SLAB = 64, AHEAD = 8 };

typedef struct {
    uint32_t count, updated;
    double weight, weight_sq, mean, m2, low, high, inv_cf;
} cell;

typedef struct {
    double a, coverage, min_radius, widest, min_share, min_distance;
    double range_sigma, range_per_m, beam, min_range, max_range, ceiling, ceiling_slope;
    double mount[12], pose[12]; /* rotation by rows, then translation */
    double spread[27];          /* of S: A (6) + B l (9) + K C K^T (6), and the mounting's K_m D K_m^T (6) */
} settings;

typedef struct {
    long tiles, room, hashed;
    uint64_t *keys, (*bits)[SIDE];
    cell **slot;
    int32_t *table;
    long points;
    double *x, *y, *z, *rx, *ry, *q;
    int32_t *i0, *j0, *i1, *j1, *home;
    uint8_t *reason;
} map;

static uint64_t key_of(int32_t tx, int32_t ty) { return (uint64_t)(uint32_t)tx << 32 | (uint32_t)ty; }

static long place_of(const map *m, uint64_t key) {
    long at = (long)((key * 0x9E3779B97F4A7C15u >> 32) & (uint64_t)(m->hashed - 1));
    while (m->table[at] >= 0 && m->keys[m->table[at]] != key) at = (at + 1) & (m->hashed - 1);
    return at;
}

static void grow(map *m) {
    m->room = m->room ? 2 * m->room : SLAB;
    m->keys = realloc(m->keys, (size_t)m->room * sizeof *m->keys);
    m->bits = realloc(m->bits, (size_t)m->room * sizeof *m->bits);
    m->slot = realloc(m->slot, (size_t)m->room * sizeof *m->slot);
    m->hashed = 4 * m->room;
    m->table = realloc(m->table, (size_t)m->hashed * sizeof *m->table);
    memset(m->table, 0xFF, (size_t)m->hashed * sizeof *m->table);
    for (int32_t t = 0; t < m->tiles; t++) m->table[place_of(m, m->keys[t])] = t;
}

static int32_t tile_of(map *m, int32_t tx, int32_t ty) {
    const uint64_t key = key_of(tx, ty);
    long at = place_of(m, key);
    if (m->table[at] >= 0) return m->table[at];
    if (m->tiles == m->room) {
        grow(m);
        at = place_of(m, key);
    }
    const long t = m->tiles++;
    m->keys[t] = key;
    m->slot[t] = t % SLAB ? m->slot[t - 1] + SLOT
                          : mmap(NULL, SLAB * SLOT * sizeof(cell), PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
    memset(m->bits[t], 0, sizeof m->bits[t]);
    m->table[at] = (int32_t)t;
    return (int32_t)t;
}

map *map_new(long points) {
    map *m = calloc(1, sizeof *m);
    grow(m);
    m->points = points;
    double **planes[] = {&m->x, &m->y, &m->z, &m->rx, &m->ry, &m->q};
    int32_t **numbers[] = {&m->i0, &m->j0, &m->i1, &m->j1, &m->home};
    for (int k = 0; k < 6; k++) *planes[k] = malloc((size_t)points * sizeof(double));
    for (int k = 0; k < 5; k++) *numbers[k] = malloc((size_t)points * sizeof(int32_t));
    m->reason = malloc((size_t)points);
    return m;
}

void map_free(map *m) {
    for (long t = 0; t < m->tiles; t += SLAB) munmap(m->slot[t], SLAB * SLOT * sizeof(cell));
    void *all[] = {m->keys, m->bits, m->slot, m->table, m->x,  m->y,  m->z,    m->rx,
                   m->ry,   m->q,    m->i0,   m->j0,    m->i1, m->j1, m->home, m->reason, m};
    for (size_t k = 0; k < sizeof all / sizeof *all; k++) free(all[k]);
}

long map_tiles(const map *m) { return m->tiles; }
void map_tile(const map *m, long t, int32_t *number, cell *cells) {
    number[0] = (int32_t)(m->keys[t] >> 32), number[1] = (int32_t)m->keys[t];
    memcpy(cells, m->slot[t], SLOT * sizeof(cell));
}

/* A block: place, S, tests, radii, cells. One loop a step, over plain arrays, so that each is vectorised. */
static void geometry(const settings *s, long size, const float *points, double *restrict x, double *restrict y,
                     double *restrict z, double *restrict rx, double *restrict ry, double *restrict q, int32_t *restrict i0,
                     int32_t *restrict j0, int32_t *restrict i1, int32_t *restrict j1, uint8_t *restrict reason) {
    double lx[BLOCK], ly[BLOCK], lz[BLOCK], mx[BLOCK], my[BLOCK], mz[BLOCK], square[BLOCK], S[6][BLOCK];
    int64_t bad[BLOCK];
    const double *M = s->mount, *P = s->pose, *c = s->spread;
    for (long n = 0; n < size; n++) x[n] = points[3 * n], y[n] = points[3 * n + 1], z[n] = points[3 * n + 2];
    for (long n = 0; n < size; n++) {
        const double px = x[n], py = y[n], pz = z[n];
        const double v0 = M[0] * px + M[1] * py + M[2] * pz, v1 = M[3] * px + M[4] * py + M[5] * pz,
                     v2 = M[6] * px + M[7] * py + M[8] * pz;
        const double b0 = M[9] + v0, b1 = M[10] + v1, b2 = M[11] + v2;
        lx[n] = P[0] * b0 + P[1] * b1 + P[2] * b2;
        ly[n] = P[3] * b0 + P[4] * b1 + P[5] * b2;
        lz[n] = P[6] * b0 + P[7] * b1 + P[8] * b2;
        mx[n] = P[0] * v0 + P[1] * v1 + P[2] * v2;
        my[n] = P[3] * v0 + P[4] * v1 + P[5] * v2;
        mz[n] = P[6] * v0 + P[7] * v1 + P[8] * v2;
        square[n] = px * px + py * py + pz * pz;
        x[n] = P[9] + lx[n], y[n] = P[10] + ly[n], z[n] = P[11] + lz[n];
    }
    for (long n = 0; n < size; n++) {
        const double r = sqrt(square[n]);
        const int64_t finite = square[n] < INFINITY, zero = square[n] == 0, out = (r < s->min_range) | (r > s->max_range);
        const int64_t high = mz[n] > s->ceiling + s->ceiling_slope * sqrt(mx[n] * mx[n] + my[n] * my[n]);
        bad[n] = !finite ? 1 : zero ? 2 : out ? 6 : high ? 7 : 0;
    }
    for (long n = 0; n < size; n++) {
        const double X = lx[n], Y = ly[n], Z = lz[n], U = mx[n], V = my[n], W = mz[n];
        const double sr = s->range_sigma + s->range_per_m * sqrt(square[n]), across = s->beam * s->beam * square[n],
                     along = (sr * sr - across) / square[n];
        const double *B = c + 6, *C = c + 15, *D = c + 21;
        const double d01 = C[2] * X - C[0] * Z, d02 = C[0] * Y - C[1] * X, d10 = C[3] * Z - C[4] * Y, d11 = C[4] * X - C[1] * Z,
                     d12 = C[1] * Y - C[3] * X, d20 = C[4] * Z - C[5] * Y, d21 = C[5] * X - C[2] * Z, d22 = C[2] * Y - C[4] * X;
        const double e01 = D[2] * U - D[0] * W, e02 = D[0] * V - D[1] * U, e10 = D[3] * W - D[4] * V, e11 = D[4] * U - D[1] * W,
                     e12 = D[1] * V - D[3] * U, e20 = D[4] * W - D[5] * V, e21 = D[5] * U - D[2] * W, e22 = D[2] * V - D[4] * U;
        const double b00 = B[1] * Z - B[2] * Y, b01 = B[2] * X - B[0] * Z, b02 = B[0] * Y - B[1] * X, b10 = B[4] * Z - B[5] * Y,
                     b11 = B[5] * X - B[3] * Z, b12 = B[3] * Y - B[4] * X, b20 = B[7] * Z - B[8] * Y, b21 = B[8] * X - B[6] * Z,
                     b22 = B[6] * Y - B[7] * X;
        S[0][n] = across + along * U * U + c[0] + 2 * b00 + (Z * d10 - Y * d20) + (W * e10 - V * e20);
        S[1][n] = along * U * V + c[1] + (b01 + b10) + (Z * d11 - Y * d21) + (W * e11 - V * e21);
        S[2][n] = along * U * W + c[2] + (b02 + b20) + (Z * d12 - Y * d22) + (W * e12 - V * e22);
        S[3][n] = across + along * V * V + c[3] + 2 * b11 + (X * d21 - Z * d01) + (U * e21 - W * e01);
        S[4][n] = along * V * W + c[4] + (b12 + b21) + (X * d22 - Z * d02) + (U * e22 - W * e02);
        S[5][n] = across + along * W * W + c[5] + 2 * b22 + (Y * d02 - X * d12) + (V * e02 - U * e12);
    }
    for (long n = 0; n < size; n++) {
        const double trace = S[0][n] + S[3][n] + S[5][n], t = 1 / trace, slack = 1e-9;
        const double a = S[0][n] * t + slack, b = S[1][n] * t, d = S[2][n] * t, e = S[3][n] * t + slack, f = S[4][n] * t,
                     g = S[5][n] * t + slack;
        const double second = e - b * b / a, corner = f - b * d / a, third = g - d * d / a - corner * corner / second;
        const int64_t good = (trace < INFINITY) & (S[0][n] >= 0) & (S[3][n] >= 0) & (S[5][n] >= 0) & (a > 0) & (second > 0) & (third > 0);
        const double sx = s->coverage * sqrt(S[0][n]), sy = s->coverage * sqrt(S[3][n]), sz = s->coverage * sqrt(S[5][n]);
        rx[n] = sx > s->min_radius ? sx : s->min_radius;
        ry[n] = sy > s->min_radius ? sy : s->min_radius;
        q[n] = s->a / (rx[n] * ry[n] * (sz > s->min_radius ? sz : s->min_radius));
        const int64_t wide = (sx > s->widest) | (sy > s->widest);
        bad[n] = bad[n] ? bad[n] : !good ? 8 : wide ? 9 : 0;
    }
    for (long n = 0; n < size; n++) {
        const double f0 = floor((x[n] - rx[n]) / s->a), g0 = floor((y[n] - ry[n]) / s->a), f1 = floor((x[n] + rx[n]) / s->a),
                     g1 = floor((y[n] + ry[n]) / s->a);
        const int64_t inside = (f0 >= -2147483648.0) & (g0 >= -2147483648.0) & (f1 <= 2147483647.0) & (g1 <= 2147483647.0);
        bad[n] = bad[n] ? bad[n] : inside ? 0 : 10;
        i0[n] = (int32_t)(inside ? f0 : 0), j0[n] = (int32_t)(inside ? g0 : 0);
        i1[n] = (int32_t)(inside ? f1 : 0), j1[n] = (int32_t)(inside ? g1 : 0);
    }
    for (long n = 0; n < size; n++) reason[n] = (uint8_t)bad[n];
}

/* The tile of each footprint that lies in one; -1 for those in several, whose tiles are made now. */
static void collect(map *m, long number) {
    int32_t last_x = INT32_MIN, last_y = INT32_MIN, last = -1;
    for (long n = 0; n < number; n++) {
        m->home[n] = -1;
        if (m->reason[n]) continue;
        const int32_t x0 = m->i0[n] >> 6, y0 = m->j0[n] >> 6, x1 = m->i1[n] >> 6, y1 = m->j1[n] >> 6;
        if (x0 == x1 && y0 == y1) {
            if (x0 != last_x || y0 != last_y) last_x = x0, last_y = y0, last = tile_of(m, x0, y0);
            m->home[n] = last;
        } else
            for (int32_t ty = y0; ty <= y1; ty++)
                for (int32_t tx = x0; tx <= x1; tx++) tile_of(m, tx, ty);
    }
}

static double clip(double v, double r) { return v < -r ? -r : v > r ? r : v; }

static void update(cell *c, double h, double w, double q, uint32_t second, double min_distance) {
    const double before = c->weight, total = before + w, g = w / total, delta = h - c->mean;
    double mean = c->mean, low = c->low, high = c->high, m2 = c->m2;
    if (c->count == 0) {
        mean = low = high = h;
    } else {
        mean += delta * g;
        m2 += (before * g) * (delta * delta);
        low = h < low ? h : low;
        high = h > high ? h : high;
    }
    const double off = fabs(h - mean), d = off > min_distance ? off : min_distance;
    c->count += 1, c->updated = second > c->updated ? second : c->updated;
    c->weight = total, c->weight_sq += w * q, c->mean = mean, c->m2 = m2, c->low = low, c->high = high;
    c->inv_cf += w / (d * d);
}

void map_add_scan(map *m, const settings *s, long number, const float *points, uint32_t second) {
    for (long first = 0; first < number; first += BLOCK) {
        const long size = number - first < BLOCK ? number - first : BLOCK;
        geometry(s, size, points + 3 * first, m->x + first, m->y + first, m->z + first, m->rx + first, m->ry + first, m->q + first,
                 m->i0 + first, m->j0 + first, m->i1 + first, m->j1 + first, m->reason + first);
    }
    collect(m, number);
    double row[SIDE], column[SIDE];
    for (long n = 0; n < number; n++) {
        if (n + AHEAD < number && m->home[n + AHEAD] >= 0) {
            const cell *slot = m->slot[m->home[n + AHEAD]];
            for (int32_t j = m->j0[n + AHEAD]; j <= m->j1[n + AHEAD]; j++)
                for (int32_t i = m->i0[n + AHEAD]; i <= m->i1[n + AHEAD]; i++)
                    __builtin_prefetch(slot + (j & 63) * SIDE + (i & 63), 1);
        }
        if (m->reason[n]) continue;
        const int32_t i0 = m->i0[n], j0 = m->j0[n], ni = m->i1[n] - i0 + 1, nj = m->j1[n] - j0 + 1;
        const double x = m->x[n], y = m->y[n], rx = m->rx[n], ry = m->ry[n], q = m->q[n], h = m->z[n];
        double widest = 0, tallest = 0, before = clip(i0 * s->a - x, rx);
        for (int32_t i = 0; i < ni; i++) {
            const double after = clip((i0 + i + 1) * s->a - x, rx);
            row[i] = (after - before) / (2 * rx);
            widest = row[i] > widest ? row[i] : widest;
            before = after;
        }
        before = clip(j0 * s->a - y, ry);
        for (int32_t j = 0; j < nj; j++) {
            const double after = clip((j0 + j + 1) * s->a - y, ry);
            column[j] = (after - before) / (2 * ry);
            tallest = column[j] > tallest ? column[j] : tallest;
            before = after;
        }
        const double least = s->min_share * (widest * tallest);
        int32_t t = m->home[n];
        for (int32_t j = 0; j < nj; j++)
            for (int32_t i = 0; i < ni; i++) {
                const double p = column[j] * row[i];
                if (!(p >= least && p > 1e-12)) continue;
                if (m->home[n] < 0) t = tile_of(m, (i0 + i) >> 6, (j0 + j) >> 6);
                const int line = (j0 + j) & 63, place = (i0 + i) & 63;
                m->bits[t][line] |= 1ull << place;
                update(m->slot[t] + line * SIDE + place, h, p * q, q, second, s->min_distance);
            }
    }
}
