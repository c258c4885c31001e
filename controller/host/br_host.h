/* The loop of a controller without Python: states in, actuations out, at a fixed rate in real time,
 * one answer to each state in lockstep. The same rules as controller/process.py, which says why.
 *
 * After br_host_open nothing is allocated, and nothing is written but what the link sends.
 */
#ifndef BR_HOST_H
#define BR_HOST_H

#include <signal.h>

#include "bayesrace_cycle.h"
#include "br_files.h"
#include "br_messages.h"
#include "br_schedule.h"
#include "br_transport.h"
#include "br_update.h"

_Static_assert(BR_NX == BR_QUANTITIES && BR_NU == 2, "messages are those of a car");
_Static_assert(sizeof(((br_actuation_message *)0)->weights_version) == BR_VERSION_BYTES,
               "a version of a file fits into messages");

/* Numbers of the instruments of a run, by name, in the order in which they have reported. */
typedef struct {
    int count;
    char name[BR_INSTRUMENTS][sizeof(((br_reading_message *)0)->instrument)];
} br_instruments;

/* Times of the cycle at hand, as in the telemetry, and what the loop has counted. */
typedef struct {
    int64_t released_ns, arrived_ns;
    double wake_us, decode_us, prepare_us, solve_us, encode_us, prepared_s;
    int missed, prepared_refusals, prepared_refused[BR_REFUSALS];
    int64_t commands, updates, ticks, skipped, misses, overruns, late_states, taken, reported;
    int64_t refused, from_others, readings_left_out; /* datagrams that are no state; those from
                                                      * others than the plant that is driven for;
                                                      * readings of too many instruments */
} br_timing;

/* Number of the next release's cycle, unless it is passed over. */
static inline int64_t br_next_cycle(const br_timing *timing) {
    return timing->ticks + timing->skipped - timing->late_states;
}

typedef struct {
    br_mpc *mpc;
    br_cycle *cycle;
    br_link link;
    br_schedule schedule;
    double budget; /* share of the period that a cycle may take */
    int telemetry; /* 1: it is sent */
    br_settings settings;
    br_update update;               /* weights in use, and new ones */
    volatile sig_atomic_t stopping; /* set it from anywhere */
    int error;                      /* br_mpc_error of the last step that was broken */
    br_timing timing;
    br_instruments instruments;
    int by_weights; /* 1: states are estimated by a model with weights */
    br_state_message state, incoming,
        unanswered;                         /* the newest that counts; the last that does not */
    br_address unanswered_from, asked_from; /* of that state; of the newest request about weights */
    int has_state, has_unanswered;
    int64_t actuations, reports, brakings, braked_ns; /* sent so far; when the last plan was */
    br_command_message command;
    br_measured measured;
    br_decision decision;
    br_braking plan;
    br_actuation_message actuation;
    br_braking_message braking;
    br_telemetry_message report;
    br_belief belief;
    double plan_x[(BR_N + 1) * BR_NX], plan_u[BR_N * BR_NU], tube[BR_N];
    uint8_t datagram[BR_DATAGRAM + BR_SEAL_BYTES];
} br_host;

/* br_host.c. Loads what the folder of 'bayesrace export' has, and opens the link. 0, or -1 and a
 * sentence in text. */
int br_host_open(br_host *host, const char *folder, const char *link, double rate_hz, char *text,
                 size_t size);

void br_host_close(br_host *host);

/* Until host->stopping, or until nothing can come any more. */
void br_host_serve(br_host *host);

/* br_report.c: the messages that a cycle sends. */
void br_send_actuation(br_host *host);
void br_send_braking(br_host *host);
void br_send_updated(br_host *host); /* to who has asked */
void br_send_telemetry(br_host *host);

#endif
