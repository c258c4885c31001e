/* FMI 3.0 Co-Simulation and Model Exchange over fmu_layer.h; fmi3_absent.c has the functions for
 * what these FMUs do not have (clocks, arrays, strings, configuration), which must exist. */
#include <math.h>
#include <string.h>

#include "fmi3Functions.h"
#include "fmu_layer.h"
#include "fmu_tables.h" /* generated */

#define INSTANCE                                                                                   \
    fmu_instance *instance = c;                                                                    \
    if (!instance) return fmi3Error

#define IN(...)                                                                                    \
    INSTANCE;                                                                                      \
    if (fmu_in_phase(instance, __func__, __VA_ARGS__)) return fmi3Error

#define EVENT (1u << FMU_EVENT)
#define CONTINUOUS (1u << FMU_CONTINUOUS)
#define STEPPING (1u << FMU_STEPPING)
#define INITIALISATION (1u << FMU_INITIALISATION)
#define TERMINATED (1u << FMU_TERMINATED)

static fmi3Status status(int result)
{
    return result == FMU_FINE ? fmi3OK : result == FMU_NOT_FINITE ? fmi3Discard : fmi3Error;
}

static void put(fmi3Boolean *where, fmi3Boolean value)
{
    if (where) *where = value;
}

void fmu_emit(const fmu_instance *instance, const char *text)
{
    fmi3LogMessageCallback log;
    memcpy(&log, &instance->logger, sizeof log);
    if (log) log(instance->environment, fmi3Error, "logStatusError", text);
}

const char *fmi3GetVersion(void)
{
    return "3.0";
}

fmi3Status fmi3SetDebugLogging(fmi3Instance c, fmi3Boolean on, size_t n, const fmi3String names[])
{
    (void)on, (void)n, (void)names; /* there are errors only, always passed on */
    return c ? fmi3OK : fmi3Error;
}

/* ---- instances ---- */

static fmi3Instance make(int offered, fmi3String name, fmi3String token, fmi3String resources,
                         void *environment, fmi3LogMessageCallback log)
{
    void *logger = NULL;
    memcpy(&logger, &log, sizeof logger);
    if (offered) return fmu_new(name, token, resources, logger, environment);
    if (log) log(environment, fmi3Error, "logStatusError", "this FMU is of another kind");
    return NULL;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources,
                                          fmi3Boolean visible, fmi3Boolean logging,
                                          fmi3InstanceEnvironment environment,
                                          fmi3LogMessageCallback log)
{
    (void)visible, (void)logging;
    return make(FMU_ME, name, token, resources, environment, log);
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources,
                                         fmi3Boolean visible, fmi3Boolean logging,
                                         fmi3Boolean events, fmi3Boolean early_return,
                                         const fmi3ValueReference intermediate[],
                                         size_t n_intermediate, fmi3InstanceEnvironment environment,
                                         fmi3LogMessageCallback log,
                                         fmi3IntermediateUpdateCallback update)
{
    (void)visible, (void)logging, (void)early_return, (void)intermediate, (void)update;
    if (events || n_intermediate) {
        if (log)
            log(environment, fmi3Error, "logStatusError",
                "this FMU has neither event mode nor intermediate variables");
        return NULL;
    }
    return make(FMU_CS, name, token, resources, environment, log);
}

void fmi3FreeInstance(fmi3Instance c)
{
    if (c) fmu_delete(c);
}

/* ---- phases ---- */

fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean has_tolerance,
                                       fmi3Float64 tolerance, fmi3Float64 start,
                                       fmi3Boolean has_stop, fmi3Float64 stop)
{
    INSTANCE;
    (void)has_tolerance, (void)tolerance;
    if (fmu_enter_initialisation(instance)) return fmi3Error;
    if (fmu_set_times(instance, start, has_stop, stop) == FMU_FINE) return fmi3OK;
    instance->phase = FMU_INSTANTIATED;
    return fmi3Error;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance c)
{
    INSTANCE;
    return status(fmu_exit_initialisation(instance));
}

fmi3Status fmi3EnterEventMode(fmi3Instance c)
{
    IN(CONTINUOUS);
    instance->phase = FMU_EVENT;
    return fmi3OK;
}

fmi3Status fmi3Terminate(fmi3Instance c)
{
    INSTANCE;
    return status(fmu_terminate(instance));
}

fmi3Status fmi3Reset(fmi3Instance c)
{
    INSTANCE;
    return status(fmu_reset(instance));
}

/* ---- values ---- */

static void store_int(void *value, size_t i, double number)
{
    ((fmi3Int32 *)value)[i] = (fmi3Int32)number;
}

static double load_int(const void *value, size_t i)
{
    return ((const fmi3Int32 *)value)[i];
}

static void store_boolean(void *value, size_t i, double number)
{
    ((fmi3Boolean *)value)[i] = number != 0;
}

static double load_boolean(const void *value, size_t i)
{
    return ((const fmi3Boolean *)value)[i] ? 1 : 0;
}

/* all variables are scalars */
static int scalars(const fmu_instance *instance, size_t n, size_t n_values)
{
    if (n == n_values) return 1;
    fmu_log(instance, "%lu scalar variables, but %lu values", (unsigned long)n,
            (unsigned long)n_values);
    return 0;
}

#define ACCESS(name, type, kind, store, load)                                                      \
    fmi3Status fmi3Get##name(fmi3Instance c, const fmi3ValueReference vr[], size_t n,              \
                             type value[], size_t n_values)                                        \
    {                                                                                              \
        INSTANCE;                                                                                  \
        if (!scalars(instance, n, n_values)) return fmi3Error;                                     \
        return status(fmu_get(instance, kind, vr, n, value, store));                               \
    }                                                                                              \
    fmi3Status fmi3Set##name(fmi3Instance c, const fmi3ValueReference vr[], size_t n,              \
                             const type value[], size_t n_values)                                  \
    {                                                                                              \
        INSTANCE;                                                                                  \
        if (!scalars(instance, n, n_values)) return fmi3Error;                                     \
        return status(fmu_set(instance, kind, vr, n, value, load));                                \
    }

ACCESS(Float64, fmi3Float64, FMU_REAL, fmu_store_real, fmu_load_real)
ACCESS(Int32, fmi3Int32, FMU_INTEGER, store_int, load_int)
ACCESS(Boolean, fmi3Boolean, FMU_BOOLEAN, store_boolean, load_boolean)

/* ---- saved states ---- */

fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *state)
{
    INSTANCE;
    return status(fmu_save(instance, state));
}

fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState state)
{
    INSTANCE;
    return status(fmu_restore(instance, state));
}

fmi3Status fmi3FreeFMUState(fmi3Instance c, fmi3FMUState *state)
{
    INSTANCE;
    return status(fmu_forget(instance, state));
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance c, fmi3FMUState state, size_t *size)
{
    INSTANCE;
    return status(fmu_serialised_size(instance, state, size));
}

fmi3Status fmi3SerializeFMUState(fmi3Instance c, fmi3FMUState state, fmi3Byte bytes[], size_t size)
{
    INSTANCE;
    return status(fmu_serialise(instance, state, bytes, size));
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance c, const fmi3Byte bytes[], size_t size,
                                   fmi3FMUState *state)
{
    INSTANCE;
    return status(fmu_deserialise(instance, bytes, size, state));
}

/* ---- partial derivatives ---- */

static int partials(const fmu_instance *instance, const fmi3ValueReference *known, size_t n_known,
                    const fmi3ValueReference *unknown, size_t n_unknown, const double *seed,
                    const double *out, int sizes_fit)
{
    if (!FMU_DERIVATIVES) {
        fmu_log(instance, "this FMU has no partial derivatives");
    } else if (!sizes_fit || (n_known && !known) || (n_unknown && !unknown) || !seed || !out) {
        fmu_log(instance, "partial derivatives: a pointer is NULL or a size does not fit");
    } else if (!fmu_in_phase(instance, "a partial derivative",
                             INITIALISATION | EVENT | CONTINUOUS | TERMINATED)) {
        return fmu_differentiable(instance, known, n_known, unknown, n_unknown);
    }
    return FMU_REFUSED;
}

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance c, const fmi3ValueReference unknown[],
                                        size_t n_unknown, const fmi3ValueReference known[],
                                        size_t n_known, const fmi3Float64 seed[], size_t n_seed,
                                        fmi3Float64 out[], size_t n_out)
{
    INSTANCE;
    if (partials(instance, known, n_known, unknown, n_unknown, seed, out,
                 n_seed == n_known && n_out == n_unknown))
        return fmi3Error;
#if FMU_DERIVATIVES
    return status(fmu_model_directional(instance, known, n_known, seed, unknown, n_unknown, out));
#else
    return fmi3Error;
#endif
}

fmi3Status fmi3GetAdjointDerivative(fmi3Instance c, const fmi3ValueReference unknown[],
                                    size_t n_unknown, const fmi3ValueReference known[],
                                    size_t n_known, const fmi3Float64 seed[], size_t n_seed,
                                    fmi3Float64 out[], size_t n_out)
{
    INSTANCE;
    if (partials(instance, known, n_known, unknown, n_unknown, seed, out,
                 n_seed == n_unknown && n_out == n_known))
        return fmi3Error;
#if FMU_DERIVATIVES
    return status(fmu_model_adjoint(instance, unknown, n_unknown, seed, known, n_known, out));
#else
    return fmi3Error;
#endif
}

/* ---- Co-Simulation ---- */

fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 time, fmi3Float64 h, fmi3Boolean no_rollback,
                      fmi3Boolean *event, fmi3Boolean *terminate, fmi3Boolean *early,
                      fmi3Float64 *reached)
{
    INSTANCE;
    (void)no_rollback;
    int result = fmu_step(instance, time, h);
    put(event, fmi3False);
    put(terminate, fmi3False);
    put(early, fmi3False);
    if (reached) *reached = instance->time;
    return status(result);
}

/* ---- Model Exchange ---- */

fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance c)
{
    IN(EVENT);
    instance->phase = FMU_CONTINUOUS;
    return fmi3OK;
}

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *again, fmi3Boolean *terminate,
                                    fmi3Boolean *nominals, fmi3Boolean *values, fmi3Boolean *timed,
                                    fmi3Float64 *next)
{
    IN(EVENT);
    put(again, fmi3False);
    put(terminate, fmi3False);
    put(nominals, fmi3False);
    put(values, fmi3False);
    put(timed, fmi3False);
    if (next) *next = INFINITY;
    return fmi3OK;
}

fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c, fmi3Boolean no_rollback, fmi3Boolean *event,
                                       fmi3Boolean *terminate)
{
    IN(CONTINUOUS);
    (void)no_rollback;
    put(event, fmi3False);
    put(terminate, fmi3False);
    return fmi3OK;
}

fmi3Status fmi3SetTime(fmi3Instance c, fmi3Float64 time)
{
    IN(EVENT | CONTINUOUS);
    if (!isfinite(time)) {
        fmu_log(instance, "fmi3SetTime: %g is no time", time);
        return fmi3Error;
    }
    instance->time = time;
    return fmi3OK;
}

#if FMU_STATES
fmi3Status fmi3SetContinuousStates(fmi3Instance c, const fmi3Float64 x[], size_t n)
{
    IN(CONTINUOUS);
    return status(fmu_set_states(instance, x, n));
}

fmi3Status fmi3GetContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n)
{
    IN(INITIALISATION | EVENT | CONTINUOUS | TERMINATED);
    return status(fmu_get_states(instance, x, n));
}

fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, fmi3Float64 dx[], size_t n)
{
    IN(INITIALISATION | EVENT | CONTINUOUS | TERMINATED);
    return status(fmu_get_derivatives(instance, dx, n));
}

fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance c, fmi3Float64 nominal[], size_t n)
{
    IN(INITIALISATION | EVENT | CONTINUOUS | TERMINATED);
    if (fmu_get_states(instance, nominal, n)) return fmi3Error; /* checks the arguments */
    for (size_t k = 0; k < n; k++) nominal[k] = fmu_nominals[k];
    return fmi3OK;
}
#endif

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance c, size_t *n)
{
    INSTANCE;
    if (!n) return fmi3Error;
    *n = FMU_STATES;
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance c, size_t *n)
{
    INSTANCE;
    if (!n) return fmi3Error;
    *n = 0;
    return fmi3OK;
}

fmi3Status fmi3GetEventIndicators(fmi3Instance c, fmi3Float64 indicators[], size_t n)
{
    INSTANCE;
    (void)indicators;
    if (n) fmu_log(instance, "this FMU has no event indicators");
    return n ? fmi3Error : fmi3OK;
}
