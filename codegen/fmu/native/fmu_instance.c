/* Instances, their phases, their messages; steps of Co-Simulation. */
#include "fmu.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define ALIGNED(size) (((size) + 63) / 64 * 64)
#define LONGEST_STEP_S 1000.0 /* internal steps are counted by int */

const char *FMI(GetVersion)(void) { return FMI(Version); }

/* ---- messages ---- */

static void report(const fmu_instance *instance, FMI(Status) status, const char *format,
                   va_list arguments) {
    static const char *const categories[] = {"logStatusOK", "logStatusWarning", "logStatusDiscard",
                                             "logStatusError"};
    char text[512];
    vsnprintf(text, sizeof text, format, arguments);
    fmu_report(instance, status, categories[status], text);
}

bool fmu_refuse(const fmu_instance *instance, const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    report(instance, FMI(Error), format, arguments);
    va_end(arguments);
    return false;
}

FMI(Status) fmu_note(const fmu_instance *instance, FMI(Status) status, const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    report(instance, status, format, arguments);
    va_end(arguments);
    return status;
}

FMI(Status) fmu_absent(const fmu_instance *instance, size_t variables, const char *function) {
    if (instance && !variables) return FMI(OK);
    if (instance) fmu_refuse(instance, "%s: this FMU does not have that", function);
    return FMI(Error);
}

/* Only what is not OK is logged, and always. */
FMI(Status) FMI(SetDebugLogging)(void *c, FMI(Boolean) on, size_t n, const FMI(String) names[]) {
    return c ? FMI(OK) : FMI(Error);
}

/* ---- instances ---- */

static bool create(fmu_instance *instance) {
    for (size_t i = 0; i < FMU_VALUES; i++) instance->value[i] = fmu_variables[i].start;
    instance->stop_time = INFINITY;
    memset(instance->model, 0, fmu_model_size());
    const bool fine = fmu_model_create(instance);
    instance->phase = fine ? FMU_INSTANTIATED : FMU_FAILED;
    return fine;
}

fmu_instance *fmu_new(const char *name, const char *token, const char *resources,
                      void (*logger)(void), void *environment) {
    if (!name || !name[0]) name = FMU_IDENTIFIER;
    if (!resources) resources = "";
    const size_t own = ALIGNED(sizeof(fmu_instance)), model = ALIGNED(fmu_model_size());
    const size_t letters = strlen(name) + 1;
    char *block = calloc(1, 64 + own + model + letters + strlen(resources) + 1);
    if (!block) return NULL;
    fmu_instance *instance = (fmu_instance *)ALIGNED((uintptr_t)block);
    instance->block = block;
    instance->model = (char *)instance + own;
    instance->name = strcpy((char *)instance + own + model, name);
    instance->resources = fmu_folder(strcpy(instance->name + letters, resources));
    instance->logger = logger;
    instance->environment = environment;
    char *path = instance->resources;
    for (size_t n = path ? strlen(path) : 0; n > 1 && strchr("/\\", path[n - 1]);) path[--n] = 0;
    if (!token || strcmp(token, FMU_TOKEN) != 0)
        fmu_refuse(instance,
                   "the instantiation token (GUID) is '%s', but this binary belongs to "
                   "'%s'",
                   token ? token : "", FMU_TOKEN);
    else if (create(instance))
        return instance;
    FMI(FreeInstance)(instance);
    return NULL;
}

void FMI(FreeInstance)(void *c) {
    fmu_instance *instance = c;
    if (!instance) return;
    while (instance->saved) {
        void *state = instance->saved;
        FMI(FreeFMUState)(instance, &state);
    }
    free(instance->block);
}

/* ---- phases ---- */

const char *fmu_phase_name(const fmu_instance *instance) {
    switch (instance->phase) {
    case FMU_INSTANTIATED:
        return "instantiated";
    case FMU_INITIALISATION:
        return "initialisation";
    case FMU_EVENT:
        return "event mode";
    case FMU_CONTINUOUS:
        return "continuous-time mode";
    case FMU_STEPPING:
        return "stepping";
    case FMU_TERMINATED:
        return "terminated";
    default:
        return "failed";
    }
}

bool fmu_in_phase(const fmu_instance *instance, unsigned phases, const char *function) {
    if (!instance) return false;
    return instance->phase & phases || fmu_refuse(instance, "%s is not allowed in phase '%s'",
                                                  function, fmu_phase_name(instance));
}

bool fmu_set_times(fmu_instance *instance, double start, bool has_stop, double stop) {
    if (!isfinite(start) || (has_stop && !(stop >= start)))
        return fmu_refuse(instance, "start time %g and stop time %g are no interval", start, stop);
    instance->value[FMU_V_time] = start;
    instance->stop_time = has_stop ? stop : INFINITY;
    return true;
}

FMI(Status) FMI(ExitInitializationMode)(void *c) {
    REQUIRE(FMU_INITIALISATION);
    if (!fmu_model_initialise(instance)) return FMI(Error);
    instance->phase = FMU_STATES ? FMU_EVENT : FMU_STEPPING;
    return FMI(OK);
}

FMI(Status) FMI(Terminate)(void *c) {
    REQUIRE(FMU_EVENT | FMU_CONTINUOUS | FMU_STEPPING);
    instance->phase = FMU_TERMINATED;
    return FMI(OK);
}

FMI(Status) FMI(Reset)(void *c) {
    REQUIRE(ANY_PHASE);
    return create(instance) ? FMI(OK) : FMI(Error);
}

FMI(Status) fmu_step(fmu_instance *instance, double time, double h) {
    double *now = &instance->value[FMU_V_time];
    const double tolerance = 1e-6 * (1 + fabs(*now)), end = instance->stop_time;
    if (!(h > 0 && h <= LONGEST_STEP_S))
        return fmu_note(instance, FMI(Error),
                        "the communication step is %g s, must be positive and at most %g", h,
                        LONGEST_STEP_S);
    if (!(fabs(time - *now) <= tolerance))
        return fmu_note(instance, FMI(Error), "asked to continue at %.9g s, but time is %.9g s",
                        time, *now);
    if (time + h > end + tolerance)
        return fmu_note(instance, FMI(Error), "%.9g s is after the stop time %.9g s", time + h,
                        end);
    FMI(Status) status = FMI(OK);
#if !FMU_STATES
    status = fmu_model_step(instance, h);
#endif
    if (status == FMI(Error))
        instance->phase = FMU_FAILED;
    else
        *now = time + h;
    return status;
}
