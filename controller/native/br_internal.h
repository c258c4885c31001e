/* What the parts of the controller know of each other; not for users. */
#ifndef BR_INTERNAL_H
#define BR_INTERNAL_H

#include <daqp/types.h>
#include <stdatomic.h>

#define BR_TABLES /* the sparsity of the problem, too */
#include "bayesrace_mpc.h"
#include "br_code.h"
#include "br_vector.h"

/* Before loops over states, inputs, rows and their nonzeros, which have constant bounds: unrolled,
 * the problem's sparsity is in the code, and no table is read. */
#ifdef __clang__
#define BR_UNROLL _Pragma("unroll")
#else
#define BR_UNROLL _Pragma("GCC unroll 16")
#endif

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
#define BR_GP_BLOCK 128     /* training points that are taken at a time: in the first-level cache */
#define BR_GP_BLOCKS ((BR_GP_CAPACITY + BR_GP_BLOCK - 1) / BR_GP_BLOCK)
#define BR_GP_PADDED (BR_GP_BLOCKS * BR_GP_BLOCK)
/* Training points that the posterior variance is exact with: the memory for it grows with the
 * square. */
#define BR_GP_ROOT (BR_GP_CAPACITY < 512 ? (BR_GP_CAPACITY + 7) / 8 * 8 : 512)
#define BR_ROOT_TILE 8 /* rows of a triangular matrix that are stored together */
#define BR_ROOT_SIZE(n) \
    ((n) * ((n) + BR_ROOT_TILE) / 2)      /* numbers of n rows, whole tiles of them */
#define BR_COLUMNS 8                      /* stages whose correlations are at hand at a time */
#define BR_GP_FIRST ((1 + BR_NZ + 7) / 8) /* groups of eight columns for 1 and the inputs ... */
#define BR_GP_SECOND ((BR_NZ * (BR_NZ + 1) / 2 + 7) / 8) /* ... and for their products */

/* One output of the residual as the kernel wants it: scaled features, structure of arrays. */
typedef struct {
    int kernel, n_padded;
    double offset;
    double inverse_scale[BR_NZ], middle[BR_NZ]; /* z * inverse_scale - middle is what is in ... */
    double reach;                               /* length of the longest input */
    BR_ALIGNED double inputs[BR_NZ][BR_GP_PADDED];
    BR_ALIGNED double alpha[BR_GP_PADDED];   /* signal scale folded in */
    BR_ALIGNED double squares[BR_GP_PADDED]; /* of the length of the inputs, times -log2(e) / 2 */
    BR_ALIGNED double columns[BR_GP_FIRST + BR_GP_SECOND][BR_GP_PADDED][8];
} br_gp_output;

/* What the posterior variance of one output is made from: see br_variance.c. */
typedef struct {
    int kernel, count;    /* training points that count */
    double signal, noise; /* variances; signal 0: not known */
    double inputs[BR_NZ][BR_GP_ROOT];
    BR_ALIGNED double root[BR_ROOT_SIZE(BR_GP_ROOT)];
} br_gp_variance;

typedef struct br_gp {
    int any; /* 0 while every output is constant zero: WorstCase and BestCase skip the kernels */
    int uncertain; /* the variance of an output is known */
    br_gp_output output[BR_NE];
    br_gp_variance variance[BR_NE];
} br_gp;

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

/* Weights of one block of training points. */
typedef double br_gp_row[BR_GP_BLOCK];

/* The residual at one stage. */
typedef struct {
    double mean[BR_NE], gradient[BR_NE][BR_NZ];
    double sums[BR_NE][8 * BR_GP_FIRST]; /* for br_gp_curvature */
} br_correction;

/* Linearisation of the corrected model at one stage. */
typedef struct {
    double f[BR_NX];
    double jacobian[BR_NX][BR_NV];
    double hessian[BR_NV][BR_NV]; /* weighted with the costate of the stage's end; made later */
    double in_e[BR_NX][BR_NE];    /* the nominal model's Jacobian in the residual */
    br_correction residual;
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
} br_path;

/* Where a state is beside the line. */
typedef struct {
    double left_m;    /* of the line */
    double middle_m;  /* of the track, to the left of the line */
    double outside_m; /* of the track less its margin; negative inside */
    double speed_mps; /* of the line */
} br_beside;

typedef struct {
    int regularised;  /* the exact Hessian was not positive definite */
    double curvature; /* share of the second-order part that is in h */
    br_stage_terms terms[BR_N];
    br_stage_curvature second[BR_N];
    double penalty[BR_NR];                       /* of the soft rows */
    BR_ALIGNED double g[BR_N + 1][BR_NX][BR_MP]; /* sensitivity of stage k to all blocks */
    BR_ALIGNED double costate[2][BR_NX][BR_MP];
    BR_ALIGNED double h[BR_M][BR_MP];   /* condensed Hessian, then its Cholesky factor */
    BR_ALIGNED double y[BR_M][BR_COLS]; /* L^{-1} [A' | gradient] */
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

/* The best plan so far of the iterations at hand, with its residuals. */
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
} br_transition;

/* What a residual learns from, and the errors on it: see br_watch.c. */
typedef struct {
    double z[BR_NZ], residual[BR_NE];
} br_sample;

typedef struct {
    int64_t number;         /* of the sample, from 1 on; 0: not judged */
    double error[2][BR_NE]; /* of the weights in use, of the proven ones */
} br_judged;

typedef struct {
    br_transition newest; /* not taken yet */
    int64_t count;        /* samples so far; the last BR_SAMPLES are kept */
    int64_t since;        /* of these, before the weights in use were adopted */
    br_sample sample[BR_SAMPLES];
    br_judged judged[BR_WATCHED]; /* the newest */
} br_watch;

/* Of each output, by how many standard deviations the residual errs: see br_caution.c. */
typedef struct {
    double recent[BR_NE], held[BR_NE]; /* mean of the newest; the largest, slowly forgotten */
} br_misfit;

typedef struct {
    br_transition newest, due; /* due: observed before the last step */
    int judged;                /* what is due is in misfit, else in neither */
    br_misfit misfit, before;
} br_innovation;

/* What the residual's uncertainty does to the plan: see br_caution.c. */
typedef struct {
    int active;                           /* there is an uncertainty to be cautious about */
    double deviation[BR_N][BR_NE][BR_NX]; /* of the states at the ends of the stages */
    double tube[BR_N];                    /* by how much the rows are uncertain, */
    double share[BR_N];                   /* as a share of the room that they leave */
    double pace;                          /* of the reference, as a share of the line's speed */
    double widening;                      /* of the last step's standard deviations, the largest */
    BR_ALIGNED double correlations[BR_GP_ROOT][BR_COLUMNS];
} br_caution;

/* Time within a call, by the host's clock. */
typedef struct {
    br_mpc_clock clock; /* NULL: none */
    void *context;
    int limited; /* there is a deadline */
    double deadline;
    double iteration, trial; /* longest seen, of the line search's trials too; 0: none yet */
    double caution;          /* what the last br_caution_update took */
} br_timer;

/* What is computed from the plan, the weights and a call's arguments, and kept while these stay.
 * The order is such that none is needed for one after it: see br_invalidate. */
typedef enum {
    BR_TERMS,    /* qp.terms: of the plan, the reference, u_before, the parameters and the tube */
    BR_FOLLOWED, /* reference and first_row: where the plan is on the line, if it follows that */
    BR_FACTORS,  /* qp: g, h, and y, scale, m of the rows before BR_ROW_LATE */
    BR_TUBE,     /* caution: of the plan that the step starts with */
    BR_LINEARISATION, /* stage[]: of the plan and the weights in use */
    BR_RESULTS
} br_result;

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
    double turn_u[BR_N][BR_NU]; /* inputs that the reference of a turn has been made with */
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
    br_innovation innovation;
    br_watch watch;
    br_stage stage[BR_N];
    BR_ALIGNED br_gp_row kernels[BR_NE * BR_GP_BLOCKS * BR_N]; /* see br_gp_evaluate */
    br_qp qp;
    double penalty; /* on the sum of the plan's defects ... */
    double merit;   /* ... beside its cost */
    double worth;   /* cost, to first order, once the defects are gone: costates price them */
    br_mpc_info info;
    br_gp gp[3]; /* in use, proven, spare. The last member of br_mpc, so that memory for points that
                    the weights do not have is never written to */
};

/* The result and all before it have to be computed again: what they are made from has changed. */
static inline void br_invalidate(br_mpc *mpc, br_result result) {
    memset(mpc->valid, 0, result + 1);
}

/* br_gp.c */
/* Mean and gradient of several stages, at most BR_N. Their weights for br_gp_curvature go into
 * kept, which has room for those of so many stages: (output, block, stage), row by row. */
BR_PART void br_gp_evaluate(const br_gp *gp, int stages, double (*z)[BR_NZ], br_gp_row *kept,
                            int room, br_correction *out);
/* Of all stages that kept has room for, out[s] = sum_j weight[s][j] d^2 mu_j / d z^2. */
BR_PART void br_gp_curvature(const br_gp *gp, int stages, double (*z)[BR_NZ], br_gp_row *kept,
                             const br_correction *const values[], double (*weight)[BR_NE],
                             double (*out)[BR_NZ][BR_NZ]);
BR_PART void br_gp_clear(br_gp *gp);
BR_PART void br_gp_mean(const br_gp *gp, const double z[BR_NZ], double mean[BR_NE]);
BR_PART br_mpc_error br_gp_load(br_gp *gp, const br_mpc_gp outputs[BR_NE]);

/* br_watch.c */
BR_PART void br_watch_update(br_mpc *mpc); /* in the preparation */

/* br_variance.c */
/* Of one output whose weights are loaded. */
BR_PART void br_variance_load(const br_gp_output *gp, const br_mpc_gp *in, br_gp_variance *v);
/* Noise included, of several stages; 0 where it is not known. */
BR_PART void br_gp_variances(const br_gp *gp, int stages, double (*z)[BR_NZ],
                             double (*work)[BR_COLUMNS], double (*variance)[BR_NE]);

/* br_caution.c */
BR_PART void br_caution_reset(br_caution *caution);
BR_PART void br_caution_update(br_mpc *mpc);
BR_PART void br_caution_tighten(br_mpc *mpc, int k, br_stage_terms *terms);
BR_PART void br_caution_pace(br_mpc *mpc, double elapsed);
BR_PART void br_caution_report(br_mpc *mpc); /* into mpc->info */

/* br_caution.c: against what the car does */
BR_PART void br_innovation_reset(br_innovation *innovation);
/* A step has been made: what was observed before it is due. */
BR_PART void br_innovation_advance(br_innovation *innovation);
/* By what the standard deviations of the output are to be multiplied. */
BR_PART int br_most_changed(const br_stage *stage, int output); /* state, by this output */
BR_PART double br_innovation_widening(const br_innovation *innovation, int output);
BR_PART int br_innovation_due(const br_innovation *innovation);
/* As if what is due had not been judged: parameters or code are others now. */
BR_PART void br_innovation_undo(br_innovation *innovation);
/* What is due, by the variance of the residual there; the plan is linearised. */
BR_PART void br_innovation_judge(br_mpc *mpc, const double variance[BR_NE]);

/* br_weights.c */
void br_weights_init(br_mpc *mpc);

/* br_planner.c */
BR_PART br_mpc_error br_path_load(br_path *path, const double *table, int n, double spacing);
BR_PART void br_path_plan(const br_path *path, double pace, br_mpc_reference reference[BR_N]);
BR_PART void br_path_project(br_path *path, const double x[BR_NX], double *lateral);
#if BR_FOLLOWS_PLAN
BR_PART void br_path_follow(br_mpc *mpc);
#else
static inline void br_path_follow(br_mpc *mpc) { (void)mpc; }
#endif
BR_PART void br_path_beside(const br_path *path, const double x[BR_NX], double *s_m,
                            br_beside *beside);
BR_PART double br_path_heading(const br_path *path, double s);
BR_PART double br_path_curvature(const br_path *path, double s);
BR_PART void br_path_ahead(const br_path *path, double distance, double point[2]);

/* br_turnaround.c */
BR_PART void br_turnaround(br_mpc *mpc);

/* br_stage.c */
/* Values and Jacobians of several stages, which take the slots from the given one on of kernels,
 * with room for so many. */
BR_PART void br_stages_linearise(const br_gp *gp, int stages, double (*x)[BR_NX],
                                 double (*u)[BR_NU], br_gp_row *kernels, int room, int slot,
                                 br_stage *stage);
/* Hessians of all linearised stages, at the same x and u; of each slot there is one. */
BR_PART void br_stages_curve(const br_gp *gp, int stages, double (*x)[BR_NX], double (*u)[BR_NU],
                             double (*lambda)[BR_NX], br_gp_row *kernels, br_stage *stage);
BR_PART void br_stage_features(const double x[BR_NX], const double u[BR_NU], double z[BR_NZ]);
/* Of at most BR_N + 1 states and inputs. */
BR_PART void br_stages_variances(const br_gp *gp, int stages, double (*x)[BR_NX],
                                 double (*u)[BR_NU], double (*work)[BR_COLUMNS],
                                 double (*variance)[BR_NE]);
/* gp NULL: without correction. */
BR_PART void br_stage_next(const br_gp *gp, const double x[BR_NX], const double u[BR_NU],
                           double x_next[BR_NX]);
BR_PART void br_stage_advance(const br_gp *gp, const double x[BR_NX], const double u[BR_NU],
                              double duration, double x_next[BR_NX]);

/* br_problem.c: cost and constraints as the problem's generated functions have them */
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
static inline const double *br_theta(const br_mpc_parameters *parameters) {
    return (const double *)parameters; /* the problem's come first, all of them doubles */
}

/* Whether the stage is the first of its block. */
static inline int br_opens_block(int k) { return k == 0 || BR_BLOCK_OF(k) > BR_BLOCK_OF(k - 1); }

/* Whole vectors that cover columns 0..n-1 of a BR_MP-wide row; the rest of a row is zero. */
static inline int br_padded(int n) { return (n + 7) & ~7; }

/* br_condense.c */
BR_PART void br_condense_states(br_mpc *mpc); /* the sensitivities of all states, into qp.g */
/* Into qp.h, with this share of the second-order part of dynamics and rows. */
BR_PART void br_condense_hessian(br_mpc *mpc, double tau);
/* At dU = 0, into qp.gradient; and the change of the states there, into qp.xbar. */
BR_PART void br_condense_gradient(br_mpc *mpc, double tau);

/* br_qp.c: the QP of one SQP iteration */
BR_PART void br_qp_init(br_qp *qp);
BR_PART void br_qp_factorise(br_mpc *mpc);
BR_PART br_mpc_status br_qp_condense(br_mpc *mpc);
BR_PART br_mpc_status br_qp_solve(br_mpc *mpc, int warm);
BR_PART void br_qp_shift_rows(void *rows, size_t size);
BR_PART void br_qp_forget_working_set(br_qp *qp);

/* br_prepare.c: the clock that the host gave */
BR_PART void br_timer_start(br_timer *timer, double budget);
BR_PART double br_timer_now(const br_timer *timer);
BR_PART int br_timer_allows(const br_timer *timer, double now, double duration);
BR_PART void br_timer_note(const br_timer *timer, double begin, double *longest);

/* br_sqp.c: the plan's start, shift and iteration */
BR_PART void br_sqp_linearise(br_mpc *mpc);
BR_PART void br_sqp_curve(br_mpc *mpc);
BR_PART void br_sqp_cold_start(br_mpc *mpc);
BR_PART void br_sqp_roll_out(br_mpc *mpc, const double u[BR_NU]);
BR_PART void br_sqp_shift(br_mpc *mpc);
BR_PART br_mpc_status br_sqp_iterate(br_mpc *mpc, int warm, int first_of_warm);

/* br_prepare.c: in step with time */
BR_PART int br_plausible_state(const double x[BR_NX]);
BR_PART int br_plausible_input(const double u[BR_NU]);
BR_PART int br_shifts_due(double *lag);
BR_PART void br_align(br_mpc *mpc, int shifts);
BR_PART void br_undo_preparation(br_mpc *mpc);
BR_PART void br_forget_linearisation(br_mpc *mpc);

/* br_step.c, br_prepare.c, br_predict.c, br_planner.c: functions of the interface,
 * see br_code.h */
BR_PART br_mpc_error br_step(br_mpc *mpc, const double x[BR_NX], const double u_before[BR_NU],
                             const br_environment *environment, double elapsed_s, double budget_s,
                             double u[BR_NU], br_mpc_status *status, br_mpc_info *info);
BR_PART br_mpc_error br_solve(br_mpc *mpc, const double x[BR_NX], const double u_before[BR_NU],
                              double elapsed_s, double budget_s,
                              const br_mpc_reference reference[BR_N], double u[BR_NU],
                              br_mpc_status *status, br_mpc_info *info);
BR_PART br_mpc_error br_prepare(br_mpc *mpc, double elapsed_s, double budget_s);
BR_PART br_mpc_error br_rehearse(br_mpc *mpc);
BR_PART br_mpc_error br_predict(const br_mpc *mpc, const double x[BR_NX], const double u[BR_NU],
                                double duration_s, double x_next[BR_NX]);
/* The same by these weights; gp NULL: without correction. */
BR_PART br_mpc_error br_predict_by(const br_mpc *mpc, const br_gp *gp, const double x[BR_NX],
                                   const double u[BR_NU], double duration_s, double x_next[BR_NX]);
BR_PART br_mpc_error br_steer(const br_mpc *mpc, const double x[BR_NX], double *s_m,
                              double *angle_rad, double *outside_m);
BR_PART br_mpc_error br_variance(br_mpc *mpc, const double v[BR_NV], double variance[BR_NE]);
BR_PART br_mpc_error br_evaluate(const br_mpc *mpc, const double v[BR_NV],
                                 const double lambda[BR_NX], double x_next[BR_NX],
                                 double jacobian[BR_NX * BR_NV], double hessian[BR_NV * BR_NV]);

/* br_step.c */
BR_PART br_mpc_status br_start_again(br_mpc *mpc, br_mpc_status status, unsigned turn);
BR_PART int br_iteration_limit(const br_mpc *mpc);

/* br_sqp.c: the best plan of several iterations */
BR_PART void br_incumbent_reset(br_mpc *mpc);
BR_PART void br_incumbent_keep(br_mpc *mpc, br_mpc_status status, int lowest);
BR_PART br_mpc_status br_incumbent_restore(br_mpc *mpc, br_mpc_status status);
BR_PART void br_first_plan_keep(br_mpc *mpc, br_mpc_status status);
BR_PART br_mpc_status br_first_plan_compare(br_mpc *mpc, br_mpc_status status, int *second);

/* br_residuals.c */
BR_PART int br_all_finite(const double *values, int n);
/* The larger one, and NaN if either is: fmax would lose a NaN and with it a bad solution. */
static inline double br_worse(double a, double b) { return b > a || b != b ? b : a; }
BR_PART void br_residuals(br_mpc *mpc);
BR_PART double br_residual(const br_mpc *mpc);
BR_PART br_mpc_status br_judge(const br_mpc *mpc);
static inline int br_usable(br_mpc_status status) { return status <= BR_ACCEPTABLE; }

#endif
