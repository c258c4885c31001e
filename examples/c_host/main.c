/* The whole controller in a C program: states in, inputs out, no Python.
 *
 *   c_host DATA < states > inputs            answers the states of a file, one line each
 *   c_host DATA --udp PORT [--rate HZ]       answers datagrams, one line each, to their sender
 *
 * DATA: folder that 'bayesrace export' has written. A state is a line of
 *
 *   epoch run seq time_s lockstep final x y psi vx vy omega delta d delta_rate [delay_s ...]
 *
 * of which x to delta are not read where readings of instruments follow, or a lone ';' for none:
 *
 *   ... ; instrument time_s state value deviation [state value deviation ...] [; ...]
 *
 * with instruments and states (0 x to 6 delta) by number. Its answer is the line
 * 'epoch run seq decided_at_s d delta_rate status level': 17 digits carry every double. Over UDP
 * the car of a free-running plant also has an input when no state arrives: the controller predicts,
 * then falls back, at its own rate, and gives up after a second of silence.
 */
#include <arpa/inet.h>
#include <errno.h>
#include <math.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>

#include "br_files.h"

#define LINE 8192
#define SILENT_S 1.0
#define SHARE 0.8 /* of the period that a cycle may take */

typedef struct {
    br_mpc *mpc;
    br_cycle *cycle;
    double period_s, arrived_s; /* of the newest state, by the host's clock */
    br_measured newest;
    int driving;
} host;

static int failed(const char *what, const char *why) {
    fprintf(stderr, "c_host: %s: %s\n", what, why);
    return -1;
}

/* A block of memory as the controller wants it. */
static void *block(size_t size) { return aligned_alloc(64, (size + 63) / 64 * 64); }

static int set_up(host *h, const char *data) {
    char text[256];
    if (br_mpc_abi() != BR_ABI) return failed("library", "not that of the headers: build anew");
    br_mpc_parameters parameters;
    br_driving driving;
    br_estimation estimation;
    br_mpc_error error = br_mpc_init(block(br_mpc_memory_size()), br_mpc_memory_size(), &h->mpc);
    if (error) return failed("controller", br_mpc_error_text(error));
    if (br_files_load(h->mpc, data, BR_MODEL_IDENTITY, text, sizeof text) ||
        br_files_settings(data, &parameters, &driving, &estimation, text, sizeof text))
        return failed(data, text);
    const size_t size = br_cycle_memory_size();
    error = br_mpc_set_parameters(h->mpc, &parameters);
    if (!error) error = br_cycle_drive_mpc(block(size), size, h->mpc, 0, &h->cycle);
    if (!error) error = br_cycle_set_driving(h->cycle, &driving);
    if (!error) error = br_cycle_set_estimation(h->cycle, NULL, &estimation);
    if (error) return failed(data, br_mpc_error_text(error));
    br_cycle_set_clock(h->cycle, br_mpc_monotonic, NULL);
    return 0;
}

/* One reading, from behind its semicolon on: where it ends; NULL if it is none. */
static const char *read_measurement(const char *at, br_measurement *m) {
    char *end;
    m->instrument = (int)strtol(at, &end, 10);
    m->time_s = strtod(at = end, &end);
    if (end == at) return NULL;
    for (m->count = 0; m->count < BR_NX; ++m->count) {
        m->of[m->count] = (int)strtol(at = end, &end, 10);
        if (end == at) break;
        m->value[m->count] = strtod(end, &end);
        m->deviation[m->count] = strtod(at = end, &end);
        if (end == at) return NULL;
    }
    return m->count ? end : NULL;
}

/* What has been measured; -1 if it is no such list. */
static int read_measurements(const char *at, br_measured *state) {
    while (*(at += strspn(at, " \t\r\n")) == ';') {
        state->estimated = 1;
        at += 1 + strspn(at + 1, " \t\r\n");
        if (!*at) return 0;
        if (state->measurements == BR_MEASUREMENTS) return -1;
        at = read_measurement(at, &state->measured[state->measurements++]);
        if (!at) return -1;
    }
    return 0;
}

/* The state of a line; -1 if it is none. */
static int read_state(const char *line, br_measured *state, int *final) {
    double numbers[3 + BR_NX + BR_NU]; /* time_s, lockstep, final, the state, the input */
    const int count = sizeof numbers / sizeof numbers[0];
    const char *at = line;
    char *end;
    memset(state, 0, sizeof *state);
    state->epoch = strtoll(at, &end, 10);
    state->run = strtoll(end, &end, 10);
    state->seq = strtoll(end, &end, 10);
    for (int i = 0; i < count; ++i) {
        at = end;
        numbers[i] = strtod(at, &end);
        if (end == at) return -1;
    }
    state->time_s = numbers[0];
    state->lockstep = numbers[1] != 0;
    *final = numbers[2] != 0;
    memcpy(state->x, numbers + 3, sizeof state->x);
    memcpy(state->u_applied, numbers + 3 + BR_NX, sizeof state->u_applied);
    state->averaged = 1;
    for (at = end; state->delays < BR_DELAYS; at = end) {
        const double delay_s = strtod(at, &end);
        if (end == at) break;
        state->delays_s[state->delays++] = delay_s;
    }
    return read_measurements(at, state);
}

static int write_decision(char *line, size_t size, const br_decision *d) {
    return snprintf(line, size, "%lld %lld %lld %.17g %.17g %.17g %d %d\n", (long long)d->epoch,
                    (long long)d->run, (long long)d->seq, d->decided_at_s, d->u[0], d->u[1],
                    d->status, d->level);
}

/* Takes a line; the length of the answer, 0 if there is none to be given, -1 if it is no state. */
static int answer(host *h, const char *line, char *out, size_t size) {
    const double arrived_s = br_mpc_monotonic(NULL);
    br_measured state;
    br_decision decision;
    int final;
    if (read_state(line, &state, &final)) return -1;
    if (br_cycle_observe(h->cycle, &state) != BR_STATE_NEW) return 0;
    h->newest = state;
    h->driving = !state.lockstep && !final;
    h->arrived_s = arrived_s;
    if (final) br_cycle_end(h->cycle);
    const double budget_s = state.lockstep ? 0 : SHARE * h->period_s;
    const double now_s = br_cycle_counters(h->cycle)->time_s;
    if (final || br_cycle_decide(h->cycle, NULL, now_s, budget_s, 0, &decision)) return 0;
    return write_decision(out, size, &decision);
}

/* Once an answer is sent: the preparation of the next one. */
static void prepare(host *h) {
    const double interval_s = br_cycle_counters(h->cycle)->interval_s;
    br_cycle_prepare(h->cycle, interval_s, h->newest.lockstep ? 0 : (1 - SHARE) * interval_s);
}

static int serve_file(host *h) {
    char line[LINE], out[LINE];
    while (fgets(line, sizeof line, stdin)) {
        const int length = answer(h, line, out, sizeof out);
        if (length < 0) return failed("no state", line);
        if (!length) continue;
        fputs(out, stdout);
        prepare(h);
    }
    return fflush(stdout) ? failed("stdout", strerror(errno)) : 0;
}

/* No state within a period: the input for the car that drives on. */
static int bridge(host *h, char *out, size_t size) {
    const double since_s = br_mpc_monotonic(NULL) - h->arrived_s;
    br_decision decision;
    if (since_s > SILENT_S) {
        h->driving = 0;
        br_cycle_forget(h->cycle);
    }
    if (!h->driving) return 0;
    const double decided_at_s = br_cycle_counters(h->cycle)->time_s + since_s;
    if (br_cycle_decide(h->cycle, NULL, decided_at_s, SHARE * h->period_s, 0, &decision)) return 0;
    return write_decision(out, size, &decision);
}

/* Whether a datagram is there before the host's clock says due_s; -1: an error. */
static int wait_until(int in, double due_s) {
    struct pollfd one = {.fd = in, .events = POLLIN};
    const double left_s = fmax(due_s - br_mpc_monotonic(NULL), 0);
    const int ready = poll(&one, 1, (int)ceil(1e3 * left_s));
    return ready < 0 && errno != EINTR ? -1 : ready > 0;
}

static int open_socket(int port) {
    struct sockaddr_in here = {.sin_family = AF_INET, .sin_port = htons((uint16_t)port)};
    here.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    const int in = socket(AF_INET, SOCK_DGRAM, 0);
    return in < 0 || bind(in, (struct sockaddr *)&here, sizeof here) ? -1 : in;
}

static int serve_udp(host *h, int port) {
    const int in = open_socket(port);
    if (in < 0) return failed("UDP", strerror(errno));
    fprintf(stderr, "c_host: listening on port %d\n", port);
    struct sockaddr_in plant = {0}; /* whose state counts */
    double due_s = 0;               /* of the next input if no state comes */
    for (;;) {
        char line[LINE], out[LINE];
        const int ready = wait_until(in, due_s);
        if (ready < 0) return failed("UDP", strerror(errno));
        int length = 0;
        if (ready) {
            struct sockaddr_in from;
            socklen_t size = sizeof from;
            const ssize_t got =
                recvfrom(in, line, sizeof line - 1, 0, (struct sockaddr *)&from, &size);
            line[got > 0 ? got : 0] = 0;
            length =
                answer(h, line, out, sizeof out); /* anyone may send anything: not all counts */
            if (length > 0) plant = from;
        }
        const int bridged = length <= 0 && br_mpc_monotonic(NULL) >= due_s;
        if (bridged) length = bridge(h, out, sizeof out);
        if (length > 0 || bridged) due_s = br_mpc_monotonic(NULL) + h->period_s;
        if (length <= 0) continue;
        sendto(in, out, (size_t)length, 0, (struct sockaddr *)&plant, sizeof plant);
        if (!bridged) prepare(h);
    }
}

int main(int argc, char **argv) {
    host h = {.period_s = 0.02};
    int port = 0;
    for (int i = 2; i + 1 < argc; i += 2) {
        if (!strcmp(argv[i], "--udp"))
            port = atoi(argv[i + 1]);
        else if (!strcmp(argv[i], "--rate"))
            h.period_s = 1 / atof(argv[i + 1]);
        else
            argc = 0;
    }
    if (argc < 2 || argc % 2 || !(h.period_s > 1e-4 && h.period_s < 1)) {
        fprintf(stderr, "usage: c_host DATA [--udp PORT] [--rate HZ]\n");
        return 2;
    }
    const int failure = set_up(&h, argv[1]) || (port ? serve_udp(&h, port) : serve_file(&h));
    free(h.cycle);
    free(h.mpc);
    return failure;
}
