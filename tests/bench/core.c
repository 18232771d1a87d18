/* The core of the cuboid model in C, for the benchmark alone: placed points with half extents into a dense grid of the
 * map's records. No georeferencing, no tests, no tiles, no footprint wider than the grid: a floor under what is measured. */
#include <math.h>
#include <stdint.h>

typedef struct {
    uint32_t count, updated;
    double weight, weight_sq, mean, m2, low, high, inv_cf;
} cell;

static double clip(double v, double r) { return v < -r ? -r : v > r ? r : v; }

void integrate(long n, const double *x, const double *y, const double *z, const double *rx, const double *ry,
               const double *q, double a, double min_share, double min_distance, long i_low, long j_low, long width,
               uint32_t second, cell *grid) {
    double row[64], column[64];
    for (long p = 0; p < n; p++) {
        const long i0 = (long)floor((x[p] - rx[p]) / a), i1 = (long)floor((x[p] + rx[p]) / a);
        const long j0 = (long)floor((y[p] - ry[p]) / a), j1 = (long)floor((y[p] + ry[p]) / a);
        double widest = 0, tallest = 0;
        for (long i = i0; i <= i1; i++) {
            row[i - i0] = (clip((i + 1) * a - x[p], rx[p]) - clip(i * a - x[p], rx[p])) / (2 * rx[p]);
            widest = fmax(widest, row[i - i0]);
        }
        for (long j = j0; j <= j1; j++) {
            column[j - j0] = (clip((j + 1) * a - y[p], ry[p]) - clip(j * a - y[p], ry[p])) / (2 * ry[p]);
            tallest = fmax(tallest, column[j - j0]);
        }
        const double least = min_share * widest * tallest, h = z[p];
        for (long j = j0; j <= j1; j++)
            for (long i = i0; i <= i1; i++) {
                const double share = row[i - i0] * column[j - j0], w = share * q[p];
                if (share < least || share <= 1e-12) continue;
                cell *c = grid + (j - j_low) * width + (i - i_low);
                const double before = c->weight, g = w / (before + w), delta = h - c->mean;
                if (c->count == 0) {
                    c->mean = c->low = c->high = h;
                } else {
                    c->mean += delta * g;
                    c->low = h < c->low ? h : c->low;
                    c->high = h > c->high ? h : c->high;
                    c->m2 += (before * g) * (delta * delta);
                }
                const double off = fabs(h - c->mean), d = off > min_distance ? off : min_distance;
                c->count++;
                c->updated = second > c->updated ? second : c->updated;
                c->weight = before + w;
                c->weight_sq += w * q[p];
                c->inv_cf += w / (d * d);
            }
    }
}
