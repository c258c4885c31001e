/* The step but the generated model, once more, by br_avx2.c and br_avx512.c.
 *
 * The step is compiled for several instruction sets, of which the processor's best is chosen at
 * run time. Each of the files below is compiled by itself, for the processor that the compiler's
 * options name (any x86-64, say). On x86-64, br_avx2.c and br_avx512.c include all of them once
 * more, each with its own instructions and vectors of its own length; there everything is static
 * but the table of functions. What is stored in a br_mpc is the same for all, so code may be
 * exchanged between two calls. Results differ by rounding. */

#pragma GCC diagnostic ignored "-Wunused-function" /* part of it is for other files */

#include "br_caution.c"
#include "br_certainty.c"
#include "br_condense.c"
#include "br_gp.c"
#include "br_mismatch.c"
#include "br_planner.c"
#include "br_problem.c"
#include "br_qp.c"
#include "br_sqp.c"
#include "br_stage.c"
#include "br_step.c"
#include "br_variance.c"
#include "br_watch.c"
