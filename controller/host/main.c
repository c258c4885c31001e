/* A controller without Python, for one control problem, which is linked in.
 *
 *   bayesrace-controller DATA LINK [--rate HZ] [--budget SHARE] [--telemetry]
 *                        [--key FILE] [--fifo PRIORITY] [--cpu N] [--lock-memory]
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
static br_seal seal;

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
    double rate_hz, budget, fifo, cpu;
    int telemetry, lock_memory;
    const char *key;
} options;

typedef struct {
    const char *name;
    double *number, low, high; /* of an option with a number, or */
    int *flag, whole;
    const char *meaning, **word;
} option;

static int usage(const option *known, int count) {
    fprintf(stderr, "usage: " NAME " DATA LINK [option ...]\n"
                    "  DATA  folder that 'bayesrace export' has written\n"
                    "  LINK  udp:ADDRESS:PORT, unix:PATH, serial:DEVICE[:BAUD] or stdio\n");
    for (int i = 0; i < count; ++i)
        fprintf(stderr, "  %-14s %s\n", known[i].name, known[i].meaning);
    return 2;
}

/* The number or word behind an option; 0, or -1 if it is none, or not within its limits. */
static int read_value(const option *of, const char *word) {
    char *end = NULL;
    if (of->word) return (*of->word = word) ? 0 : -1;
    const double value = word ? strtod(word, &end) : 0;
    if (!end || end == word || *end || !(value >= of->low && value <= of->high)) return -1;
    if (of->whole && value != floor(value)) return -1;
    *of->number = value;
    return 0;
}

/* The options behind the arguments; 0, or an exit code. */
static int read_options(int argc, char **argv, options *o) {
    const option known[] = {
        {"--rate", &o->rate_hz, 1, 500, NULL, 0, "HZ: in real time, 1 to 500; default 50", NULL},
        {"--budget", &o->budget, 0.05, 1, NULL, 0,
         "SHARE: of the period that a cycle may take, 0.05 to 1; default 0.8", NULL},
        {"--telemetry", NULL, 0, 0, &o->telemetry, 0, "send plan, residuals and timing as well",
         NULL},
        {"--key", NULL, 0, 0, NULL, 0, "FILE: datagrams are under this key", &o->key},
        {"--fifo", &o->fifo, 1, 99, NULL, 1, "PRIORITY: by SCHED_FIFO, 1 to 99", NULL},
        {"--cpu", &o->cpu, 0, CPU_SETSIZE - 1, NULL, 1, "N: run on that processor alone", NULL},
        {"--lock-memory", NULL, 0, 0, &o->lock_memory, 0, "lock the memory against paging", NULL}};
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
        } else if (read_value(&known[k], argv[++i])) { /* behind the last word is NULL */
            failed(known[k].name, known[k].meaning);
            return 2;
        }
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
    const br_counters *count = br_cycle_counters(host.cycle);
    const struct {
        const char *what;
        int64_t number;
    } counts[] = {
        {"states", timing->taken},
        {"stale", count->stale},
        {"of other runs", count->foreign},
        {"datagrams refused", timing->refused},
        {"from others", timing->from_others},
        {"commands", timing->commands},
        {"requests about weights", timing->updates},
        {"readings left out", timing->readings_left_out},
        {"cycles", timing->ticks},
        {"solution", count->levels[BR_SOLUTION]},
        {"shifted plan", count->levels[BR_SHIFTED_PLAN]},
        {"brake", count->levels[BR_BRAKE]},
        {"stop", count->levels[BR_STOP]},
        {"steps failed", count->failed},
        {"skipped", timing->skipped},
        {"deadline misses", timing->misses},
        {"overruns", timing->overruns},
        {"late states", timing->late_states},
        {"unsent", host.link.unsent},
        {"bad frames", host.link.bad_frames},
        {"forged", seal.forged},
        {"replayed", seal.replayed},
    };
    fprintf(stderr, NAME ":");
    for (size_t i = 0; i < sizeof counts / sizeof counts[0]; ++i)
        fprintf(stderr, "%s %s %lld", i ? "," : "", counts[i].what, (long long)counts[i].number);
    fprintf(stderr, "\n");
    if (count->failed) failed("last failed step", br_mpc_error_text((br_mpc_error)host.error));
}

int main(int argc, char **argv) {
    char why[512];
    options o = {.rate_hz = 50, .budget = 0.8, .cpu = -1};
    const int code = read_options(argc, argv, &o);
    if (code) return code;
    const struct sigaction ends = {.sa_handler = stop}; /* and waits are cut short */
    sigaction(SIGINT, &ends, NULL);
    sigaction(SIGTERM, &ends, NULL);
    signal(SIGPIPE, SIG_IGN); /* who no longer reads does not end it at once */
    if (o.key && br_seal_read(&seal, o.key, why, sizeof why)) return failed("--key", why);
    if (br_host_open(&host, argv[1], argv[2], o.rate_hz, why, sizeof why)) {
        fprintf(stderr, NAME ": %s\n", why);
        return 1;
    }
    host.budget = o.budget;
    host.telemetry = o.telemetry;
    if (o.key) host.link.seal = &seal;
    prepare_process(&o);
    fprintf(stderr, NAME ": ready at %s\n", argv[2]);
    br_host_serve(&host);
    report();
    br_host_close(&host);
    return 0;
}
