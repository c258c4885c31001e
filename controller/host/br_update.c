/* See br_update.h. */
#define _DEFAULT_SOURCE /* usleep */
#include <errno.h>
#include <math.h>
#include <signal.h>
#include <string.h>
#include <sys/resource.h>
#include <unistd.h>

#include "br_transport.h"
#include "br_update.h"

#define NICE 10 /* of the thread that stages, below the loop */
#define LARGEST 1e12
#define LARGEST_LOSS_S 1e6
#define LATE 1000000 /* requests; another sender's numbers are farther away */

static const char *const GONE_BACK = "the watch has rolled back meanwhile; send them again";

_Static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "samples are sent as they are");
_Static_assert(sizeof(((br_updated_message *)0)->version) == BR_VERSION_BYTES,
               "a version of a file fits into answers");

/* --- staging --- */

int br_update_is_version(const char *text) {
    const int characters = br_wire_characters(text, strlen(text));
    return characters >= 0 && characters <= BR_VERSION_CHARACTERS;
}

static void stage(br_update *update) {
    int failed = br_files_stage(update->mpc, update->buffer.bytes, update->size, update->numbers,
                                BR_MODEL_IDENTITY, update->staged, update->why, sizeof update->why);
    if (!failed && !br_update_is_version(update->staged)) {
        strcpy(update->why, "weights.bin has a version that is no text of 200 characters at most");
        failed = 1;
    }
    atomic_store(&update->staging, failed ? BR_STAGING_FAILED : BR_STAGING_DONE);
}

static void *stager_main(void *of) {
    const struct sched_param usual = {.sched_priority = 0};
    br_update *update = of;
    /* whatever the process was started with; the priority is of this thread alone, on Linux */
    pthread_setschedparam(pthread_self(), SCHED_OTHER, &usual);
    setpriority(PRIO_PROCESS, 0, NICE);
    for (;;) {
        while (sem_wait(&update->begin) && errno == EINTR) {
        }
        if (atomic_load(&update->staging) == BR_STAGING_END) return NULL;
        stage(update);
    }
}

/* As the limits of GateSettings, in controller/settings.py. */
static int is_valid(const br_mpc_probation *p) {
    int valid = p->worse_factor >= 1 && p->worse_share >= 0 && p->watch_samples >= 0 &&
                p->slow_share > 0 && p->slow_least_mps > 0 && p->watch_least >= 1;
    for (int j = 0; j < BR_NE; ++j) valid = valid && p->resolution[j] > 0;
    return valid;
}

int br_update_open(br_update *update, br_mpc *mpc, const br_settings *settings) {
    sigset_t all, before;
    if (!is_valid(&settings->probation)) {
        errno = EINVAL;
        return -1;
    }
    update->mpc = mpc;
    update->probation = settings->probation;
    update->stop_mps2 = settings->driving.stop_mps2;
    strcpy(update->proven, update->in_use);
    sigfillset(&all); /* signals are for the loop */
    if (sem_init(&update->begin, 0, 0) || pthread_sigmask(SIG_SETMASK, &all, &before)) return -1;
    const int failed = pthread_create(&update->stager, NULL, stager_main, update);
    pthread_sigmask(SIG_SETMASK, &before, NULL);
    errno = failed;
    return failed ? -1 : 0;
}

void br_update_close(br_update *update) {
    while (atomic_load(&update->staging) == BR_STAGING_BUSY) usleep(1000);
    atomic_store(&update->staging, BR_STAGING_END);
    sem_post(&update->begin);
    pthread_join(update->stager, NULL);
}

/* --- adoption and trial --- */

static void record(br_update *update, br_mpc_ruling ruling, int64_t cycle) {
    const br_mpc_trial *trial = &update->trial;
    const br_mpc_watch *found = &trial->found;
    br_updated_message *m = &update->now;
    m->rulings += 1;
    m->reverted += ruling >= BR_BACK;
    m->ruling = ruling;
    m->ruled_at = cycle;
    m->samples = found->samples;
    m->fresh = found->fresh;
    m->cycles = trial->cycles;
    m->fallen_back = trial->fallen_back;
    m->fastest_mps = fmin(trial->fastest_mps, LARGEST);
    m->limit_mps = fmin(trial->limit_mps, LARGEST);
    for (int j = 0; j < BR_NE; ++j) {
        m->errors[j] = fmin(found->in_use[j], LARGEST);
        m->errors[BR_NE + j] = fmin(found->proven[j], LARGEST);
        m->errors[2 * BR_NE + j] = fmin(found->nominal[j], LARGEST);
    }
}

static void watch(br_update *update, int64_t cycle) {
    if (!update->on_trial) return;
    const br_mpc_ruling ruling =
        br_mpc_judge_trial(update->mpc, &update->probation, &update->trial);
    if (ruling == BR_WATCH_ON) return;
    record(update, ruling, cycle);
    if (ruling == BR_SLOW) {
        update->limit_mps = update->trial.limit_mps;
        return;
    }
    update->on_trial = 0;
    if (ruling == BR_PROVEN) {
        br_mpc_prove_weights(update->mpc);
        strcpy(update->proven, update->in_use);
    } else {
        br_mpc_revert_weights(update->mpc);
        strcpy(update->in_use, update->proven);
    }
}

br_environment br_update_limits(const br_update *update, double vx_mps) {
    br_environment around = {.speed_limit_mps = INFINITY};
    if (update->limit_mps <= 0) return around;
    around.speed_limit_mps = fmax(update->limit_mps, vx_mps);
    if (vx_mps > update->limit_mps) around.speed_limit_rate_mps2 = update->stop_mps2;
    return around;
}

/* --- requests --- */

static const char *write_piece(br_update *update) {
    const br_update_message *request = &update->request;
    const size_t at = (size_t)request->at, count = (size_t)request->data_count;
    if (at + count > sizeof update->buffer) return "more than any weights that would fit";
    memcpy(update->buffer.bytes + at, request->data, count);
    atomic_store(&update->staging, BR_STAGING_IDLE);
    return NULL;
}

static const char *read_piece(br_update *update) {
    br_updated_message *answer = &update->now;
    const size_t at = (size_t)update->request.at;
    if (at >= sizeof update->buffer) return "the buffer is not as long";
    const size_t left = sizeof update->buffer - at;
    const size_t count = left < sizeof answer->data ? left : sizeof answer->data;
    memcpy(answer->data, update->buffer.bytes + at, count);
    answer->data_count = (int)count;
    return NULL;
}

/* Begins, or says what has come of it. */
static const char *stage_file(br_update *update, int waits) {
    if (atomic_load(&update->staging) == BR_STAGING_IDLE) {
        update->size = (size_t)update->request.at;
        if (update->size > sizeof update->buffer) return "the buffer is not as long";
        update->has_staged = 0;
        atomic_store(&update->staging, BR_STAGING_BUSY);
        if (waits)
            stage(update);
        else
            sem_post(&update->begin);
    }
    const int found = atomic_load(&update->staging);
    update->now.busy = found == BR_STAGING_BUSY;
    if (found == BR_STAGING_BUSY) return NULL;
    atomic_store(&update->staging, BR_STAGING_IDLE);
    update->has_staged = found == BR_STAGING_DONE;
    return update->has_staged ? NULL : update->why;
}

static const char *adopt(br_update *update) {
    const br_update_message *request = &update->asked;
    if (request->reverted != update->now.reverted) return GONE_BACK;
    const int64_t begin_ns = br_now_ns();
    /* an older file may still be staged where the newest could not be */
    const br_mpc_error error =
        update->has_staged ? br_mpc_adopt_weights(update->mpc) : BR_ERROR_NOT_STAGED;
    if (error) return br_mpc_error_text(error);
    update->has_staged = 0;
    strcpy(update->in_use, update->staged);
    update->on_trial = request->watched && update->probation.watch_samples > 0;
    if (!update->on_trial) {
        br_mpc_prove_weights(update->mpc);
        strcpy(update->proven, update->in_use);
    }
    memset(&update->trial, 0, sizeof update->trial);
    update->limit_mps = 0;
    update->now.adoption_us = (double)(br_now_ns() - begin_ns) * 1e-3;
    double lost_s = 0;
    br_mpc_get_loss(update->mpc, &lost_s);
    update->now.unknown_s = fmin(fmax(lost_s, -LARGEST_LOSS_S), LARGEST_LOSS_S);
    return NULL;
}

static const char *copy_samples(br_update *update) {
    double *numbers = update->buffer.numbers;
    int count = 0;
    if (update->request.reverted != update->now.reverted) return GONE_BACK;
    br_mpc_get_samples(update->mpc, numbers, numbers + BR_SAMPLES * BR_NZ,
                       numbers + BR_SAMPLES * (BR_NZ + BR_NE), &count);
    update->now.size = count;
    return NULL;
}

static const char *carry_out(br_update *update, int waits) {
    const char *action = update->request.action;
    if (!strcmp(action, "look")) return NULL;
    if (BR_WEIGHT_BUFFERS == 1) return "one weight buffer: no new weights while it drives";
    if (!strcmp(action, "stage")) return stage_file(update, waits);
    if (!strcmp(action, "read")) return read_piece(update);
    if (atomic_load(&update->staging) == BR_STAGING_BUSY)
        return "weights are being staged; try later";
    if (!strcmp(action, "write")) return write_piece(update);
    if (!strcmp(action, "sample")) return copy_samples(update);
    if (strcmp(action, "adopt")) return "no such action";
    update->asked = update->request; /* the next datagram may be read over it */
    update->adopts = 1;
    return NULL;
}

static void answer(br_update *update, int64_t cycle, const char *error) {
    br_updated_message *m = &update->now;
    m->cycle = cycle;
    strcpy(m->error, error ? error : "");
    strcpy(m->version, update->in_use);
    m->source_time_ns = br_now_ns();
    update->answer = *m;
}

int br_update_serve(br_update *update, int64_t cycle, int waits) {
    br_updated_message *m = &update->now;
    const int64_t behind = m->seq - update->request.seq;
    if (update->answered && behind >= 0 && behind < LATE) return !update->adopts;
    update->answered = 1;
    update->adopts = 0;
    m->seq = update->request.seq;
    m->busy = m->data_count = 0;
    m->size = 0;
    answer(update, cycle, carry_out(update, waits));
    return !update->adopts;
}

int br_update_between(br_update *update, int64_t cycle) {
    watch(update, cycle);
    if (!update->adopts) return 0;
    update->adopts = 0;
    answer(update, cycle, adopt(update));
    return 1;
}
