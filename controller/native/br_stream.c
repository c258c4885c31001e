/* Which states count: those of the current plant and run, each newer than the one before. */
#include <math.h>

#include "br_cycle.h"

/* A number that is farther ahead than this is not taken for the next one of the run at once: as
 * many states, or, where their interval allows more, as much time, and at most so many states. */
#define AHEAD 16
#define AHEAD_S 0.3
#define FARTHEST 256
#define CONFIRMED 4 /* states in a row that belong together are a stream of their own */

void br_stream_init(br_stream *stream) { *stream = (br_stream){.ended = 1, .silent = 1}; }

static int same_run(const br_measured *a, const br_measured *b) {
    return a->epoch == b->epoch && a->run == b->run;
}

static int follows(const br_measured *state, const br_measured *before, double interval_s) {
    const double in_time = interval_s > 0 ? AHEAD_S / interval_s : 0;
    const double most = fmin(fmax(in_time, AHEAD), FARTHEST);
    if (state->seq <= before->seq) return 0;
    return (double)((uint64_t)state->seq - (uint64_t)before->seq) <= most;
}

/* Whether it continues the stream, or nothing speaks against another one. */
static int continues(const br_stream *stream, const br_measured *state, double interval_s) {
    if (!stream->has_newest || stream->silent) return 1;
    if (!same_run(state, &stream->newest)) return stream->ended;
    return follows(state, &stream->newest, interval_s);
}

/* Whether it is the last of several in a row that are a stream of their own. */
static int confirmed(br_stream *stream, const br_measured *state, double interval_s) {
    const int belongs = stream->has_other && same_run(state, &stream->other) &&
                        follows(state, &stream->other, interval_s);
    stream->others = belongs ? stream->others + 1 : 1;
    stream->other = *state;
    stream->has_other = 1;
    return stream->others >= CONFIRMED;
}

br_reception br_stream_accept(br_stream *stream, const br_measured *state, br_counters *counters) {
    const br_measured *newest = &stream->newest;
    const int same = stream->has_newest && same_run(state, newest);
    const double interval_s = counters->interval_s;
    if (!continues(stream, state, interval_s) && !confirmed(stream, state, interval_s)) {
        const int stale = same && state->seq <= newest->seq;
        if (stale)
            counters->stale += 1;
        else
            counters->foreign += 1;
        return stale ? BR_STATE_STALE : BR_STATE_FOREIGN;
    }
    if (same && (uint64_t)state->seq == (uint64_t)newest->seq + 1)
        counters->interval_s = fmax(state->time_s - newest->time_s, 0);
    else if (!same)
        counters->interval_s = 0;
    stream->newest = *state;
    stream->has_newest = 1;
    stream->has_other = stream->others = stream->ended = stream->silent = 0;
    return BR_STATE_NEW;
}

int br_stream_forget(br_stream *stream, br_counters *counters) {
    const int waits = stream->has_other && stream->other.lockstep;
    stream->ended = stream->silent = 1;
    stream->has_other = 0;
    counters->interval_s = 0;
    return waits;
}
