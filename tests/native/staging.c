/* One thread controls, another stages weights, as fast as they can; meant for -fsanitize=thread.
 *
 * Set number g corrects every output by g (1 + n / 1000) wherever its points lie. So what the
 * control thread predicts with show which set is in use: the same in all outputs, the same until
 * it adopts again, and never an older one. Code 1: a promise of the interface is broken.
 */
#include <math.h>
#include <pthread.h>
#include <sched.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>

#include "bayesrace_mpc.h"
#include "check.h"

enum { POINTS = 64, ROUNDS = 400, ROWS = 400 };

static br_mpc *mpc;
static atomic_int finished;
static const double SCALES[BR_NZ] = {1, 1, 1, 1, 1, 1};
static double table[ROWS][BR_PATH_COLUMNS];

/* The uncorrected successor of this state has zero velocities and forces: standstill. */
static const double V[BR_NV] = {0};

typedef struct {
    double inputs[POINTS][BR_NZ], alpha[POINTS];
    br_mpc_gp outputs[BR_NE];
} set;

/* The first with a variance: what that takes to stage is long under a sanitizer. */
static void fill(set *s, int number) {
    const double signal = number == 1;
    for (int i = 0; i < POINTS; ++i) {
        for (int a = 0; a < BR_NZ; ++a) s->inputs[i][a] = 0;
        s->alpha[i] = 1e-3 * number;
    }
    for (int j = 0; j < BR_NE; ++j)
        s->outputs[j] = (br_mpc_gp){BR_KERNEL_RBF, POINTS, number,           1,       signal,
                                    0.1,           SCALES, &s->inputs[0][0], s->alpha};
}

/* Number of the set in use. */
static int in_use(const double nominal[BR_NX]) {
    double lambda[BR_NX] = {0}, x[BR_NX], jacobian[BR_NX * BR_NV], hessian[BR_NV * BR_NV];
    CHECK(br_mpc_evaluate(mpc, V, lambda, x, jacobian, hessian) == BR_OK);
    const double size = 1 + 1e-3 * POINTS;
    const int number = (int)lround((x[3] - nominal[3]) / size);
    for (int i = 3; i < 6; ++i)
        CHECK(fabs(x[i] - nominal[i] - number * size) < 1e-6 * (1 + number));
    return number;
}

static void *stage(void *unused) {
    (void)unused;
    static set s;
    for (int number = 1; !atomic_load(&finished); ++number) {
        fill(&s, number);
        const br_mpc_error error = br_mpc_stage_weights(mpc, s.outputs);
        CHECK(error == BR_OK || error == BR_ERROR_BUSY);
        s.alpha[POINTS - 1] = NAN; /* copied, or not to be had */
        CHECK(error != BR_OK || number % 7 || br_mpc_stage_weights(mpc, s.outputs) != BR_OK);
        sched_yield();
    }
    return NULL;
}

static void make_circle(void) {
    for (int i = 0; i < ROWS; ++i) {
        const double angle = 6.283185307179586 * i / ROWS, c = cos(angle), s = sin(angle);
        const double row[BR_PATH_COLUMNS] = {c, s, 1.0, -c, -s, -1.3, -0.7};
        for (int k = 0; k < BR_PATH_COLUMNS; ++k) table[i][k] = row[k];
    }
}

static int control(const double nominal[BR_NX]) {
    int number = 0, taken = 0;
    double x[BR_NX] = {1, 0, 1.5707963, 1, 0, 0, 0}, u[BR_NU] = {0};
    br_mpc_status status;
    for (int round = 0; round < ROUNDS; ++round) {
        const br_mpc_error error = br_mpc_adopt_weights(mpc);
        CHECK(error == BR_OK || error == BR_ERROR_NOT_STAGED);
        const int now = in_use(nominal);
        CHECK(error == BR_OK ? now > number : now == number);
        taken += error == BR_OK;
        number = now;
        const br_mpc_error predicted = br_mpc_predict(mpc, x, u, BR_TS, x);
        CHECK(predicted == BR_OK || predicted == BR_ERROR_STATE);
        x[0] = 1, x[1] = 0, x[2] = 1.5707963, x[3] = 1, x[4] = x[5] = x[6] = 0;
        CHECK(br_mpc_step(mpc, x, (double[BR_NU]){0}, NULL, BR_TS, 0, u, &status, NULL) == BR_OK);
        CHECK(br_mpc_prepare(mpc, BR_TS, 0) == BR_OK);
        CHECK(in_use(nominal) == number);
        if (taken < 5) round = 0; /* the other thread has not come far yet */
    }
    return taken;
}

int main(void) {
    void *memory = aligned_alloc(64, (br_mpc_memory_size() + 63) / 64 * 64);
    CHECK(memory && br_mpc_init(memory, br_mpc_memory_size(), &mpc) == BR_OK);
    const br_mpc_parameters parameters = {1, .002, 3e-5, 100,  .01, -.1, 1,  .35,
                                          5, 1e-6, .1,   1e-4, 1.6, 3,   30, 4000};
    CHECK(br_mpc_set_parameters(mpc, &parameters) == BR_OK);
    make_circle();
    CHECK(br_mpc_set_path(mpc, &table[0][0], ROWS, 6.283185307179586 / ROWS) == BR_OK);
    CHECK(br_mpc_adopt_weights(mpc) == BR_ERROR_NOT_STAGED);
    CHECK(br_mpc_adopt_weights(NULL) == BR_ERROR_NULL);
    CHECK(br_mpc_stage_weights(mpc, NULL) == BR_ERROR_NULL);

    double lambda[BR_NX] = {0}, nominal[BR_NX], j[BR_NX * BR_NV], h[BR_NV * BR_NV];
    CHECK(br_mpc_evaluate(mpc, V, lambda, nominal, j, h) == BR_OK);
    pthread_t other;
    CHECK(pthread_create(&other, NULL, stage, NULL) == 0);
    const int taken = control(nominal);
    atomic_store(&finished, 1);
    pthread_join(other, NULL);

    static set s; /* set beside staging: what was staged is forgotten */
    fill(&s, 1000000);
    CHECK(br_mpc_stage_weights(mpc, s.outputs) == BR_OK);
    fill(&s, 3);
    CHECK(br_mpc_set_weights(mpc, s.outputs) == BR_OK);
    CHECK(in_use(nominal) == 3);
    CHECK(br_mpc_adopt_weights(mpc) == BR_ERROR_NOT_STAGED);
    printf("%d taken over\n", taken);
    free(memory);
    return 0;
}
