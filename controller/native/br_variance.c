/* Posterior variance of the Gaussian processes at several stages:
 *
 *   variance(z) = signal (1 - |W k(z)|^2) + noise,    W'W = (K + noise / signal I)^-1
 *
 * with the correlations K among the training points and k(z) with z (Rasmussen and Williams,
 * "Gaussian Processes for Machine Learning", algorithm 2.1; W is the inverse of the Cholesky
 * factor). Exact for up to BR_GP_ROOT points; of more, so many evenly spread ones count, which
 * leaves a larger variance, never a smaller one. W is made when weights are loaded, by the thread
 * that stages them. W k of all stages is a product of two matrices.
 */
#include <math.h>

#include "br_internal.h"
#include "br_kernel.h"

#define COLUMNS BR_COLUMNS             /* queries that a tile of the product has, and ... */
#define VECTORS (COLUMNS / BR_LANES)   /* ... vectors of them, ... */
#define ROWS (8 / VECTORS < 4 ? 4 : 8) /* ... and rows of W: as much as the registers hold */
#define LEAST_PIVOT 1e-13              /* of a correlation matrix: below it a point adds nothing */

_Static_assert(BR_GP_ROOT % ROWS == 0, "a tile holds whole rows");

typedef double matrix_row[BR_GP_ROOT];

/* Correlations of COLUMNS queries with so many training points from one on, a row each. */
static inline __attribute__((always_inline)) void query_by(const int kind, const br_gp_variance *v,
                                                           int first, int rows,
                                                           double q[BR_NZ][COLUMNS],
                                                           double (*restrict k)[COLUMNS]) {
    for (int i = 0; i < rows; ++i) BR_UNROLL
    for (int p = 0; p < VECTORS; ++p) {
        br_vec r2 = {0};
        BR_UNROLL
        for (int a = 0; a < BR_NZ; ++a) {
            const br_vec t = br_load(&q[a][BR_LANES * p]) - v->inputs[a][first + i];
            r2 += t * t;
        }
        br_store(&k[i][BR_LANES * p], br_kernel(kind, r2).k);
    }
}

static void query(const br_gp_variance *v, int first, int rows, double q[BR_NZ][COLUMNS],
                  double (*k)[COLUMNS]) {
    switch (v->kernel) {
    case BR_KERNEL_RBF:
        query_by(BR_KERNEL_RBF, v, first, rows, q, k);
        break;
    case BR_KERNEL_MATERN05:
        query_by(BR_KERNEL_MATERN05, v, first, rows, q, k);
        break;
    case BR_KERNEL_MATERN15:
        query_by(BR_KERNEL_MATERN15, v, first, rows, q, k);
        break;
    default:
        query_by(BR_KERNEL_MATERN25, v, first, rows, q, k);
    }
}

/* The training points that count; zeros after them. */
static void choose(const br_gp_output *gp, int count, br_gp_variance *v) {
    v->kernel = gp->kernel;
    v->count = count < BR_GP_ROOT ? count : BR_GP_ROOT;
    for (int i = 0; i < BR_GP_ROOT; ++i) {
        const int from = i < v->count ? (int)((2LL * i + 1) * count / (2 * v->count)) : 0;
        for (int a = 0; a < BR_NZ; ++a) v->inputs[a][i] = i < v->count ? gp->inputs[a][from] : 0;
    }
}

/* K + noise I, its upper triangle. */
static void correlate(const br_gp_variance *v, double noise, matrix_row *m) {
    const int n = v->count;
    for (int left = 0; left < n; left += COLUMNS) {
        BR_ALIGNED double q[BR_NZ][COLUMNS], k[1][COLUMNS];
        for (int a = 0; a < BR_NZ; ++a)
            for (int c = 0; c < COLUMNS; ++c) q[a][c] = left + c < n ? v->inputs[a][left + c] : 0;
        for (int i = 0; i < n && i < left + COLUMNS; ++i) {
            query(v, i, 1, q, k);
            for (int c = 0; c < COLUMNS && left + c < n; ++c)
                if (left + c > i) m[i][left + c] = k[0][c];
        }
    }
    for (int i = 0; i < n; ++i) m[i][i] = 1.0 + noise;
}

/* The upper triangle becomes U with U'U = it. A point that is as good as a combination of others
 * gets a row of zeros: it is left out. */
static void factorise(int n, matrix_row *m) {
    for (int k = 0; k < n; ++k) {
        const double pivot = m[k][k];
        const double scale = pivot > LEAST_PIVOT ? 1.0 / sqrt(pivot) : 0.0;
        for (int j = k; j < n; ++j) m[k][j] *= scale;
        for (int i = k + 1; i < n; ++i) {
            const double factor = m[k][i];
            for (int j = i; j < n; ++j) m[i][j] -= factor * m[k][j];
        }
    }
}

/* The lower triangle, zero before, becomes W = (U')^-1; then the upper one zero. */
static void invert(int n, matrix_row *m) {
    for (int i = 0; i < n; ++i) {
        const double scale = m[i][i] > 0 ? 1.0 / m[i][i] : 0.0;
        for (int k = 0; k < i; ++k) {
            const double factor = scale * m[k][i];
            for (int j = 0; j <= k; ++j) m[i][j] -= factor * m[k][j];
        }
        m[i][i] = scale;
    }
    for (int i = 0; i < n; ++i)
        for (int j = i + 1; j < n; ++j) m[i][j] = 0;
}

void br_variance_load(const br_gp_output *gp, const br_mpc_gp *in, br_gp_variance *v) {
    v->signal = in->signal;
    v->noise = in->signal > 0 ? in->noise : 0;
    v->count = 0;
    if (!(v->signal > 0)) return;
    choose(gp, in->n, v);
    for (int i = 0; i < (v->count + ROWS - 1) / ROWS * ROWS; ++i)
        memset(v->root[i], 0, sizeof v->root[i]);
    correlate(v, in->noise / in->signal, v->root);
    factorise(v->count, v->root);
    invert(v->count, v->root);
}

/* |W k|^2 of each column. */
static void explain(const matrix_row *root, int rows, double (*restrict k)[COLUMNS],
                    double explained[COLUMNS]) {
    br_vec total[VECTORS] = {{0}};
    for (int first = 0; first < rows; first += ROWS) {
        br_vec t[ROWS][VECTORS] = {{{0}}};
        for (int j = 0; j < first + ROWS; ++j) {
            br_vec row[VECTORS];
            BR_UNROLL
            for (int p = 0; p < VECTORS; ++p) row[p] = br_load(&k[j][BR_LANES * p]);
            BR_UNROLL
            for (int i = 0; i < ROWS; ++i) BR_UNROLL
            for (int p = 0; p < VECTORS; ++p) t[i][p] += root[first + i][j] * row[p];
        }
        BR_UNROLL
        for (int i = 0; i < ROWS; ++i) BR_UNROLL
        for (int p = 0; p < VECTORS; ++p) total[p] += t[i][p] * t[i][p];
    }
    for (int p = 0; p < VECTORS; ++p) br_store(&explained[BR_LANES * p], total[p]);
}

void br_gp_variances(const br_gp *gp, int stages, double (*z)[BR_NZ], double (*work)[BR_COLUMNS],
                     double (*variance)[BR_NE]) {
    _Static_assert(COLUMNS <= BR_COLUMNS, "the memory for correlations has room for a tile");
    double (*k)[COLUMNS] = (double (*)[COLUMNS])work;
    for (int j = 0; j < BR_NE; ++j) {
        const br_gp_output *output = &gp->output[j];
        const br_gp_variance *v = &gp->variance[j];
        const int rows = (v->count + ROWS - 1) / ROWS * ROWS;
        for (int first = 0; first < stages; first += COLUMNS) {
            BR_ALIGNED double q[BR_NZ][COLUMNS], explained[COLUMNS];
            for (int c = 0; c < COLUMNS; ++c) { /* what fills the tile is the last stage again */
                const double *at = z[first + c < stages ? first + c : stages - 1];
                for (int a = 0; a < BR_NZ; ++a)
                    q[a][c] = at[a] * output->inverse_scale[a] - output->middle[a];
            }
            query(v, 0, rows, q, k);
            explain(v->root, rows, k, explained);
            for (int c = 0; c < COLUMNS && first + c < stages; ++c)
                variance[first + c][j] = v->signal * br_worse(0.0, 1.0 - explained[c]) + v->noise;
        }
    }
}
