/* FMI 3.0 Co-Simulation and Model Exchange: the functions that 2.0 has in another form, or not.
 * An importer may load every function, so those of what these FMUs lack exist as well. */
#include <math.h>

#include "fmi.h"

static void report(const fmu_instance *instance, fmi3Status status, const char *category,
                   const char *text) {
    if (instance->logger)
        ((fmi3LogMessageCallback)instance->logger)(instance->environment, status, category, text);
}

static void no(fmi3Boolean *answer) {
    if (answer) *answer = fmi3False;
}

/* ---- instances ---- */

#define INSTANTIATE(kind, reason, ...)                                                          \
    fmi3Instance fmi3Instantiate##kind(fmi3String name, fmi3String token, fmi3String resources, \
                                       fmi3Boolean visible, fmi3Boolean logging, __VA_ARGS__) { \
        const char *refused = reason;                                                           \
        if (!refused)                                                                           \
            return fmu_new(name, token, resources, report, (void (*)(void))log, environment);   \
        if (log) log(environment, fmi3Error, "logStatusError", refused);                        \
        return NULL;                                                                            \
    }
#define ENVIRONMENT fmi3InstanceEnvironment environment, fmi3LogMessageCallback log
#define OTHER_KIND "this FMU is of another kind"

/* clang-format off */
INSTANTIATE(ModelExchange, FMU_STATES ? NULL : OTHER_KIND, ENVIRONMENT)
INSTANTIATE(CoSimulation,
            FMU_STATES            ? OTHER_KIND
            : events || n_between ? "this FMU has neither event mode nor intermediate variables"
                                  : NULL,
            fmi3Boolean events, fmi3Boolean early_return, const fmi3ValueReference between[],
            size_t n_between, ENVIRONMENT, fmi3IntermediateUpdateCallback update)
INSTANTIATE(ScheduledExecution, OTHER_KIND, ENVIRONMENT, fmi3ClockUpdateCallback update,
            fmi3LockPreemptionCallback lock, fmi3UnlockPreemptionCallback unlock)
/* clang-format on */

fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean has_tolerance,
                                       fmi3Float64 tolerance, fmi3Float64 start,
                                       fmi3Boolean has_stop, fmi3Float64 stop) {
    REQUIRE(FMU_INSTANTIATED);
    if (!fmu_set_times(instance, start, has_stop, stop)) return fmi3Error;
    instance->phase = FMU_INITIALISATION;
    return fmi3OK;
}

/* ---- functions for what these FMUs do not have ---- */

/* clang-format off */
#define ABSENT(function, ...) /* an error unless it concerns no variable */                        \
    fmi3Status function(fmi3Instance c, __VA_ARGS__) { return fmu_absent(c, n, __func__); }
#define NEVER(function, ...)                                                                       \
    fmi3Status function(__VA_ARGS__) { return fmu_absent(c, 1, __func__); }
#define NAMED const fmi3ValueReference vr[], size_t n
#define NO_VARIABLES(type)                                                                         \
    ABSENT(fmi3Get##type, NAMED, fmi3##type value[], size_t n_values)                              \
    ABSENT(fmi3Set##type, NAMED, const fmi3##type value[], size_t n_values)

NO_VARIABLES(Float32) NO_VARIABLES(Int8) NO_VARIABLES(Int16) NO_VARIABLES(Int64)
NO_VARIABLES(UInt8) NO_VARIABLES(UInt16) NO_VARIABLES(UInt32) NO_VARIABLES(UInt64)
NO_VARIABLES(String)
ABSENT(fmi3GetBinary, NAMED, size_t sizes[], fmi3Binary value[], size_t n_values)
ABSENT(fmi3SetBinary, NAMED, const size_t sizes[], const fmi3Binary value[], size_t n_values)
ABSENT(fmi3GetClock, NAMED, fmi3Clock value[])
ABSENT(fmi3SetClock, NAMED, const fmi3Clock value[])
ABSENT(fmi3GetIntervalDecimal, NAMED, fmi3Float64 interval[], fmi3IntervalQualifier qualifier[])
ABSENT(fmi3GetIntervalFraction, NAMED, fmi3UInt64 counter[], fmi3UInt64 resolution[],
       fmi3IntervalQualifier qualifier[])
ABSENT(fmi3GetShiftDecimal, NAMED, fmi3Float64 shift[])
ABSENT(fmi3GetShiftFraction, NAMED, fmi3UInt64 counter[], fmi3UInt64 resolution[])
ABSENT(fmi3SetIntervalDecimal, NAMED, const fmi3Float64 interval[])
ABSENT(fmi3SetIntervalFraction, NAMED, const fmi3UInt64 counter[], const fmi3UInt64 resolution[])
ABSENT(fmi3SetShiftDecimal, NAMED, const fmi3Float64 shift[])
ABSENT(fmi3SetShiftFraction, NAMED, const fmi3UInt64 counter[], const fmi3UInt64 resolution[])
ABSENT(fmi3GetOutputDerivatives, NAMED, const fmi3Int32 order[], fmi3Float64 value[],
       size_t n_values)
ABSENT(fmi3GetAdjointDerivative, const fmi3ValueReference unknown[], size_t n,
       const fmi3ValueReference known[], size_t n_known, const fmi3Float64 seed[], size_t n_seed,
       fmi3Float64 out[], size_t n_out)
ABSENT(fmi3GetEventIndicators, fmi3Float64 value[], size_t n)
NEVER(fmi3GetNumberOfVariableDependencies, fmi3Instance c, fmi3ValueReference vr, size_t *n)
NEVER(fmi3GetVariableDependencies, fmi3Instance c, fmi3ValueReference dependent,
      size_t of_dependent[], fmi3ValueReference independent[], size_t of_independent[],
      fmi3DependencyKind kind[], size_t n)
NEVER(fmi3EnterConfigurationMode, fmi3Instance c)
NEVER(fmi3ExitConfigurationMode, fmi3Instance c)
NEVER(fmi3EnterStepMode, fmi3Instance c)
NEVER(fmi3EvaluateDiscreteStates, fmi3Instance c)
NEVER(fmi3ActivateModelPartition, fmi3Instance c, fmi3ValueReference clock, fmi3Float64 time)
    /* clang-format on */

    /* ---- Co-Simulation; the phase refuses it in Model Exchange ---- */

    fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 time, fmi3Float64 h, fmi3Boolean no_rollback,
                          fmi3Boolean *event, fmi3Boolean *terminate, fmi3Boolean *early,
                          fmi3Float64 *reached) {
    REQUIRE(FMU_STEPPING);
    const fmi3Status status = fmu_step(instance, time, h);
    no(event), no(terminate), no(early);
    if (reached) *reached = instance->value[FMU_V_time];
    return status;
}

/* ---- Model Exchange; the phase refuses it in Co-Simulation ---- */

#define INITIALISED (FMU_INITIALISATION | FMU_EVENT | FMU_CONTINUOUS | FMU_TERMINATED)

#define ENTER(mode, before, after)               \
    fmi3Status fmi3Enter##mode(fmi3Instance c) { \
        REQUIRE(before);                         \
        instance->phase = after;                 \
        return fmi3OK;                           \
    }

/* clang-format off */
ENTER(EventMode, FMU_CONTINUOUS, FMU_EVENT)
ENTER(ContinuousTimeMode, FMU_EVENT, FMU_CONTINUOUS)
/* clang-format on */

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *again, fmi3Boolean *terminate,
                                    fmi3Boolean *nominals, fmi3Boolean *values, fmi3Boolean *timed,
                                    fmi3Float64 *next) {
    REQUIRE(FMU_EVENT);
    no(again), no(terminate), no(nominals), no(values), no(timed);
    if (next) *next = INFINITY;
    return fmi3OK;
}

fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c, fmi3Boolean no_rollback, fmi3Boolean *event,
                                       fmi3Boolean *terminate) {
    REQUIRE(FMU_CONTINUOUS);
    no(event), no(terminate);
    return fmi3OK;
}

fmi3Status fmi3SetTime(fmi3Instance c, fmi3Float64 time) {
    REQUIRE(FMU_EVENT | FMU_CONTINUOUS);
    if (!isfinite(time)) return FMU_ERROR(instance, "fmi3SetTime: %g is no time", time);
    instance->value[FMU_V_time] = time;
    return fmi3OK;
}

/* A function of an array x [n] with one number for each state k. */
#define OF_STATES(function, type, phases, status, assignment)                                   \
    fmi3Status function(fmi3Instance c, type x[], size_t n) {                                   \
        REQUIRE(phases);                                                                        \
        if (!x || n != FMU_STATES)                                                              \
            return FMU_ERROR(instance, "%d continuous states, but an array of %lu", FMU_STATES, \
                             (unsigned long)n);                                                 \
        const fmi3Status result = status;                                                       \
        for (size_t k = 0; k < n; k++) assignment;                                              \
        return result;                                                                          \
    }

/* clang-format off */
OF_STATES(fmi3SetContinuousStates, const double, FMU_CONTINUOUS, fmi3OK, instance->value[k] = x[k])
OF_STATES(fmi3GetContinuousStates, double, INITIALISED, fmi3OK, x[k] = instance->value[k])
OF_STATES(fmi3GetNominalsOfContinuousStates, double, INITIALISED, fmi3OK,
          x[k] = fmu_variables[k].nominal)
OF_STATES(fmi3GetContinuousStateDerivatives, double, INITIALISED, fmu_derivatives(instance),
          x[k] = instance->value[FMU_FIRST_DERIVATIVE + k])
/* clang-format on */

#define COUNT(function, number)                      \
    fmi3Status function(fmi3Instance c, size_t *n) { \
        if (c && n) *n = number;                     \
        return c && n ? fmi3OK : fmi3Error;          \
    }

/* clang-format off */
COUNT(fmi3GetNumberOfContinuousStates, FMU_STATES)
COUNT(fmi3GetNumberOfEventIndicators, 0)
/* clang-format on */

/* Whether all are states or derivatives (unknowns), or none is a derivative (knowns). */
static bool differentiable(const fmu_instance *instance, const fmi3ValueReference *reference,
                           size_t n, bool unknown) {
    for (size_t i = 0; i < n; i++) {
        const uint32_t r = reference[i];
        if (r >= FMU_VALUES || fmu_variables[r].kind != FMU_REAL)
            return fmu_refuse(instance, "value reference %u is no real variable", (unsigned)r);
        if (unknown ? !FMU_IS_STATE(r) && !FMU_IS_DERIVATIVE(r) : FMU_IS_DERIVATIVE(r))
            return fmu_refuse(instance, "'%s' is no %s that can be differentiated",
                              fmu_variables[r].name, unknown ? "unknown" : "known");
    }
    return true;
}

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance c, const fmi3ValueReference unknown[],
                                        size_t n_unknown, const fmi3ValueReference known[],
                                        size_t n_known, const fmi3Float64 seed[], size_t n_seed,
                                        fmi3Float64 out[], size_t n_out) {
    double in[FMU_VALUES] = {0}, all[FMU_VALUES] = {0};
    REQUIRE(FMU_STATES ? INITIALISED : 0);
    if (!seed || !out || n_seed != n_known || n_out != n_unknown || (n_known && !known) ||
        (n_unknown && !unknown))
        return FMU_ERROR(instance, "partial derivatives: a pointer is NULL or a size does not fit");
    if (!differentiable(instance, known, n_known, false) ||
        !differentiable(instance, unknown, n_unknown, true))
        return fmi3Error;
    for (size_t i = 0; i < n_known; i++) in[known[i]] += seed[i];
#if FMU_STATES
    fmu_model_directional(instance, in, all);
#endif
    for (size_t i = 0; i < n_unknown; i++) out[i] = all[unknown[i]];
    return fmi3OK;
}
