/* A car of one's own, driven by bayesrace-controller over UDP. See README.md.
 *
 *     make && ./plant harbour.csv 127.0.0.1 7450 [laps [realtime]]
 *
 * The same plant as python_plant.py, in one file and without libraries: the car is that of
 * bayesrace/cars/orca.toml. To bring your simulator, replace step().
 */
#define _POSIX_C_SOURCE 200809L
#include <arpa/inet.h>
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <time.h>

#define STATE_SCHEMA 3
#define PERIOD_S 0.02 /* of the controller */
#define STEP_S 0.001
#define PATIENCE_S 3.0 /* without an answer */
#define REPEAT_S 0.2   /* in lockstep, until an unanswered state is sent again */
#define OVERDUE 1.5    /* periods after which an input is not held any more */
#define ROWS 192       /* largest braking plan */
#define DELAYS 64      /* rows of actuation_delays that a state has room for */

/* An actuation or a braking plan: its fields by these names, and how many numbers each has. */
enum { EPOCH, RUN, STATE_SEQ, DECIDED_AT_S, BEGINS_S, STEP_OF_PLAN_S, U, D, DELTA, OTHER };
static const char *const NAMES[OTHER] = {"epoch",  "run", "state_seq", "decided_at_s", "begins_s",
                                         "step_s", "u",   "d",         "delta"};
typedef struct {
    double of[OTHER + 1][ROWS];
    int count[OTHER + 1];
} answer;

enum { NOTHING, ACTUATION, BRAKING };

static double x[7] = {[3] = 0.1}; /* x, y, psi, vx, vy, omega, delta */
static double u[2] = {-1e3, 0};   /* drive command, steering rate: it brakes until an answer */
static double applied[2];         /* sum of what acted in this period */
static double delays[3 * DELAYS]; /* of the answers in this period */
static double decided_s = -1, heard_s;
static answer plan;
static uint64_t epoch, seq;
static long steps, acted; /* since the start; in this period */
static int delays_count, lap, realtime, link_fd;
static double line_x, line_y, line_psi, reach;

static double clip(double value, double low, double high) { return fmin(fmax(value, low), high); }
static double time_s(void) { return (double)steps * STEP_S; }

static uint64_t clock_ns(clockid_t id) {
    struct timespec now;
    clock_gettime(id, &now);
    return (uint64_t)now.tv_sec * 1000000000u + (uint64_t)now.tv_nsec;
}
static double now_s(void) { return (double)clock_ns(CLOCK_MONOTONIC) * 1e-9; }

/* --- the car: dynamic single track, Pacejka tyres, DC motor; Runge-Kutta of order 4 --- */

static void rates(const double *at, double d, double rate, double *dx) {
    const double m = 0.041, lf = 0.029, lr = 0.033, inertia = 27.8e-6;
    const double psi = at[2], vx = at[3], vy = at[4], omega = at[5], delta = at[6];
    const double v = fmax(vx, 0.1); /* below, slip fades, so that a standing car stays */
    const double slip_front = delta - atan((vy + lf * omega) / v);
    const double slip_rear = atan((lr * omega - vy) / v);
    const double front = 0.192 * sin(1.2 * atan(2.579 * slip_front));
    const double rear = 0.1737 * sin(1.2691 * atan(3.3852 * slip_rear));
    const double rolling = 0.0518 * clip(vx / 0.02, -1, 1) + 0.00035 * vx * fabs(vx);
    const double force = (0.287 - 0.0545 * vx) * d - rolling;
    dx[0] = vx * cos(psi) - vy * sin(psi);
    dx[1] = vx * sin(psi) + vy * cos(psi);
    dx[2] = omega;
    dx[3] = (force - front * sin(delta) + m * vy * omega) / m;
    dx[4] = (rear + front * cos(delta) - m * vx * omega) / m;
    dx[5] = (front * lf * cos(delta) - rear * lr) / inertia;
    dx[6] = rate;
}

/* One step of time, by what the actuators make of the command. */
static void step(double d, double rate) {
    static const double share[4] = {0, STEP_S / 2, STEP_S / 2, STEP_S};
    double k[4][7], at[7];
    d = clip(d, -0.1 * clip(x[3] / 0.1, 0, 1), 1); /* brakes do not reverse */
    rate = (clip(x[6] + STEP_S * clip(rate, -5, 5), -0.35, 0.35) - x[6]) / STEP_S;
    for (int j = 0; j < 4; ++j) {
        for (int i = 0; i < 7; ++i) at[i] = j ? x[i] + share[j] * k[j - 1][i] : x[i];
        rates(at, d, rate, k[j]);
    }
    for (int i = 0; i < 7; ++i)
        x[i] += STEP_S / 6 * (k[0][i] + 2 * k[1][i] + 2 * k[2][i] + k[3][i]);
    applied[0] += d, applied[1] += rate;
    ++acted, ++steps;
}

/* --- MessagePack, in the forms that the controller writes: states out, answers in --- */

static uint8_t buffer[65536];
static size_t size, cursor;

static void put(uint8_t tag, uint64_t bits, int bytes) { /* a tag and a number, big-endian */
    buffer[size++] = tag;
    while (bytes--) buffer[size++] = (uint8_t)(bits >> 8 * bytes);
}
static void put_text(const char *text) { /* of less than 32 characters */
    const size_t length = strlen(text);
    put((uint8_t)(0xa0 | length), 0, 0);
    memcpy(buffer + size, text, length);
    size += length;
}
static void put_whole(const char *name, uint64_t value) { put_text(name), put(0xcf, value, 8); }
static void put_flag(const char *name, int value) {
    put_text(name), put(value ? 0xc3 : 0xc2, 0, 0);
}
static void put_real(double value) {
    uint64_t bits;
    memcpy(&bits, &value, sizeof bits);
    put(0xcb, bits, 8);
}
static void put_reals(const char *name, const double *values, int length) {
    put_text(name), put(0xdc, (uint64_t)length, 2);
    for (int i = 0; i < length; ++i) put_real(values[i]);
}

static uint64_t get(int bytes) { /* past the end: zeros */
    uint64_t bits = 0;
    for (; bytes; --bytes, ++cursor) bits = bits << 8 | (cursor < size ? buffer[cursor] : 0);
    return bits;
}

/* Of a text, array or map, by the tags of a short and of a longer one; -1: it is none. */
static int get_count(unsigned tag, unsigned few, unsigned most_few, unsigned more) {
    if (tag >= few && tag <= few + most_few) return (int)(tag - few);
    return tag == more ? (int)get(2) : -1;
}

static int get_text(char text[32]) {
    const int length = get_count((unsigned)get(1), 0xa0, 31, 0xda);
    if (length < 0 || length > 31 || cursor + (size_t)length > size) return 0;
    memcpy(text, buffer + cursor, (size_t)length);
    text[length] = 0;
    cursor += (size_t)length;
    return 1;
}

static int get_number(unsigned tag, double *to) {
    const uint64_t bits = tag < 0x80 ? tag : get(8);
    if (tag == 0xcb)
        memcpy(to, &bits, sizeof bits);
    else
        *to = (double)(int64_t)bits;
    return (tag < 0x80 || tag == 0xcb || tag == 0xd3) && isfinite(*to);
}

/* A number, numbers or a text, which is skipped; how many numbers, -1: it is something else. */
static int get_numbers(double *to) {
    const unsigned tag = (unsigned)get(1);
    const int text = get_count(tag, 0xa0, 31, 0xda);
    if (text >= 0) return cursor += (size_t)text, 0;
    const int count = get_count(tag, 0x90, 15, 0xdc);
    if (count < 0) return get_number(tag, to) ? 1 : -1;
    for (int i = 0; i < count; ++i)
        if (i == ROWS || !get_number((unsigned)get(1), &to[i])) return -1;
    return count;
}

/* What the datagram in the buffer is; NOTHING if it is not for this run. */
static int read_answer(answer *to) {
    char text[32];
    memset(to, 0, sizeof *to);
    cursor = 0;
    if (get(1) != 0x92 || !get_text(text)) return NOTHING;
    const int topic = !strcmp(text, "actuation") ? ACTUATION
                      : !strcmp(text, "braking") ? BRAKING
                                                 : NOTHING;
    const int fields = topic ? get_count((unsigned)get(1), 0x80, 15, 0xde) : 0;
    for (int k = 0, i; k < fields; ++k) {
        if (!get_text(text)) return NOTHING;
        for (i = 0; i < OTHER && strcmp(text, NAMES[i]);) ++i;
        if ((to->count[i] = get_numbers(to->of[i])) < 0 || cursor > size) return NOTHING;
    }
    if (to->of[EPOCH][0] != (double)epoch || to->of[RUN][0] != 1) return NOTHING;
    const int whole = topic == ACTUATION
                          ? to->count[U] == 2 && to->count[STATE_SEQ] == 1
                          : to->of[STEP_OF_PLAN_S][0] > 0 && to->count[D] == to->count[DELTA];
    return whole ? topic : NOTHING;
}

/* --- the link --- */

static void send_state(int final) {
    const double mean[2] = {applied[0] / (double)(acted ? acted : 1),
                            applied[1] / (double)(acted ? acted : 1)};
    size = 0;
    put(0x92, 0, 0), put_text("state"), put(0x8e, 0, 0); /* 14 fields, schema first */
    put_whole("schema", STATE_SCHEMA), put_whole("seq", seq);
    put_whole("source_time_ns", clock_ns(CLOCK_MONOTONIC));
    put_whole("epoch", epoch), put_whole("run", 1);
    put_text("time_s"), put_real((double)seq * PERIOD_S);
    put_reals("x", x, 7), put_reals("u_applied", mean, 2);
    put_text("lap"), put(0xd2, (uint32_t)lap, 4);
    put_flag("estimated", 0), put_reals("readings", NULL, 0);
    put_flag("lockstep", !realtime), put_reals("actuation_delays", delays, delays_count);
    put_flag("final", final);
    (void)!send(link_fd, buffer, size, 0); /* perhaps nobody listens yet, or any more */
}

/* The next datagram, waited for so long. */
static int receive(double wait_s, answer *to) {
    struct timeval wait = {(time_t)wait_s, (suseconds_t)(fmod(wait_s, 1) * 1e6)};
    fd_set link;
    FD_ZERO(&link);
    FD_SET(link_fd, &link);
    if (select(link_fd + 1, &link, NULL, NULL, &wait) <= 0) return NOTHING;
    const ssize_t got = recv(link_fd, buffer, sizeof buffer, 0);
    size = got < 0 ? 0 : (size_t)got; /* an error: nobody listens */
    return read_answer(to);
}

/* The input that acts now. Whoever notices silence first brakes: here by the braking plan that the
 * controller has sent ahead, and fully where that ends. */
static void command(double *d, double *rate) {
    *d = u[0], *rate = u[1];
    if (!realtime || time_s() - heard_s <= OVERDUE * PERIOD_S) return;
    *d = -1e3, *rate = 0;
    const double step_s = plan.of[STEP_OF_PLAN_S][0], into_s = time_s() - plan.of[BEGINS_S][0];
    const double row = floor(into_s / step_s);
    if (!(row >= -1 && row < plan.count[D])) return; /* it is over; NaN: there is none */
    const int i = row < 0 ? 0 : (int)row;
    const double left_s = fmax((i + 1) * step_s - into_s, STEP_S);
    *d = plan.of[D][i], *rate = (plan.of[DELTA][i] - x[6]) / left_s;
}

static void advance(double to_s) { /* drives the car */
    for (double d, rate; ((double)steps + 0.5) * STEP_S < to_s; step(d, rate)) command(&d, &rate);
}

/* Lockstep: the input that answers the newest state, which is repeated until then. */
static int await_answer(void) {
    const double begin = now_s();
    double sent = begin;
    answer came;
    for (double now; (now = now_s()) - begin < PATIENCE_S;) {
        if (now - sent > REPEAT_S) send_state(0), sent = now;
        if (receive(REPEAT_S, &came) == ACTUATION && came.of[STATE_SEQ][0] == (double)seq) {
            memcpy(u, came.of[U], sizeof u);
            heard_s = time_s();
            return 1;
        }
    }
    return 0;
}

/* Whether it answers a state of ours later than the input at hand. One of the future would never
 * grow old, and all that follow would count as overtaken. */
static int is_new(const answer *came) {
    const double decided = came->of[DECIDED_AT_S][0], state = came->of[STATE_SEQ][0];
    if (!(state >= 0 && state <= (double)seq)) return 0;
    return decided > decided_s && decided <= (double)(seq + 2) * PERIOD_S;
}

/* Real time: what comes until the end of the period acts as soon as it has come. */
static void listen_until(double start, double end_s) {
    answer came;
    for (double left_s; (left_s = start + end_s - now_s()) > 0;) {
        const int topic = receive(left_s, &came);
        if (topic == BRAKING) plan = came;
        if (topic != ACTUATION || !is_new(&came)) continue;
        const double now = now_s() - start;
        advance(fmin(now, end_s));
        memcpy(u, came.of[U], sizeof u);
        decided_s = came.of[DECIDED_AT_S][0], heard_s = time_s();
        if (delays_count == 3 * DELAYS) continue;
        delays[delays_count++] = came.of[STATE_SEQ][0];
        delays[delays_count++] = now - came.of[STATE_SEQ][0] * PERIOD_S;
        delays[delays_count++] = heard_s - decided_s;
    }
}

/* --- the start line, the first row of the track's file --- */

static int read_line(const char *file) {
    double row[4] = {0}, first[4] = {0}, second[4] = {0};
    char text[256];
    int rows = 0;
    FILE *track = fopen(file, "r");
    if (!track) return 0;
    while (fgets(text, sizeof text, track)) {
        if (sscanf(text, "%lf,%lf,%lf,%lf", row, row + 1, row + 2, row + 3) != 4) continue;
        if (rows < 2) memcpy(rows ? second : first, row, sizeof row);
        ++rows;
    }
    fclose(track);
    line_x = x[0] = first[0], line_y = x[1] = first[1];
    line_psi = x[2] = atan2(second[1] - row[1], second[0] - row[0]);
    reach = 1.5 * fmax(first[2], first[3]);
    return rows > 2;
}

static double past(double at_x, double at_y) {
    return (at_x - line_x) * cos(line_psi) + (at_y - line_y) * sin(line_psi);
}

/* Whether a lap is done, by the way of the newest period, and when the line was crossed. */
static int lap_done(const double before[2], int done, double *at_s) {
    const double s0 = past(before[0], before[1]), s1 = past(x[0], x[1]);
    const double n1 = (x[1] - line_y) * cos(line_psi) - (x[0] - line_x) * sin(line_psi);
    if ((s0 < 0) != (s1 < 0) && fabs(n1) <= reach) lap += s1 >= 0 ? 1 : -1;
    *at_s = (double)(seq - 1) * PERIOD_S + s0 / (s0 - s1) * PERIOD_S;
    return lap > done;
}

/* Drives so many laps; NULL, or why there were fewer. */
static const char *drive(int laps) {
    const double start = now_s();
    double done_s = 0, at_s;
    for (int done = 0; lap < laps;) {
        const double before[2] = {x[0], x[1]}, end_s = (double)(seq + 1) * PERIOD_S;
        send_state(0);
        if (!realtime && !await_answer()) return "no answer";
        applied[0] = applied[1] = 0, acted = 0, delays_count = 0; /* a new period begins */
        if (realtime) listen_until(start, end_s);
        advance(end_s);
        ++seq;
        if (lap_done(before, done, &at_s)) {
            printf("lap %d: %.9f s\n", ++done, at_s - done_s), fflush(stdout);
            done_s = at_s;
        }
        if (fabs(x[3]) < 0.02 && time_s() - heard_s > PATIENCE_S)
            return "no answer; the car stands";
    }
    return NULL;
}

int main(int argc, char **argv) {
    struct sockaddr_in there = {.sin_family = AF_INET};
    if (argc < 4 || inet_pton(AF_INET, argv[2], &there.sin_addr) != 1 || !read_line(argv[1]))
        return fputs("plant TRACK.csv ADDRESS PORT [LAPS [realtime]]\n", stderr), 2;
    there.sin_port = htons((uint16_t)atoi(argv[3]));
    realtime = argc > 5;
    link_fd = socket(AF_INET, SOCK_DGRAM, 0);
    if (connect(link_fd, (struct sockaddr *)&there, sizeof there)) return perror("plant"), 1;
    epoch = clock_ns(CLOCK_REALTIME) / 1000;
    const char *why = drive(argc > 4 ? atoi(argv[4]) : 2);
    send_state(1); /* final: the controller is free for another plant */
    if (why) fprintf(stderr, "%s\n", why);
    return why != NULL;
}
