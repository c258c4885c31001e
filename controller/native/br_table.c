/* The table of this code's functions: see br_code.h. */
#include "br_internal.h"

#ifndef BR_CODE
#define BR_CODE br_code_baseline
#endif

const br_code BR_CODE = {.step = br_step,
                         .solve = br_solve,
                         .prepare = br_prepare,
                         .rehearse = br_rehearse,
                         .predict = br_predict,
#if BR_HAS_PATH
                         .steer = br_steer,
#endif
                         .variance = br_variance,
                         .evaluate = br_evaluate,
                         .load = br_gp_load};
