/* The car as an FMU: generated equations, and around them what the plant process does per period.
 *
 * Co-Simulation: the guard of plant/simulator.py (clip, steer within limits, brake on what is not
 * finite), then equal sub-steps of at most 1 ms. Model Exchange: the equations as they are.
 */
#include <math.h>
#include <string.h>

#include "car_model.h" /* generated: car_substep, or car_rates and car_forward */
#include "fmu.h"

#define NX 7
#define SLOWEST 1e-6 /* squared speed by which is divided */

/* Calls a generated function, which cannot fail, on its arguments and its one result. */
#define EVALUATE(function, result, ...)                                    \
    do {                                                                   \
        const double *arg[function##_SZ_ARG] = {__VA_ARGS__};              \
        double *res[function##_SZ_RES] = {result}, w[function##_SZ_W + 1]; \
        int iw[function##_SZ_IW + 1];                                      \
        function(arg, res, iw, w, 0);                                      \
    } while (0)

size_t fmu_model_size(void) { return 0; }

bool fmu_model_create(fmu_instance *car) { return true; }

#if !FMU_STATES

bool fmu_model_initialise(fmu_instance *car) {
    double *v = car->value;
    if (fabs(v[FMU_V_delta]) > v[FMU_V_delta_max_rad])
        return fmu_refuse(car, "the start value of delta, %g rad, is beyond delta_max_rad = %g rad",
                          v[FMU_V_delta], v[FMU_V_delta_max_rad]);
    v[FMU_V_d_applied] = v[FMU_V_delta_rate_applied] = 0;
    return true;
}

/* The first of two equal values, as in Python: only then signed zeros agree, too. */
static double least(double a, double b) { return b < a ? b : a; }

static double most(double a, double b) { return b > a ? b : a; }

static double clipped(double value, double low, double high) {
    return least(most(value, low), high);
}

/* The drive commands that act at a speed: AccelerationDrive and DcMotor in
 * bayesrace/vehicles/parts.py. */
#ifdef ACCELERATION_DRIVE
static double highest(const double *v) {
    const double power = v[FMU_V_power_speed_mps], top = v[FMU_V_speed_max_mps];
    const double vx = v[FMU_V_vx], vy = v[FMU_V_vy], speed = sqrt(vx * vx + vy * vy);
    const double fade = (top - speed) / (0.05 * top);
    return v[FMU_V_d_max] * (power / most(speed, power) * clipped(fade, 0.0, 1.0));
}

static double lowest(const double *v, double duration) {
    return most(v[FMU_V_d_min], -most(v[FMU_V_vx], 0.0) / duration);
}
#else
static double highest(const double *v) { return v[FMU_V_d_max]; }

static double lowest(const double *v, double duration) { return v[FMU_V_d_min]; }
#endif

static void guard(const double *v, double duration, double u[2]) {
    const double angle = v[FMU_V_delta_max_rad], fastest = v[FMU_V_delta_rate_max_radps];
    double rate = v[FMU_V_delta_rate];
    if (!(isfinite(v[FMU_V_d]) && isfinite(rate))) { /* brake, less when slow; hold the steering */
        const double vx = v[FMU_V_vx], held = BRAKE_D + BRAKE_SLOW / most(vx * vx, SLOWEST);
        const double brake = most(v[FMU_V_d_min], -held) * clipped(vx / BRAKE_FADE_MPS, 0.0, 1.0);
        u[0] = most(brake, lowest(v, duration));
        u[1] = 0.0;
        return;
    }
    rate = clipped(rate, (-angle - v[FMU_V_delta]) / duration, (angle - v[FMU_V_delta]) / duration);
    u[0] = clipped(v[FMU_V_d], lowest(v, duration), highest(v));
    u[1] = clipped(rate, -fastest, fastest);
}

fmu_status fmu_model_step(fmu_instance *car, double h) {
    double *v = car->value, x[NX], next[NX], u[2];
    memcpy(x, &v[FMU_V_x], sizeof x);
    guard(v, h, u);
    const int substeps = (int)most(ceil(h * SUBSTEP_HZ - 1e-6), 1.0);
    const double substep = h / substeps;
    for (int i = 0; i < substeps; i++) {
        EVALUATE(car_substep, next, x, u, &v[FMU_V_lf_m], &substep);
        memcpy(x, next, sizeof x);
    }
    const double angle = v[FMU_V_delta_max_rad];
    x[6] = clipped(v[FMU_V_delta] + h * u[1], -angle, angle); /* without rounding of steps */
    for (int i = 0; i < NX; i++)
        if (!isfinite(x[i]))
            return FMU_ERROR(
                car, "the state after the step from %.9g s is not finite; the step is undone",
                v[FMU_V_time]);
    memcpy(&v[FMU_V_x], x, sizeof x);
    v[FMU_V_d_applied] = u[0];
    v[FMU_V_delta_rate_applied] = u[1];
    return FMU_OK;
}

#else

/* The equations take states, inputs and parameters as one vector, as the values begin. */
#define KNOWN FMU_V_der_x

bool fmu_model_initialise(fmu_instance *car) { return true; }

void fmu_model_derivatives(const fmu_instance *car, double *dx) {
    EVALUATE(car_rates, dx, car->value);
}

void fmu_model_directional(const fmu_instance *car, const double *in, double *out) {
    memcpy(out, in, FMU_VALUES * sizeof *out); /* a state depends on itself alone */
    EVALUATE(car_forward, &out[KNOWN], car->value, in);
}

#endif
