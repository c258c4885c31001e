/* The controller as an FMU: the control cycle around the native step, as a process has it.
 *
 * A step of the FMU from t to t + h makes a control step at t, with the inputs that were set before
 * it, if one is due; its outputs are meant for the plant's step from t to t + h. An importer that
 * steps plant and controller side by side gives them to the plant one step later: parameter
 * "delay" is then h, and the state is predicted over it.
 */
#include <math.h>
#include <stdint.h>
#include <string.h>

#include "bayesrace_cycle.h"
#include "br_files.h"
#include "controller_tables.h" /* generated: PLANNED, and those of instruments */
#include "fmu.h"

#define ALIGNED(size) (((size) + 63) / 64 * 64)

/* Followed, at multiples of 64 bytes, by the br_mpc and the br_cycle. */
typedef struct {
    br_mpc *mpc;
    br_cycle *cycle;
    double next_s; /* release of the next control step */
    int64_t cycles;
    double used[FMU_VALUES];       /* by value reference: the parameters in use */
    double read_s[BR_INSTRUMENTS]; /* times of the newest readings */
    int readings;                  /* since the control step before: */
    br_measurement reading[BR_MEASUREMENTS];
} controller;

size_t fmu_model_size(void) {
    return ALIGNED(sizeof(controller)) + ALIGNED(br_mpc_memory_size()) + br_cycle_memory_size();
}

bool fmu_model_create(fmu_instance *instance) {
    controller *c = instance->model;
    char text[256];
    const br_mpc_error error =
        br_mpc_init((char *)c + ALIGNED(sizeof *c), br_mpc_memory_size(), &c->mpc);
    if (error) return fmu_refuse(instance, "controller: %s", br_mpc_error_text(error));
    if (!instance->resources)
        return fmu_refuse(instance, "controller: the importer names no resources folder, which "
                                    "holds the racing line and the weights");
    if (br_files_load(c->mpc, instance->resources, BR_MODEL_IDENTITY, NULL, text, sizeof text))
        return fmu_refuse(instance, "controller: %s", text);
    return true;
}

/* Gives the parameters to the step and to the cycle. */
static br_mpc_error use_parameters(controller *c, const double *v) {
#define TAKE(name) .name = v[FMU_V_##name],
#define TAKE_WHOLE(name) .name = (int)v[FMU_V_##name],
    const br_mpc_parameters parameters = {BR_PARAMETERS(TAKE) BR_SOLVER_FIELDS(TAKE, TAKE_WHOLE)};
#undef TAKE
#undef TAKE_WHOLE
    const br_driving driving = {
        .u_low = {parameters.d_min, -parameters.delta_rate_max_radps},
        .u_high = {parameters.d_max, parameters.delta_rate_max_radps},
        .brake_fade_mps = v[FMU_V_brake_fade_mps],
        .brake_d = BRAKE_D,
        .brake_slow = BRAKE_SLOW,
        .standing_mps = v[FMU_V_brake_fade_mps],
        .stop_mps2 = 1, /* an FMU has no command to stop */
        .shifted_s = v[FMU_V_shifted_s],
        .limit_tolerance = v[FMU_V_limit_tolerance],
        .recover_cycles = (int)v[FMU_V_recover_cycles],
        .compensation = BR_COMPENSATION_FIXED,
        .delay_s = v[FMU_V_delay],
        .longest_s = v[FMU_V_delay] > 0 ? v[FMU_V_delay] : 1,
        .stale_s = 0.06, /* every step has its state, but it may be in doubt */
        .sensor_tolerance = v[FMU_V_sensor_tolerance],
    };
    const br_mpc_error error = br_mpc_set_parameters(c->mpc, &parameters);
    return error ? error : br_cycle_set_driving(c->cycle, &driving);
}

#define UNUSABLE "controller: %s (q_position to qp_steps; d_min must be below d_max)"

/* Uses what has been set since the step before. Each parameter is within its bounds; those that do
 * not fit together are given up: step and FMU go on with the parameters of the step before. */
static fmu_status take_parameters(fmu_instance *instance) {
#define ROLE(name, kind, role, ...) FMU_##role,
    static const fmu_role roles[] = {FMU_VARIABLES(ROLE)};
#undef ROLE
    controller *c = instance->model;
    double *v = instance->value;
    const br_mpc_error error = use_parameters(c, v);
    if (!error) {
        memcpy(c->used, v, sizeof c->used);
        return FMU_OK;
    }
    use_parameters(c, c->used);
    for (int i = 0; i < FMU_VALUES; i++)
        if (roles[i] == FMU_TUNABLE) v[i] = c->used[i];
    return fmu_note(instance, FMU_WARNING, UNUSABLE "; the parameters before stay in use",
                    br_mpc_error_text(error));
}

bool fmu_model_initialise(fmu_instance *instance) {
    controller *c = instance->model;
    double *v = instance->value;
    char *memory = (char *)c->mpc + ALIGNED(br_mpc_memory_size());
    const br_estimation estimation = {ESTIMATION};
    br_cycle_drive_mpc(memory, br_cycle_memory_size(), c->mpc, 0, &c->cycle);
    br_cycle_set_estimation(c->cycle, NULL, &estimation);
    br_mpc_reset(c->mpc);
    const br_mpc_error error = use_parameters(c, v);
    if (error) return fmu_refuse(instance, UNUSABLE, br_mpc_error_text(error));
    if (INSTRUMENTS && v[FMU_V_delay] > 0 && !v[FMU_V_d_applied_connected])
        return fmu_refuse(instance, "controller: with instruments and a delay, connect d_applied "
                                    "and delta_rate_applied, and set d_applied_connected");
    memcpy(c->used, v, sizeof c->used);
    c->next_s = v[FMU_V_time];
    c->cycles = c->readings = 0;
    for (int i = 0; i < BR_INSTRUMENTS; ++i) c->read_s[i] = NOT_READ;
    memset(&v[FMU_V_d], 0, (FMU_V_time - FMU_V_d) * sizeof *v); /* the outputs */
    v[FMU_V_status] = BR_HALTED;
    v[FMU_V_fallback_level] = BR_STOP;
    v[FMU_V_stationarity] = v[FMU_V_defect] = v[FMU_V_slack_max_m] = -1;
    return true;
}

/* Whether a control step is due: once per period, on a grid that does not drift. */
static bool due(controller *c, double time_s, double period_s) {
    const double early = 1e-6 * period_s;
    if (time_s < c->next_s - early) return false;
    if (period_s > 0) c->next_s += period_s * (floor((time_s + early - c->next_s) / period_s) + 1);
    return true;
}

#if INSTRUMENTS
/* Keeps what is new of the readings until the next control step; the newest if they are too many.
 */
static void collect(controller *c, const double *v) {
    static const struct {
        int instrument, value, of;
        double deviation, relative;
    } channels[] = {CHANNELS};
    static const int times[] = {TIMES};
    for (int i = 0; i < INSTRUMENTS; ++i) {
        br_measurement m = {.time_s = v[times[i]], .instrument = i};
        if (m.time_s == c->read_s[i]) continue;
        c->read_s[i] = m.time_s;
        for (size_t k = 0; k < sizeof channels / sizeof *channels; ++k) {
            if (channels[k].instrument != i) continue;
            const double value = m.value[m.count] = v[channels[k].value];
            m.of[m.count] = channels[k].of;
            m.deviation[m.count++] =
                fmax(channels[k].deviation, channels[k].relative * fabs(value));
        }
        if (c->readings == BR_MEASUREMENTS)
            memmove(c->reading, c->reading + 1, --c->readings * sizeof *c->reading);
        c->reading[c->readings++] = m;
    }
}
#endif

/* The inputs of the FMU as a received state. If the importer connects the input that acts and there
 * is no delay, nothing has to be predicted. Without a delay, the outputs of the last control step
 * have acted since; with one, what has acted is not known. */
static br_measured measured(fmu_instance *instance) {
    controller *c = instance->model;
    const double *v = instance->value;
    const bool connected = v[FMU_V_d_applied_connected] != 0, at_once = v[FMU_V_delay] == 0;
    br_measured state = {
        .seq = c->cycles++,
        .time_s = v[FMU_V_time],
        .averaged = at_once,
        .lockstep = connected && at_once,
    };
    if (connected)
        state.u_applied[BR_INDEX_DUTY] = v[FMU_V_d_applied];
    else if (at_once)
        state.u_applied[BR_INDEX_DUTY] = v[FMU_V_d];
    if (at_once) state.u_applied[BR_INDEX_DELTA_RATE] = v[FMU_V_delta_rate];
#if INSTRUMENTS
    if (connected) state.u_applied[BR_INDEX_DELTA_RATE] = v[FMU_V_delta_rate_applied];
    state.averaged |= connected;
    state.estimated = 1;
    state.measurements = c->readings;
    memcpy(state.measured, c->reading, sizeof state.measured);
    c->readings = 0;
#else
    memcpy(state.x, &v[FMU_V_x], sizeof state.x);
#endif
    return state;
}

static double known(double value) { return isfinite(value) ? value : -1; }

static void set_outputs(fmu_instance *instance, const br_decision *decision) {
    static const br_mpc_info nothing = {.stationarity = NAN, .defect = NAN, .slack_max_m = NAN};
    const controller *c = instance->model;
    const br_mpc_info *info = decision->stepped ? br_cycle_info(c->cycle) : &nothing;
    double *v = instance->value;
    const int status = decision->stepped ? info->status : decision->status;
    v[FMU_V_d] = decision->u[BR_INDEX_DUTY];
    v[FMU_V_delta_rate] = decision->u[BR_INDEX_DELTA_RATE];
    v[FMU_V_fallback_level] = decision->level;
    v[FMU_V_status] = status;
    v[FMU_V_usable] = status <= BR_ACCEPTABLE;
    v[FMU_V_iterations_used] = info->iterations;
    v[FMU_V_stationarity] = known(info->stationarity);
    v[FMU_V_defect] = known(info->defect);
    v[FMU_V_slack_max_m] = known(info->slack_max_m);
    const bool planned = decision->stepped && status != BR_BAD_STATE;
    v[FMU_V_tube_m] = planned ? known(info->tube_m) : -1;
    if (!planned) return; /* nor projected */
#define COPY(name) v[FMU_V_##name] = info->name;
    PLANNED(COPY)
#undef COPY
}

fmu_status fmu_model_step(fmu_instance *instance, double h) {
    controller *c = instance->model;
    const double *v = instance->value;
#if INSTRUMENTS
    collect(c, v);
#endif
    if (!due(c, v[FMU_V_time], v[FMU_V_period])) return FMU_OK;
    br_environment around = {v[FMU_V_speed_limit], v[FMU_V_speed_limit_rate]};
    if (around.speed_limit_mps >= NO_SPEED_LIMIT) around.speed_limit_mps = INFINITY;
    const fmu_status status = take_parameters(instance);
    const br_measured state = measured(instance);
    br_decision decision;
    if (br_cycle_observe(c->cycle, &state) != BR_STATE_NEW ||
        br_cycle_decide(c->cycle, &around, br_cycle_counters(c->cycle)->time_s, 0, 0, &decision))
        return FMU_ERROR(instance, "controller: the control cycle refuses the state");
    set_outputs(instance, &decision);
    return status;
}
