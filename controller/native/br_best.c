/* The best plan of several iterations: one that fails later does not take it back. */
#include "br_internal.h"

static void note(const br_mpc *mpc, br_best *best, br_mpc_status status) {
    best->plan = mpc->plan;
    best->info = mpc->info;
    best->status = status;
    best->residual = br_residual(mpc);
    best->worth = mpc->worth;
}

static void put_back(br_mpc *mpc, const br_best *best) {
    mpc->plan = best->plan;
    mpc->linearised = mpc->qp.factorised = mpc->qp.evaluated = 0;
    mpc->info.stationarity = best->info.stationarity;
    mpc->info.defect = best->info.defect;
    mpc->info.bound = best->info.bound;
    mpc->info.cost = best->info.cost;
    mpc->info.slack_max_m = best->info.slack_max_m;
    mpc->worth = best->worth;
}

void br_best_begin(br_mpc *mpc) { mpc->best.status = BR_NOT_FINITE; }

/* Keeps the plan, whose residuals are in info. lowest: only if it is better than the one kept. Else
 * the latest usable one, which is how iterations without a budget have always ended. */
void br_best_keep(br_mpc *mpc, br_mpc_status status, int lowest) {
    br_best *best = &mpc->best;
    if (lowest ? status > BR_DEFECT : !br_usable(status)) return;
    const double residual = br_residual(mpc);
    if (lowest && (status > best->status || (status == best->status && !(residual < best->residual))))
        return;
    note(mpc, best, status);
}

/* Puts the best plan and its residuals back. Returns its status, or the given one if it is not
 * usable either. */
br_mpc_status br_best_restore(br_mpc *mpc, br_mpc_status status) {
    const br_best *best = &mpc->best;
    if (best->status > BR_DEFECT) return status;
    if (best->info.iterations != mpc->info.iterations) put_back(mpc, best); /* else it is at hand */
    return br_usable(best->status) ? best->status : status;
}

/* Keeps the plan at hand as the one that another start has to beat. */
void br_first_keep(br_mpc *mpc, br_mpc_status status) { note(mpc, &mpc->first, status); }

/* Leaves the better one of that plan and the one at hand: the usable one, or the one of less cost.
 * Returns its status; *second: whether it is the one at hand. */
br_mpc_status br_first_compare(br_mpc *mpc, br_mpc_status status, int *second) {
    const br_best *first = &mpc->first;
    *second = br_usable(status) && (!br_usable(first->status) || mpc->worth < first->worth);
    if (*second) return status;
    put_back(mpc, first);
    return first->status;
}
