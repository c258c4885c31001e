/* What is alike in both versions of FMI: instances, their phases and messages, steps of
 * Co-Simulation; access to variables; saved states. */
#include "fmi.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define ALIGNED(size) (((size) + 63) / 64 * 64)
#define LONGEST_STEP_S 1000.0 /* internal steps are counted by int */

#define ROW(name, kind, role, ...) {#name, FMU_##kind, FMU_##role, __VA_ARGS__},
const fmu_variable fmu_variables[FMU_VALUES] = {FMU_VARIABLES(ROW)};

const char *FMI(GetVersion)(void) { return FMI(Version); }

FMI(Status) fmu_absent(const fmu_instance *instance, size_t variables, const char *function) {
    if (!instance) return FMI(Error);
    return variables ? FMU_ERROR(instance, "%s: this FMU does not have that", function) : FMI(OK);
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
                      fmu_report *report, void (*logger)(void), void *environment) {
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
    instance->resources = resources[0] ? strcpy(instance->name + letters, resources) : NULL;
    instance->report = report;
    instance->logger = logger;
    instance->environment = environment;
    char *path = instance->resources;
    for (size_t n = path ? strlen(path) : 0; n > 1 && strchr("/\\", path[n - 1]);) path[--n] = 0;
    if (!token || strcmp(token, FMU_TOKEN) != 0)
        FMU_ERROR(instance,
                  "the instantiation token (GUID) is '%s', but this binary belongs to '%s'",
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

static const char *phase_name(const fmu_instance *instance) {
    static const char *const names[] = {
        "instantiated", "initialisation", "event mode", "continuous-time mode",
        "stepping",     "terminated",     "failed"};
    size_t i = 0;
    while (instance->phase >> (i + 1)) i++;
    return names[i];
}

bool fmu_in_phase(const fmu_instance *instance, unsigned phases, const char *function) {
    if (!instance) return false;
    return instance->phase & phases ||
           fmu_refuse(instance, "%s is not allowed in phase '%s'", function, phase_name(instance));
}

bool fmu_set_times(fmu_instance *instance, double start, bool has_stop, double stop) {
    if (!isfinite(start) || (has_stop && !(stop >= start)))
        return fmu_refuse(instance, "start time %g and stop time %g are no interval", start, stop);
    instance->value[FMU_V_time] = start;
    instance->stop_time = has_stop ? stop : (double)INFINITY;
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
        return FMU_ERROR(instance,
                         "the communication step is %g s, must be positive and at most %g", h,
                         LONGEST_STEP_S);
    if (!(fabs(time - *now) <= tolerance))
        return FMU_ERROR(instance, "asked to continue at %.9g s, but time is %.9g s", time, *now);
    if (time + h > end + tolerance)
        return FMU_ERROR(instance, "%.9g s is after the stop time %.9g s", time + h, end);
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

/* ---- variables: a call reads or writes all that it names, or none ---- */

static bool accessible(const fmu_instance *instance, fmu_kind kind, const uint32_t *reference,
                       size_t n, const void *value, size_t n_values) {
    if (!instance) return false;
    if (n != n_values)
        return fmu_refuse(instance, "%lu scalar variables, but %lu values", (unsigned long)n,
                          (unsigned long)n_values);
    if (n && (!reference || !value)) return fmu_refuse(instance, "get or set: a pointer is NULL");
    for (size_t i = 0; i < n; i++) {
        if (reference[i] >= FMU_VALUES)
            return fmu_refuse(instance, "unknown value reference %u", (unsigned)reference[i]);
        if (fmu_variables[reference[i]].kind != kind)
            return fmu_refuse(instance, "variable '%s' (value reference %u) is not of this type",
                              fmu_variables[reference[i]].name, (unsigned)reference[i]);
    }
    return true;
}

/* OK if a variable may be set to a number now. */
static FMI(Status) settable(const fmu_instance *instance, uint32_t reference, double number) {
    const fmu_variable *v = &fmu_variables[reference];
    const bool before_run = instance->phase & (FMU_INSTANTIATED | FMU_INITIALISATION);
    const bool running = instance->phase & (FMU_EVENT | FMU_CONTINUOUS | FMU_STEPPING);
    const bool integrated = running && FMU_IS_STATE(reference);
    const bool now = before_run || integrated || (running && v->role != FMU_FIXED);
    if (!now || v->role == FMU_CALCULATED)
        return FMU_ERROR(instance, "variable '%s' cannot be set in phase '%s'", v->name,
                         phase_name(instance));
    const bool inside =
        v->open ? number > v->min && number < v->max : number >= v->min && number <= v->max;
    if (v->role == FMU_INPUT || integrated || (isfinite(number) && inside)) return FMI(OK);
    return fmu_note(instance, FMI(Discard),
                    "variable '%s' cannot be %g: it must be finite and %s %g and %g", v->name,
                    number, v->open ? "strictly between" : "between", v->min, v->max);
}

FMI(Status) fmu_derivatives(fmu_instance *instance) {
#if FMU_STATES
    double *dx = &instance->value[FMU_FIRST_DERIVATIVE];
    fmu_model_derivatives(instance, dx);
    for (size_t k = 0; k < FMU_STATES; k++)
        if (!isfinite(dx[k])) return FMI(Discard);
#endif
    return FMI(OK);
}

/* Brings the named values up to date. */
static FMI(Status) refresh(fmu_instance *instance, const uint32_t *reference, size_t n) {
    for (size_t i = 0; i < n; i++)
        if (FMU_IS_DERIVATIVE(reference[i])) return fmu_derivatives(instance);
    return FMI(OK);
}

#if FMU_FMI == 2 /* which has scalars only, and booleans that are integers */
#define COUNT
#define COUNTED n
#else
#define COUNT , size_t n_values
#define COUNTED n_values
#endif
#define REFERENCES void *c, const FMI(ValueReference) reference[], size_t n

#define ACCESS(name, type, kind)                                                                 \
    FMI(Status) FMI(Get##name)(REFERENCES, type value[] COUNT) {                                 \
        fmu_instance *instance = c;                                                              \
        if (!accessible(instance, kind, reference, n, value, COUNTED)) return FMI(Error);        \
        const FMI(Status) status = refresh(instance, reference, n);                              \
        for (size_t i = 0; i < n; i++) value[i] = (type)instance->value[reference[i]];           \
        return status;                                                                           \
    }                                                                                            \
    FMI(Status) FMI(Set##name)(REFERENCES, const type value[] COUNT) {                           \
        fmu_instance *instance = c;                                                              \
        if (!accessible(instance, kind, reference, n, value, COUNTED)) return FMI(Error);        \
        for (size_t i = 0; i < n; i++) {                                                         \
            const FMI(Status) status = settable(instance, reference[i], (double)value[i]);       \
            if (status != FMI(OK)) return status;                                                \
        }                                                                                        \
        for (size_t i = 0; i < n; i++)                                                           \
            instance->value[reference[i]] = kind == FMU_BOOLEAN ? !!value[i] : (double)value[i]; \
        return FMI(OK);                                                                          \
    }

#if FMU_FMI == 2
ACCESS(Real, fmi2Real, FMU_REAL)
ACCESS(Integer, fmi2Integer, FMU_INTEGER)
#else
ACCESS(Float64, fmi3Float64, FMU_REAL)
ACCESS(Int32, fmi3Int32, FMU_INTEGER)
#endif
ACCESS(Boolean, FMI(Boolean), FMU_BOOLEAN)

/* ---- saved states: everything that a later call could depend on, so that a tool can roll back
 * ----
 *
 * They belong to the instance that made them; as bytes they can be given to another one. A saved
 * state is the beginning of the instance and the model's memory; its bytes are that after a
 * checksum, which also covers the token: bytes of another FMU or byte order do not pass.
 */

#define OF_INSTANCE offsetof(fmu_instance, model)

struct fmu_saved {
    fmu_saved *next;
    unsigned char bytes[];
};

static size_t state_size(void) { return OF_INSTANCE + fmu_model_size(); }

/* By address: a state that has been freed or belongs elsewhere is never read. */
static fmu_saved *own(const fmu_instance *instance, const void *state) {
    for (fmu_saved *s = instance->saved; s; s = s->next)
        if (s == state) return s;
    FMU_ERROR(instance, state ? "this state was not made by this instance, or has been freed"
                              : "the state is NULL");
    return NULL;
}

/* The state to overwrite, or a new one if *state is NULL. */
static fmu_saved *slot(fmu_instance *instance, void **state) {
    if (state && *state) return own(instance, *state);
    fmu_saved *s = state ? calloc(1, sizeof *s + state_size()) : NULL;
    if (!s) {
        FMU_ERROR(instance, state ? "out of memory" : "saved state: a pointer is NULL");
        return NULL;
    }
    s->next = instance->saved;
    return *state = instance->saved = s;
}

FMI(Status) FMI(GetFMUState)(void *c, void **state) {
    REQUIRE(ANY_PHASE);
    fmu_saved *s = slot(instance, state);
    if (!s) return FMI(Error);
    memcpy(s->bytes, instance, OF_INSTANCE);
    memcpy(s->bytes + OF_INSTANCE, instance->model, fmu_model_size());
    return FMI(OK);
}

FMI(Status) FMI(SetFMUState)(void *c, void *state) {
    REQUIRE(ANY_PHASE);
    const fmu_saved *s = own(instance, state);
    if (!s) return FMI(Error);
    memcpy(instance, s->bytes, OF_INSTANCE);
    memcpy(instance->model, s->bytes + OF_INSTANCE, fmu_model_size());
    return FMI(OK);
}

FMI(Status) FMI(FreeFMUState)(void *c, void **state) {
    REQUIRE(ANY_PHASE);
    if (!state || !*state) return FMI(OK);
    fmu_saved *s = own(instance, *state);
    if (!s) return FMI(Error);
    fmu_saved **link = &instance->saved;
    while (*link != s) link = &(*link)->next;
    *link = s->next;
    free(s);
    *state = NULL;
    return FMI(OK);
}

/* ---- as bytes ---- */

#define REQUIRE_BYTES(pointer) /* and that the FMU can serialise at all */                  \
    REQUIRE(ANY_PHASE);                                                                     \
    if (!FMU_SERIALISES) return FMU_ERROR(instance, "this FMU cannot serialise its state"); \
    if (!(pointer)) return FMU_ERROR(instance, "saved state: a pointer is NULL")

static uint64_t checksum(const unsigned char *bytes) {
    const unsigned char *const parts[] = {(const unsigned char *)FMU_TOKEN, bytes};
    const size_t sizes[] = {sizeof FMU_TOKEN, state_size()};
    uint64_t hash = 0xcbf29ce484222325u; /* FNV-1a: a change of one byte always changes it */
    for (int k = 0; k < 2; k++)
        for (size_t i = 0; i < sizes[k]; i++) hash = (hash ^ parts[k][i]) * 0x100000001b3u;
    return hash;
}

FMI(Status) FMI(SerializedFMUStateSize)(void *c, void *state, size_t *size) {
    REQUIRE_BYTES(size);
    if (!own(instance, state)) return FMI(Error);
    *size = sizeof(uint64_t) + state_size();
    return FMI(OK);
}

FMI(Status) FMI(SerializeFMUState)(void *c, void *state, FMI(Byte) bytes[], size_t size) {
    REQUIRE_BYTES(bytes);
    const fmu_saved *s = own(instance, state);
    if (!s) return FMI(Error);
    if (size < sizeof(uint64_t) + state_size())
        return FMU_ERROR(instance, "a serialised state needs %lu bytes, got %lu",
                         (unsigned long)(sizeof(uint64_t) + state_size()), (unsigned long)size);
    const uint64_t sum = checksum(s->bytes);
    memcpy(bytes, &sum, sizeof sum);
    memcpy(bytes + sizeof sum, s->bytes, state_size());
    return FMI(OK);
}

FMI(Status) FMI(DeserializeFMUState)(void *c, const FMI(Byte) bytes[], size_t size, void **state) {
    REQUIRE_BYTES(bytes && state);
    uint64_t sum = 0;
    const unsigned char *content = (const unsigned char *)bytes + sizeof sum;
    const bool whole = size >= sizeof sum + state_size();
    if (whole) memcpy(&sum, bytes, sizeof sum);
    if (!whole || sum != checksum(content))
        return FMU_ERROR(instance, "these bytes are no state of this FMU");
    fmu_saved *s = slot(instance, state);
    if (!s) return FMI(Error);
    memcpy(s->bytes, content, state_size());
    return FMI(OK);
}
