/* Delay compensation: the state at the moment from which the new input will act.
 *
 * The plant reports, in its own time, how long after the decision on it each input began to act;
 * the median of the newest delays is the delay. The input decided at plant time t acts from t +
 * delay on. Until then the inputs that were sent before act, each from its own decision plus the
 * delay on; the corrected model carries the state through them. No clocks have to agree. */
#include <math.h>
#include <string.h>

#include "br_cycle.h"

/* The lower median. */
static double median(const double *values, int n) {
    double ordered[BR_MEDIAN_OF];
    for (int i = 0; i < n; ++i) {
        int k = i;
        for (; k > 0 && ordered[k - 1] > values[i]; --k) ordered[k] = ordered[k - 1];
        ordered[k] = values[i];
    }
    return ordered[(n - 1) / 2];
}

void br_delay_observe(br_delay *delay, const br_driving *settings, const br_measured *state,
                      double *delay_s) {
    if (settings->compensation != BR_COMPENSATION_MEASURED) return;
    int some = 0;
    for (int i = 0; i < state->delays && i < BR_DELAYS; ++i) {
        if (!(state->delays_s[i] >= 0)) continue; /* overtaken: it never acts */
        delay->delays_s[delay->next_delay] = state->delays_s[i];
        delay->next_delay = (delay->next_delay + 1) % BR_MEDIAN_OF;
        if (delay->delays < BR_MEDIAN_OF) delay->delays += 1;
        some = 1;
    }
    if (some) *delay_s = fmin(median(delay->delays_s, delay->delays), settings->longest_s);
}

static br_sent *sent(br_delay *delay, int i) { return &delay->sent[(delay->first + i) % BR_SENT]; }

static void drop_first(br_delay *delay) {
    delay->first = (delay->first + 1) % BR_SENT;
    delay->count -= 1;
}

void br_delay_sent(br_delay *delay, double decided_at_s, const double u[BR_NU]) {
    if (delay->count == BR_SENT) drop_first(delay);
    br_sent *one = sent(delay, delay->count++);
    one->decided_at_s = decided_at_s;
    memcpy(one->u, u, sizeof one->u);
}

/* x and u when an input decided at that plant time begins to act; -1 if the model cannot follow. */
int br_delay_at_acting(br_delay *delay, const br_driving *settings, const br_controller *controller,
                       const br_measured *state, double decided_at_s, double delay_s,
                       double x[BR_NX], double u[BR_NU]) {
    double now_s = state->time_s;
    const double end_s = fmin(decided_at_s + delay_s, now_s + settings->longest_s);
    memcpy(x, state->x, sizeof state->x);
    memcpy(u, state->u_applied, sizeof state->u_applied);
    if (settings->compensation == BR_COMPENSATION_OFF) return 0;
    while (delay->count > 1 && sent(delay, 1)->decided_at_s + delay_s <= now_s)
        drop_first(delay); /* has stopped acting */
    for (int i = 0; i < delay->count; ++i) {
        const br_sent *one = sent(delay, i);
        const double from_s = one->decided_at_s + delay_s;
        if (from_s >= end_s) break;
        if (from_s > now_s) {
            if (controller->predict(controller->self, x, u, from_s - now_s, x)) return -1;
            now_s = from_s;
        }
        memcpy(u, one->u, sizeof one->u);
    }
    if (end_s <= now_s) return 0;
    return controller->predict(controller->self, x, u, end_s - now_s, x) ? -1 : 0;
}
