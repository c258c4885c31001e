/* The car as an FMU: generated equations, and around them what the plant process does per period.
 *
 * Co-Simulation: the guard of plant/simulator.py (clip, steer within limits, brake on what is not
 * finite), then equal sub-steps of at most 1 ms. Model Exchange: the equations as they are.
 */
#include <math.h>

#include "car_model.h" /* generated: car_substep or car_rates, car_forward, car_reverse */
#include "fmu_model.h"

#define NX 7
#define NU 2
#define FIRST_STATE FMU_V_x
#define FIRST_INPUT FMU_V_d
#define FIRST_PARAMETER FMU_V_lf_m
#define NP (FMU_V_cr2 - FMU_V_lf_m + 1)

_Static_assert(FMU_V_delta == FIRST_STATE + NX - 1 && FMU_V_delta_rate == FIRST_INPUT + NU - 1,
               "states, inputs and parameters lie together");

size_t fmu_model_size(void) { return 0; }

int fmu_model_create(fmu_instance *car, const char *resources) {
    (void)car, (void)resources;
    return 0;
}

#if FMU_CS

#define DELTA FMU_V_delta
#define D_APPLIED FMU_V_d_applied
#define RATE_APPLIED FMU_V_delta_rate_applied

int fmu_model_initialise(fmu_instance *car) {
    double *v = car->value;
    if (fabs(v[DELTA]) > v[FMU_V_delta_max_rad]) {
        fmu_log(car, "the start value of delta, %g rad, is beyond delta_max_rad = %g rad", v[DELTA],
                v[FMU_V_delta_max_rad]);
        return -1;
    }
    v[D_APPLIED] = v[RATE_APPLIED] = 0;
    return 0;
}

/* the first of two equal values, as in Python: only then do signed zeros agree, too */
static double least(double a, double b) { return b < a ? b : a; }

static double most(double a, double b) { return b > a ? b : a; }

static void guard(const double *v, double duration, double u[NU]) {
    double d = v[FMU_V_d], rate = v[FMU_V_delta_rate];
    if (!(isfinite(d) && isfinite(rate))) { /* brake, less and less when slow; hold the steering */
        u[0] = v[FMU_V_d_min] * least(most(v[FMU_V_vx] / BRAKE_FADE_MPS, 0.0), 1.0);
        u[1] = 0.0;
        return;
    }
    double angle = v[FMU_V_delta_max_rad], fastest = v[FMU_V_delta_rate_max_radps];
    double lowest = (-angle - v[DELTA]) / duration, highest = (angle - v[DELTA]) / duration;
    rate = least(most(rate, lowest), highest);
    u[0] = least(most(d, v[FMU_V_d_min]), v[FMU_V_d_max]);
    u[1] = least(most(rate, -fastest), fastest);
}

static void substep(double x[NX], const double u[NU], const double p[NP], double h) {
    double next[NX];
    const double *arg[car_substep_SZ_ARG] = {x, u, p, &h};
    double *res[car_substep_SZ_RES] = {next};
    int iw[car_substep_SZ_IW + 1];
    double w[car_substep_SZ_W + 1];
    car_substep(arg, res, iw, w, 0);
    for (int i = 0; i < NX; i++) x[i] = next[i];
}

int fmu_model_step(fmu_instance *car, double h) {
    double *v = car->value, x[NX], u[NU];
    for (int i = 0; i < NX; i++) x[i] = v[FIRST_STATE + i];
    guard(v, h, u);
    double substeps = most(ceil(h * SUBSTEP_HZ - 1e-6), 1.0);
    for (int i = 0; i < (int)substeps; i++) substep(x, u, &v[FIRST_PARAMETER], h / substeps);
    /* free of the integrator's rounding */
    double angle = v[FMU_V_delta_max_rad];
    x[6] = least(most(v[DELTA] + h * u[1], -angle), angle);
    for (int i = 0; i < NX; i++)
        if (!isfinite(x[i])) {
            fmu_log(car, "the state is not finite after the step from %.9g s; the step is undone",
                    car->time);
            return -1;
        }
    for (int i = 0; i < NX; i++) v[FIRST_STATE + i] = x[i];
    v[D_APPLIED] = u[0];
    v[RATE_APPLIED] = u[1];
    return 0;
}

#else

int fmu_model_initialise(fmu_instance *car) {
    (void)car;
    return 0;
}

int fmu_model_derivatives(const fmu_instance *car, double *dx) {
    const double *v = car->value;
    const double *arg[car_rates_SZ_ARG] = {&v[FIRST_STATE], &v[FIRST_INPUT], &v[FIRST_PARAMETER]};
    double *res[car_rates_SZ_RES] = {dx};
    int iw[car_rates_SZ_IW + 1];
    double w[car_rates_SZ_W + 1];
    return car_rates(arg, res, iw, w, 0) ? -1 : 0;
}

/* s: seeds or sensitivities of all values, and last of time, which is in none of the equations.
 * The derivative of state i is variable FMU_V_der_x + i. */
#define IS_DERIVATIVE(reference) ((reference) - FMU_V_der_x < (uint32_t)NX)

int fmu_model_directional(const fmu_instance *car, const uint32_t *known, size_t n_known,
                          const double *seed, const uint32_t *unknown, size_t n_unknown,
                          double *out) {
    const double *v = car->value;
    double s[FMU_VALUES + 1] = {0}, rates[NX];
    for (size_t i = 0; i < n_known; i++) s[known[i]] += seed[i];
    const double *arg[car_forward_SZ_ARG] = {&v[FIRST_STATE], &v[FIRST_INPUT], &v[FIRST_PARAMETER],
                                             &s[FIRST_STATE], &s[FIRST_INPUT], &s[FIRST_PARAMETER]};
    double *res[car_forward_SZ_RES] = {rates};
    int iw[car_forward_SZ_IW + 1];
    double w[car_forward_SZ_W + 1];
    if (car_forward(arg, res, iw, w, 0)) return -1;
    for (size_t i = 0; i < n_unknown; i++)
        out[i] = IS_DERIVATIVE(unknown[i]) ? rates[unknown[i] - FMU_V_der_x] : s[unknown[i]];
    return 0;
}

int fmu_model_adjoint(const fmu_instance *car, const uint32_t *unknown, size_t n_unknown,
                      const double *seed, const uint32_t *known, size_t n_known, double *out) {
    const double *v = car->value;
    double s[FMU_VALUES + 1] = {0}, rates[NX] = {0}, part[NX + NU + NP];
    for (size_t i = 0; i < n_unknown; i++) {
        if (IS_DERIVATIVE(unknown[i]))
            rates[unknown[i] - FMU_V_der_x] += seed[i];
        else
            s[unknown[i]] += seed[i]; /* a state depends on itself alone */
    }
    const double *arg[car_reverse_SZ_ARG] = {&v[FIRST_STATE], &v[FIRST_INPUT], &v[FIRST_PARAMETER],
                                             rates};
    double *res[car_reverse_SZ_RES] = {part, part + NX, part + NX + NU};
    int iw[car_reverse_SZ_IW + 1];
    double w[car_reverse_SZ_W + 1];
    if (car_reverse(arg, res, iw, w, 0)) return -1;
    for (int i = 0; i < NX; i++) s[FIRST_STATE + i] += part[i];
    for (int i = 0; i < NU; i++) s[FIRST_INPUT + i] += part[NX + i];
    for (int i = 0; i < NP; i++) s[FIRST_PARAMETER + i] += part[NX + NU + i];
    for (size_t i = 0; i < n_known; i++) out[i] = s[known[i]];
    return 0;
}

#endif
