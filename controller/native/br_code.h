/* The step's code, compiled for several instruction sets, of which the processor's best is chosen
 * at run time.
 *
 * Each file of br_parts.h is compiled as it is, for whatever the compiler is told to compile for
 * (any x86-64, say). On x86-64, br_avx2.c and br_avx512.c include all of them once more, each with
 * its own instructions and vectors of its own length; there everything is static but the table of
 * functions. What is stored in a br_mpc is the same for all, so code may be exchanged between two
 * calls. Results differ by rounding.
 */
#ifndef BR_CODE_H
#define BR_CODE_H

#include "bayesrace_mpc.h"

/* Linkage of what the parts of the step know of each other. */
#ifndef BR_PART
#define BR_PART
#endif

struct br_gp;

/* The functions of the interface that take time. */
typedef struct {
    br_mpc_error (*step)(br_mpc *, const double *, const double *, const br_environment *, double,
                         double, double *, br_mpc_status *, br_mpc_info *);
    br_mpc_error (*solve)(br_mpc *, const double *, const double *, double, double,
                          const br_mpc_reference *, double *, br_mpc_status *, br_mpc_info *);
    br_mpc_error (*prepare)(br_mpc *, double, double);
    br_mpc_error (*rehearse)(br_mpc *);
    br_mpc_error (*predict)(const br_mpc *, const double *, const double *, double, double *);
#if BR_HAS_PATH
    br_mpc_error (*steer)(const br_mpc *, const double *, double *, double *, double *);
#endif
    br_mpc_error (*variance)(br_mpc *, const double *, double *);
    br_mpc_error (*evaluate)(const br_mpc *, const double *, const double *, double *, double *,
                             double *);
    br_mpc_error (*load)(struct br_gp *, const br_mpc_gp *);
} br_code;

extern const br_code br_code_baseline;
#if defined(__x86_64__)
extern const br_code br_code_avx2, br_code_avx512;
#endif

/* br_dispatch.c */
const br_code *br_fastest_code(void);

#endif
