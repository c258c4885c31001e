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
#include "br_internal.h"

#define VECTORS (BR_COLUMNS / BR_LANES)       /* that a row of a tile has */
#define ROWS (VECTORS > 2 ? 4 : BR_ROOT_TILE) /* of W at a time: as much as the registers hold */
#define LEAST_PIVOT 1e-13 /* of a correlation matrix: below it a point adds nothing */

/* Correlations of BR_COLUMNS queries with so many training points from one on, a row each. */
static inline __attribute__((always_inline)) void query_by(const int kind, const br_gp_variance *v,
                                                           int first, int rows,
                                                           double q[BR_NZ][BR_COLUMNS],
                                                           double (*restrict k)[BR_COLUMNS]) {
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

static void query(const br_gp_variance *v, int first, int rows, double q[BR_NZ][BR_COLUMNS],
                  double (*k)[BR_COLUMNS]) {
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
        break;
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

/* Rows of a triangular matrix from one of BR_ROOT_TILE rows on, column by column: (i, j) is [j][i %
 * BR_ROOT_TILE]. */
typedef double tile_column[BR_ROOT_TILE];

static tile_column *rows_from(br_gp_variance *v, int first) {
    return (tile_column *)&v->root[BR_ROOT_SIZE(first)];
}

/* K + noise I, its rows of one tile up to the diagonal; 0 after it and for rows that are none. */
static void correlate(const br_gp_variance *v, double noise, int first, tile_column *m) {
    BR_ALIGNED double q[BR_NZ][BR_COLUMNS];
    for (int a = 0; a < BR_NZ; ++a)
        for (int c = 0; c < BR_ROOT_TILE; ++c) q[a][c] = v->inputs[a][first + c];
    query(v, 0, first + BR_ROOT_TILE, q, m);
    for (int j = 0; j < first + BR_ROOT_TILE; ++j)
        for (int c = 0; c < BR_ROOT_TILE; ++c)
            if (first + c >= v->count || j > first + c)
                m[j][c] = 0;
            else if (j == first + c)
                m[j][c] = 1.0 + noise;
}

/* total[c] -= sum_k rows[k] factors[next k + across c] of so many k, for the columns of a tile. */
static inline __attribute__((always_inline)) void subtract(int count, const tile_column *rows,
                                                           const double *factors, const int next,
                                                           const int across, tile_column *total) {
    br_vec sum[BR_ROOT_TILE][VECTORS];
    BR_UNROLL
    for (int c = 0; c < BR_ROOT_TILE; ++c) BR_UNROLL
    for (int p = 0; p < VECTORS; ++p) sum[c][p] = br_load(&total[c][BR_LANES * p]);
    for (int k = 0; k < count; ++k) BR_UNROLL
    for (int p = 0; p < VECTORS; ++p) {
        const br_vec row = br_load(&rows[k][BR_LANES * p]);
        BR_UNROLL
        for (int c = 0; c < BR_ROOT_TILE; ++c) sum[c][p] -= factors[next * k + across * c] * row;
    }
    BR_UNROLL
    for (int c = 0; c < BR_ROOT_TILE; ++c) BR_UNROLL
    for (int p = 0; p < VECTORS; ++p) br_store(&total[c][BR_LANES * p], sum[c][p]);
}

/* Rows of the Cholesky factor L in place of those of the matrix, given the rows before. A point
 * that is as good as a combination of others gets a column of zeros: it is left out. */
static void factorise(br_gp_variance *v, int first, tile_column *m) {
    for (int left = 0; left <= first; left += BR_ROOT_TILE) {
        const tile_column *above = rows_from(v, left);
        subtract(left, m, above[0], BR_ROOT_TILE, 1, m + left);
        for (int j = 0; j < BR_ROOT_TILE; ++j) { /* the triangle at the diagonal */
            double *column = m[left + j];
            for (int k = 0; k < j; ++k)
                for (int c = 0; c < BR_ROOT_TILE; ++c)
                    column[c] -= above[left + k][j] * m[left + k][c];
            double pivot = above[left + j][j];
            if (left == first) pivot = column[j] > LEAST_PIVOT ? sqrt(column[j]) : 0.0;
            const double scale = pivot > 0 ? 1.0 / pivot : 0.0;
            for (int c = 0; c < BR_ROOT_TILE; ++c)
                column[c] = left + j <= first + c ? column[c] * scale : 0.0;
        }
    }
}

/* Rows of W = L^-1 in place of those of L, given the rows of W before. */
static void invert(br_gp_variance *v, int first, tile_column *m) {
    BR_ALIGNED tile_column diagonal[BR_ROOT_TILE];
    memcpy(diagonal, m + first, sizeof diagonal);
    for (int left = 0; left <= first; left += BR_ROOT_TILE) {
        BR_ALIGNED tile_column right[BR_ROOT_TILE] = {{0}};
        if (left == first)
            for (int c = 0; c < BR_ROOT_TILE; ++c) right[c][c] = 1;
        for (int k = left; k < first; k += BR_ROOT_TILE) /* the columns that W has above */
            subtract(BR_ROOT_TILE, m + k, rows_from(v, k)[left], 1, BR_ROOT_TILE, right);
        for (int i = 0; i < BR_ROOT_TILE; ++i) { /* forward substitution */
            const double scale = diagonal[i][i] > 0 ? 1.0 / diagonal[i][i] : 0.0;
            for (int c = 0; c < BR_ROOT_TILE; ++c) {
                for (int k = 0; k < i; ++k) right[c][i] -= diagonal[k][i] * right[c][k];
                right[c][i] *= scale;
            }
        }
        memcpy(m + left, right, sizeof right);
    }
}

void br_variance_load(const br_gp_output *gp, const br_mpc_gp *in, br_gp_variance *v) {
    v->signal = in->signal;
    v->noise = in->signal > 0 ? in->noise : 0;
    v->count = 0;
    if (!(v->signal > 0)) return;
    choose(gp, in->n, v);
    for (int first = 0; first < v->count; first += BR_ROOT_TILE) {
        correlate(v, in->noise / in->signal, first, rows_from(v, first));
        factorise(v, first, rows_from(v, first));
    }
    for (int first = 0; first < v->count; first += BR_ROOT_TILE)
        invert(v, first, rows_from(v, first));
}

/* |W k|^2 of each column. */
static void explain(const br_gp_variance *v, double (*restrict k)[BR_COLUMNS],
                    double explained[BR_COLUMNS]) {
    br_vec total[VECTORS] = {{0}};
    for (int first = 0; first < v->count; first += BR_ROOT_TILE) {
        const tile_column *restrict rows = (const void *)&v->root[BR_ROOT_SIZE(first)];
        for (int half = 0; half < BR_ROOT_TILE; half += ROWS) {
            br_vec t[ROWS][VECTORS] = {{{0}}};
            for (int j = 0; j < first + BR_ROOT_TILE; ++j) {
                br_vec row[VECTORS];
                BR_UNROLL
                for (int p = 0; p < VECTORS; ++p) row[p] = br_load(&k[j][BR_LANES * p]);
                BR_UNROLL
                for (int i = 0; i < ROWS; ++i) BR_UNROLL
                for (int p = 0; p < VECTORS; ++p) t[i][p] += rows[j][half + i] * row[p];
            }
            BR_UNROLL
            for (int i = 0; i < ROWS; ++i) BR_UNROLL
            for (int p = 0; p < VECTORS; ++p) total[p] += t[i][p] * t[i][p];
        }
    }
    for (int p = 0; p < VECTORS; ++p) br_store(&explained[BR_LANES * p], total[p]);
}

void br_gp_variances(const br_gp *gp, int stages, double (*z)[BR_NZ], double (*work)[BR_COLUMNS],
                     double (*variance)[BR_NE]) {
    double (*k)[BR_COLUMNS] = work;
    for (int j = 0; j < BR_NE; ++j) {
        const br_gp_output *output = &gp->output[j];
        const br_gp_variance *v = &gp->variance[j];
        const int rows = (v->count + BR_ROOT_TILE - 1) / BR_ROOT_TILE * BR_ROOT_TILE;
        for (int first = 0; first < stages; first += BR_COLUMNS) {
            BR_ALIGNED double q[BR_NZ][BR_COLUMNS], explained[BR_COLUMNS];
            for (int c = 0; c < BR_COLUMNS; ++c) { /* what fills the tile is the last stage again */
                const double *at = z[first + c < stages ? first + c : stages - 1];
                for (int a = 0; a < BR_NZ; ++a)
                    q[a][c] = at[a] * output->inverse_scale[a] - output->middle[a];
            }
            query(v, 0, rows, q, k);
            explain(v, k, explained);
            for (int c = 0; c < BR_COLUMNS && first + c < stages; ++c)
                variance[first + c][j] = v->signal * br_worse(0.0, 1.0 - explained[c]) + v->noise;
        }
    }
}
