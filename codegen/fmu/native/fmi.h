/* The FMI layer: what is alike in both versions of FMI (fmi.c), for fmi2.c or fmi3.c, which have
 * the functions of one version. */
#ifndef FMI_H
#define FMI_H

#include "fmu.h"

typedef enum { FMU_REAL, FMU_INTEGER, FMU_BOOLEAN } fmu_kind;

typedef struct {
    const char *name;
    fmu_kind kind;
    fmu_role role;
    double start, min, max;
    bool open; /* min and max themselves are excluded */
    double nominal;
} fmu_variable;

extern const fmu_variable fmu_variables[FMU_VALUES];

/* States of Model Exchange come first, their derivatives last but for the time. */
#define FMU_FIRST_DERIVATIVE (FMU_VALUES - 1 - FMU_STATES)
#define FMU_IS_STATE(reference) ((int)(reference) < FMU_STATES)
#define FMU_IS_DERIVATIVE(reference) \
    ((int)(reference) >= FMU_FIRST_DERIVATIVE && (reference) != FMU_V_time)

/* NULL after a message if the token is another FMU's, or the model refuses. resources: path of that
 * folder, empty or NULL for none. */
fmu_instance *fmu_new(const char *name, const char *token, const char *resources,
                      fmu_report *report, void (*logger)(void), void *environment);

/* Whether the instance, which may be NULL, is in one of the phases; else a message. */
bool fmu_in_phase(const fmu_instance *instance, unsigned phases, const char *function);

/* Ends an FMI function of `void *c` with an error unless that is an instance in such a phase. */
#define REQUIRE(phases)         \
    fmu_instance *instance = c; \
    if (!fmu_in_phase(instance, phases, __func__)) return FMI(Error)
#define ANY_PHASE (~0u)

/* Answers a function that these FMUs do not have: with an error unless it concerns no variable. */
FMI(Status) fmu_absent(const fmu_instance *instance, size_t variables, const char *function);

bool fmu_set_times(fmu_instance *instance, double start, bool has_stop, double stop);
FMI(Status) fmu_step(fmu_instance *instance, double time, double h); /* Co-Simulation */

/* Model Exchange: computes the derivatives' values; Discard if they are not finite. */
FMI(Status) fmu_derivatives(fmu_instance *instance);

#endif
