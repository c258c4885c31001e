/* FMI 2.0 Co-Simulation over fmu_layer.h. */
#include <ctype.h>
#include <string.h>

#include "fmi2Functions.h"
#include "fmu_layer.h"

#define INSTANCE                                                                                   \
    fmu_instance *instance = c;                                                                    \
    if (!instance) return fmi2Error

static fmi2Status status(int result)
{
    return result == FMU_FINE ? fmi2OK : result == FMU_NOT_FINITE ? fmi2Discard : fmi2Error;
}

static fmi2Status unsupported(const fmu_instance *instance, const char *function)
{
    fmu_log(instance, "%s: this FMU does not have that", function);
    return fmi2Error;
}

/* Some importers take the text for a printf format, others print it as it is. */
void fmu_emit(const fmu_instance *instance, const char *text)
{
    fmi2CallbackLogger logger;
    memcpy(&logger, &instance->logger, sizeof logger);
    if (!logger) return;
    char escaped[1024];
    size_t n = 0;
    for (; *text && n < sizeof escaped - 2; text++) {
        if (*text == '%') escaped[n++] = '%';
        escaped[n++] = *text;
    }
    escaped[n] = 0;
    logger(instance->environment, instance->name, fmi2Error, "logStatusError", escaped);
}

static int hex(char c)
{
    const int lower = c | 32;
    if (c >= '0' && c <= '9') return c - '0';
    return lower >= 'a' && lower <= 'f' ? lower - 'a' + 10 : -1;
}

static int has_scheme(const char *location)
{
    size_t n = 0;
    while (isalnum((unsigned char)location[n])) n++;
    return n > 1 && location[n] == ':'; /* a single letter is a drive */
}

/* The folder that is meant by file:///a%20b, file:/a%20b or file://host/a, as FMI has it, or by a
 * plain path, as many importers pass it; NULL for another scheme, nothing, or a URI that is too
 * long. The answer may lie in either argument. */
static const char *folder_of(const char *location, char *path, size_t size)
{
    if (!location || !location[0]) return NULL;
    if (!has_scheme(location)) return location;
    if (strncmp(location, "file:", 5) != 0) return NULL;
    const char *uri = location + 5;
    if (strncmp(uri, "//", 2) == 0) {
        uri = strchr(uri + 2, '/');
        if (!uri) return NULL;
    }
    if (uri[0] == '/' && uri[1] && uri[2] == ':') uri++; /* /C:/... */
    size_t n = 0;
    for (; *uri; uri++) {
        if (n + 1 >= size) return NULL;
        int high = *uri == '%' ? hex(uri[1]) : -1, low = high >= 0 ? hex(uri[2]) : -1;
        path[n++] = low >= 0 ? (char)(high << 4 | low) : *uri;
        if (low >= 0) uri += 2;
    }
    path[n] = 0;
    return path;
}

const char *fmi2GetTypesPlatform(void)
{
    return fmi2TypesPlatform;
}

const char *fmi2GetVersion(void)
{
    return "2.0";
}

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String names[])
{
    (void)on, (void)n, (void)names; /* there are errors only, always passed on */
    return c ? fmi2OK : fmi2Error;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible,
                              fmi2Boolean logging)
{
    (void)visible, (void)logging;
    char path[4096];
    void *logger = NULL;
    if (!functions || type != fmi2CoSimulation) return NULL;
    memcpy(&logger, &functions->logger, sizeof logger);
    return fmu_new(name, guid, folder_of(resources, path, sizeof path), logger,
                   functions->componentEnvironment);
}

void fmi2FreeInstance(fmi2Component c)
{
    if (c) fmu_delete(c);
}

/* ---- phases ---- */

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean has_tolerance, fmi2Real tolerance,
                               fmi2Real start, fmi2Boolean has_stop, fmi2Real stop)
{
    INSTANCE;
    (void)has_tolerance, (void)tolerance;
    if (fmu_in_phase(instance, "fmi2SetupExperiment", 1u << FMU_INSTANTIATED)) return fmi2Error;
    return status(fmu_set_times(instance, start, has_stop, stop));
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c)
{
    INSTANCE;
    return status(fmu_enter_initialisation(instance));
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
    INSTANCE;
    return status(fmu_exit_initialisation(instance));
}

fmi2Status fmi2Terminate(fmi2Component c)
{
    INSTANCE;
    return status(fmu_terminate(instance));
}

fmi2Status fmi2Reset(fmi2Component c)
{
    INSTANCE;
    return status(fmu_reset(instance));
}

/* ---- values ---- */

static void store_int(void *value, size_t i, double number)
{
    ((int *)value)[i] = (int)number;
}

static double load_int(const void *value, size_t i)
{
    return ((const int *)value)[i];
}

static double load_boolean(const void *value, size_t i)
{
    return ((const int *)value)[i] != 0;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real value[])
{
    INSTANCE;
    return status(fmu_get(instance, FMU_REAL, vr, n, value, fmu_store_real));
}

fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                          fmi2Integer value[])
{
    INSTANCE;
    return status(fmu_get(instance, FMU_INTEGER, vr, n, value, store_int));
}

fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                          fmi2Boolean value[])
{
    INSTANCE;
    return status(fmu_get(instance, FMU_BOOLEAN, vr, n, value, store_int));
}

fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                         fmi2String value[])
{
    INSTANCE;
    (void)vr, (void)value;
    return n ? unsupported(instance, "fmi2GetString") : fmi2OK;
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                       const fmi2Real value[])
{
    INSTANCE;
    return status(fmu_set(instance, FMU_REAL, vr, n, value, fmu_load_real));
}

fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                          const fmi2Integer value[])
{
    INSTANCE;
    return status(fmu_set(instance, FMU_INTEGER, vr, n, value, load_int));
}

fmi2Status fmi2SetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                          const fmi2Boolean value[])
{
    INSTANCE;
    return status(fmu_set(instance, FMU_BOOLEAN, vr, n, value, load_boolean));
}

fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                         const fmi2String value[])
{
    INSTANCE;
    (void)vr, (void)value;
    return n ? unsupported(instance, "fmi2SetString") : fmi2OK;
}

/* ---- saved states ---- */

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state)
{
    INSTANCE;
    return status(fmu_save(instance, state));
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state)
{
    INSTANCE;
    return status(fmu_restore(instance, state));
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state)
{
    INSTANCE;
    return status(fmu_forget(instance, state));
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t *size)
{
    INSTANCE;
    return status(fmu_serialised_size(instance, state, size));
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size)
{
    INSTANCE;
    return status(fmu_serialise(instance, state, (unsigned char *)bytes, size));
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size,
                                   fmi2FMUstate *state)
{
    INSTANCE;
    return status(fmu_deserialise(instance, (const unsigned char *)bytes, size, state));
}

/* ---- Co-Simulation ---- */

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real time, fmi2Real h, fmi2Boolean no_rollback)
{
    INSTANCE;
    (void)no_rollback;
    return status(fmu_step(instance, time, h));
}

fmi2Status fmi2CancelStep(fmi2Component c)
{
    INSTANCE;
    return unsupported(instance, "fmi2CancelStep");
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value)
{
    INSTANCE;
    if (kind != fmi2LastSuccessfulTime || !value) return fmi2Discard;
    *value = instance->time;
    return fmi2OK;
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value)
{
    INSTANCE;
    (void)instance;
    if (kind != fmi2Terminated || !value) return fmi2Discard;
    *value = fmi2False; /* whether the FMU wants the simulation to end: ours never does */
    return fmi2OK;
}

/* only for steps that go on in the background, which ours never do */
fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Status *value)
{
    (void)kind, (void)value;
    return c ? fmi2Discard : fmi2Error;
}

fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Integer *value)
{
    (void)kind, (void)value;
    return c ? fmi2Discard : fmi2Error;
}

fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind kind, fmi2String *value)
{
    (void)kind, (void)value;
    return c ? fmi2Discard : fmi2Error;
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                                       const fmi2Integer order[], const fmi2Real value[])
{
    INSTANCE;
    (void)vr, (void)order, (void)value;
    return n ? unsupported(instance, "fmi2SetRealInputDerivatives") : fmi2OK;
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                                        const fmi2Integer order[], fmi2Real value[])
{
    INSTANCE;
    (void)vr, (void)order, (void)value;
    return n ? unsupported(instance, "fmi2GetRealOutputDerivatives") : fmi2OK;
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknown[],
                                        size_t n_unknown, const fmi2ValueReference known[],
                                        size_t n_known, const fmi2Real seed[], fmi2Real out[])
{
    INSTANCE;
    (void)unknown, (void)n_unknown, (void)known, (void)n_known, (void)seed, (void)out;
    return unsupported(instance, "fmi2GetDirectionalDerivative");
}
