/* All of the step but the model, once more, by br_avx2.c and br_avx512.c: see br_code.h. */

/* Compiled as if each were in a file of its own: inlined into each other, or copied for constant
 * arguments, which gcc does to functions of one file, second derivatives take a quarter longer. */
#if defined(__clang__)
#define BR_PART static __attribute__((noinline))
#else
#define BR_PART static __attribute__((noinline, noclone))
#endif

#pragma GCC diagnostic ignored "-Wunused-function" /* part of it is for other files */

#include "br_caution.c"
#include "br_condense.c"
#include "br_gp.c"
#include "br_planner.c"
#include "br_predict.c"
#include "br_prepare.c"
#include "br_problem.c"
#include "br_qp.c"
#include "br_residuals.c"
#include "br_sqp.c"
#include "br_stage.c"
#include "br_step.c"
#include "br_turnaround.c"
#include "br_variance.c"
#include "br_watch.c"
