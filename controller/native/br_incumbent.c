/* The incumbent: the best plan of several iterations, which is returned although a later one fails;
 * and the comparison of the plans from two starts. */
#include "br_internal.h"

static void note(const br_mpc *mpc, br_incumbent *incumbent, br_mpc_status status) {
    incumbent->plan = mpc->plan;
    incumbent->info = mpc->info;
    incumbent->status = status;
    incumbent->residual = br_residual(mpc);
    incumbent->worth = mpc->worth;
}

static void put_back(br_mpc *mpc, const br_incumbent *incumbent) {
    mpc->plan = incumbent->plan;
    br_invalidate(mpc, BR_LINEARISATION);
    mpc->info.stationarity = incumbent->info.stationarity;
    mpc->info.defect = incumbent->info.defect;
    mpc->info.bound = incumbent->info.bound;
    mpc->info.cost = incumbent->info.cost;
    mpc->info.slack_max_m = incumbent->info.slack_max_m;
    mpc->worth = incumbent->worth;
}

void br_incumbent_reset(br_mpc *mpc) { mpc->incumbent.status = BR_NOT_FINITE; }

/* Keeps the plan, whose residuals are in info. lowest: only if it is better than the one kept. Else
 * the latest usable one, which is how iterations without a budget have always ended. */
void br_incumbent_keep(br_mpc *mpc, br_mpc_status status, int lowest) {
    br_incumbent *incumbent = &mpc->incumbent;
    if (lowest ? status > BR_DEFECT : !br_usable(status)) return;
    const double residual = br_residual(mpc);
    const int better = status < incumbent->status ||
                       (status == incumbent->status && residual < incumbent->residual);
    if (lowest && !better) return;
    note(mpc, incumbent, status);
}

/* Puts the best plan and its residuals back. Returns its status, or the given one if it is not
 * usable either. */
br_mpc_status br_incumbent_restore(br_mpc *mpc, br_mpc_status status) {
    const br_incumbent *incumbent = &mpc->incumbent;
    if (incumbent->status > BR_DEFECT) return status;
    if (incumbent->info.iterations != mpc->info.iterations) put_back(mpc, incumbent);
    return br_usable(incumbent->status) ? incumbent->status : status;
}

/* Keeps the plan at hand as the one that another start has to beat. */
void br_first_plan_keep(br_mpc *mpc, br_mpc_status status) { note(mpc, &mpc->first, status); }

/* Leaves the better one of that plan and the one at hand: the usable one, or the one of less cost.
 * Returns its status; *second: whether it is the one at hand. */
br_mpc_status br_first_plan_compare(br_mpc *mpc, br_mpc_status status, int *second) {
    const br_incumbent *first = &mpc->first;
    *second = br_usable(status) && (!br_usable(first->status) || mpc->worth < first->worth);
    if (*second) return status;
    put_back(mpc, first);
    return first->status;
}
