/* Runs the controller from C alone: reads a recorded drive, steps through it, writes the inputs.
 *
 *   harness PROBLEMS RESULTS
 *
 * PROBLEMS, all doubles: spacing, rows, table; the parameters; per GP output kernel, n, offset,
 * scale, signal, noise, 6 length scales, n x 6 inputs, n alphas; steps, then per step x (7) and
 * d_previous. RESULTS: per step error, status, u (2). The first half goes one stage at a time,
 * without budget; the second adds other times, budgets by a clock that counts its readings, and
 * spoiled references. With -DCOUNT_ALLOCATIONS and the linker's --wrap, any allocation after
 * br_mpc_init ends the program with code 3. Code 1: a promise of the interface is broken (the line
 * says which).
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "bayesrace_mpc.h"
#include "check.h"

static int armed = 0;
static const double no_input[BR_NU]; /* input before */

#ifdef COUNT_ALLOCATIONS
void *__real_malloc(size_t size);
void *__real_calloc(size_t n, size_t size);
void *__real_realloc(void *p, size_t size);
void __real_free(void *p);
void *__wrap_malloc(size_t size);
void *__wrap_calloc(size_t n, size_t size);
void *__wrap_realloc(void *p, size_t size);
void __wrap_free(void *p);

static void forbidden(const char *what) {
    if (!armed) return;
    fprintf(stderr, "%s called in the control loop\n", what);
    _Exit(3);
}
void *__wrap_malloc(size_t size) {
    forbidden("malloc");
    return __real_malloc(size);
}
void *__wrap_calloc(size_t n, size_t size) {
    forbidden("calloc");
    return __real_calloc(n, size);
}
void *__wrap_realloc(void *p, size_t size) {
    forbidden("realloc");
    return __real_realloc(p, size);
}
void __wrap_free(void *p) {
    forbidden("free");
    __real_free(p);
}
#endif

static const double *cursor;
static double next(void) { return *cursor++; }
static const double *take(size_t n) {
    const double *here = cursor;
    cursor += n;
    return here;
}

static double *read_file(const char *path) {
    FILE *file = fopen(path, "rb");
    CHECK(file);
    CHECK(fseek(file, 0, SEEK_END) == 0);
    const long size = ftell(file);
    rewind(file);
    double *data = malloc((size_t)size);
    CHECK(data && fread(data, 1, (size_t)size, file) == (size_t)size);
    fclose(file);
    return data;
}

static br_mpc_parameters read_parameters(void) {
    br_mpc_parameters p;
    const size_t size = offsetof(br_mpc_parameters, iterations); /* doubles, then ints */
    memcpy(&p, take(size / sizeof(double)), size);
    p.iterations = (int)next(), p.iterations_cold = (int)next();
    p.qp_steps = (int)next();
    return p;
}

static void read_weights(br_mpc_gp outputs[BR_NE]) {
    for (int j = 0; j < BR_NE; ++j) {
        br_mpc_gp *gp = &outputs[j];
        gp->kernel = (int)next(), gp->n = (int)next();
        gp->offset = next(), gp->scale = next();
        gp->signal = next(), gp->noise = next();
        gp->length_scales = take(BR_NZ);
        gp->inputs = take((size_t)gp->n * BR_NZ);
        gp->alpha = take((size_t)gp->n);
    }
}

static void check_memory_errors(char *block, size_t size) {
    br_mpc *mpc = NULL;
    CHECK(br_mpc_init(NULL, size, &mpc) == BR_ERROR_NULL);
    CHECK(br_mpc_init(block, size, NULL) == BR_ERROR_NULL);
    CHECK(br_mpc_init(block, size - 1, &mpc) == BR_ERROR_MEMORY);
    CHECK(br_mpc_init(block + 8, size, &mpc) == BR_ERROR_MEMORY);
    CHECK(mpc == NULL);
}

static void check_not_ready(br_mpc *mpc, const br_mpc_parameters *p) {
    double x[BR_NX] = {0}, u[BR_NU] = {7, 7};
    br_mpc_status status;
    CHECK(br_mpc_step(mpc, x, no_input, NULL, BR_TS, 0, u, &status, NULL) == BR_ERROR_NOT_READY);
    CHECK(br_mpc_prepare(mpc, BR_TS, 0) == BR_ERROR_NOT_READY);
    CHECK(br_mpc_predict(mpc, x, u, 0, x) == BR_ERROR_NOT_READY);
    CHECK(br_mpc_set_parameters(mpc, p) == BR_OK);
    CHECK(br_mpc_prepare(mpc, BR_TS, 0) == BR_OK); /* no plan yet: nothing to do */
    CHECK(br_mpc_step(mpc, x, no_input, NULL, BR_TS, 0, u, &status, NULL) ==
          BR_ERROR_NOT_READY); /* no path */
    CHECK(u[0] == 7 && u[1] == 7);
}

static void check_parameters(br_mpc *mpc, const br_mpc_parameters *good) {
    const size_t doubles = offsetof(br_mpc_parameters, iterations) / sizeof(double);
    for (size_t i = 0; i < doubles; ++i) {
        br_mpc_parameters bad = *good;
        double *field = &bad.q_position + i;
        *field = NAN;
        CHECK(br_mpc_set_parameters(mpc, &bad) == BR_ERROR_PARAMETERS);
        *field = INFINITY;
        CHECK(br_mpc_set_parameters(mpc, &bad) == BR_ERROR_PARAMETERS);
        if (field == &bad.d_min || field == &bad.d_max) continue;
        *field = -1;
        CHECK(br_mpc_set_parameters(mpc, &bad) == BR_ERROR_PARAMETERS);
    }
    br_mpc_parameters bad = *good;
    bad.d_min = bad.d_max;
    CHECK(br_mpc_set_parameters(mpc, &bad) == BR_ERROR_PARAMETERS);
    bad = *good;
    bad.iterations = 0;
    CHECK(br_mpc_set_parameters(mpc, &bad) == BR_ERROR_PARAMETERS);
    bad = *good;
    bad.iterations_cold = 0;
    CHECK(br_mpc_set_parameters(mpc, &bad) == BR_ERROR_PARAMETERS);
    CHECK(br_mpc_set_parameters(NULL, good) == BR_ERROR_NULL);
    CHECK(br_mpc_set_parameters(mpc, NULL) == BR_ERROR_NULL);
}

static void check_null(br_mpc *mpc, const double *table, int rows, double spacing) {
    double x[BR_NX] = {0}, u[BR_NU], plan_x[(BR_N + 1) * BR_NX], plan_u[BR_N * BR_NU];
    double jacobian[BR_NX * BR_NV], hessian[BR_NV * BR_NV];
    br_mpc_reference reference[BR_N];
    br_mpc_status status;
    CHECK(br_mpc_set_path(NULL, table, rows, spacing) == BR_ERROR_NULL);
    CHECK(br_mpc_set_path(mpc, NULL, rows, spacing) == BR_ERROR_NULL);
    CHECK(br_mpc_set_path(mpc, table, -1, spacing) == BR_ERROR_PATH);
    CHECK(br_mpc_set_path(mpc, table, BR_PATH_CAPACITY + 1, spacing) == BR_ERROR_PATH);
    CHECK(br_mpc_set_weights(NULL, NULL) == BR_ERROR_NULL);
    CHECK(br_mpc_set_weights(mpc, NULL) == BR_ERROR_NULL);
    CHECK(br_mpc_step(NULL, x, no_input, NULL, BR_TS, 0, u, &status, NULL) == BR_ERROR_NULL);
    CHECK(br_mpc_step(mpc, NULL, no_input, NULL, BR_TS, 0, u, &status, NULL) == BR_ERROR_NULL);
    CHECK(br_mpc_step(mpc, x, no_input, NULL, BR_TS, 0, NULL, &status, NULL) == BR_ERROR_NULL);
    CHECK(br_mpc_step(mpc, x, no_input, NULL, BR_TS, 0, u, NULL, NULL) == BR_ERROR_NULL);
    CHECK(br_mpc_solve(mpc, x, no_input, BR_TS, 0, NULL, u, &status, NULL) == BR_ERROR_NULL);
    CHECK(br_mpc_prepare(NULL, BR_TS, 0) == BR_ERROR_NULL);
    CHECK(br_mpc_set_clock(NULL, NULL, NULL) == BR_ERROR_NULL);
    CHECK(br_mpc_predict(NULL, x, u, 0, x) == BR_ERROR_NULL);
    CHECK(br_mpc_predict(mpc, NULL, u, 0, x) == BR_ERROR_NULL);
    CHECK(br_mpc_predict(mpc, x, NULL, 0, x) == BR_ERROR_NULL);
    CHECK(br_mpc_predict(mpc, x, u, 0, NULL) == BR_ERROR_NULL);
    CHECK(br_mpc_observe(NULL, x, x, BR_TS, x, NULL) == BR_ERROR_NULL);
    CHECK(br_mpc_observe(mpc, NULL, x, BR_TS, x, NULL) == BR_ERROR_NULL);
    CHECK(br_mpc_observe(mpc, x, NULL, BR_TS, x, NULL) == BR_ERROR_NULL);
    CHECK(br_mpc_observe(mpc, x, x, BR_TS, NULL, NULL) == BR_ERROR_NULL);
    CHECK(br_mpc_get_plan(NULL, plan_x, plan_u) == BR_ERROR_NULL);
    CHECK(br_mpc_get_reference(NULL, reference) == BR_ERROR_NULL);
    CHECK(br_mpc_evaluate(mpc, NULL, x, plan_x, jacobian, hessian) == BR_ERROR_NULL);
    br_mpc_reset(NULL);
}

static void check_times(br_mpc *mpc) {
    static const double bad[] = {-1e-9, NAN, INFINITY, -INFINITY};
    double x[BR_NX] = {0}, u[BR_NU] = {0};
    br_mpc_status status;
    for (size_t i = 0; i < sizeof bad / sizeof bad[0]; ++i) {
        CHECK(br_mpc_step(mpc, x, no_input, NULL, bad[i], 0, u, &status, NULL) == BR_ERROR_TIME);
        CHECK(br_mpc_prepare(mpc, bad[i], 0) == BR_ERROR_TIME);
        CHECK(br_mpc_predict(mpc, x, u, bad[i], x) == BR_ERROR_TIME);
        CHECK(br_mpc_observe(mpc, x, u, bad[i], x, NULL) == BR_ERROR_TIME);
    }
    CHECK(br_mpc_predict(mpc, x, u, 1.001 * BR_PREDICT_MAX_S, x) == BR_ERROR_TIME);
    CHECK(br_mpc_monotonic(NULL) > 0 && br_mpc_monotonic(NULL) >= br_mpc_monotonic(NULL) - 60);
}

static void check_texts(void) {
    for (int i = -1; i < 10; ++i) {
        CHECK(strlen(br_mpc_error_text((br_mpc_error)i)) > 3);
        CHECK(strlen(br_mpc_status_text((br_mpc_status)i)) > 3);
    }
    CHECK(br_mpc_abi() == BR_ABI);
}

/* The same problem through the caller's own planner, spoiled: never a crash, never a status that
 * says usable with numbers that are not finite. */
static void spoiled_solve(br_mpc *mpc, const double *x, double d, int what) {
    static const double poison[] = {NAN, INFINITY, 1e300, -1e300, 0};
    br_mpc_reference reference[BR_N];
    double u[BR_NU] = {0.5, 0.5};
    br_mpc_status status;
    CHECK(br_mpc_get_reference(mpc, reference) == BR_OK);
    (&reference[what % BR_N].x)[what % 6] = poison[what % 5];
    CHECK(br_mpc_solve(mpc, x, (double[BR_NU]){d}, BR_TS, 0, reference, u, &status, NULL) == BR_OK);
    CHECK(isfinite(u[0]) && isfinite(u[1]));
    if (status > BR_ACCEPTABLE) CHECK(u[0] == 0.5 && u[1] == 0.5);
}

/* Every reading takes 10 us. */
static double counting_clock(void *context) { return *(double *)context += 1e-5; }

/* x is given with what may be in it; a prediction that is no error is finite. */
static void predict(const br_mpc *mpc, const double *x, const double *u, double duration) {
    double after[BR_NX] = {-7};
    const br_mpc_error error = br_mpc_predict(mpc, x, u, duration, after);
    CHECK(error == BR_OK || error == BR_ERROR_STATE);
    for (int i = 0; i < BR_NX; ++i) CHECK(isfinite(after[i]));
    if (error) CHECK(after[0] == -7);
}

/* What may happen between two steps. */
static void interlude(br_mpc *mpc, int i, int second_half, const br_mpc_gp *weights,
                      const br_mpc_gp *none) {
    if (i % 3 == 1) CHECK(br_mpc_prepare(mpc, BR_TS, second_half ? 2e-3 : 0) == BR_OK);
    if (i % 7 == 6) CHECK(br_mpc_prepare(mpc, (i % 5) * BR_TS, 0) == BR_OK);
    if (i % 50 == 40) CHECK(br_mpc_set_weights(mpc, i % 100 == 40 ? none : weights) == BR_OK);
    if (i % 97 == 96) br_mpc_reset(mpc);
}

int main(int argc, char **argv) {
    CHECK(argc == 3);
    double *data = read_file(argv[1]);
    cursor = data;
    const double spacing = next();
    const int rows = (int)next();
    const double *table = take((size_t)rows * BR_PATH_COLUMNS);
    const br_mpc_parameters parameters = read_parameters();
    br_mpc_gp weights[BR_NE], none[BR_NE];
    memset(none, 0, sizeof none);
    read_weights(weights);
    const int steps = (int)next();
    double *results = malloc((size_t)steps * 4 * sizeof(double));

    const size_t size = br_mpc_memory_size();
    char *block = aligned_alloc(64, (size + 127) / 64 * 64);
    CHECK(block && results);
    memset(block, 0xa5, size); /* init must not rely on zeroed memory */
    br_mpc *mpc = NULL;
    check_memory_errors(block, size);
    CHECK(br_mpc_init(block, size, &mpc) == BR_OK && mpc);

    armed = 1;
    check_texts();
    check_not_ready(mpc, &parameters);
    check_parameters(mpc, &parameters);
    check_null(mpc, table, rows, spacing);
    check_times(mpc);
    CHECK(br_mpc_set_path(mpc, table, rows, spacing) == BR_OK);
    CHECK(br_mpc_set_weights(mpc, weights) == BR_OK);
    double now = 0;
    CHECK(br_mpc_set_clock(mpc, counting_clock, &now) == BR_OK);
    for (int i = 0; i < steps; ++i) {
        const double *x = take(BR_NX), d = next();
        double u[BR_NU] = {-9, -9};
        br_mpc_status status;
        br_mpc_info info;
        const int second_half = i >= steps / 2;
        const double elapsed = second_half ? (i % 4) * 0.7 * BR_TS : BR_TS;
        const double budget = second_half ? (i % 6) * 1e-4 : 0;
        interlude(mpc, i, second_half, weights, none);
        if (second_half && i % 9 == 8) spoiled_solve(mpc, x, d, i);
        const br_mpc_error error =
            br_mpc_step(mpc, x, (double[BR_NU]){d}, NULL, elapsed, budget, u, &status, &info);
        predict(mpc, x, u, (i % 10) * 0.01);
        if (status > BR_ACCEPTABLE)
            CHECK(u[0] == -9 && u[1] == -9);
        else
            CHECK(isfinite(u[0]) && isfinite(u[1]) && info.defect <= parameters.defect_max);
        const double row[] = {error, status, u[0], u[1]};
        memcpy(&results[4 * i], row, sizeof row);
    }
    armed = 0;

    FILE *out = fopen(argv[2], "wb");
    CHECK(out && fwrite(results, 4 * sizeof(double), (size_t)steps, out) == (size_t)steps);
    fclose(out);
    free(results);
    free(block);
    free(data);
    return 0;
}
