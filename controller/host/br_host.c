/* See br_host.h. */
#define _GNU_SOURCE /* clock_nanosleep */
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "br_host.h"

#define SILENT_NS 1000000000 /* without a state for so long it waits for another plant */
#define IDLE_NS 100000000    /* longest wait while there is none */
#define LEAD 0.1             /* share of the period by which it wakes before a release, ... */
#define LEAD_NS 300000       /* ... and at most */
#define REHEARSAL_NS 700000  /* how much sooner, to rehearse a cycle, ... */
#define COLD_NS 5000000      /* ... where the period is long enough for caches to go cold */
#define WAY 0.05       /* pause before the preparation, so that the actuation gets the CPU, ... */
#define WAY_NS 1000000 /* ... as a share of the period, and at most */
#define ROOM 2.0       /* time that a late cycle must have, in times of the one before */
#define BRAKING_NS 15000000 /* between two braking plans */
#define NEWEST 1024         /* states that are looked through for the newest */

/* Topic of a datagram, "" if it has none, and its message. */
typedef struct {
    char topic[32];
    const uint8_t *data;
    size_t size;
} content;

/* What has come of looking for a state. */
typedef enum { NOTHING, NO_NEW_STATE, NEW_STATE } arrival;

/* --- start --- */

/* A block of memory as the controller wants it. */
static void *block(size_t size) { return aligned_alloc(64, (size + 63) / 64 * 64); }

/* States are estimated by what the model of the weights in use is worth. */
static br_mpc_error trust_model(br_host *host) {
    const br_settings *settings = &host->settings;
    host->by_weights = *host->update.in_use != 0;
    if (!BR_HAS_ESTIMATOR) return BR_OK;
    return br_cycle_set_estimation(
        host->cycle, NULL, host->by_weights ? &settings->with_weights : &settings->without_weights);
}

static br_mpc_error make(br_host *host) {
    const size_t size = br_cycle_memory_size();
    const br_settings *settings = &host->settings;
    void *memory = block(size);
    br_mpc_error error =
        memory ? br_mpc_set_parameters(host->mpc, &settings->parameters) : BR_ERROR_MEMORY;
    if (!error) error = br_cycle_drive_mpc(memory, size, host->mpc, 0, &host->cycle);
    if (!error) error = br_cycle_set_driving(host->cycle, &settings->driving);
    if (!error && BR_HAS_ESTIMATOR) /* that both are valid is found now, not in a later run */
        error = br_cycle_set_estimation(host->cycle, NULL, &settings->without_weights);
    if (!error && BR_HAS_ESTIMATOR)
        error = br_cycle_set_estimation(host->cycle, NULL, &settings->with_weights);
    if (!error) error = trust_model(host);
    if (!error) error = br_cycle_set_clock(host->cycle, br_mpc_monotonic, NULL);
    return error;
}

int br_host_open(br_host *host, const char *folder, const char *link, double rate_hz, char *text,
                 size_t size) {
    char why[256];
    char *version = host->update.in_use;
    const size_t memory = br_mpc_memory_size();
    br_mpc_error error = br_mpc_init(block(memory), memory, &host->mpc);
    if (error) return br_refused(text, size, "controller", br_mpc_error_text(error));
    if (br_files_load(host->mpc, folder, BR_MODEL_IDENTITY, version, why, sizeof why) ||
        br_files_settings(folder, &host->settings, why, sizeof why))
        return br_refused(text, size, folder, why);
    if (!br_update_is_version(version))
        return br_refused(text, size, folder, "weights.bin has a version that is no text");
    error = make(host);
    if (error) return br_refused(text, size, folder, br_mpc_error_text(error));
    host->schedule.period_ns = llrint(1e9 / rate_hz);
    if (br_link_open(&host->link, link, &host->stopping, why, sizeof why))
        return br_refused(text, size, "link", why);
    if (br_update_open(&host->update, host->mpc, &host->settings)) {
        br_refused(text, size, "new weights, by settings.txt and a thread", strerror(errno));
        br_link_close(&host->link);
        return -1;
    }
    return 0;
}

void br_host_close(br_host *host) {
    br_update_close(&host->update);
    br_link_close(&host->link);
    free(host->cycle);
    free(host->mpc);
}

/* --- states --- */

/* The number of an instrument, which may be new; -1: there is no room for it. */
static int number_of(br_instruments *instruments, const char *name) {
    for (int i = 0; i < instruments->count; ++i)
        if (!strcmp(instruments->name[i], name)) return i;
    if (instruments->count == BR_INSTRUMENTS) return -1;
    strcpy(instruments->name[instruments->count], name);
    return instruments->count++;
}

static void take_readings(br_host *host, const br_state_message *state, br_instruments *known) {
    br_measured *m = &host->measured;
    for (int k = 0; k < state->readings_count; ++k) {
        const br_reading_message *reading = &state->readings[k];
        const int number = number_of(known, reading->instrument);
        if (number < 0) {
            host->timing.readings_left_out += 1;
            continue;
        }
        br_measurement *one = &m->measured[m->measurements++];
        one->instrument = number;
        one->time_s = reading->time_s;
        one->count = reading->values.count;
        for (int i = 0; i < one->count; ++i) {
            one->of[i] = reading->values.of[i];
            one->value[i] = reading->values.value[i];
            one->deviation[i] = reading->values.deviation[i];
        }
    }
}

static void measure(br_host *host, const br_state_message *state, br_instruments *known) {
    br_measured *m = &host->measured;
    m->epoch = state->epoch, m->run = state->run, m->seq = state->seq;
    m->time_s = state->time_s;
    memcpy(m->x, state->x, sizeof m->x);
    memcpy(m->u_applied, state->u_applied, sizeof m->u_applied);
    m->averaged = 1;
    m->lockstep = state->lockstep;
    m->delays = 0;
    for (int i = 2; i < state->actuation_delays_count && m->delays < BR_DELAYS; i += 3)
        m->delays_s[m->delays++] = state->actuation_delays[i];
    m->estimated = state->estimated;
    m->measurements = 0;
    if (state->estimated) take_readings(host, state, known);
}

/* Speed in the newest state, measured or estimated; 0 where it is not known. */
static double speed_mps(br_host *host) {
    if (!host->state.estimated) return host->state.x[BR_INDEX_VX];
    const int unknown = br_estimator_read(br_cycle_estimator(host->cycle), &host->belief);
    return unknown ? 0 : host->belief.x[BR_INDEX_VX];
}

/* What the watch over new weights makes of a state. */
static void observe_trial(br_host *host) {
    const br_decision *before = &host->decision;
    if (!host->update.on_trial || br_cycle_counters(host->cycle)->doubted) return;
    const int undriven = before->status == BR_HALTED || before->status == BR_NO_STATE;
    br_mpc_observe_trial(&host->update.trial, speed_mps(host),
                         undriven ? -1 : before->level != BR_SOLUTION);
}

/* The cycle's verdict on a state; a new one is driven on, for its sender. */
static arrival observe(br_host *host, const br_state_message *state, const br_address *from,
                       int64_t arrived_ns) {
    const br_state_message *newest = &host->state;
    const int begins =
        !host->has_state || state->epoch != newest->epoch || state->run != newest->run;
    br_instruments known = host->instruments;
    if (begins) known.count = 0;
    measure(host, state, &known);
    const br_reception reception = br_cycle_observe(host->cycle, &host->measured);
    if (!begins || reception == BR_STATE_NEW) host->instruments = known;
    if (reception != BR_STATE_NEW) {
        if (state != &host->unanswered) host->unanswered = *state;
        host->unanswered_from = *from;
        host->has_unanswered = 1;
        return NO_NEW_STATE;
    }
    host->link.peer = *from;
    host->state = *state;
    host->has_state = 1;
    host->timing.taken += 1;
    host->timing.arrived_ns = arrived_ns;
    if (begins && state->estimated && host->by_weights != (*host->update.in_use != 0))
        trust_model(host);
    observe_trial(host);
    return NEW_STATE;
}

static int silent(const br_host *host) { return br_now_ns() - host->timing.arrived_ns > SILENT_NS; }

/* Whether a datagram is from another sender than the plant that is driven for. Until that plant has
 * ended its run or is silent, the states of other senders are ignored. */
static int from_other(const br_host *host) {
    if (!host->has_state || host->state.final || silent(host)) return 0;
    return !br_same_address(&host->link.from, &host->link.peer);
}

/* The datagram at hand. */
static content content_of(const br_host *host, size_t size) {
    content of = {.data = host->datagram};
    size_t begin = size;
    if (!br_wire_topic(host->datagram, size, &begin, of.topic)) of.topic[0] = 0;
    of.data += begin;
    of.size = size - begin;
    return of;
}

/* Whether it is a message of that topic. */
static int reads(const content *of, const br_wire_table *table, void *message) {
    return !strcmp(of->topic, table->topic) && !br_wire_read(table, of->data, of->size, message);
}

static int reads_state(br_host *host, const content *of) {
    return reads(of, &BR_STATE_TABLE, &host->incoming) &&
           host->incoming.actuation_delays_count % 3 == 0; /* whole rows */
}

/* Carries out a command to stop or go, from any sender; whether the datagram was one. */
static int obeys(br_host *host, const content *of) {
    if (!reads(of, &BR_COMMAND_TABLE, &host->command)) return 0;
    if (!strcmp(host->command.command, "stop"))
        br_cycle_stop(host->cycle);
    else
        br_cycle_go(host->cycle);
    host->timing.commands += 1;
    return 1;
}

/* Serves a request about weights; whether the datagram was one. */
static int updates(br_host *host, const content *of) {
    if (!reads(of, &BR_UPDATE_TABLE, &host->update.request)) return 0;
    const int waits = host->has_state && host->state.lockstep;
    host->asked_from = host->link.from;
    host->timing.updates += 1;
    if (br_update_serve(&host->update, br_next_cycle(&host->timing), waits)) br_send_updated(host);
    return 1;
}

/* What is done about weights between two cycles, before the next one is prepared. */
static void between_cycles(br_host *host) {
    if (br_update_between(&host->update, br_next_cycle(&host->timing))) br_send_updated(host);
}

/* The next datagram, waited for until then. The end of the link ends the loop. */
static arrival receive_state(br_host *host, int64_t until_ns) {
    const long size = br_link_receive(&host->link, until_ns, host->datagram, sizeof host->datagram);
    if (size == BR_LINK_ENDED) host->stopping = 1;
    if (size == BR_LINK_REFUSED) return NO_NEW_STATE;
    if (size < 0) return NOTHING;
    const int64_t arrived_ns = br_now_ns();
    const content of = content_of(host, (size_t)size);
    if (obeys(host, &of)) return NO_NEW_STATE;
    if (from_other(host)) {
        host->timing.from_others += 1;
        return NO_NEW_STATE;
    }
    if (updates(host, &of)) return NO_NEW_STATE;
    if (!reads_state(host, &of)) {
        host->timing.refused += 1;
        return NO_NEW_STATE;
    }
    host->timing.decode_us = (double)(br_now_ns() - arrived_ns) * 1e-3;
    return observe(host, &host->incoming, &host->link.from, arrived_ns);
}

/* After silence: a state that was not driven on, to which its plant may want an answer. */
static int take_unanswered(br_host *host) {
    if (!silent(host) || !br_cycle_forget(host->cycle) || !host->has_unanswered) return 0;
    const br_address from = host->unanswered_from;
    return observe(host, &host->unanswered, &from, br_now_ns()) == NEW_STATE;
}

/* Ends a loop, for want of states or with one that is not for it; whether there is one to drive. */
static int end_run(br_host *host, int fresh) {
    br_cycle_end(host->cycle);
    return fresh || take_unanswered(host);
}

static int await_state(br_host *host) {
    between_cycles(host);
    return receive_state(host, br_now_ns() + IDLE_NS) == NEW_STATE || take_unanswered(host);
}

/* --- a cycle --- */

static const br_counters *counters(const br_host *host) { return br_cycle_counters(host->cycle); }

static int64_t part_ns(const br_host *host, double share) {
    return llrint(share * (double)host->schedule.period_ns);
}

/* When the budget of the cycles after this release is used up. */
static int64_t budget_end_ns(const br_host *host) {
    return host->schedule.release_ns + part_ns(host, host->budget);
}

static br_environment limits(br_host *host) {
    return br_update_limits(&host->update, host->update.limit_mps > 0 ? speed_mps(host) : 0);
}

/* Decides, and sends what it has decided. */
static void cycle(br_host *host, double decided_at_s, double budget_s, double spent_s) {
    br_timing *timing = &host->timing;
    const int64_t begin_ns = br_now_ns();
    const br_environment around = limits(host);
    const br_mpc_error error =
        br_cycle_decide(host->cycle, &around, decided_at_s, budget_s, spent_s, &host->decision);
    if (error) return; /* without a state there is none to answer */
    const int64_t decided_ns = br_now_ns();
    timing->solve_us = (double)(decided_ns - begin_ns) * 1e-3;
    timing->overruns += budget_s > 0 && decided_ns > budget_end_ns(host);
    if (host->decision.status == BR_STEP_FAILED) host->error = host->decision.error;
    br_send_actuation(host);
    const int64_t deadline_ns = host->schedule.release_ns + host->schedule.period_ns;
    timing->missed = budget_s > 0 && br_now_ns() > deadline_ns;
    timing->misses += timing->missed;
    br_send_telemetry(host);
}

static void prepare(br_host *host, double period_s, double budget_s) {
    br_timing *timing = &host->timing;
    const int64_t begin_ns = br_now_ns();
    br_cycle_prepare(host->cycle, period_s, budget_s);
    timing->prepare_us = (double)(br_now_ns() - begin_ns) * 1e-3;
    timing->prepared_s = period_s;
    timing->prepared_refusals =
        budget_s > 0 ? br_cycle_get_refusals(host->cycle, timing->prepared_refused) : 0;
}

/* --- lockstep --- */

/* Answers each state, until one comes that is not to be answered so, or none any more. */
static int lockstep(br_host *host) {
    br_timing *timing = &host->timing;
    int fresh = 1;
    timing->wake_us = 0;
    while (!host->stopping) {
        if (fresh && (host->state.final || !host->state.lockstep)) break;
        if (!fresh && silent(host)) break;
        if (fresh) {
            timing->released_ns = br_now_ns();
            cycle(host, counters(host)->time_s, 0, 0);
            between_cycles(host);
            prepare(host, counters(host)->interval_s, 0);
        }
        fresh = receive_state(host, br_now_ns() + IDLE_NS) == NEW_STATE;
    }
    return end_run(host, fresh);
}

/* --- real time --- */

static int64_t smaller(int64_t a, int64_t b) { return a < b ? a : b; }

static int missing(const br_host *host) {
    const br_counters *count = counters(host);
    return br_schedule_missing(&host->schedule, count->time_s, count->interval_s);
}

static void sleep_until(int64_t at_ns) {
    const struct timespec at = {.tv_sec = (time_t)(at_ns / 1000000000),
                                .tv_nsec = (long)(at_ns % 1000000000)};
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &at, NULL);
}

/* late: a further cycle after the same release. */
static void tick(br_host *host, int late) {
    br_timing *timing = &host->timing;
    br_schedule *schedule = &host->schedule;
    timing->released_ns = br_now_ns();
    if (late) {
        timing->late_states += 1;
        timing->wake_us = timing->prepare_us = 0;
    }
    const double by_schedule_s = br_schedule_plant_time_s(schedule, timing->released_ns);
    const double spent_s = (double)(timing->released_ns - schedule->release_ns) * 1e-9;
    cycle(host, fmax(by_schedule_s, counters(host)->time_s),
          (double)part_ns(host, host->budget) * 1e-9, spent_s);
}

/* The newest state that is there, or comes until then; the one that is due is waited for even if an
 * older one is there. */
static int newest_state(br_host *host, int64_t until_ns) {
    const int64_t run = host->state.run, epoch = host->state.epoch;
    int fresh = 0;
    for (int i = 0; i < NEWEST && !host->stopping; ++i) {
        if (i && br_now_ns() > budget_end_ns(host)) break; /* a flood */
        const int waits = !fresh || missing(host) == 1;
        const arrival found = receive_state(host, waits ? until_ns : 0);
        if (found == NOTHING) break;
        fresh |= found == NEW_STATE;
    }
    if (!fresh) return 0;
    const int64_t arrived_ns = host->timing.arrived_ns;
    if (host->state.run != run || host->state.epoch != epoch)
        br_schedule_start(&host->schedule, arrived_ns);
    br_schedule_observe(&host->schedule, arrived_ns, counters(host)->time_s,
                        counters(host)->interval_s);
    return 1;
}

/* The state that was due at this release, if it comes while another cycle still fits. */
static int late_state(br_host *host) {
    if (missing(host) != 1) return 0;
    const int64_t spent_ns = br_now_ns() - host->timing.released_ns;
    const int64_t latest_ns = budget_end_ns(host) - llrint(ROOM * (double)spent_ns);
    while (br_now_ns() < latest_ns && !host->stopping)
        if (newest_state(host, latest_ns)) return 1;
    return 0;
}

static void plan_braking(br_host *host) {
    const int64_t now_ns = br_now_ns();
    if (host->brakings && now_ns - host->braked_ns <= BRAKING_NS) return;
    if (br_cycle_brake(host->cycle, &host->plan)) return;
    br_send_braking(host);
    host->braked_ns = now_ns;
}

static void prepare_next(br_host *host) {
    between_cycles(host);
    const int64_t pause_ns = smaller(part_ns(host, WAY), WAY_NS);
    if (budget_end_ns(host) - br_now_ns() > pause_ns) sleep_until(br_now_ns() + pause_ns);
    plan_braking(host);
    const int64_t left_ns = budget_end_ns(host) - br_now_ns();
    const int64_t next_ns = host->schedule.release_ns + host->schedule.period_ns;
    if (left_ns > 0)
        prepare(host, (double)(next_ns - host->timing.released_ns) * 1e-9, (double)left_ns * 1e-9);
}

/* Uses what the cycle will use, without effect: message, cycle, message. */
static void rehearse(br_host *host) {
    const size_t size = br_wire_write(&BR_STATE_TABLE, &host->state, host->datagram, BR_DATAGRAM);
    const content of = content_of(host, size);
    reads_state(host, &of);
    br_cycle_rehearse(host->cycle);
    br_wire_write(&BR_ACTUATION_TABLE, &host->actuation, host->datagram, BR_DATAGRAM);
}

/* Sleeps until shortly before the release, then looks for the state that is due. */
static int next_state(br_host *host) {
    const br_schedule *schedule = &host->schedule;
    const int rehearses = schedule->period_ns >= COLD_NS;
    const int64_t lead_ns = smaller(part_ns(host, LEAD), LEAD_NS) + (rehearses ? REHEARSAL_NS : 0);
    const int64_t wake_ns = schedule->release_ns - lead_ns;
    sleep_until(wake_ns);
    host->timing.wake_us = fmax((double)(br_now_ns() - wake_ns) * 1e-3, 0);
    if (rehearses) rehearse(host);
    return newest_state(host,
                        missing(host) ? br_schedule_window_end_ns(schedule) : schedule->release_ns);
}

/* Keeps the rate, until a state comes that is not to be driven on, or none for long. */
static int real_time(br_host *host) {
    br_schedule *schedule = &host->schedule;
    int fresh = 1, late = 0;
    br_schedule_start(schedule, host->timing.arrived_ns);
    br_schedule_observe(schedule, host->timing.arrived_ns, counters(host)->time_s, 0);
    host->timing.wake_us = 0;
    while (!host->stopping) {
        if (fresh && (host->state.final || host->state.lockstep)) break;
        if (silent(host)) {
            fresh = 0;
            break;
        }
        tick(host, late);
        fresh = late = late_state(host);
        if (late) continue;
        prepare_next(host);
        host->timing.skipped += br_schedule_advance(schedule, br_now_ns());
        fresh = next_state(host);
    }
    return end_run(host, fresh);
}

void br_host_serve(br_host *host) {
    int there = 0;
    while (!host->stopping) {
        if (!there || host->state.final)
            there = await_state(host);
        else
            there = host->state.lockstep ? lockstep(host) : real_time(host);
    }
}
