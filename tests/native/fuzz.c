/* Fuzz target: bytes become calls of the interface, whose promises are checked after each.
 *
 * For libFuzzer (LLVMFuzzerTestOneInput) and for fuzz_main.c, which needs no clang. Whatever is
 * asked, no crash, and:
 *   - a usable status comes with a finite first input within the limits, small residuals, and no
 *     more iterations than allowed; any other leaves the input alone;
 *   - a prediction is a plausible state, or an error;
 *   - what is observed is taken, or refused;
 *   - br_mpc_prepare leaves the plan that is read; without a budget it changes no bit of any step:
 *     a second controller, which is never prepared, must agree.
 * Numbers are mostly plausible, so that the calls get past the checks, and now and then anything
 * that fits in a double.
 */
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define BR_TABLES /* plausible states */
#include "bayesrace_mpc.h"

#define CHECK_END abort()
#include "check.h"

#define ROWS 160
#define RADIUS_M 1.2
#define POINTS 9 /* of a GP output; not a whole number of vectors */

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

/* --- bytes to numbers --- */

static const uint8_t *at, *end;

static uint8_t byte(void) { return at < end ? *at++ : 0; }

static double raw(void) {
    uint64_t bits = 0;
    for (int i = 0; i < 8; ++i) bits = bits << 8 | byte();
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static double special(void) {
    static const double values[] = {NAN,    INFINITY, -INFINITY, 0.0,    -0.0, 5e-324,
                                    1e-300, 1e300,    -1e300,    1e9,    -1e9, 1e4,
                                    1.5,    -1.5,     1.0e-12,   1.0 / 3};
    return values[byte() % 16];
}

/* Around `usual` within `spread`, rarely anything. */
static double number(double usual, double spread) {
    const uint8_t how = byte();
    if (how < 0x60) return usual;
    if (how < 0xe8) return usual + spread * ((int16_t)(byte() << 8 | byte()) / 32768.0);
    return how < 0xf4 ? special() : raw();
}

/* --- the controllers --- */

typedef struct {
    br_mpc *mpc;
    double time, tick; /* of its clock */
} controller;

static double ticking(void *context) {
    controller *c = context;
    return c->time += c->tick;
}

static double table[ROWS][BR_PATH_COLUMNS];

static void make_path(void) {
    for (int i = 0; i < ROWS; ++i) {
        const double angle = 2 * 3.14159265358979323846 * i / ROWS, c = cos(angle), s = sin(angle);
        const double row[] = {RADIUS_M * c, RADIUS_M * s,    1.8,           -c,
                              -s,           -RADIUS_M - 0.2, 0.2 - RADIUS_M};
        memcpy(table[i], row, sizeof row);
    }
}

static const br_mpc_parameters usual = {
    .q_position = 1,
    .r_duty = 5e-3,
    .r_delta_rate = 1e-4,
    .s_slack = 100,
    .margin_m = 0.01,
    .d_min = -0.1,
    .d_max = 1,
    .delta_max_rad = 0.35,
    .delta_rate_max_radps = 5,
#if BR_FOLLOWS_PLAN
    .q_contour = 0.1,
    .gain = 2.5,
#endif
    .tolerance = 1e-6,
    .defect_max = 0.1,
    .early_stop_tol = 1e-4,
    .caution_sigmas = 1.6,
    .iterations = 3,
    .iterations_cold = 12,
    .qp_steps = 2000,
};

static br_mpc_parameters parameters;
static double x[BR_NX], before[BR_NU];

/* The same for all, whose answers must agree to the bit. */
static void set_instructions(controller *c, int count) {
    const br_instructions wanted = byte() % 4;
    for (int i = 0; i < count; ++i) {
        const br_mpc_error error = br_mpc_set_instructions(c[i].mpc, wanted);
        CHECK(error == BR_OK || error == BR_ERROR_INSTRUCTIONS);
        CHECK(br_mpc_get_instructions(c[i].mpc) == br_mpc_get_instructions(c[0].mpc));
    }
}

static void set_parameters(controller *c, int count) {
    br_mpc_parameters p = usual;
    double *field = &p.q_position;
    for (size_t i = 0; i < offsetof(br_mpc_parameters, iterations) / sizeof(double); ++i)
        field[i] = number(field[i], 0.9 * fabs(field[i]));
    p.iterations = byte() % 8, p.iterations_cold = byte() % 32;
    p.qp_steps = 190 + byte();
    br_mpc_error error = BR_OK;
    for (int i = 0; i < count; ++i) error = br_mpc_set_parameters(c[i].mpc, &p);
    CHECK(error == BR_OK || error == BR_ERROR_PARAMETERS);
    if (!error) parameters = p;
}

static void set_path(controller *c, int count) {
    double changed[ROWS][BR_PATH_COLUMNS];
    memcpy(changed, table, sizeof table);
    for (int i = byte() % 8; i > 0; --i) {
        double *cell = &changed[byte() % ROWS][byte() % BR_PATH_COLUMNS];
        *cell = number(*cell, 0.1);
    }
    const int rows = byte() < 0xe0 ? ROWS : byte() - 64;
    const double spacing = number(2 * 3.14159265358979323846 * RADIUS_M / ROWS, 0.05);
    for (int i = 0; i < count; ++i) {
        const br_mpc_error error =
            br_mpc_set_path(c[i].mpc, changed[0], rows <= ROWS ? rows : -1, spacing);
        CHECK(error == BR_OK || error == BR_ERROR_PATH);
    }
}

static br_environment around;

static void set_speed_limit(void) { around = (br_environment){number(1, 1), number(0, 5)}; }

static void set_weights(controller *c, int count) {
    static double scales[BR_NE][BR_NZ], inputs[BR_NE][POINTS][BR_NZ], alpha[BR_NE][POINTS];
    br_mpc_gp outputs[BR_NE];
    for (int j = 0; j < BR_NE; ++j) {
        const uint8_t how = byte();
        outputs[j] =
            (br_mpc_gp){how % 5,          how < 0xf8 ? (how >> 2) % (POINTS + 1) : how - 0xfb,
                        number(0, 0.1),   number(0.1, 1),
                        number(0.1, 0.2), number(0.01, 0.02),
                        scales[j],        inputs[j][0],
                        alpha[j]};
        for (int a = 0; a < BR_NZ; ++a) scales[j][a] = number(1, 0.99);
        for (int i = 0; i < POINTS; ++i) {
            for (int a = 0; a < BR_NZ; ++a) inputs[j][i][a] = number(0.3 * a - 0.1 * i, 2);
            alpha[j][i] = number(i % 2 ? 0.3 : -0.3, 1);
        }
        if (outputs[j].n > POINTS) outputs[j].n = POINTS;
    }
    for (int i = 0; i < count; ++i) {
        const br_mpc_error error = br_mpc_set_weights(c[i].mpc, outputs);
        CHECK(error == BR_OK || error == BR_ERROR_WEIGHTS);
    }
}

static void measure(void) {
    static const double spread[BR_NX] = {0.1, 0.1, 0.3, 1, 0.3, 3, 0.4};
    for (int i = 0; i < BR_NX; ++i) x[i] = number(x[i], spread[i]);
    before[0] = number(0.3, 0.5);
}

static void check_answer(const double u[BR_NU], br_mpc_status status, const br_mpc_info *info) {
    const br_mpc_parameters *p = &parameters;
    const int limit = p->iterations > p->iterations_cold ? p->iterations : p->iterations_cold;
    CHECK(status >= BR_CONVERGED && status <= BR_TIME_LIMIT);
    CHECK(info->iterations <= limit + (BR_COLD_GUESSES + 1) * BR_SECOND_START_ITERATIONS);
    CHECK(info->qp_iterations <= p->qp_steps);
    CHECK(info->pace > 0 && info->pace <= 1);
    CHECK(info->widening >= 1 && info->widening <= 1e6);
    if (status > BR_ACCEPTABLE) {
        CHECK(u[0] == -9 && u[1] == -9);
        return;
    }
    CHECK(u[0] >= p->d_min - 1e-6 && u[0] <= p->d_max + 1e-6);
    CHECK(fabs(u[1]) <= p->delta_rate_max_radps + 1e-6);
    CHECK(info->defect <= p->defect_max && info->bound <= 1e-6 && isfinite(info->stationarity));
    CHECK(isfinite(info->cost) && info->slack_max_m >= 0 && info->tube_m >= 0);
    if (status == BR_CONVERGED)
        CHECK(info->stationarity <= p->tolerance && info->defect <= p->tolerance);
}

/* One step or solve of all controllers, which must agree; the car goes where the input takes it. */
static void step(controller *c, int count, int own_reference, double budget) {
    measure();
    const double elapsed = number(BR_TS, 0.9 * BR_TS);
    const int cell = byte() % (6 * BR_N);
    const double value = number(0, 1);
    double u[2][BR_NU] = {{-9, -9}, {-9, -9}};
    br_mpc_status status[2];
    br_mpc_info info[2];
    br_mpc_error error = BR_OK;
    for (int i = 0; i < count; ++i) {
        if (own_reference) {
            br_mpc_reference reference[BR_N];
            CHECK(br_mpc_get_reference(c[i].mpc, reference) == BR_OK);
            (&reference[0].x)[cell] += value;
            error = br_mpc_solve(c[i].mpc, x, before, elapsed, budget, reference, u[i], &status[i],
                                 &info[i]);
        } else {
            error = br_mpc_step(c[i].mpc, x, before, &around, elapsed, budget, u[i], &status[i],
                                &info[i]);
        }
        CHECK(error == BR_OK || error == BR_ERROR_NOT_READY || error == BR_ERROR_TIME ||
              error == BR_ERROR_PARAMETERS); /* of the environment */
        if (!error) check_answer(u[i], status[i], &info[i]);
    }
    if (error) return;
    if (count == 2) {
        CHECK(status[0] == status[1] && memcmp(u[0], u[1], sizeof u[0]) == 0);
        CHECK(info[0].iterations == info[1].iterations && info[0].shifts == info[1].shifts);
        CHECK(info[0].pace == info[1].pace);
        /* Where the state was refused, what a preparation has found already is reported. */
        CHECK(info[0].widening == info[1].widening || status[0] == BR_BAD_STATE);
    }
    if (status[0] > BR_ACCEPTABLE || br_mpc_predict(c[0].mpc, x, u[0], BR_TS, x) != BR_OK) {
        const double start[BR_NX] = {RADIUS_M, 0, 1.5707963267948966, 1.5, 0, 0, 0};
        memcpy(x, start, sizeof x);
    }
}

static void prepare(controller *c, double budget) {
    double plan_x[2][(BR_N + 1) * BR_NX], plan_u[2][BR_N * BR_NU];
    CHECK(br_mpc_get_plan(c->mpc, plan_x[0], plan_u[0]) == BR_OK);
    const br_mpc_error error = br_mpc_prepare(c->mpc, number(BR_TS, 1.5 * BR_TS), budget);
    CHECK(error == BR_OK || error == BR_ERROR_NOT_READY || error == BR_ERROR_TIME);
    CHECK(br_mpc_get_plan(c->mpc, plan_x[1], plan_u[1]) == BR_OK);
    CHECK(memcmp(plan_x[0], plan_x[1], sizeof plan_x[0]) == 0);
    CHECK(memcmp(plan_u[0], plan_u[1], sizeof plan_u[0]) == 0);
}

/* From the state at hand, mostly to one that the car may have come to. */
static void observe(controller *c, int count) {
    double after[BR_NX], u[BR_NU];
    for (int i = 0; i < BR_NX; ++i) after[i] = number(x[i], 0.5);
    u[0] = number(0.3, 1), u[1] = number(0, 6);
    const double duration = number(BR_TS, 2 * BR_TS);
    for (int i = 0; i < count; ++i) {
        const br_mpc_error error = br_mpc_observe(c[i].mpc, x, u, duration, after, NULL);
        CHECK(error == BR_OK || error == BR_ERROR_TIME || error == BR_ERROR_STATE);
    }
}

static void predict(const controller *c) {
    double from[BR_NX], after[BR_NX], u[BR_NU];
    for (int i = 0; i < BR_NX; ++i) from[i] = number(x[i], 0.5);
    const int at_limit = byte() % (2 * BR_NX); /* from where a prediction may go beyond it */
    if (at_limit < BR_NX) from[at_limit] = BR_STATE_LIMIT[at_limit];
    u[0] = number(0.3, 1), u[1] = number(0, 6);
    const br_mpc_error error = br_mpc_predict(c->mpc, from, u, number(0.03, 0.07), after);
    CHECK(error == BR_OK || error == BR_ERROR_NOT_READY || error == BR_ERROR_TIME ||
          error == BR_ERROR_STATE);
    if (error) return;
    for (int i = 0; i < BR_NX; ++i) CHECK(fabs(after[i]) <= BR_STATE_LIMIT[i]);
}

static void evaluate(const controller *c) {
    double v[BR_NV], lambda[BR_NX], f[BR_NX], jacobian[BR_NX * BR_NV], hessian[BR_NV * BR_NV];
    for (int i = 0; i < BR_NV; ++i) v[i] = number(i < BR_NX ? x[i] : 0.1, 1);
    for (int i = 0; i < BR_NX; ++i) lambda[i] = number(0, 1);
    CHECK(br_mpc_evaluate(c->mpc, v, lambda, f, jacobian, hessian) == BR_OK);
}

/* --- one input --- */

static void call(controller *c, int count) {
    const int limited = count == 1; /* budgets only without the second controller */
    const uint8_t what = byte();
    switch (what % 16) {
    case 0:
        set_parameters(c, count);
        break;
    case 1:
        set_path(c, count);
        break;
    case 2:
        set_weights(c, count);
        break;
    case 3:
        if (what < 0x40)
            for (int i = 0; i < count; ++i) br_mpc_reset(c[i].mpc);
        else
            set_instructions(c, count);
        break;
    case 4:
        if (what & 0x40)
            set_speed_limit();
        else
            c->tick = number(1e-4, 1e-4);
        break;
    case 5:
        CHECK(br_mpc_set_clock(c->mpc, what & 0x40 ? ticking : NULL, c) == BR_OK);
        break;
    case 6:
        predict(c);
        break;
    case 7:
        observe(c, count);
        break;
    case 8:
        evaluate(c);
        break;
    case 9:
    case 10:
    case 11:
        prepare(c, limited ? number(3e-3, 3e-3) : 0);
        break;
    case 12:
        step(c, count, 1, limited ? number(0, 3e-3) : 0);
        break;
    default:
        step(c, count, 0, limited ? number(3e-3, 3e-3) : 0);
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size) {
    static char *block[2];
    at = data, end = data + size;
    const size_t memory = br_mpc_memory_size();
    controller c[2];
    for (int i = 0; i < 2; ++i) {
        if (!block[i]) block[i] = aligned_alloc(64, (memory + 63) / 64 * 64);
        c[i] = (controller){.tick = 1e-4};
        CHECK(block[i] && br_mpc_init(block[i], memory, &c[i].mpc) == BR_OK);
    }
    if (table[0][0] == 0) make_path();
    const uint8_t first = byte();
    const int count = 1 + first % 2;
    parameters = usual;
    const double start[BR_NX] = {RADIUS_M, 0, 1.5707963267948966, 1.5, 0, 0, 0};
    memcpy(x, start, sizeof x);
    around = (br_environment){INFINITY, 0};
    if (first < 0xf0) /* else the calls must do with what they find */
        for (int i = 0; i < count; ++i) {
            CHECK(br_mpc_set_parameters(c[i].mpc, &usual) == BR_OK);
            CHECK(br_mpc_set_path(c[i].mpc, table[0], ROWS,
                                  2 * 3.14159265358979323846 * RADIUS_M / ROWS) == BR_OK);
            CHECK(br_mpc_set_clock(c[i].mpc, ticking, &c[i]) == BR_OK);
        }
    for (int calls = 0; calls < 24 && at < end; ++calls) call(c, count);
    return 0;
}
