/* New weights while driving: requests 'update' (bayesrace/messages/link.py) put a file of weights
 * together in a buffer, stage it beside the weights in use, and adopt it between two cycles; then
 * the weights are on trial, and the controller goes back by itself if they are worse. */
#ifndef BR_UPDATE_H
#define BR_UPDATE_H

#include <pthread.h>
#include <semaphore.h>
#include <stdatomic.h>

#include "bayesrace_cycle.h"
#include "br_files.h"
#include "br_messages.h"

#define BR_SAMPLE_NUMBERS (BR_NZ + 2 * BR_NE)

typedef struct {
    br_mpc *mpc;
    br_mpc_probation probation;
    double stop_mps2;

    char in_use[BR_VERSION_BYTES], proven[BR_VERSION_BYTES], staged[BR_VERSION_BYTES];
    br_mpc_trial trial; /* while on_trial: the loop passes it each state that it uses */
    int on_trial;
    double limit_mps; /* to which the car slows down, until weights are adopted, also where it has
                       * gone back; 0: none */

    union {
        uint8_t bytes[BR_WEIGHTS_BYTES];
        double numbers[BR_SAMPLES * BR_SAMPLE_NUMBERS]; /* features, residuals, their variances */
    } buffer;
    br_update_message request, asked; /* the newest; the newest to adopt */
    br_updated_message now, answer;   /* with what the watch has found since; as it was given: the
                                       * same again where the request comes again */
    int answered, adopts;             /* 1: the request is to adopt, and that is still to be done */

    /* Staging, by a thread of its own while the car is driven in real time. */
    double numbers[BR_WEIGHTS_NUMBERS];
    size_t size; /* of the file in the buffer */
    char why[200];
    pthread_t stager;
    sem_t begin;
    atomic_int staging; /* br_staging */
    int has_staged;     /* 1: the newest file is staged, and not adopted yet */
} br_update;

typedef enum {
    BR_STAGING_IDLE,
    BR_STAGING_BUSY,
    BR_STAGING_DONE,
    BR_STAGING_FAILED,
    BR_STAGING_END
} br_staging;

/* Whether weights of this version can be named in messages. */
int br_update_is_version(const char *text);

/* in_use holds the version that is in use at the start; all other members are zero. Starts the
 * thread; 0, or -1 with errno, EINVAL for a probation that is none. */
int br_update_open(br_update *update, br_mpc *mpc, const br_settings *settings);
void br_update_close(br_update *update);

/* Carries out the request in update->request, if it is no repetition; 1: update->answer is the
 * answer, 0: it comes between two cycles. cycle: number of the next one; waits: staging may take
 * its time. */
int br_update_serve(br_update *update, int64_t cycle, int waits);

/* Between two cycles, before the next one is prepared: acts on what the watch finds, and adopts. 1:
 * update->answer is the answer to that request. */
int br_update_between(br_update *update, int64_t cycle);

/* What limits the car in the next cycle: a faster one slows down from its own speed. */
br_environment br_update_limits(const br_update *update, double vx_mps);

#endif
