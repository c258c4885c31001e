/* The controller as an FMU: what controller/driver.py does with a state, around the native step.
 *
 * A step of the FMU from t to t + h makes a control step at t, with the inputs that were set before
 * it, if one is due; its outputs are meant for the plant's step from t to t + h. An importer that
 * steps plant and controller side by side gives them to the plant one step later: parameter
 * "delay" is then h, and the state is predicted over it.
 */
#include <math.h>
#include <stdint.h>
#include <string.h>

#include "bayesrace_mpc.h"
#include "controller_fallback.h"
#include "controller_resources.h"
#include "fmu_model.h"

#define HISTORY 256 /* inputs under way: the longest delay at 500 Hz */

typedef struct {
    double basis_s, u[BR_NU];
} sent_input;

/* Followed, at a multiple of 64 bytes, by the br_mpc. No pointers, so that a copy is a state. */
typedef struct {
    fallback fallback;
    fallback_settings settings;
    double next_s;    /* release of the next control step */
    double stepped_s; /* moment for which the last one was made */
    int has_stepped;
    int first, count; /* of the inputs sent */
    sent_input sent[HISTORY];
} controller;

#define OFFSET ((sizeof(controller) + 63) / 64 * 64)

static br_mpc *native(const fmu_instance *instance) {
    return (br_mpc *)((char *)instance->model + OFFSET);
}

size_t fmu_model_size(void) { return OFFSET + br_mpc_memory_size(); }

int fmu_model_create(fmu_instance *instance, const char *resources) {
    br_mpc *mpc;
    char text[256];
    const br_mpc_error error =
        br_mpc_init((char *)instance->model + OFFSET, br_mpc_memory_size(), &mpc);
    if (error) {
        fmu_log(instance, "controller: %s", br_mpc_error_text(error));
        return -1;
    }
    if (!resources) {
        fmu_log(instance, "controller: the importer names no resources folder: the racing line and "
                          "the weights are in there");
        return -1;
    }
    if (resources_load(mpc, resources, CONTROLLER_IDENTITY, text, sizeof text)) {
        fmu_log(instance, "controller: %s", text);
        return -1;
    }
    return 0;
}

/* Parameters as they are now; any of them may be set between two steps. */
static int take_parameters(fmu_instance *instance) {
    const double *v = instance->value;
    controller *c = instance->model;
    const br_mpc_parameters parameters = {
        .q_position = v[FMU_V_q_position],
        .r_duty = v[FMU_V_r_duty],
        .r_delta_rate = v[FMU_V_r_delta_rate],
        .s_slack = v[FMU_V_s_slack],
        .margin_m = v[FMU_V_margin_m],
        .d_min = v[FMU_V_d_min],
        .d_max = v[FMU_V_d_max],
        .delta_max_rad = v[FMU_V_delta_max_rad],
        .delta_rate_max_radps = v[FMU_V_delta_rate_max_radps],
        .tolerance = v[FMU_V_tolerance],
        .defect_max = v[FMU_V_defect_max],
        .settle = v[FMU_V_settle],
        .iterations = (int)v[FMU_V_iterations],
        .iterations_cold = (int)v[FMU_V_iterations_cold],
    };
    const br_mpc_error error = br_mpc_set_parameters(native(instance), &parameters);
    if (error) { /* the ones before stay */
        fmu_log(instance,
                "controller: %s (q_position to iterations_cold; d_min must be below d_max)",
                br_mpc_error_text(error));
        return -1;
    }
    c->settings = (fallback_settings){
        .d_min = parameters.d_min,
        .d_max = parameters.d_max,
        .delta_rate_max_radps = parameters.delta_rate_max_radps,
        .shifted_s = v[FMU_V_shifted_s],
        .tolerance = v[FMU_V_limit_tolerance],
        .brake_fade_mps = v[FMU_V_brake_fade_mps],
        .recover_cycles = (int)v[FMU_V_recover_cycles],
    };
    return 0;
}

int fmu_model_initialise(fmu_instance *instance) {
    controller *c = instance->model;
    double *v = instance->value;
    memset(c, 0, sizeof *c);
    br_mpc_reset(native(instance));
    if (take_parameters(instance)) return -1;
    c->next_s = instance->time;
    v[FMU_V_d] = v[FMU_V_delta_rate] = 0;
    v[FMU_V_status] = STATUS_NO_STEP;
    v[FMU_V_usable] = 0;
    v[FMU_V_fallback_level] = LEVEL_STOP;
    v[FMU_V_iterations_used] = 0;
    v[FMU_V_stationarity] = v[FMU_V_defect] = v[FMU_V_slack_max_m] = -1;
    v[FMU_V_s_ref_m] = v[FMU_V_lateral_m] = 0;
    return 0;
}

/* Once per period, on a grid that does not drift. */
static int due(controller *c, double time_s, double period_s) {
    const double early = 1e-6 * period_s;
    if (time_s < c->next_s - early) return 0;
    if (period_s > 0)
        c->next_s += period_s * (floor((time_s + early - c->next_s) / period_s) + 1);
    return 1;
}

static sent_input *sent(controller *c, int i) { return &c->sent[(c->first + i) % HISTORY]; }

static void remember(controller *c, double basis_s, double d, double delta_rate) {
    if (c->count == HISTORY) {
        c->first = (c->first + 1) % HISTORY;
        c->count -= 1;
    }
    *sent(c, c->count++) = (sent_input){basis_s, {d, delta_rate}};
}

/* x when the input made now begins to act, and the duty cycle that acts just before it; as
 * controller/compensation.py. 0, or -1 if the model cannot follow. */
static int at_acting(fmu_instance *instance, double x[BR_NX], double *d) {
    controller *c = instance->model;
    const double *v = instance->value, delay_s = v[FMU_V_delay];
    const int connected = v[FMU_V_d_applied_connected] != 0;
    double u[BR_NU] = {connected ? v[FMU_V_d_applied] : 0, 0};
    double now_s = instance->time;
    const double end_s = now_s + delay_s;
    memcpy(x, &v[FMU_V_x], BR_NX * sizeof *x);
    *d = u[0];
    if (connected && delay_s == 0) return 0;
    while (c->count > 1 && sent(c, 1)->basis_s + delay_s <= now_s) { /* has stopped acting */
        c->first = (c->first + 1) % HISTORY;
        c->count -= 1;
    }
    for (int i = 0; i < c->count; ++i) {
        const double from_s = sent(c, i)->basis_s + delay_s;
        if (from_s >= end_s) break;
        if (from_s > now_s) {
            if (br_mpc_predict(native(instance), x, u, from_s - now_s, x)) return -1;
            now_s = from_s;
        }
        memcpy(u, sent(c, i)->u, sizeof u);
    }
    *d = u[0];
    return end_s > now_s && br_mpc_predict(native(instance), x, u, end_s - now_s, x) ? -1 : 0;
}

/* The native step; its status, or why there was none. */
static int solve(fmu_instance *instance, double u[BR_NU], br_mpc_info *info) {
    controller *c = instance->model;
    const double *v = instance->value;
    double limit = v[FMU_V_speed_limit], x[BR_NX], d;
    if (limit >= NO_SPEED_LIMIT) limit = INFINITY;
    if (br_mpc_set_speed_limit(native(instance), limit, v[FMU_V_speed_limit_rate]))
        return STATUS_REFUSED;
    if (at_acting(instance, x, &d)) return STATUS_UNPREDICTABLE;
    const double time_s = instance->time + v[FMU_V_delay];
    const double elapsed_s = c->has_stepped ? fmax(time_s - c->stepped_s, 0) : 0;
    c->stepped_s = time_s;
    c->has_stepped = 1;
    br_mpc_status status;
    const double before[BR_NU] = {[BR_INDEX_DUTY] = d};
    if (br_mpc_step(native(instance), x, before, elapsed_s, 0, u, &status, info)) return STATUS_REFUSED;
    return (int)status;
}

static double known(double value) { return isfinite(value) ? value : -1; }

static void tell(fmu_instance *instance, int status, const br_mpc_info *info) {
    double *v = instance->value;
    v[FMU_V_status] = status;
    v[FMU_V_usable] = status <= BR_ACCEPTABLE;
    v[FMU_V_iterations_used] = info->iterations;
    v[FMU_V_stationarity] = known(info->stationarity);
    v[FMU_V_defect] = known(info->defect);
    v[FMU_V_slack_max_m] = known(info->slack_max_m);
    if (status == BR_BAD_STATE || status >= STATUS_UNPREDICTABLE) return; /* projected nothing */
    v[FMU_V_s_ref_m] = info->s_ref_m;
    v[FMU_V_lateral_m] = info->lateral_m;
}

int fmu_model_step(fmu_instance *instance, double h) {
    (void)h;
    controller *c = instance->model;
    double *v = instance->value, u[BR_NU] = {0, 0};
    if (!due(c, instance->time, v[FMU_V_period])) return 0;
    static const br_mpc_info nothing;
    br_mpc_info info = nothing;
    double plan_x[BR_N + 1][BR_NX], plan_u[BR_N][BR_NU];
    const int failed = take_parameters(instance); /* the outputs are safe even then */
    const int status = failed ? STATUS_REFUSED : solve(instance, u, &info);
    const int usable = status <= BR_ACCEPTABLE;
    if (usable) br_mpc_get_plan(native(instance), &plan_x[0][0], &plan_u[0][0]);
    v[FMU_V_fallback_level] =
        fallback_decide(&c->fallback, &c->settings, usable ? (const double(*)[BR_NU])plan_u : NULL,
                        v[FMU_V_vx], instance->time + v[FMU_V_delay], u);
    v[FMU_V_d] = u[0];
    v[FMU_V_delta_rate] = u[1];
    remember(c, instance->time, u[0], u[1]);
    tell(instance, status, &info);
    return failed;
}
