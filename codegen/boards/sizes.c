/* What a controller keeps in its memory, by part, for codegen/boards/memory.py: it reads the
 * assembler text, so that a compiler for any processor says it, and nothing has to run. */
#define br_residual br_residual_of_plan /* a function here, a type there */
#include "br_internal.h"
#undef br_residual
#include "br_cycle.c"

#define SIZE(part, bytes) __asm__ volatile(".ascii \"->" part " %c0;\"" ::"i"(bytes))

void br_sizes(void) {
    SIZE("controller", sizeof(br_mpc));
    SIZE("path", sizeof(br_path));
    SIZE("weights", sizeof(((br_mpc *)0)->gp));
    SIZE("qp", sizeof(br_qp));
    SIZE("stages", sizeof(((br_mpc *)0)->stage) + sizeof(((br_mpc *)0)->kernels));
    SIZE("watch", sizeof(br_watch));
#if BR_HAS_PATH
    SIZE("cycle", sizeof(br_cycle));
    SIZE("estimator", sizeof(br_estimator));
#endif
}
