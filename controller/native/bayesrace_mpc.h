/* BayesRace model predictive controller: public interface.
 *
 * One controller lives in one block of memory that the caller owns. After br_mpc_init nothing
 * here allocates, prints, locks, exits or reads a clock other than the one given to
 * br_mpc_set_clock; every function is bounded in time by the dimensions below and the iteration
 * limits in br_mpc_parameters. Not re-entrant per object: one thread at a time may call functions
 * on the same br_mpc, but for br_mpc_stage_weights, which one other thread may call meanwhile.
 *
 * A control period, with or without the preparation:
 *
 *   br_mpc_step(mpc, x, u_before, NULL, elapsed, budget, u, &status, &info);   the state is here
 *   (send u)
 *   br_mpc_prepare(mpc, period, budget);                          while waiting for the next one
 *
 * Two enums, after OSQP: br_mpc_error says what is wrong with a call, br_mpc_status what became
 * of the optimisation problem. The status is derived from residuals measured at the returned plan.
 *
 * The problem (states, inputs, cost, constraints, parameters) is described in codegen/problems/ and
 * generated; br_problem.h has its sizes and structures. Units are SI.
 */
#ifndef BAYESRACE_MPC_H
#define BAYESRACE_MPC_H

#include <stddef.h>
#include <stdint.h>

#include "br_config.h"  /* generated: BR_N, BR_TS, BR_GP_CAPACITY, BR_PATH_CAPACITY (points of the
                         * path table), BR_WEIGHT_BUFFERS, BR_HAS_ESTIMATOR, BR_MODEL_IDENTITY,
                         * BR_ABI */
#include "br_problem.h" /* generated: sizes, BR_PARAMETERS, br_mpc_reference */

#ifdef __cplusplus
extern "C" {
#endif

/* A step without a plan tries up to BR_COLD_GUESSES guesses; each after the first gets at most
 * BR_SECOND_START_ITERATIONS. If none gives a usable plan, the problem is solved without its soft
 * rows, and from that result with them; each of the two gets as many again. */
enum {
    BR_COLD_GUESSES = 4,
    BR_SECOND_START_ITERATIONS = 12, /* at most; most often it needs eight */
    BR_QP_STEPS = 200                /* of the active-set method in one QP, at most */
};
#define BR_NV (BR_NX + BR_NU) /* stage variables v = [x; u] */
#define BR_PATH_COLUMNS 7     /* see br_mpc_set_path */
#define BR_PREDICT_MAX_S 1.0  /* longest br_mpc_predict */

#if defined(BR_API) /* as it is given */
#elif defined(_WIN32)
#define BR_API __declspec(dllexport)
#else
#define BR_API __attribute__((visibility("default")))
#endif

typedef struct br_mpc br_mpc;

/* What is wrong with a call: see br_mpc_error_text. */
typedef enum {
    BR_OK = 0,
    BR_ERROR_NULL,
    BR_ERROR_MEMORY,
    BR_ERROR_PARAMETERS,
    BR_ERROR_PATH,
    BR_ERROR_WEIGHTS,
    BR_ERROR_NOT_READY,
    BR_ERROR_TIME,
    BR_ERROR_STATE,
    BR_ERROR_BUSY,
    BR_ERROR_NOT_STAGED,
    BR_ERROR_INSTRUCTIONS,
    BR_ERROR_LEFT_OUT
} br_mpc_error;

/* What becomes of the optimisation problem. The first two are usable. */
typedef enum {
    BR_CONVERGED = 0, /* all residuals below tolerance */
    BR_ACCEPTABLE,    /* dynamics and bounds hold; not stationary to tolerance */
    BR_DEFECT,        /* the dynamics are violated by more than defect_max */
    BR_INFEASIBLE,    /* the QP has no solution */
    BR_QP_LIMIT,      /* the QP solver hit its iteration limit or cycled */
    BR_NOT_FINITE,    /* a number in the problem or its solution is not finite */
    BR_BAD_STATE,     /* the measured state is not finite or absurd; nothing was solved */
    BR_TIME_LIMIT     /* the budget or qp_steps were used up before the plan was usable */
} br_mpc_status;

/* Instruction sets that a library has code for. */
typedef enum {
    BR_BASELINE = 0, /* those that every processor of its kind has */
    BR_AVX2,         /* x86-64 with AVX2 and fused multiply-add */
    BR_AVX512        /* x86-64 with AVX-512 */
} br_instructions;

/* Run-time parameters: of the problem (BR_PARAMETERS, all doubles), then settings of the solver. */
#define BR_SOLVER_FIELDS(REAL, WHOLE)                                                       \
    REAL(tolerance)        /* KKT residual (scaled) of a converged step; above 0 */         \
    REAL(defect_max)       /* largest dynamics defect of a usable plan; above 0 */          \
    REAL(early_stop_tol)   /* a step ends at this stationarity and a tenth of it as defect, \
                            * or earlier: see br_step.c */                                  \
    REAL(caution_sigmas)   /* standard deviations of the residual that a plan's tube is     \
                            * wide to either side; 0: no caution */                         \
    WHOLE(iterations)      /* SQP iterations a step without budget may use, once the defect \
                            * is below 0.01; at least 1 */                                  \
    WHOLE(iterations_cold) /* the same for the first step after a reset; with a budget the  \
                            * larger limits every step */                                   \
    WHOLE(qp_steps)        /* of the active-set method, at most, in all QPs of a step, and  \
                            * of a preparation; at least BR_QP_STEPS */

#define BR_REAL_MEMBER(name) double name;
#define BR_WHOLE_MEMBER(name) int name;

typedef struct {
    BR_PARAMETERS(BR_REAL_MEMBER)
    BR_SOLVER_FIELDS(BR_REAL_MEMBER, BR_WHOLE_MEMBER)
} br_mpc_parameters;

/* br_mpc_info.second_start, where there was one. */
enum {
    BR_NO_BETTER = 1, /* the plan from before was doubtful, and a new one no better */
    BR_BETTER,        /* the new one is better, and used */
    BR_CREEPS /* the slow car creeps along its line, or is led round, as no start has led to a plan,
               * or as it has stood for too long */
};

/* What a step reports. */
typedef struct {
    int status;              /* br_mpc_status */
    int iterations;          /* SQP iterations used, those of a second start included */
    int qp_iterations;       /* active-set iterations, summed */
    int regularised;         /* iterations whose Hessian had to be made positive definite */
    int shortened;           /* steps that the line search halved */
    int second_start;        /* what came of it: BR_NO_BETTER, ...; 0: there was none */
    int shifts;              /* stages by which the plan was shifted; -1: there was no plan */
    int prepared;            /* 1: br_mpc_prepare had linearised and factorised already */
    int prepared_iterations; /* SQP iterations of br_mpc_prepare since the step before */
    int time_limited;        /* 1: the budget or qp_steps ended the iterations */
    double stationarity;     /* scaled infinity norms at the returned plan: of the gradient, */
    double defect;           /* of the dynamics, */
    double bound;            /* of the hard constraints */
    double shifted_cost;     /* of the plan before, shifted, under the same reference; 0 after a
                              * cold start */
    double cost;             /* objective at the returned plan, slack included */
    double slack_max_m;      /* largest violation of a soft constraint */
    double tube_m;           /* half the width that uncertainty takes of a soft constraint, the
                              * largest; may be infinite */
    double pace;             /* of the reference, as a share of the line's speed; 1 where all is
                              * known */
    double widening;         /* of the residual's standard deviations, noise included, by what is
                              * not known of its mismatch; the largest along the plan */
    double s_ref_m;          /* projection of the car on the racing line */
    double lateral_m;        /* distance of the car from the racing line, positive left */
} br_mpc_info;

/* What a step takes into account beside the car's own state. With INFINITY and 0 nothing is
 * limited. */
typedef struct {
    double speed_limit_mps;       /* the reference moves along the line at most this fast */
    double speed_limit_rate_mps2; /* by how much the limit falls along the horizon */
} br_environment;

/* Samples of what the car has done that a controller keeps; and the newest of these, on which
 * weights are compared while they are watched. */
enum { BR_SAMPLES = 512, BR_WATCHED = 100 };

enum { BR_NPHI = 1 + BR_NZ + BR_NE }; /* terms of the mismatch: see br_mismatch.c */

/* Where the states before and after a step are estimates. What the measurements between them say of
 * the mismatch's weights w: for each output they are y = B w + white noise of covariance S. Sums of
 * B' S^-1 B, B' S^-1 y, y' S^-1 y, and of how many values there are. */
typedef struct {
    double step[BR_NX]; /* variance of the estimated step from the car's, whatever the model */
    double information[BR_NE][BR_NPHI][BR_NPHI], projection[BR_NE][BR_NPHI], squares[BR_NE];
    double values;
} br_mpc_noise;

/* The mismatch of the weights that states are estimated by: w' phi for each output, per stage. */
typedef struct {
    uint64_t identity;             /* of the Gaussian processes' weights that err by it */
    double phi[BR_NPHI];           /* at the car's state and input; all 0: it is not estimated */
    double unexplained[BR_NE];     /* there, the variance of what no weights explain */
    double weight[BR_NE][BR_NPHI]; /* mean of w */
    double factor[BR_NE][BR_NPHI][BR_NPHI]; /* Cholesky factor of its inverse covariance, with the
                                             * reciprocals of its diagonal; 0: w is known */
} br_mpc_mismatch;

/* How the weights in use do beside others: root mean square errors per stage, beyond what the
 * noise of estimates explains. */
typedef struct {
    int samples;           /* of the newest, judged so far */
    double fresh;          /* samples since the weights in use were adopted */
    double in_use[BR_NE];  /* error of the weights in use */
    double proven[BR_NE];  /* of the proven weights */
    double nominal[BR_NE]; /* of the model without correction */
} br_mpc_watch;

/* When weights on probation are worse than the proven ones: GateSettings in
 * controller/settings.py, which says what each means. */
#define BR_PROBATION_FIELDS(REAL, WHOLE)                           \
    REAL(worse_factor)                                             \
    REAL(worse_share)                                              \
    REAL(watch_samples) /* of driving, after which weights stay */ \
    REAL(slow_share)                                               \
    REAL(slow_least_mps) /* to which any car may be slowed down */ \
    WHOLE(watch_least)                                             \
    WHOLE(watch_cycles)

typedef struct {
    BR_PROBATION_FIELDS(BR_REAL_MEMBER, BR_WHOLE_MEMBER)
    double resolution[BR_NE]; /* errors per stage that do not count, above 0 */
} br_mpc_probation;

/* What to do about weights on probation. */
typedef enum {
    BR_WATCH_ON, /* nothing */
    BR_PROVEN,   /* they stay */
    BR_SLOW,     /* they predict some outputs worse and others better: slow down */
    BR_BACK,     /* they predict worse: go back to the proven ones */
    BR_HOPELESS  /* go back, as hardly any cycle finds a solution */
} br_mpc_ruling;

/* Of weights from their adoption on; zeros then. */
typedef struct {
    br_mpc_watch found; /* when they were looked at last */
    int64_t cycles, fallen_back;
    double fastest_mps;
    double limit_mps; /* to which the car is to slow down; 0: it is not */
    double judged, slowed_after;
} br_mpc_trial;

typedef enum {
    BR_KERNEL_RBF = 0,
    BR_KERNEL_MATERN05 = 1,
    BR_KERNEL_MATERN15 = 2,
    BR_KERNEL_MATERN25 = 3
} br_mpc_kernel;

/* Time in seconds since any fixed moment, never going backwards. */
typedef double (*br_mpc_clock)(void *context);

/* Posterior mean of one output: mean(z) = offset + scale * sum_i alpha_i k(r_i),
 * r_i = || (z - inputs_i) / length_scales ||. n = 0 gives offset alone. */
typedef struct {
    int kernel; /* br_mpc_kernel */
    int n;      /* training points, at most BR_GP_CAPACITY */
    double offset, scale;
    double signal, noise;        /* variances of the output and of its noise; signal 0: not known */
    const double *length_scales; /* BR_NZ */
    const double *inputs;        /* n x BR_NZ, row major */
    const double *alpha;         /* n */
} br_mpc_gp;

/* --- set-up; none is for the control loop but where it says so --- */

BR_API size_t br_mpc_memory_size(void);
BR_API br_mpc_error br_mpc_init(void *memory, size_t size, br_mpc **out);
BR_API br_mpc_error br_mpc_set_parameters(br_mpc *mpc, const br_mpc_parameters *parameters);

/* Racing line and track, n rows of BR_PATH_COLUMNS sampled every spacing_m along the closed line:
 * x, y, speed, left unit normal of the centreline (2), lower and upper bound of normal . p. */
BR_API br_mpc_error br_mpc_set_path(br_mpc *mpc, const double *table, int n, double spacing_m);

/* Copies the weights and, where signal is given, makes what the posterior variance needs; the next
 * step uses them. Some 4 ms per 400 points and output, and 0.1 ms per wheelbase of the path for its
 * speeds (br_mpc_get_speeds), which another path or other parameters change, too. What is staged is
 * forgotten. BR_ERROR_BUSY while another thread stages. Where there is one buffer of weights, none
 * are left after an error: there is no correction. */
BR_API br_mpc_error br_mpc_set_weights(br_mpc *mpc, const br_mpc_gp outputs[BR_NE]);

/* The same in two parts, for a control loop that has no time to copy. br_mpc_stage_weights copies
 * into a second buffer, while steps go on with the weights in use: the one function that another
 * thread may call beside the one that calls all others. Staged again before they are adopted, the
 * newer ones count. BR_ERROR_BUSY: two threads stage, or the other adopts, at this very moment;
 * call again. After an error nothing is staged.
 *
 * br_mpc_adopt_weights, between two steps, puts what is staged into use: an exchange of buffers,
 * about a microsecond. Then as after br_mpc_set_weights: plan and multipliers stay, and a
 * br_mpc_prepare before the next step does the linearisation anew. BR_ERROR_NOT_STAGED if there is
 * nothing; never waits.
 *
 * Both, and br_mpc_revert_weights, need BR_WEIGHT_BUFFERS 3 (in use, proven, spare); with 1 they do
 * nothing but BR_ERROR_LEFT_OUT, weights are set before driving, and no samples are kept. */
BR_API br_mpc_error br_mpc_stage_weights(br_mpc *mpc, const br_mpc_gp outputs[BR_NE]);
BR_API br_mpc_error br_mpc_adopt_weights(br_mpc *mpc);

/* Weights that have been adopted are on probation, and what was proven before them is kept.
 * br_mpc_get_watch, between two calls: the errors of both, and of none, on the newest samples of
 * what the car did, as br_mpc_observe has been shown it; they are judged in br_mpc_prepare.
 * resolution: errors per stage that do not count, above 0; a sample whose residual has a variance v
 * by the noise of estimates has the weight 1 / (1 + v / resolution^2).
 * br_mpc_prove_weights ends the probation, br_mpc_revert_weights goes back to what is proven, as
 * fast as an adoption. What br_mpc_set_weights has loaded counts as proven. Until the probation
 * ends states are estimated (br_mpc_propagate, br_mpc_variance) by the proven weights, if these
 * correct anything: wrong ones would make estimates that agree with them.
 *
 * br_mpc_get_samples copies the newest BR_SAMPLES samples, the oldest first: features, the residual
 * per stage that the weights are to explain, and its variance by the noise of estimates. All by the
 * thread that steps. */
BR_API br_mpc_error br_mpc_get_watch(const br_mpc *mpc, const double resolution[BR_NE],
                                     br_mpc_watch *watch);

/* Judges weights on probation, between two calls, as GateSettings says. br_mpc_observe_trial is
 * called for each state, with its speed and whether the fallback drove in the cycle before it; -1:
 * the car was not driven. The caller carries out the ruling: after BR_SLOW the trial goes on, on
 * samples from then on, and does not end by proof; after others it is over. */
BR_API void br_mpc_observe_trial(br_mpc_trial *trial, double vx_mps, int fallen_back);
BR_API br_mpc_ruling br_mpc_judge_trial(const br_mpc *mpc, const br_mpc_probation *probation,
                                        br_mpc_trial *trial);
BR_API br_mpc_error br_mpc_prove_weights(br_mpc *mpc);
BR_API br_mpc_error br_mpc_revert_weights(br_mpc *mpc);
BR_API br_mpc_error br_mpc_get_samples(const br_mpc *mpc, double features[BR_SAMPLES * BR_NZ],
                                       double residuals[BR_SAMPLES * BR_NE],
                                       double noise[BR_SAMPLES * BR_NE], int *count);

/* The clock that budgets are measured with, NULL for none (then there are no budgets). It is read
 * from within br_mpc_step, br_mpc_solve and br_mpc_prepare only, in their thread. */
BR_API br_mpc_error br_mpc_set_clock(br_mpc *mpc, br_mpc_clock clock, void *context);

/* Where time ran out, for replaying what was driven in real time. A call with a budget asks its
 * clock several times whether what comes next still fits. The refusals, the numbers of the
 * questions (from 0 on) that were answered no, are all that a clock changes: another call with the
 * same arguments and refusals gives the same result to the bit. br_mpc_get_refusals returns how
 * many there were in the newest br_mpc_step, br_mpc_solve or br_mpc_prepare, the first BR_REFUSALS
 * counted; br_mpc_repeat has the next call with a budget refuse these in place of the clock. */
enum { BR_REFUSALS = 16 };
BR_API int br_mpc_get_refusals(const br_mpc *mpc, int refused[BR_REFUSALS]);
BR_API br_mpc_error br_mpc_repeat(br_mpc *mpc, const int *refused, int count);

/* A clock for hosts that have none of their own: the system's monotonic one. context is unused.
 * Alone in br_clock.c, which a system without it leaves out. */
BR_API double br_mpc_monotonic(void *context);

/* --- the control loop --- */

/* Forgets the previous plan, working set and position on the line, what slowed the car down, and
 * what its model errs by. */
BR_API void br_mpc_reset(br_mpc *mpc);

/* One control step: projects the car on the racing line, makes the reference, solves, checks.
 * A problem without a path has none of that (BR_ERROR_NOT_READY): br_mpc_solve serves it.
 * Where the car stands and points away from the line, the reference (br_mpc_get_reference) leads it
 * round at a walking pace instead, with the track's edges farther out: see br_planner.c.
 *
 * x: measured state. u_before: the input that acts now. u: first input of the plan; written
 * only for BR_CONVERGED and BR_ACCEPTABLE. info may be NULL.
 *
 * environment: what limits the car besides. The reference moves along the line at most at the speed
 * limit, and at every stage by its rate times BR_TS less, down to standstill: for a stop on the
 * line. NULL: nothing does. BR_ERROR_PARAMETERS if a number is negative or none.
 *
 * elapsed_s: time from the state of the call before to this one, whether that was solved or not.
 * The plan is shifted by whole stages as soon as it lags behind by half a stage, so that it is
 * never more than that out of step: BR_TS shifts it once, a tenth of that every tenth time, a
 * missed period twice. A plan older than the horizon is forgotten. BR_ERROR_TIME if negative or
 * not finite.
 *
 * budget_s: time from the call within which it should return; needs a clock. The step then
 * iterates until an early stop (early_stop_tol 0: until converged) or as long as another iteration,
 * at the longest duration seen, fits, and returns the best usable plan. The first iteration is
 * always done. Without a clock or with budget_s <= 0 the iteration limits and qp_steps alone count,
 * which bound the work of a step: docs/timing.md has the product. Either way an iteration that
 * fails does not take back a usable plan found before it. After BR_TIME_LIMIT the next step goes on
 * from where this one stopped. */
BR_API br_mpc_error br_mpc_step(br_mpc *mpc, const double x[BR_NX], const double u_before[BR_NU],
                                const br_environment *environment, double elapsed_s,
                                double budget_s, double u[BR_NU], br_mpc_status *status,
                                br_mpc_info *info);

/* The same with a reference of the caller's own planner, stages 1..BR_N. How fast its stages go
 * is the caller's: info->pace says which share of its speed br_mpc_step would ask for. */
BR_API br_mpc_error br_mpc_solve(br_mpc *mpc, const double x[BR_NX], const double u_before[BR_NU],
                                 double elapsed_s, double budget_s,
                                 const br_mpc_reference reference[BR_N], double u[BR_NU],
                                 br_mpc_status *status, br_mpc_info *info);

/* Compares what the car did between two measured states, under the mean of the inputs that acted
 * meanwhile, with the prediction. What this errs by is estimated: the tube counts what is not known
 * of it from the step after the next on (info->widening), and the model is corrected by it from the
 * one after that on, until br_mpc_reset or other weights. For consecutive states of a car that
 * moves, about a stage apart, by the thread that steps; the newest before a step counts. Never
 * needed; without caution it changes nothing. noise: as an estimator has it, and what it says of
 * the mismatch counts, as estimates follow the model; NULL: the states are exact. BR_ERROR_TIME
 * for a duration that is not above 0 and at most BR_PREDICT_MAX_S, BR_ERROR_STATE as for
 * br_mpc_predict.
 */
BR_API br_mpc_error br_mpc_observe(br_mpc *mpc, const double x[BR_NX], const double u[BR_NU],
                                   double duration_s, const double x_next[BR_NX],
                                   const br_mpc_noise *noise);

/* The state of the next step is an estimate with this covariance, row by row. The tube of the step
 * after it begins with that, which hardly changes from step to step, so that it can be made in the
 * preparation. To be said before each step; otherwise the state is exact. */
BR_API br_mpc_error br_mpc_set_covariance(br_mpc *mpc, const double covariance[BR_NX * BR_NX]);

/* The preparation phase of the next step, between two steps: shifts the plan for the elapsed_s
 * that is expected, linearises there, and does what of the QP depends neither on the next state nor
 * on its reference. With budget_s (and a clock) it first solves the next problem as it is foreseen,
 * from the state that the plan predicts, towards tolerance, and looks for another local minimum of
 * it, so that the step has little left to do; after br_mpc_solve, whose next reference is the
 * caller's, the last problem. Never needed: with no budget, the step returns the same to the last
 * bit without it, also if the real elapsed_s, the weights or the parameters turn out to be others.
 * Does nothing if there is no plan. */
BR_API br_mpc_error br_mpc_prepare(br_mpc *mpc, double elapsed_s, double budget_s);

/* Where the corrected model with its mismatch takes x within duration_s (0 to BR_PREDICT_MAX_S)
 * under input u, both held to their limits as the car does: whole stages by the map that the
 * controller predicts with, the rest by the same scheme with the shorter step and that share of the
 * residual. x_next may be x. Changes nothing in mpc. BR_ERROR_STATE: x_next is not written. */
BR_API br_mpc_error br_mpc_predict(const br_mpc *mpc, const double x[BR_NX], const double u[BR_NU],
                                   double duration_s, double x_next[BR_NX]);

/* The same over at most a stage (BR_TS), with what an estimator needs: how x_next changes while no
 * limit is reached, row by row, with x and with the disturbance, and the covariance that the
 * residual's variance (per stage; NULL: 0) adds, whose errors are taken to be independent from one
 * stage to the next. begin: the state at which the stage has begun, whose residual counts in all
 * its parts, because it is learned as that of a whole stage; NULL: x. disturbance: a rate of change
 * beside the residual [unit/s]; NULL: 0. By the proven weights, if they correct anything. */
BR_API br_mpc_error br_mpc_propagate(const br_mpc *mpc, const double x[BR_NX],
                                     const double begin[BR_NX], const double u[BR_NU],
                                     double duration_s, const double variance[BR_NE],
                                     const double disturbance[BR_NE], double x_next[BR_NX],
                                     double jacobian[BR_NX * BR_NX],
                                     double by_disturbance[BR_NX * BR_NE],
                                     double covariance[BR_NX * BR_NX]);

/* What the corrected model errs by, as it is estimated from br_mpc_observe, at v = [x; u]; 0
 * without caution and while estimates are by other weights than those in use. */
BR_API br_mpc_error br_mpc_get_mismatch(const br_mpc *mpc, const double v[BR_NV],
                                        br_mpc_mismatch *mismatch);

#if BR_HAS_PATH
/* The steering angle that keeps a car in state x by its line while it brakes to standstill.
 * *s_m: arc length of the line near which x is sought, below 0 for anywhere; that of x on return.
 * *outside_m: how far x is outside of the track less its margin, negative inside. Changes nothing
 * in mpc. */
BR_API br_mpc_error br_mpc_steer(const br_mpc *mpc, const double x[BR_NX], double *s_m,
                                 double *angle_rad, double *outside_m);
#endif

/* Does over what br_mpc_prepare has done, to the same bits, so that caches and branch predictors
 * are warm when the state arrives: after 20 ms of other work a step takes half as long again.
 * Nothing if nothing is prepared. */
BR_API br_mpc_error br_mpc_rehearse(br_mpc *mpc);

/* Plan of the last step, row major: x (BR_N + 1) x BR_NX, u BR_N x BR_NU; NULL for what is not
 * wanted; and the stage parameters that it was made with. br_mpc_prepare changes neither. */
BR_API br_mpc_error br_mpc_get_plan(const br_mpc *mpc, double *x, double *u);
BR_API br_mpc_error br_mpc_get_reference(const br_mpc *mpc, br_mpc_reference reference[BR_N]);

#if BR_HAS_PATH
/* The speeds that the car is to reach at the path's n rows: the line's, lower where the weights in
 * use do not know the car well enough. Without caution, or where the residual's variance is not
 * known, the line's. The thread that stages weights may ask, too. */
BR_API br_mpc_error br_mpc_get_speeds(const br_mpc *mpc, double *speeds_mps, int n);

/* What a lap loses to the line's speeds by that. */
BR_API br_mpc_error br_mpc_get_loss(const br_mpc *mpc, double *lost_s);
#endif

/* How uncertain the last step's plan is: for each stage, half the width that uncertainty takes of
 * the cautious rows, the largest [the row's unit]. 0 without caution. */
BR_API br_mpc_error br_mpc_get_tube(const br_mpc *mpc, double tube[BR_N]);

/* --- for tests and tools --- */

/* The instructions that the functions above use: at first the best that processor and system have.
 * For others, between two calls, and not while another thread stages: results differ by rounding.
 * BR_ERROR_INSTRUCTIONS if the processor lacks them. */
BR_API br_mpc_error br_mpc_set_instructions(br_mpc *mpc, br_instructions instructions);
BR_API br_instructions br_mpc_get_instructions(const br_mpc *mpc);

/* Posterior variance of the residual at v = [x; u], noise included; 0 where it is not known; and,
 * where noise is not NULL, that of the noise alone. By the proven weights, if they correct
 * anything. */
BR_API br_mpc_error br_mpc_variance(br_mpc *mpc, const double v[BR_NV], double variance[BR_NE],
                                    double noise[BR_NE]);

/* Corrected model of the plan, with its mismatch, at v = [x; u]: x_next, J = d x_next / d v (row
 * major) and H = sum_i lambda_i d^2 x_next_i / d v^2. */
BR_API br_mpc_error br_mpc_evaluate(const br_mpc *mpc, const double v[BR_NV],
                                    const double lambda[BR_NX], double x_next[BR_NX],
                                    double jacobian[BR_NX * BR_NV], double hessian[BR_NV * BR_NV]);

/* Version of the interface: a hash of the declarations in this header and bayesrace_cycle.h.
 * A library fits to headers whose BR_ABI it has. */
BR_API int br_mpc_abi(void);

BR_API const char *br_mpc_error_text(br_mpc_error error);
BR_API const char *br_mpc_status_text(br_mpc_status status);

#ifdef __cplusplus
}
#endif
#endif
