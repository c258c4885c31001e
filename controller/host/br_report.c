/* The messages that a cycle sends: as controller/cycle.py makes them. */
#include <math.h>
#include <string.h>

#include "br_host.h"

#define SCALE 1e6 /* plans are reported to so many parts */
#define LARGEST 1e6
#define LARGEST_MEASURE 1e12

static void publish(br_host *host, const br_wire_table *table, const void *message) {
    const size_t size = br_wire_write(table, message, host->datagram, BR_DATAGRAM);
    if (size)
        br_link_send(&host->link, host->datagram, size);
    else
        host->link.unsent += 1;
}

void br_send_updated(br_host *host) {
    br_link *link = &host->link;
    const br_address driven = link->peer;
    link->peer = host->asked_from; /* before a run, the sender may not be the plant driven for */
    publish(host, &BR_UPDATED_TABLE, &host->update.answer);
    link->peer = driven;
}

void br_send_actuation(br_host *host) {
    const br_decision *decision = &host->decision;
    br_actuation_message *m = &host->actuation;
    const int64_t begin_ns = br_now_ns();
    m->seq = host->actuations++;
    m->source_time_ns = begin_ns;
    m->epoch = host->state.epoch, m->run = host->state.run;
    m->state_seq = host->state.seq;
    m->decided_at_s = decision->decided_at_s;
    memcpy(m->u, decision->u, sizeof m->u);
    strcpy(m->weights_version, host->update.in_use);
    m->status = decision->status;
    publish(host, &BR_ACTUATION_TABLE, m);
    host->timing.encode_us = (double)(br_now_ns() - begin_ns) * 1e-3;
}

static int rounded(const double *from, int count, double *to) {
    for (int i = 0; i < count; ++i) to[i] = rint(from[i] * SCALE) / SCALE;
    return count;
}

void br_send_braking(br_host *host) {
    const br_braking *plan = &host->plan;
    br_braking_message *m = &host->braking;
    m->seq = host->brakings++;
    m->source_time_ns = br_now_ns();
    m->epoch = host->state.epoch, m->run = host->state.run;
    m->begins_s = fmax(plan->begins_s, 0);
    m->step_s = plan->step_s;
    m->d_count = rounded(plan->duty, plan->rows, m->d);
    m->delta_count = rounded(plan->delta_rad, plan->rows, m->delta);
    publish(host, &BR_BRAKING_TABLE, m);
}

/* --- telemetry --- */

/* A measure that is not negative, or -1. */
static double measure(double value) { return value >= 0 && value <= LARGEST_MEASURE ? value : -1; }

static double known(double value, double otherwise) { return isfinite(value) ? value : otherwise; }

/* For viewing, to six digits; nothing of it if any of it is no number. */
static int viewed(const double *plan, int count, double *out) {
    for (int i = 0; i < count; ++i)
        if (!(fabs(plan[i]) <= LARGEST)) return 0;
    return rounded(plan, count, out);
}

/* What has come of the step, if one was made. */
static void report_step(br_host *host, br_telemetry_message *m) {
    static const br_mpc_info none = {.pace = 1,
                                     .widening = 1,
                                     .stationarity = -1,
                                     .defect = -1,
                                     .bound = -1,
                                     .cost = -1,
                                     .shifted_cost = -1};
    const int stepped = host->decision.stepped;
    const br_mpc_info *info = stepped ? br_cycle_info(host->cycle) : &none;
    m->iterations = info->iterations;
    m->pace = known(info->pace, 1);
    m->widening = known(info->widening, 1);
    m->residual_dynamics = measure(info->defect);
    m->residual_bounds = measure(info->bound);
    m->residual_stationarity = measure(info->stationarity);
    m->cost = measure(info->cost);
    m->cost_shifted = stepped && info->shifts >= 0 ? measure(info->shifted_cost) : -1;
    m->second_start = info->second_start;
    m->s_ref_m = known(info->s_ref_m, 0);
    m->n_ref_m = known(info->lateral_m, 0);
    m->plan_x_count = m->plan_u_count = m->tube_m_count = 0;
    if (!stepped) return;
    br_mpc_get_plan(host->mpc, host->plan_x, host->plan_u);
    br_mpc_get_tube(host->mpc, host->tube);
    m->plan_x_count = viewed(host->plan_x, (BR_N + 1) * BR_NX, m->plan_x);
    m->plan_u_count = viewed(host->plan_u, BR_N * BR_NU, m->plan_u);
    m->tube_m_count = viewed(host->tube, BR_N, m->tube_m);
}

/* What the readings say of the state. */
static void report_estimate(br_host *host, br_telemetry_message *m) {
    m->estimate_count = m->deviation_count = 0;
    if (!host->state.estimated) return;
    if (br_estimator_read(br_cycle_estimator(host->cycle), &host->belief)) return;
    m->estimate_count = m->deviation_count = BR_NB;
    for (int i = 0; i < BR_NB; ++i) {
        const double deviation = sqrt(fmax(host->belief.covariance[i * BR_NB + i], 0));
        m->estimate[i] = fmin(fmax(host->belief.x[i], -LARGEST), LARGEST);
        m->deviation[i] = fmin(deviation, LARGEST);
    }
}

static void report_timing(br_host *host, br_telemetry_message *m) {
    br_timing *timing = &host->timing;
    m->tick = br_next_cycle(timing);
    timing->ticks += 1;
    m->released_ns = timing->released_ns;
    m->received_ns = timing->arrived_ns;
    m->missed = timing->missed;
    m->wake_us = timing->wake_us;
    m->decode_us = timing->decode_us;
    m->prepare_us = timing->prepare_us;
    m->solve_us = host->decision.step_us > 0 ? host->decision.step_us : timing->solve_us;
    m->encode_us = timing->encode_us;
    m->states = timing->taken - timing->reported;
    timing->reported = timing->taken;
    m->prepared_s = timing->prepared_s;
    m->prepared_refused_count = timing->prepared_refusals;
    for (int i = 0; i < timing->prepared_refusals; ++i)
        m->prepared_refused[i] = timing->prepared_refused[i];
    timing->prepared_s = 0;
    timing->prepared_refusals = 0;
}

void br_send_telemetry(br_host *host) {
    const br_decision *decision = &host->decision;
    br_telemetry_message *m = &host->report;
    int refused[BR_REFUSALS];
    report_timing(host, m);
    if (!host->telemetry) return;
    m->seq = host->reports++;
    m->run = host->state.run;
    m->state_seq = host->state.seq;
    m->status = decision->status;
    m->fallback = decision->level;
    m->delay_s = decision->delay_s;
    m->late_s = fmax(decision->late_s, 0);
    strcpy(m->sensor_fault, br_telemetry_sensor_fault[decision->fault]);
    report_step(host, m);
    report_estimate(host, m);
    m->refused_count = decision->stepped ? br_cycle_get_refusals(host->cycle, refused) : 0;
    for (int i = 0; i < m->refused_count; ++i) m->refused[i] = refused[i];
    m->source_time_ns = br_now_ns();
    publish(host, &BR_TELEMETRY_TABLE, m);
}
