/* Memory, parameters, texts: everything of the interface that is not the control step. */
#include <math.h>

#include "br_internal.h"

size_t br_mpc_memory_size(void) { return sizeof(br_mpc); }

br_mpc_error br_mpc_init(void *memory, size_t size, br_mpc **out) {
    if (!memory || !out) return BR_ERROR_NULL;
    if (size < sizeof(br_mpc) || (uintptr_t)memory % 64) return BR_ERROR_MEMORY;
    br_mpc *mpc = memory;
    memset(mpc, 0, offsetof(br_mpc, gp));
    for (int i = 0; i < 3; ++i) br_gp_clear(&mpc->gp[i]);
    br_qp_init(&mpc->qp);
    br_weights_init(mpc);
    br_caution_reset(&mpc->caution);
    br_innovation_reset(&mpc->innovation);
    mpc->code = br_fastest_code();
    *out = mpc;
    return BR_OK;
}

static int valid(const br_mpc_parameters *p) {
    const double numbers[] = {p->tolerance, p->defect_max, p->early_stop_tol, p->caution_sigmas};
    return br_all_finite(numbers, sizeof numbers / sizeof numbers[0]) && p->tolerance > 0 &&
           p->defect_max > 0 && p->early_stop_tol >= 0 && p->caution_sigmas >= 0 &&
           p->iterations >= 1 && p->iterations_cold >= 1 && br_valid_parameters(p);
}

br_mpc_error br_mpc_set_parameters(br_mpc *mpc, const br_mpc_parameters *parameters) {
    if (!mpc || !parameters) return BR_ERROR_NULL;
    if (!valid(parameters)) return BR_ERROR_PARAMETERS;
    mpc->parameters = *parameters;
    mpc->has_parameters = 1;
    br_invalidate(mpc, BR_TUBE);
    br_innovation_undo(&mpc->innovation);
    br_evaluate_penalties(mpc);
    return BR_OK;
}

br_mpc_error br_mpc_set_path(br_mpc *mpc, const double *table, int n, double spacing_m) {
    if (!mpc || !table) return BR_ERROR_NULL;
#if BR_HAS_PATH
    br_invalidate(mpc, BR_FOLLOWED); /* what has been prepared is of the path before */
    return br_path_load(&mpc->path, table, n, spacing_m);
#else
    (void)n, (void)spacing_m;
    return BR_ERROR_PATH;
#endif
}

br_mpc_error br_mpc_set_clock(br_mpc *mpc, br_mpc_clock clock, void *context) {
    if (!mpc) return BR_ERROR_NULL;
    mpc->timer = (br_timer){.clock = clock, .context = context};
    return BR_OK;
}

void br_mpc_reset(br_mpc *mpc) {
    if (!mpc) return;
    mpc->warm = 0;
    br_invalidate(mpc, BR_LINEARISATION);
    mpc->ahead = mpc->prepared = mpc->prepared_iterations = 0;
    mpc->path.known = 0;
    br_caution_reset(&mpc->caution);
    mpc->innovation.newest.duration = 0;
    br_innovation_reset(&mpc->innovation);
    mpc->turn = 0;
    mpc->attempts = mpc->starts = mpc->futile = mpc->looks = 0;
}

br_mpc_error br_mpc_observe(br_mpc *mpc, const double x[BR_NX], const double u[BR_NU],
                            double duration_s, const double x_next[BR_NX]) {
    if (!mpc || !x || !u || !x_next) return BR_ERROR_NULL;
    if (!(duration_s > 0 && duration_s <= BR_PREDICT_MAX_S)) return BR_ERROR_TIME;
    if (!br_plausible_state(x) || !br_plausible_state(x_next) || !br_plausible_input(u))
        return BR_ERROR_STATE;
    br_transition *newest = &mpc->innovation.newest;
    newest->duration = duration_s;
    memcpy(newest->x, x, sizeof newest->x);
    memcpy(newest->u, u, sizeof newest->u);
    memcpy(newest->x_next, x_next, sizeof newest->x_next);
    mpc->watch.newest = *newest;
    return BR_OK;
}

br_mpc_error br_mpc_get_plan(const br_mpc *mpc, double *x, double *u) {
    if (!mpc) return BR_ERROR_NULL;
    if (x) memcpy(x, mpc->answer_x, sizeof mpc->answer_x);
    if (u) memcpy(u, mpc->answer_u, sizeof mpc->answer_u);
    return BR_OK;
}

br_mpc_error br_mpc_get_reference(const br_mpc *mpc, br_mpc_reference reference[BR_N]) {
    if (!mpc || !reference) return BR_ERROR_NULL;
    memcpy(reference, mpc->answer_reference, sizeof mpc->answer_reference);
    return BR_OK;
}

br_mpc_error br_mpc_get_tube(const br_mpc *mpc, double tube[BR_N]) {
    if (!mpc || !tube) return BR_ERROR_NULL;
    memcpy(tube, mpc->answer_tube, sizeof mpc->answer_tube);
    return BR_OK;
}

const char *br_mpc_error_text(br_mpc_error error) {
    static const char *const texts[] = {
        [BR_OK] = "no error",
        [BR_ERROR_NULL] = "a required pointer is NULL",
        [BR_ERROR_MEMORY] = "memory block too small or not aligned to 64 bytes",
        [BR_ERROR_PARAMETERS] = "a parameter is not finite or out of its range",
        [BR_ERROR_PATH] = "path table is unusable",
        [BR_ERROR_WEIGHTS] = "GP weights are unusable",
        [BR_ERROR_NOT_READY] = "parameters or path have not been set",
        [BR_ERROR_TIME] = "a time is negative, not finite or too long",
        [BR_ERROR_STATE] = "a state or input is not finite or absurd",
        [BR_ERROR_BUSY] = "another thread is staging weights",
        [BR_ERROR_NOT_STAGED] = "no weights are staged",
        [BR_ERROR_INSTRUCTIONS] = "this processor lacks these instructions",
    };
    return (unsigned)error < sizeof texts / sizeof texts[0] ? texts[error] : "unknown error";
}

const char *br_mpc_status_text(br_mpc_status status) {
    static const char *const texts[] = {
        [BR_CONVERGED] = "converged",
        [BR_ACCEPTABLE] = "acceptable",
        [BR_DEFECT] = "dynamics defect too large",
        [BR_INFEASIBLE] = "QP infeasible",
        [BR_QP_LIMIT] = "QP iteration limit",
        [BR_NOT_FINITE] = "not finite",
        [BR_BAD_STATE] = "bad state",
        [BR_TIME_LIMIT] = "out of time before the plan was usable",
    };
    return (unsigned)status < sizeof texts / sizeof texts[0] ? texts[status] : "unknown status";
}

const char *br_mpc_model_name(void) { return BR_MODEL_NAME; }

int br_mpc_abi(void) { return BR_ABI; }
