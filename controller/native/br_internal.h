/* What the parts of the controller know of each other; not for users. */
#ifndef BR_INTERNAL_H
#define BR_INTERNAL_H

#include <daqp/types.h>
#include <math.h>
#include <stdatomic.h>

#define BR_TABLES /* the sparsity of the problem, too */
#include "bayesrace_mpc.h"
#include "br_kernel.h"

_Static_assert(BR_WEIGHT_BUFFERS == 1 || BR_WEIGHT_BUFFERS == 3,
               "one for all, or one each for the weights in use, the proven and the staged ones");

/* Inputs that a QP changes alike make a block: each of the first BR_FREE stages is one, and of the
 * stages after them each BR_BLOCK. */
#define BR_BLOCK_OF(k) ((k) < BR_FREE ? (k) : BR_FREE + ((k) - BR_FREE) / BR_BLOCK)
#define BR_BLOCKS (BR_BLOCK_OF(BR_N - 1) + 1)
#define BR_M (BR_NU * BR_BLOCKS)      /* condensed variables */
#define BR_MP (((BR_M + 7) / 8) * 8)  /* padded to whole vectors */
#define BR_ROWS (BR_M + BR_NR * BR_N) /* bounds of the blocks, then the problem's, row by row */
#define BR_ROW(r, k) (BR_M + BR_N * (r) + (k))   /* row r of stage k + 1 */
#define BR_ACTIVE (BR_M + BR_NR_SOFT * BR_N + 2) /* most rows that DAQP holds active at a time */
#define BR_ROW_LATE BR_ROW(BR_NR_EARLY, 0) /* from here on gradients are known at a step only */
#define BR_COLS ((((BR_ROWS + 1) + 7) / 8) * 8) /* right-hand sides of one substitution */
#define BR_HORIZON_S (BR_N * BR_TS)
#define BR_LINE_SEARCH_TRIALS 5
#define BR_FUTILE 8 /* second starts in vain from which they are made only each so many steps */
#define BR_DEFECT_FINE 0.01 /* of BR_STATE_SCALE: not worth another iteration */

/* Cost and constraints of one stage, at the state of its end: br_terms writes this. */
typedef struct {
    double cost;
    double in_x[BR_NX], in_u[BR_NU], in_u_before[BR_NU]; /* the cost's gradient */
    double value[BR_NR], lower[BR_NR], upper[BR_NR];     /* of the rows */
    double gradient[BR_ROW_NNZ];                         /* of the rows in x, by BR_ROW_INDEX */
} br_stage_terms;

/* Second derivatives of the same: br_curvature writes them. */
typedef struct {
    double cost_xx[BR_CXX_NNZ + 1], rows_xx[BR_RXX_NNZ + 1]; /* by BR_CXX_ROW and so on */
    double uu[2 * BR_NU][2 * BR_NU];                         /* of [u; u_before] */
} br_stage_curvature;

/* Linearisation of the corrected model at one stage. */
typedef struct {
    double f[BR_NX];
    double jacobian[BR_NX][BR_NV];
    double hessian[BR_NV][BR_NV]; /* weighted with the costate of the stage's end; made later */
    double in_e[BR_NX][BR_NE];    /* the nominal model's Jacobian in the residual */
    br_correction residual;
    double phi[BR_NPHI]; /* terms of the mismatch, by the model without it: */
    double plain_f[BR_NX], plain_jacobian[BR_NX][BR_NV];
    int slot; /* where the weights of its kernels are kept */
} br_stage;

typedef struct {
    int n, ready;
    double spacing, length;
    double table[BR_PATH_CAPACITY][BR_PATH_COLUMNS];
    int known;                            /* the projection of the step before is valid */
    double s;                             /* arc length of the last projection */
    double speed_limit, speed_limit_rate; /* of the environment */
    double age;                           /* time since then */
    int buffer;                           /* of the speeds that count: as of the weights in use */
    /* as far as these know: see br_certainty.c */
    double speed[BR_WEIGHT_BUFFERS][BR_PATH_CAPACITY];
} br_path;

/* Columns of the path's table. */
enum {
    BR_LINE_X,
    BR_LINE_Y,
    BR_LINE_SPEED,
    BR_LINE_NORMAL_X,
    BR_LINE_NORMAL_Y,
    BR_LINE_LOWER,
    BR_LINE_UPPER
};

typedef struct {
    int regularised;  /* the exact Hessian was not positive definite */
    double curvature; /* share of the second-order part that is in h */
    br_stage_terms terms[BR_N];
    br_stage_curvature second[BR_N];
    double penalty[BR_NR];                       /* of the soft rows */
    BR_ALIGNED double g[BR_N + 1][BR_NX][BR_MP]; /* sensitivity of stage k to all blocks */
    BR_ALIGNED double costate[2][BR_NX][BR_MP];
    BR_ALIGNED double h[BR_M][BR_MP]; /* condensed Hessian, then its Cholesky factor */
    BR_ALIGNED double undamped[BR_PROXIMAL ? BR_M : 1][BR_MP]; /* h before its proximal term */
    BR_ALIGNED double y[BR_M][BR_COLS];                        /* L^{-1} [A' | gradient] */
    double diagonal[BR_M];
    double xbar[BR_N + 1][BR_NX];
    double gradient[BR_M];
    double lower[BR_ROWS], upper[BR_ROWS], scale[BR_ROWS];
    double delta_u[BR_NU * BR_N];
    double multiplier[BR_ROWS]; /* of the rows above, QP units */
    double delta_x[BR_N + 1][BR_NX];
    double costate_next[BR_N + 1][BR_NX];
    /* DAQP's least-distance problem, in our memory */
    DAQPWorkspace daqp;
    DAQPSettings settings;
    BR_ALIGNED double m[BR_ROWS * BR_M];
    double dupper[BR_ROWS], dlower[BR_ROWS], unit[BR_ROWS];
    int sense[BR_ROWS];
    double lam[2][BR_ACTIVE], l[BR_ACTIVE * (BR_ACTIVE + 1) / 2], d[BR_ACTIVE], xldl[BR_ACTIVE],
        zldl[BR_ACTIVE], u[BR_M];
    int working_set[BR_ACTIVE];
} br_qp;

/* Trajectory with its multipliers. costate[k] belongs to the dynamics into stage k,
 * multiplier to the rows of the QP. */
typedef struct {
    double x[BR_N + 1][BR_NX];
    double u[BR_N][BR_NU];
    double costate[BR_N + 1][BR_NX];
    double multiplier[BR_ROWS];
} br_plan;

/* A plan that is kept, with its residuals, such as the best one so far. */
typedef struct {
    br_plan plan;
    br_mpc_info info;
    br_mpc_status status;
    double residual, worth;
} br_incumbent;

/* From one measured state to the next. */
typedef struct {
    double duration; /* 0: there is none */
    double x[BR_NX], u[BR_NU], x_next[BR_NX];
    int estimated; /* the states are estimates, with noise; else they are exact */
    br_mpc_noise noise;
} br_transition;

/* What a residual learns from, and the errors on it: see br_watch.c. */
typedef struct {
    double z[BR_NZ], residual[BR_NE], noise[BR_NE]; /* noise: variances of the residual */
} br_sample;

typedef struct {
    int64_t number;         /* of the sample, from 1 on; 0: not judged */
    double error[2][BR_NE]; /* of the weights in use, of the proven ones */
} br_judged;

typedef struct {
    br_transition newest; /* not taken yet */
    int64_t count;        /* samples so far; the last BR_SAMPLES are kept */
    int64_t since;        /* of these, before the weights in use were adopted */
    br_sample sample[BR_WEIGHT_BUFFERS > 1 ? BR_SAMPLES : 1]; /* with one buffer none is taken */
    br_judged judged[BR_WEIGHT_BUFFERS > 1 ? BR_WATCHED : 1]; /* the newest */
} br_watch;

/* Of one output: what the errors of the corrected model say, older ones less, and what follows. */
typedef struct {
    double information[BR_NPHI][BR_NPHI], projection[BR_NPHI]; /* sums of phi phi' / r, phi y / r */
    double squares, precision, samples;                        /* sums of y y / r, 1 / r, 1 */
    double values;      /* as many squares are independent: of samples, or of measurements */
    double surprise;    /* mean square of the newest errors, over that of all */
    double prior;       /* variance of a weight before anything has been seen */
    double noise_scale; /* mean square of what the weights leave, over r; ... */
    double scaled_by;   /* ... the one that these belong to: */
    double weight[BR_NPHI];
    double factor[BR_NPHI][BR_NPHI]; /* Cholesky factor of their inverse covariance, with the
                                        reciprocals of its diagonal */
    double unexplained;              /* variance of y beside r */
    double doubt; /* square of the mean that is the variance of whether there is a mismatch */
} br_regression;

/* The model's mismatch, by what the car has done lately: see br_mismatch.c. */
typedef struct {
    br_transition newest, due; /* due: observed before the last step */
    int judged;                /* what is due is in the regressions, else in neither: */
    br_regression of[BR_NE], before[BR_NE];
    double weight[BR_NE][BR_NPHI]; /* of these, since the last step */
    int any;                       /* there are such weights; ... */
    int renewed;                   /* ... and stages that are linearised with those before */
} br_mismatch;

/* What the residual's uncertainty does to the pace: see br_caution.c. */
typedef struct {
    int wanted; /* by the parameters: there are rows to be cautious about, and standard deviations
                 */
    int active; /* there is an uncertainty to be cautious about */
    int given;  /* covariance of the step at hand; it becomes begin after it: */
    double covariance[BR_NX][BR_NX];
    int begins; /* columns of begin, whose squares are the covariance: BR_NX; 0: it is none */
    double begin[BR_NX][BR_NX];
    double deviation[BR_N][BR_NE + BR_NX][BR_NX]; /* of the states at the ends of the stages, by
                                                   * output, then by column of begin */
    double pace;     /* of the reference, as a share of the line's speed */
    double widening; /* of the last step's standard deviations, the largest */
    BR_ALIGNED double correlations[BR_GP_ROOT][BR_COLUMNS];
} br_caution;

/* Time within a call, by the host's clock, and steps of its QPs. */
typedef struct {
    br_mpc_clock clock; /* NULL: none */
    void *context;
    int limited; /* there is a deadline */
    double deadline;
    int qp_steps;            /* left */
    double iteration, trial; /* longest seen, of the line search's trials too; 0: none yet */
    double caution;          /* what the last br_caution_update took */
    int checks, refusals, refused[BR_REFUSALS]; /* of the newest call: see br_mpc_get_refusals */
    int repeat_next, repeats; /* br_mpc_repeat: for the next call with a budget, for this one */
    int given, refuse[BR_REFUSALS];
} br_timer;

/* What is computed from the plan, the weights and a call's arguments, and kept while these stay.
 * The order is such that none is needed for one after it: see br_invalidate. */
typedef enum {
    BR_TERMS,    /* qp.terms: of the plan, the reference, u_before and the parameters */
    BR_FOLLOWED, /* reference and first_row: where the plan is on the line, if it follows that */
    BR_FACTORS,  /* qp: g, h, and y, scale, m of the rows before BR_ROW_LATE */
    BR_TUBE,     /* caution: of the plan that the step starts with */
    BR_LINEARISATION, /* stage[]: of the plan and the weights in use */
    BR_RESULTS
} br_result;

/* The functions of the interface that take time, as one code has them. */
typedef struct {
    __typeof__(br_mpc_step) *step;
    __typeof__(br_mpc_solve) *solve;
    __typeof__(br_mpc_prepare) *prepare;
    __typeof__(br_mpc_rehearse) *rehearse;
    __typeof__(br_mpc_predict) *predict;
    __typeof__(br_mpc_propagate) *propagate;
#if BR_HAS_PATH
    __typeof__(br_mpc_steer) *steer;
#endif
    __typeof__(br_mpc_variance) *variance;
    __typeof__(br_mpc_get_mismatch) *mismatch;
    __typeof__(br_mpc_evaluate) *evaluate;
    br_mpc_error (*load)(br_gp *gp, const br_mpc_gp outputs[BR_NE]);
#if BR_HAS_PATH
    void (*limit)(br_mpc *mpc, int buffer);
#endif
} br_code;

extern const br_code br_code_baseline;
#if defined(__x86_64__)
extern const br_code br_code_avx2, br_code_avx512;
#endif

/* The spare one of the weight buffers, and whose it is. */
enum {
    BR_SPARE_FREE = 0, /* not in use */
    BR_SPARE_TAKEN,    /* one thread writes it, or exchanges the two */
    BR_SPARE_STAGED    /* complete, to be adopted */
};

struct br_mpc {
    const br_code *code; /* that makes the steps */
    br_mpc_parameters parameters;
    int has_parameters;
    br_path path;
    int gp_in_use, gp_proven; /* written by the control thread; equal: nothing is watched */
    int gp_spare;             /* written by the control thread once it has taken the buffer */
    atomic_int spare;
    /* the problem */
    double u_before[BR_NU];
    double u_lower[BR_NU], u_upper[BR_NU];
    double x0[BR_NX];
    br_mpc_reference reference[BR_N];
    int own_reference; /* of the caller's planner */
    int follows;   /* the reference is where the plan is on the line, not points to track; ... */
    int first_row; /* ... the plan's first stage is at this row of the path */
    double turn;   /* the side that the car turns round to, 1 left, -1 right; 0: it does not */
    double stood;  /* [s] that the car has stood although it may drive */
    int stuck;     /* that was too long: it creeps until it rolls */
    double led_u[BR_N][BR_NU]; /* inputs that lead the car round, or creeping along its line */
    /* the plan, primal and dual */
    int warm;               /* a plan from the step before is there */
    char valid[BR_RESULTS]; /* by br_result */
    int curved;             /* the Hessians in stage[] belong to the linearisation */
    unsigned attempts; /* steps without a usable plan since the last warm start that gave one */
    int unfinished;    /* iterations that BR_TIME_LIMIT has left without a usable plan */
    double elapsed;    /* since the call before */
    double lag;        /* of the plan, without what br_mpc_prepare shifted, behind the last state */
    int ahead;         /* shifts that br_mpc_prepare did */
    int prepared, prepared_iterations;
    br_plan plan;
    br_plan before; /* the plan that the iteration at hand started from */
    br_incumbent incumbent;
    br_incumbent begun; /* the plan that the iterations began with, ... */
    br_incumbent once;  /* ... and that after the first of them */
    br_incumbent first; /* the plan that a second start has to beat */
    unsigned starts;    /* second ones in a row */
    unsigned futile;    /* tries in a row since one was better */
    unsigned looks;     /* second starts of br_mpc_prepare, ... */
    int looked;         /* ... of which one was at the problem that comes */
    br_plan kept;       /* the plan, and the QP's working set, before those shifts */
    int kept_sense[BR_ROWS];
    double answer_x[BR_N + 1][BR_NX], answer_u[BR_N][BR_NU]; /* plan of the last step */
    br_mpc_reference answer_reference[BR_N];                 /* what it was made with */
    double answer_tube[BR_N];                                /* how uncertain it is */
    br_timer timer;
    br_caution caution;
    br_mismatch mismatch;
    br_watch watch;
    br_stage stage[BR_N];
    BR_ALIGNED br_gp_row kernels[BR_NE * BR_GP_BLOCKS * BR_N]; /* see br_gp_evaluate */
    br_qp qp;
    double penalty; /* on the sum of the plan's defects ... */
    double merit;   /* ... beside its cost */
    double worth;   /* cost, to first order, once the defects are gone: costates price them */
    br_mpc_info info;
    br_gp gp[BR_WEIGHT_BUFFERS]; /* in use, proven, spare; or all in one. The last member of br_mpc,
                                    so that memory for points that the weights do not have is never
                                    written to */
};

/* The result and all before it have to be computed again: what they are made from has changed. */
static inline void br_invalidate(br_mpc *mpc, br_result result) {
    memset(mpc->valid, 0, result + 1);
}

/* --- what all parts need --- */

/* The larger one, and NaN if either is: fmax would lose a NaN and with it a bad solution. */
static inline double br_worse(double a, double b) { return b > a || b != b ? b : a; }

static inline int br_usable(br_mpc_status status) { return status <= BR_ACCEPTABLE; }

static inline int br_all_finite(const double *values, int n) {
    double sum = 0; /* 0 * inf and 0 * nan are nan */
    for (int i = 0; i < n; ++i) sum += 0.0 * values[i];
    return sum == 0.0;
}

/* Whether each number is at most as large as its limit, BR_STATE_LIMIT or BR_INPUT_LIMIT. */
static inline int br_plausible(const double *values, const double *limit, int n) {
    for (int i = 0; i < n; ++i)
        if (!(fabs(values[i]) <= limit[i])) return 0;
    return 1;
}

static inline int br_plausible_state(const double x[BR_NX]) {
    return br_plausible(x, BR_STATE_LIMIT, BR_NX);
}

static inline const double *br_theta(const br_mpc_parameters *parameters) {
    return (const double *)parameters; /* the problem's come first, all of them doubles */
}

#define BR_LIST(...) {__VA_ARGS__}

/* Calls a function that CasADi has generated (br_model.h), with its working memory on the stack. */
#define BR_CALL(function, arguments, results)                   \
    do {                                                        \
        const casadi_real *arg_[function##_SZ_ARG] = arguments; \
        casadi_real *res_[function##_SZ_RES] = results;         \
        casadi_int iw_[function##_SZ_IW + 1];                   \
        casadi_real w_[function##_SZ_W + 1];                    \
        function(arg_, res_, iw_, w_, 0);                       \
    } while (0)

/* Whether the stage is the first of its block. */
static inline int br_opens_block(int k) { return k == 0 || BR_BLOCK_OF(k) > BR_BLOCK_OF(k - 1); }

/* Whole vectors that cover columns 0..n-1 of a BR_MP-wide row; the rest of a row is zero. */
static inline int br_padded(int n) { return (n + 7) & ~7; }

/* 0 without a clock; its time is measured with and without a budget, so that br_mpc_prepare knows
 * what an iteration takes. */
static inline double br_timer_now(const br_timer *timer) {
    return timer->clock ? timer->clock(timer->context) : 0;
}

/* Whether what takes that long fits, and QPs may take steps yet; a clock that gives NaN never lets
 * anything begin. */
static inline int br_timer_allows(br_timer *timer, double now, double duration) {
    if (timer->qp_steps <= 0) return 0;
    if (!timer->limited) return 1;
    const int number = timer->checks++;
    int allows = timer->deadline - now >= duration;
    if (timer->repeats) {
        allows = 1;
        for (int i = 0; i < timer->given; ++i) allows &= timer->refuse[i] != number;
    }
    if (!allows && timer->refusals < BR_REFUSALS) timer->refused[timer->refusals++] = number;
    return allows;
}

static inline void br_timer_note(const br_timer *timer, double begin, double *longest) {
    *longest = fmax(*longest, br_timer_now(timer) - begin);
}

/* --- br_stage.c: the corrected model --- */

BR_PART void br_stage_features(const double x[BR_NX], const double u[BR_NU], double z[BR_NZ]);
/* Of at most BR_N + 1 states and inputs. */
BR_PART void br_stages_variances(const br_gp *gp, int stages, double (*x)[BR_NX],
                                 double (*u)[BR_NU], double (*work)[BR_COLUMNS],
                                 double (*variance)[BR_NE]);
/* What of that is not the output's noise. */
static inline double br_latent(const br_gp *gp, int output, double variance) {
    return br_worse(0, variance - gp->variance[output].noise);
}
/* gp NULL: without correction. */
BR_PART void br_stage_advance(const br_gp *gp, const double x[BR_NX], const double u[BR_NU],
                              double duration, double x_next[BR_NX]);
/* One state by itself. */
BR_PART void br_stage_linearise(const br_gp *gp, const double x[BR_NX], const double u[BR_NU],
                                br_stage *stage);
BR_PART __typeof__(br_mpc_predict) br_predict;
BR_PART __typeof__(br_mpc_propagate) br_propagate;
BR_PART __typeof__(br_mpc_variance) br_variance;
BR_PART __typeof__(br_mpc_get_mismatch) br_get_mismatch;
BR_PART __typeof__(br_mpc_evaluate) br_evaluate;
/* br_predict by these weights; gp NULL: without correction. */
BR_PART br_mpc_error br_predict_by(const br_mpc *mpc, const br_gp *gp, const double x[BR_NX],
                                   const double u[BR_NU], double duration_s, double x_next[BR_NX]);
/* So many stages of the plan from one on; their kernels go into the slots from the given one on. */
BR_PART void br_linearise_stages(br_mpc *mpc, int first, int stages, int slot);
BR_PART void br_linearise_plan(br_mpc *mpc);
/* The second derivatives of the linearised plan, for a QP. */
BR_PART void br_curve_plan(br_mpc *mpc);

/* --- br_planner.c: where the car is to go --- */

BR_PART br_mpc_error br_path_load(br_path *path, const double *table, int n, double spacing);
BR_PART void br_path_plan(const br_path *path, double pace, br_mpc_reference reference[BR_N]);
BR_PART void br_path_project(br_path *path, const double x[BR_NX], double *lateral);
#if BR_FOLLOWS_PLAN
BR_PART void br_path_follow(br_mpc *mpc);
/* Whether the weights in use know the line's speeds for a horizon ahead of the car. */
BR_PART int br_path_known_ahead(const br_path *path);
#else
static inline void br_path_follow(br_mpc *mpc) { (void)mpc; }
#endif
BR_PART void br_turnaround(br_mpc *mpc);
/* Whether a car as slow as this may creep; the inputs that lead it along its line. */
BR_PART int br_creep(br_mpc *mpc);
/* Notes whether the car stands although it may drive, and is to creep off. */
BR_PART void br_note_standing(br_mpc *mpc);
BR_PART double br_path_curvature(const br_path *path, double s);
/* Speed of the reference at this pace, where the car is, as a share of the line's. */
BR_PART double br_path_pace(const br_path *path, double pace);
#if BR_HAS_PATH
BR_PART __typeof__(br_mpc_steer) br_steer;
#endif

/* --- br_certainty.c: the line's speeds, and plans, as far as the weights know --- */

BR_PART void br_limit_speeds(br_mpc *mpc, int buffer);
#if BR_HAS_PATH
/* How far errors as large as the residual's standard deviation take the car from the plan until
 * feedback notices them, as a share of what they may: BR_CAUTION_SHARE of half the width there; the
 * most of all stages. 0 without caution, and for a turn, of which there is one way. */
BR_PART double br_plan_unknown(br_mpc *mpc, const br_plan *plan);
/* Acceleration on a straight by this command. */
BR_PART double br_straight_acceleration(const br_gp *gp, double speed, double duty);
#else
static inline double br_plan_unknown(br_mpc *mpc, const br_plan *plan) {
    (void)mpc, (void)plan;
    return 0;
}
#endif

/* --- br_mismatch.c: what the corrected model errs by lately --- */

/* The regression that the weights in use are of, whether or not what is due has been judged. */
static inline const br_regression *br_mismatch_used(const br_mismatch *mismatch, int output) {
    return mismatch->judged ? &mismatch->before[output] : &mismatch->of[output];
}

BR_PART void br_mismatch_reset(br_mismatch *mismatch);
/* A step has been made: what was observed before it is due. */
BR_PART void br_mismatch_advance(br_mismatch *mismatch);
BR_PART int br_mismatch_due(const br_mismatch *mismatch);
/* As if what is due had not been judged: parameters or code are others now. */
BR_PART void br_mismatch_undo(br_mismatch *mismatch);
/* What is due, by the variance of the residual there; the plan is linearised. */
BR_PART void br_mismatch_judge(br_mpc *mpc, const double variance[BR_NE]);
/* phi of a transition from x under u to `end`, by the corrected model, in so many stages. */
BR_PART void br_mismatch_terms(const double x[BR_NX], const double u[BR_NU],
                               const double end[BR_NX], double stages, double phi[BR_NPHI]);
/* w' phi of each output; the variance of what is not known of it, of one. */
BR_PART void br_mismatch_mean(const br_mpc *mpc, const double phi[BR_NPHI], double error[BR_NE]);
BR_PART double br_mismatch_variance(const br_mpc *mpc, const double phi[BR_NPHI], int output);
/* The part of it that no weights explain. */
BR_PART double br_mismatch_unexplained(const br_regression *of, const double phi[BR_NPHI]);
/* To a stage that is linearised without it, to first order in it. */
BR_PART void br_mismatch_add(const br_mpc *mpc, const double x[BR_NX], const double u[BR_NU],
                             br_stage *stage);
/* To stages that are linearised with the mismatch before: the one in use. */
BR_PART void br_mismatch_renew(br_mpc *mpc);
/* With what this adds to lambda, lambda' F has the second derivatives of lambda' (F + F_e w' phi),
 * as phi is linear in [x; u] and F; but for those of F_e. */
BR_PART void br_mismatch_costate(const br_mpc *mpc, const br_stage *stage, double lambda[BR_NX]);

/* --- br_watch.c: what the car does against predictions --- */

BR_PART void br_watch_update(br_mpc *mpc); /* in the preparation */

/* --- br_caution.c: the tube --- */

BR_PART void br_caution_reset(br_caution *caution);
BR_PART void br_caution_update(br_mpc *mpc);
BR_PART void br_caution_advance(br_caution *caution);
BR_PART void br_caution_pace(br_mpc *mpc, double elapsed);
BR_PART void br_caution_report(br_mpc *mpc); /* into mpc->info */

/* --- br_problem.c: cost and constraints, and what a plan is worth --- */

BR_PART void br_evaluate_terms(br_mpc *mpc);
/* out += (cost_xx + share * rows_xx) dx */
static inline void br_add_curvature(const br_stage_curvature *second, double share,
                                    const double dx[BR_NX], double out[BR_NX]) {
    for (int n = 0; n < BR_CXX_NNZ; ++n)
        out[BR_CXX_ROW[n]] += second->cost_xx[n] * dx[BR_CXX_COLUMN[n]];
    for (int n = 0; n < BR_RXX_NNZ; ++n)
        out[BR_RXX_ROW[n]] += share * second->rows_xx[n] * dx[BR_RXX_COLUMN[n]];
}
BR_PART void br_evaluate_curvature(br_mpc *mpc);
BR_PART void br_evaluate_bounds(br_mpc *mpc);
BR_PART void br_evaluate_penalties(br_mpc *mpc);
BR_PART void br_first_guess(const br_mpc *mpc, const double u_before[BR_NU], double share,
                            double u[BR_NU]);
BR_PART int br_valid_parameters(const br_mpc_parameters *parameters);
BR_PART void br_residuals(br_mpc *mpc);
BR_PART double br_residual(const br_mpc *mpc);
BR_PART br_mpc_status br_judge(const br_mpc *mpc);

/* --- br_condense.c --- */

BR_PART void br_condense_states(br_mpc *mpc); /* the sensitivities of all states, into qp.g */
/* Into qp.h, with this share of the second-order part of dynamics and rows. */
BR_PART void br_condense_hessian(br_mpc *mpc, double tau);
/* At dU = 0, into qp.gradient; and the change of the states there, into qp.xbar. */
BR_PART void br_condense_gradient(br_mpc *mpc, double tau);

/* --- br_qp.c: the QP of one SQP iteration --- */

BR_PART void br_qp_init(br_qp *qp);
BR_PART void br_qp_factorise(br_mpc *mpc);
BR_PART br_mpc_status br_qp_condense(br_mpc *mpc);
BR_PART br_mpc_status br_qp_solve(br_mpc *mpc, int warm);
BR_PART void br_qp_shift_rows(void *rows, size_t size);
BR_PART void br_qp_forget_working_set(br_qp *qp);

/* --- br_sqp.c: the plan's start, shift and iteration; the best plan of several iterations --- */

BR_PART void br_sqp_cold_start(br_mpc *mpc);
/* The plan that holds this input, or is led: on a turn, or with NULL. */
BR_PART void br_sqp_roll_out(br_mpc *mpc, const double u[BR_NU]);
BR_PART void br_sqp_shift(br_mpc *mpc);
BR_PART br_mpc_status br_sqp_iterate(br_mpc *mpc, int warm, int first_of_warm);
BR_PART void br_incumbent_reset(br_mpc *mpc);
BR_PART void br_incumbent_keep(br_mpc *mpc, br_mpc_status status, int lowest);
BR_PART br_mpc_status br_incumbent_restore(br_mpc *mpc, br_mpc_status status);
BR_PART void br_plan_keep(const br_mpc *mpc, br_mpc_status status, br_incumbent *kept);
BR_PART void br_plan_restore(br_mpc *mpc, const br_incumbent *kept);
BR_PART br_mpc_status br_first_plan_compare(br_mpc *mpc, br_mpc_status status, int *second);

/* --- br_step.c --- */

BR_PART void br_forget_linearisation(br_mpc *mpc);

#endif
