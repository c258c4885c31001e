/* Firmware that drives a recorded drive over again, as an autopilot would drive the car.
 *
 * Under QEMU it reads the files of 'bayesrace export' and the states of states.py from the folder
 * in which it is started, by semihosting. On a board the files lie in flash (br_mpc_set_path and
 * br_mpc_set_weights take arrays), a state comes from the link and the input goes to it, each where
 * this reads and prints; br_cycle_decide and br_cycle_prepare get a budget, and br_cycle_brake says
 * what the actuator board does if no more comes.
 *
 * Prints a line for each state: status, fallback level, inputs, and how long the decision and the
 * preparation have taken by the board's clock [us]; then how deep the stack has been.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "bayesrace_cycle.h"
#include "bayesrace_memory.h"
#include "board.h"
#include "br_files.h"

static _Alignas(64) unsigned char mpc_memory[BR_MPC_BYTES], cycle_memory[BR_CYCLE_BYTES];

static double seconds(void *context) {
    (void)context;
    return board_seconds();
}

static int failed(const char *what) {
    printf("failed: %s\n", what);
    return EXIT_FAILURE;
}

/* The controller, by the files of the folder; what is wrong with them, or NULL. */
static const char *begin(br_cycle **cycle) {
    static char text[256];
    static br_settings settings;
    br_mpc *mpc;
    br_mpc_error error = br_mpc_init(mpc_memory, sizeof mpc_memory, &mpc);
    if (error) return br_mpc_error_text(error);
    if (br_files_settings(".", &settings, text, sizeof text)) return text;
    error = br_mpc_set_parameters(mpc, &settings.parameters);
    if (error) return br_mpc_error_text(error);
    if (br_files_load(mpc, ".", BR_MODEL_IDENTITY, NULL, text, sizeof text)) return text;
    error = br_cycle_drive_mpc(cycle_memory, sizeof cycle_memory, mpc, 0, cycle);
    if (!error) error = br_cycle_set_driving(*cycle, &settings.driving);
    if (!error && BR_HAS_ESTIMATOR)
        error = br_cycle_set_estimation(*cycle, NULL, &settings.with_weights);
    if (!error) error = br_cycle_set_clock(*cycle, seconds, NULL);
    return error ? br_mpc_error_text(error) : NULL;
}

static int read_numbers(FILE *from, double *numbers, int count) {
    for (int i = 0; i < count; ++i)
        if (fscanf(from, "%lf", &numbers[i]) != 1) return 0;
    return 1;
}

/* The next state of the drive; 0 behind the last. */
static int next(FILE *drive, br_measured *state) {
    double count;
    state->epoch = state->run = 1;
    state->seq += 1;
    state->averaged = state->lockstep = 1;
    if (!read_numbers(drive, &state->time_s, 1) || !read_numbers(drive, state->x, BR_NX) ||
        !read_numbers(drive, state->u_applied, BR_NU) || !read_numbers(drive, &count, 1))
        return 0;
    state->delays = (int)count;
    return state->delays <= BR_DELAYS && read_numbers(drive, state->delays_s, state->delays);
}

/* One control cycle. */
static void answer(br_cycle *cycle, const br_measured *state) {
    static br_decision decision;
    const br_counters *counters = br_cycle_counters(cycle);
    br_cycle_observe(cycle, state);
    const double begun_s = board_seconds();
    br_cycle_decide(cycle, NULL, counters->time_s, 0, 0, &decision);
    const double decided_s = board_seconds();
    br_cycle_prepare(cycle, counters->interval_s, 0);
    const double prepared_s = board_seconds();
    printf("%d %d", decision.status, decision.level);
    for (int i = 0; i < BR_NU; ++i) printf(" %.17g", decision.u[i]);
    printf(" %.1f %.1f\n", 1e6 * (decided_s - begun_s), 1e6 * (prepared_s - decided_s));
}

int main(void) {
    static br_measured state;
    br_cycle *cycle;
    const char *wrong = begin(&cycle);
    if (wrong) return failed(wrong);
    FILE *drive = fopen("drive.txt", "r");
    if (!drive) return failed("drive.txt is missing: write it with states.py");
    while (next(drive, &state)) answer(cycle, &state);
    printf("stack %u\n", board_stack());
    return EXIT_SUCCESS;
}
