/* FMI 2.0 Co-Simulation: the functions that 3.0 has in another form. */
#include <ctype.h>
#include <stdlib.h>
#include <string.h>

#include "fmi.h"

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }

/* Some importers take the text for a printf format, others print it as it is. */
static void report(const fmu_instance *instance, fmi2Status status, const char *category,
                   const char *text) {
    char escaped[1024];
    size_t n = 0;
    for (; *text && n < sizeof escaped - 2; text++) {
        if (*text == '%') escaped[n++] = '%';
        escaped[n++] = *text;
    }
    escaped[n] = 0;
    if (instance->logger)
        ((fmi2CallbackLogger)instance->logger)(instance->environment, instance->name, status,
                                               category, escaped);
}

/* ---- instances ---- */

/* Turns the URI file:///a%20b, file:/a%20b or file://host/a of FMI into a plain path, in place;
 * a plain path, which many importers pass, stays. NULL for nothing or another scheme. */
static char *plain_path(char *location) {
    const size_t n = strcspn(location, ":/\\");
    const bool has_scheme = location[n] == ':' && n > 1; /* a single letter is a drive */
    if (location[0] && !has_scheme) return location;
    if (strncmp(location, "file:", 5) != 0) return NULL;
    const char *uri = location + 5;
    if (strncmp(uri, "//", 2) == 0) uri = strchr(uri + 2, '/');
    if (!uri) return NULL;
    if (uri[0] == '/' && uri[1] && uri[2] == ':') uri++; /* /C:/... */
    char *end = location;
    for (; *uri; uri++) {
        const char digits[3] = {uri[1], uri[1] ? uri[2] : 0, 0};
        const bool coded =
            *uri == '%' && isxdigit((unsigned char)digits[0]) && isxdigit((unsigned char)digits[1]);
        *end++ = coded ? (char)strtoul(digits, NULL, 16) : *uri;
        if (coded) uri += 2;
    }
    *end = 0;
    return location;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String location,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible,
                              fmi2Boolean logging) {
    char *copy = malloc(location ? strlen(location) + 1 : 1);
    fmu_instance *instance = NULL;
    if (copy && functions && type == fmi2CoSimulation)
        instance = fmu_new(name, guid, plain_path(strcpy(copy, location ? location : "")), report,
                           (void (*)(void))functions->logger, functions->componentEnvironment);
    free(copy);
    return instance;
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean has_tolerance, fmi2Real tolerance,
                               fmi2Real start, fmi2Boolean has_stop, fmi2Real stop) {
    REQUIRE(FMU_INSTANTIATED);
    return fmu_set_times(instance, start, has_stop, stop) ? fmi2OK : fmi2Error;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c) {
    REQUIRE(FMU_INSTANTIATED);
    instance->phase = FMU_INITIALISATION;
    return fmi2OK;
}

/* ---- steps ---- */

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real time, fmi2Real h, fmi2Boolean no_rollback) {
    REQUIRE(FMU_STEPPING);
    return fmu_step(instance, time, h);
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value) {
    REQUIRE(ANY_PHASE);
    if (kind != fmi2LastSuccessfulTime || !value) return fmi2Discard;
    *value = instance->value[FMU_V_time];
    return fmi2OK;
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value) {
    REQUIRE(ANY_PHASE);
    if (kind != fmi2Terminated || !value) return fmi2Discard;
    *value = fmi2False; /* whether the FMU demands the end of the simulation */
    return fmi2OK;
}

/* Only for steps that go on in the background, which these FMUs never make. */
#define STATUS(function, type)                                                     \
    fmi2Status function(fmi2Component c, const fmi2StatusKind kind, type *value) { \
        return c ? fmi2Discard : fmi2Error;                                        \
    }

STATUS(fmi2GetStatus, fmi2Status)
STATUS(fmi2GetIntegerStatus, fmi2Integer)
STATUS(fmi2GetStringStatus, fmi2String)

/* ---- what these FMUs do not have ---- */

#define ABSENT(function, ...) /* an error unless it concerns no variable */                      \
    fmi2Status function(fmi2Component c, const fmi2ValueReference vr[], size_t n, __VA_ARGS__) { \
        return fmu_absent(c, n, __func__);                                                       \
    }

ABSENT(fmi2GetString, fmi2String value[])
ABSENT(fmi2SetString, const fmi2String value[])
ABSENT(fmi2SetRealInputDerivatives, const fmi2Integer order[], const fmi2Real value[])
ABSENT(fmi2GetRealOutputDerivatives, const fmi2Integer order[], fmi2Real value[])
ABSENT(fmi2GetDirectionalDerivative, const fmi2ValueReference known[], size_t n_known,
       const fmi2Real seed[], fmi2Real out[])

fmi2Status fmi2CancelStep(fmi2Component c) { return fmu_absent(c, 1, __func__); }
