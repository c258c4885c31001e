/* The least program that drives by a controller, so that the linker says what it takes of a board's
 * memory. Line, weights and settings are in flash, wherever that is, and not counted. */
#include "bayesrace_cycle.h"
#include "bayesrace_memory.h"

typedef struct {
    br_mpc_parameters parameters;
    br_driving driving;
    br_estimation estimation;
    br_mpc_gp weights[BR_NE];
    const double *path;
    int rows;
    double spacing_m;
} files;

static const files *volatile in_flash;
static volatile double seconds;
static volatile int driving;

static _Alignas(64) unsigned char controller[BR_MPC_BYTES], whole_cycle[BR_CYCLE_BYTES];
static br_measured state;
static br_decision decision;
static br_braking braking;

static double now(void *context) {
    (void)context;
    return seconds;
}

int main(void) {
    const files *given = in_flash;
    br_mpc *mpc;
    br_cycle *cycle;
    br_mpc_init(controller, sizeof controller, &mpc);
    br_mpc_set_parameters(mpc, &given->parameters);
    br_mpc_set_path(mpc, given->path, given->rows, given->spacing_m);
    br_mpc_set_weights(mpc, given->weights);
    br_cycle_drive_mpc(whole_cycle, sizeof whole_cycle, mpc, 0, &cycle);
    br_cycle_set_driving(cycle, &given->driving);
    br_cycle_set_estimation(cycle, NULL, &given->estimation);
    br_cycle_set_clock(cycle, now, NULL);
    while (driving) {
        br_cycle_observe(cycle, &state);
        br_cycle_decide(cycle, NULL, seconds, 0.016, 0, &decision);
        br_cycle_brake(cycle, &braking);
        br_cycle_prepare(cycle, 0.02, 0.016);
        if (driving > 1) br_cycle_stop(cycle);
    }
    return 0;
}
