/* A controller without Python, for one control problem, which is linked in.
 *
 *   bayesrace-controller DATA LINK [--rate HZ] [--budget SHARE] [--telemetry]
 *                        [--fifo PRIORITY] [--cpu N] [--lock-memory]
 *
 * DATA: folder of 'bayesrace export': racing line, weights, settings. LINK: see br_transport.h.
 * Ends with SIGINT or SIGTERM, or with standard input; then says what it has counted.
 */
#define _GNU_SOURCE /* sched_setaffinity */
#include <errno.h>
#include <math.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/prctl.h>

#include "br_host.h"

#define NAME "bayesrace-controller"

static br_host host; /* too large for a stack */

static void stop(int signal_number) {
    (void)signal_number;
    host.stopping = 1;
}

static int failed(const char *what, const char *why) {
    fprintf(stderr, NAME ": %s: %s\n", what, why);
    return 1;
}

/* --- options --- */

typedef struct {
    double rate_hz, fifo, cpu;
    int lock_memory;
} options;

typedef struct {
    const char *name;
    double *number, low, high; /* of an option with a number, or */
    int *flag;
    const char *meaning;
} option;

static int usage(const option *known, int count) {
    fprintf(stderr, "usage: " NAME " DATA LINK [option ...]\n"
                    "  DATA  folder that 'bayesrace export' has written\n"
                    "  LINK  udp:ADDRESS:PORT, unix:PATH or stdio\n");
    for (int i = 0; i < count; ++i)
        fprintf(stderr, "  %-14s %s\n", known[i].name, known[i].meaning);
    return 2;
}

/* The options behind the arguments; 0, or an exit code. */
static int read_options(int argc, char **argv, options *o) {
    const option known[] = {
        {"--rate", &o->rate_hz, 1, 500, NULL, "HZ: in real time, 1 to 500; default 50"},
        {"--budget", &host.budget, 0.05, 1, NULL, "SHARE: of the period for a cycle; default 0.8"},
        {"--telemetry", NULL, 0, 0, &host.telemetry, "send plan, residuals and timing as well"},
        {"--fifo", &o->fifo, 1, 99, NULL, "PRIORITY: by SCHED_FIFO"},
        {"--cpu", &o->cpu, 0, 1023, NULL, "N: run on that processor alone"},
        {"--lock-memory", NULL, 0, 0, &o->lock_memory, "lock the memory against paging"}};
    const int count = sizeof known / sizeof known[0];
    if (argc < 3) return usage(known, count);
    for (int i = 3; i < argc; ++i) {
        int k = 0;
        while (k < count && strcmp(known[k].name, argv[i])) ++k;
        if (k == count) {
            failed(argv[i], "no such option");
            return usage(known, count);
        }
        if (known[k].flag) {
            *known[k].flag = 1;
            continue;
        }
        char *end = NULL;
        const double value = i + 1 < argc ? strtod(argv[++i], &end) : -1;
        if (!end || end == argv[i] || *end || !(value >= known[k].low && value <= known[k].high)) {
            failed(known[k].name, known[k].meaning);
            return 2;
        }
        *known[k].number = value;
    }
    return 0;
}

/* --- the process --- */

/* What is refused is said, and the work goes on: most of it needs rights that few processes have.
 */
static void prepare_process(const options *o) {
    const struct sched_param priority = {.sched_priority = (int)o->fifo};
    cpu_set_t one;
    CPU_ZERO(&one);
    CPU_SET((size_t)fmax(o->cpu, 0), &one);
    prctl(PR_SET_TIMERSLACK, 1UL);
    if (o->cpu >= 0 && sched_setaffinity(0, sizeof one, &one)) failed("--cpu", strerror(errno));
    if (o->lock_memory && mlockall(MCL_CURRENT | MCL_FUTURE))
        failed("--lock-memory", strerror(errno));
    if (o->fifo > 0 && sched_setscheduler(0, SCHED_FIFO, &priority))
        failed("--fifo", strerror(errno));
}

static void report(void) {
    const br_timing *timing = &host.timing;
    const int64_t *levels = br_cycle_counters(host.cycle)->levels;
    fprintf(stderr,
            NAME ": states %lld, cycles %lld (solution %lld, shifted plan %lld, brake %lld, stop "
                 "%lld), skipped %lld, deadline misses %lld, overruns %lld, late states %lld, "
                 "datagrams refused %lld, unsent %lld\n",
            (long long)timing->taken, (long long)timing->ticks, (long long)levels[BR_SOLUTION],
            (long long)levels[BR_SHIFTED_PLAN], (long long)levels[BR_BRAKE],
            (long long)levels[BR_STOP], (long long)timing->skipped, (long long)timing->misses,
            (long long)timing->overruns, (long long)timing->late_states, (long long)timing->refused,
            (long long)host.link.unsent);
}

int main(int argc, char **argv) {
    char why[512];
    options o = {.rate_hz = 50, .cpu = -1};
    host.budget = 0.8;
    const int code = read_options(argc, argv, &o);
    if (code) return code;
    const struct sigaction ends = {.sa_handler = stop}; /* and waits are cut short */
    sigaction(SIGINT, &ends, NULL);
    sigaction(SIGTERM, &ends, NULL);
    if (br_host_open(&host, argv[1], argv[2], o.rate_hz, why, sizeof why)) {
        fprintf(stderr, NAME ": %s\n", why);
        return 1;
    }
    prepare_process(&o);
    fprintf(stderr, NAME ": ready at %s\n", argv[2]);
    br_host_serve(&host);
    br_link_close(&host.link);
    report();
    free(host.cycle);
    free(host.mpc);
    return 0;
}
