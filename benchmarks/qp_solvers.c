/* Times one QP of the SQP step in two ways: the step's own condensing with DAQP, and HPIPM.
 *
 *   qp_solvers PROBLEMS RESULTS
 *
 * Follows a recorded closed loop with the step's own iterations. At each problem, before the
 * iteration, both routes solve the same QP: the linearisation in store with the Gauss-Newton
 * Hessian, which is convex stage by stage, as HPIPM's default Riccati recursion needs it.
 *
 * Ours is timed from the linearisation to the change of the inputs: condensing, Cholesky,
 * transformation, active set (warm started as in the step). HPIPM is timed from its filled QP
 * (filling is left out, in its favour) to its solution, partial condensing included. Best of
 * REPEATS each. HPIPM has the duty cycle before as eighth state, x0 eliminated, soft half-planes.
 *
 * PROBLEMS as tests/native/harness.c reads them, but without table, each step followed by its
 * reference (20 x 6). RESULTS: per problem and route, time [us], distance of the inputs' change
 * from ours (infinity norm), iterations, solver status.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include <hpipm_d_ocp_qp.h>
#include <hpipm_d_ocp_qp_dim.h>
#include <hpipm_d_ocp_qp_ipm.h>
#include <hpipm_d_ocp_qp_sol.h>
#include <hpipm_d_part_cond.h>

#include "br_internal.h"

#define REPEATS 5
#define ROUTES 5 /* ours, then HPIPM: BALANCE, SPEED, each without and with blocks */
#define BLOCKS 5
#define NXA (BR_NX + 1)

static double now_us(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return 1e6 * (double)t.tv_sec + 1e-3 * (double)t.tv_nsec;
}

static void *block(size_t size) {
    void *memory = aligned_alloc(64, (size + 127) / 64 * 64);
    if (!memory) exit(1);
    return memory;
}

typedef struct {
    struct d_ocp_qp_dim dim;
    struct d_ocp_qp qp;
    struct d_ocp_qp_sol sol;
} ocp;

typedef struct {
    struct d_ocp_qp_ipm_arg arg;
    struct d_ocp_qp_ipm_ws ws;
} solver;

static void make_ocp(ocp *o) {
    d_ocp_qp_create(&o->dim, &o->qp, block(d_ocp_qp_memsize(&o->dim)));
    d_ocp_qp_sol_create(&o->dim, &o->sol, block(d_ocp_qp_sol_memsize(&o->dim)));
}

static void make_solver(solver *s, ocp *o, enum hpipm_mode mode) {
    int iterations = 100;
    double tolerance = 1e-8;
    d_ocp_qp_ipm_arg_create(&o->dim, &s->arg, block(d_ocp_qp_ipm_arg_memsize(&o->dim)));
    d_ocp_qp_ipm_arg_set_default(mode, &s->arg);
    d_ocp_qp_ipm_arg_set_iter_max(&iterations, &s->arg);
    d_ocp_qp_ipm_arg_set_tol_stat(&tolerance, &s->arg);
    d_ocp_qp_ipm_arg_set_tol_eq(&tolerance, &s->arg);
    d_ocp_qp_ipm_arg_set_tol_ineq(&tolerance, &s->arg);
    d_ocp_qp_ipm_arg_set_tol_comp(&tolerance, &s->arg);
    d_ocp_qp_ipm_ws_create(&o->dim, &s->arg, &s->ws,
                           block(d_ocp_qp_ipm_ws_memsize(&o->dim, &s->arg)));
}

static void make_dimensions(struct d_ocp_qp_dim *dim) {
    int nx[BR_N + 1], nu[BR_N + 1], nbx[BR_N + 1], nbu[BR_N + 1], ng[BR_N + 1], ns[BR_N + 1];
    for (int k = 0; k <= BR_N; ++k) {
        nx[k] = k ? NXA : 0;
        nu[k] = nbu[k] = k < BR_N ? BR_NU : 0;
        nbx[k] = ng[k] = ns[k] = k > 0;
    }
    d_ocp_qp_dim_create(BR_N, dim, block(d_ocp_qp_dim_memsize(BR_N)));
    d_ocp_qp_dim_set_all(nx, nu, nbx, nbu, ng, ns, dim);
}

/* Dynamics of [dx; change of d before] under du, column major. */
static void fill_dynamics(br_mpc *mpc, int k, struct d_ocp_qp *qp) {
    const br_stage *stage = &mpc->stage[k];
    double a[NXA * NXA] = {0}, b[NXA * BR_NU] = {0}, c[NXA] = {0};
    for (int i = 0; i < BR_NX; ++i) {
        for (int j = 0; j < BR_NX; ++j) a[j * NXA + i] = stage->jacobian[i][j];
        for (int j = 0; j < BR_NU; ++j) b[j * NXA + i] = stage->jacobian[i][BR_NX + j];
        c[i] = stage->f[i] - mpc->plan.x[k + 1][i];
        for (int j = 0; k == 0 && j < BR_NX; ++j)
            c[i] += stage->jacobian[i][j] * (mpc->x0[j] - mpc->plan.x[0][j]);
    }
    b[BR_NX] = 1;
    if (k) d_ocp_qp_set_A(k, a, qp);
    d_ocp_qp_set_B(k, b, qp);
    d_ocp_qp_set_b(k, c, qp);
}

static void fill_cost(br_mpc *mpc, int k, struct d_ocp_qp *qp) {
    const br_mpc_parameters *p = &mpc->parameters;
    double q[NXA * NXA] = {0}, qv[NXA] = {0}, s[BR_NU * NXA] = {0};
    if (k < BR_N) {
        const double *u = mpc->plan.u[k];
        const double change = u[0] - (k ? mpc->plan.u[k - 1][0] : mpc->u_before[0]);
        double r[BR_NU * BR_NU] = {2 * p->r_duty, 0, 0, 2 * p->r_delta_rate};
        double rv[BR_NU] = {2 * p->r_duty * change, 2 * p->r_delta_rate * u[1]};
        d_ocp_qp_set_R(k, r, qp);
        d_ocp_qp_set_r(k, rv, qp);
        s[BR_NX * BR_NU] = -2 * p->r_duty;
        q[BR_NX * NXA + BR_NX] = 2 * p->r_duty;
        qv[BR_NX] = -2 * p->r_duty * change;
    }
    if (!k) return;
    const br_mpc_reference *ref = &mpc->reference[k - 1];
    q[0] = q[NXA + 1] = 2 * p->q_position;
    qv[0] = 2 * p->q_position * (mpc->plan.x[k][0] - ref->x);
    qv[1] = 2 * p->q_position * (mpc->plan.x[k][1] - ref->y);
    d_ocp_qp_set_Q(k, q, qp);
    d_ocp_qp_set_q(k, qv, qp);
    if (k < BR_N) d_ocp_qp_set_S(k, s, qp);
}

static void fill_bounds(br_mpc *mpc, int k, struct d_ocp_qp *qp) {
    const br_mpc_parameters *p = &mpc->parameters;
    if (k < BR_N) {
        int index[BR_NU] = {0, 1};
        const double *u = mpc->plan.u[k];
        double low[BR_NU] = {p->d_min - u[0], -p->delta_rate_max_radps - u[1]};
        double high[BR_NU] = {p->d_max - u[0], p->delta_rate_max_radps - u[1]};
        d_ocp_qp_set_idxbu(k, index, qp);
        d_ocp_qp_set_lbu(k, low, qp);
        d_ocp_qp_set_ubu(k, high, qp);
    }
    if (!k) return;
    const br_mpc_reference *ref = &mpc->reference[k - 1];
    const double *x = mpc->plan.x[k];
    int angle = 6;
    double low = -p->delta_max_rad - x[6], high = p->delta_max_rad - x[6];
    d_ocp_qp_set_idxbx(k, &angle, qp);
    d_ocp_qp_set_lbx(k, &low, qp);
    d_ocp_qp_set_ubx(k, &high, qp);
    const double along = ref->normal_x * x[0] + ref->normal_y * x[1];
    double c[NXA] = {ref->normal_x, ref->normal_y}, one = 1, zero = 0, z = 2 * p->s_slack;
    low = ref->lower + p->margin_m - along, high = ref->upper - p->margin_m - along;
    d_ocp_qp_set_C(k, c, qp);
    d_ocp_qp_set_lg(k, &low, qp);
    d_ocp_qp_set_ug(k, &high, qp);
    d_ocp_qp_set_Jsg(k, &one, qp);
    d_ocp_qp_set_Zl(k, &z, qp);
    d_ocp_qp_set_Zu(k, &z, qp);
    d_ocp_qp_set_zl(k, &zero, qp);
    d_ocp_qp_set_zu(k, &zero, qp);
    d_ocp_qp_set_lls(k, &zero, qp);
    d_ocp_qp_set_lus(k, &zero, qp);
}

static void fill(br_mpc *mpc, ocp *o) {
    for (int k = 0; k <= BR_N; ++k) {
        if (k < BR_N) fill_dynamics(mpc, k, &o->qp);
        fill_cost(mpc, k, &o->qp);
        fill_bounds(mpc, k, &o->qp);
    }
}

static ocp full, part;
static solver plain[2], condensed[2];
static struct d_part_cond_qp_arg cond_arg;
static struct d_part_cond_qp_ws cond_ws;

static void set_up_hpipm(void) {
    static const enum hpipm_mode modes[2] = {BALANCE, SPEED};
    int sizes[BLOCKS + 1];
    make_dimensions(&full.dim);
    make_ocp(&full);
    d_part_cond_qp_compute_block_size(BR_N, BLOCKS, sizes);
    d_ocp_qp_dim_create(BLOCKS, &part.dim, block(d_ocp_qp_dim_memsize(BLOCKS)));
    d_part_cond_qp_compute_dim(&full.dim, sizes, &part.dim);
    make_ocp(&part);
    d_part_cond_qp_arg_create(BLOCKS, &cond_arg, block(d_part_cond_qp_arg_memsize(BLOCKS)));
    d_part_cond_qp_arg_set_default(&cond_arg);
    d_part_cond_qp_ws_create(
        &full.dim, sizes, &part.dim, &cond_arg, &cond_ws,
        block(d_part_cond_qp_ws_memsize(&full.dim, sizes, &part.dim, &cond_arg)));
    for (int m = 0; m < 2; ++m) {
        make_solver(&plain[m], &full, modes[m]);
        make_solver(&condensed[m], &part, modes[m]);
    }
}

static void run_hpipm(int m, int blocks, double result[4], const double reference[BR_M]) {
    solver *s = blocks ? &condensed[m] : &plain[m];
    result[0] = INFINITY;
    for (int repeat = 0; repeat < REPEATS; ++repeat) {
        const double start = now_us();
        if (blocks) {
            d_part_cond_qp_cond(&full.qp, &part.qp, &cond_arg, &cond_ws);
            d_ocp_qp_ipm_solve(&part.qp, &part.sol, &s->arg, &s->ws);
            d_part_cond_qp_expand_sol(&full.qp, &part.sol, &full.sol, &cond_arg, &cond_ws);
        } else {
            d_ocp_qp_ipm_solve(&full.qp, &full.sol, &s->arg, &s->ws);
        }
        result[0] = fmin(result[0], now_us() - start);
    }
    int iterations, status;
    d_ocp_qp_ipm_get_iter(&s->ws, &iterations);
    d_ocp_qp_ipm_get_status(&s->ws, &status);
    result[1] = 0;
    for (int k = 0; k < BR_N; ++k) {
        double u[BR_NU];
        d_ocp_qp_sol_get_u(k, &full.sol, u);
        for (int c = 0; c < BR_NU; ++c)
            result[1] = fmax(result[1], fabs(u[c] - reference[BR_NU * k + c]));
    }
    result[2] = iterations;
    result[3] = status;
}

static void run_ours(br_mpc *mpc, int warm, double result[4]) {
    int sense[BR_ROWS];
    memcpy(sense, mpc->qp.sense, sizeof sense);
    result[0] = INFINITY;
    for (int repeat = 0; repeat < REPEATS; ++repeat) {
        memcpy(mpc->qp.sense, sense, sizeof sense);
        mpc->info.qp_iterations = 0;
        mpc->qp.factorised = 0;
        const double start = now_us();
        br_qp_condense(mpc);
        result[3] = br_qp_solve(mpc, warm);
        result[0] = fmin(result[0], now_us() - start);
    }
    result[1] = 0;
    result[2] = mpc->info.qp_iterations;
    memcpy(mpc->qp.sense, sense, sizeof sense);
}

/* Both routes at the QP in store, whose exact Hessians come back afterwards. */
static void compare(br_mpc *mpc, int warm, double results[ROUTES][4]) {
    static br_stage exact[BR_N];
    memcpy(exact, mpc->stage, sizeof exact);
    for (int k = 0; k < BR_N; ++k) memset(mpc->stage[k].hessian, 0, sizeof mpc->stage[k].hessian);
    run_ours(mpc, warm, results[0]);
    double ours[BR_M];
    memcpy(ours, mpc->qp.delta_u, sizeof ours);
    fill(mpc, &full);
    for (int m = 0; m < 2; ++m)
        for (int blocks = 0; blocks < 2; ++blocks)
            run_hpipm(m, blocks, results[1 + 2 * m + blocks], ours);
    memcpy(mpc->stage, exact, sizeof exact);
}

static double *read_file(const char *path, size_t *count) {
    FILE *file = fopen(path, "rb");
    if (!file || fseek(file, 0, SEEK_END)) exit(1);
    const size_t size = (size_t)ftell(file);
    double *data = block(size);
    rewind(file);
    if (fread(data, 1, size, file) != size) exit(1);
    fclose(file);
    *count = size / sizeof(double);
    return data;
}

int main(int argc, char **argv) {
    if (argc != 3) return 1;
    size_t count;
    const double *at = read_file(argv[1], &count);
    const double *end = at + count;
    br_mpc *mpc;
    if (br_mpc_init(block(br_mpc_memory_size()), br_mpc_memory_size(), &mpc)) return 1;
    br_mpc_parameters p;
    memcpy(&p, at, offsetof(br_mpc_parameters, iterations)); /* doubles, then two ints */
    at += offsetof(br_mpc_parameters, iterations) / sizeof(double);
    p.iterations = (int)*at++, p.iterations_cold = (int)*at++;
    br_mpc_gp outputs[BR_NE];
    for (int j = 0; j < BR_NE; ++j) {
        const int n = (int)at[1];
        outputs[j] = (br_mpc_gp){(int)at[0], n, at[2], at[3], at + 4, at + 10, at + 10 + 6 * n};
        at += 10 + 7 * n;
    }
    if (br_mpc_set_parameters(mpc, &p) || br_mpc_set_weights(mpc, outputs)) return 1;
    set_up_hpipm();
    FILE *out = fopen(argv[2], "wb");
    if (!out) return 1;
    for (++at; at + 8 + 6 * BR_N <= end; at += 8 + 6 * BR_N) {
        memcpy(mpc->x0, at, sizeof mpc->x0);
        mpc->u_before[0] = at[7];
        br_evaluate_bounds(mpc);
        memcpy(mpc->reference, at + 8, sizeof mpc->reference);
        memset(&mpc->info, 0, sizeof mpc->info);
        const int warm = mpc->warm;
        if (warm)
            br_sqp_shift(mpc);
        else
            br_sqp_cold_start(mpc);
        double results[ROUTES][4];
        compare(mpc, warm, results);
        mpc->qp.factorised = 0; /* compare left that of the Gauss-Newton Hessian */
        mpc->warm = br_sqp_iterate(mpc, warm, warm) <= BR_DEFECT;
        fwrite(results, sizeof results, 1, out);
    }
    fclose(out);
    return 0;
}
