#include "fmu_layer.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmu_tables.h" /* generated: fmu_variables, fmu_states, fmu_derivatives */

#define ALIGNMENT 64
#define LONGEST_STEP_S 1000.0 /* internal steps are counted by int, and nobody waits that long */
#define BEFORE_RUN (1u << FMU_INSTANTIATED | 1u << FMU_INITIALISATION)

static const char *const PHASE[] = {"instantiated",         "initialisation", "event mode",
                                    "continuous-time mode", "stepping",       "terminated",
                                    "failed"};

void fmu_log(const fmu_instance *instance, const char *format, ...)
{
    char text[512];
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(text, sizeof text, format, arguments);
    va_end(arguments);
    fmu_emit(instance, text);
}

/* ---- instances ---- */

static int create(fmu_instance *instance)
{
    for (size_t i = 0; i < FMU_VALUES; i++) instance->value[i] = fmu_variables[i].start;
    instance->time = instance->start_time = 0;
    instance->stop_time = INFINITY;
    instance->phase = FMU_INSTANTIATED;
    if (instance->model) memset(instance->model, 0, fmu_model_size());
    return fmu_model_create(instance, instance->resources) ? FMU_REFUSED : FMU_FINE;
}

static char *copy_text(const char *text)
{
    size_t size = strlen(text) + 1;
    char *copy = malloc(size);
    if (copy) memcpy(copy, text, size);
    return copy;
}

static char *copy_folder(const char *path)
{
    char *copy = copy_text(path);
    size_t length = copy ? strlen(copy) : 0;
    while (length > 1 && (copy[length - 1] == '/' || copy[length - 1] == '\\')) copy[--length] = 0;
    return copy;
}

fmu_instance *fmu_new(const char *name, const char *token, const char *plain, void *logger,
                      void *environment)
{
    size_t before = (sizeof(fmu_instance) + ALIGNMENT - 1) / ALIGNMENT * ALIGNMENT;
    char *block = calloc(1, before + fmu_model_size() + ALIGNMENT);
    if (!block) return NULL;
    fmu_instance *instance =
        (fmu_instance *)(block + (ALIGNMENT - (uintptr_t)block % ALIGNMENT) % ALIGNMENT);
    instance->block = block;
    instance->logger = logger;
    instance->environment = environment;
    instance->name = copy_text(name && name[0] ? name : FMU_IDENTIFIER);
    instance->resources = plain ? copy_folder(plain) : NULL;
    if (fmu_model_size()) instance->model = (char *)instance + before;
    if (!instance->name || (plain && !instance->resources)) {
        fmu_log(instance, "out of memory");
    } else if (!token || strcmp(token, FMU_TOKEN) != 0) {
        fmu_log(instance, "the instantiation token (GUID) is '%s', but this binary belongs to '%s'",
                token ? token : "", FMU_TOKEN);
    } else if (create(instance) == FMU_FINE) {
        return instance;
    }
    fmu_delete(instance);
    return NULL;
}

int fmu_reset(fmu_instance *instance)
{
    if (create(instance) == FMU_FINE) return FMU_FINE;
    instance->phase = FMU_FAILED; /* until a reset that succeeds */
    return FMU_REFUSED;
}

/* ---- phases ---- */

int fmu_in_phase(const fmu_instance *instance, const char *function, unsigned phases)
{
    if (phases >> instance->phase & 1) return FMU_FINE;
    fmu_log(instance, "%s is not allowed in phase '%s'", function, PHASE[instance->phase]);
    return FMU_REFUSED;
}

int fmu_set_times(fmu_instance *instance, double start, int has_stop, double stop)
{
    if (!isfinite(start) || (has_stop && !(stop >= start))) {
        fmu_log(instance, "start time %g and stop time %g do not make an interval", start, stop);
        return FMU_REFUSED;
    }
    instance->time = instance->start_time = start;
    instance->stop_time = has_stop ? stop : INFINITY;
    return FMU_FINE;
}

int fmu_enter_initialisation(fmu_instance *instance)
{
    if (fmu_in_phase(instance, "entering initialisation mode", 1u << FMU_INSTANTIATED))
        return FMU_REFUSED;
    instance->phase = FMU_INITIALISATION;
    return FMU_FINE;
}

int fmu_exit_initialisation(fmu_instance *instance)
{
    if (fmu_in_phase(instance, "leaving initialisation mode", 1u << FMU_INITIALISATION))
        return FMU_REFUSED;
    if (fmu_model_initialise(instance)) return FMU_REFUSED;
    instance->phase = FMU_CS ? FMU_STEPPING : FMU_EVENT;
    return FMU_FINE;
}

int fmu_terminate(fmu_instance *instance)
{
    if (fmu_in_phase(instance, "terminate",
                     1u << FMU_STEPPING | 1u << FMU_EVENT | 1u << FMU_CONTINUOUS))
        return FMU_REFUSED;
    instance->phase = FMU_TERMINATED;
    return FMU_FINE;
}

/* ---- values ---- */

void fmu_store_real(void *value, size_t i, double number)
{
    ((double *)value)[i] = number;
}

double fmu_load_real(const void *value, size_t i)
{
    return ((const double *)value)[i];
}

static const fmu_variable *find(const fmu_instance *instance, uint32_t reference, fmu_kind kind)
{
    if (reference >= FMU_VALUES) {
        fmu_log(instance, "unknown value reference %u", (unsigned)reference);
        return NULL;
    }
    if (fmu_variables[reference].kind != kind) {
        fmu_log(instance, "variable '%s' (value reference %u) is not of this type",
                fmu_variables[reference].name, (unsigned)reference);
        return NULL;
    }
    return &fmu_variables[reference];
}

#if FMU_STATES
static int derivatives(const fmu_instance *instance, double *dx)
{
    if (fmu_model_derivatives(instance, dx)) return FMU_REFUSED;
    for (size_t k = 0; k < FMU_STATES; k++)
        if (!isfinite(dx[k])) return FMU_NOT_FINITE;
    return FMU_FINE;
}
#endif

int fmu_get(const fmu_instance *instance, fmu_kind kind, const uint32_t *reference, size_t n,
            void *value, void (*store)(void *value, size_t i, double number))
{
    if (n && (!reference || !value)) {
        fmu_log(instance, "get: a pointer is NULL");
        return FMU_REFUSED;
    }
    int derived = 0;
    for (size_t i = 0; i < n; i++) {
        if (reference[i] == FMU_VALUES && kind == FMU_REAL) continue; /* time */
        const fmu_variable *variable = find(instance, reference[i], kind);
        if (!variable) return FMU_REFUSED;
        derived |= variable->derivative >= 0;
    }
    int result = FMU_FINE;
#if FMU_STATES
    double dx[FMU_STATES] = {0};
    if (derived && (result = derivatives(instance, dx)) == FMU_REFUSED) return FMU_REFUSED;
#endif
    for (size_t i = 0; i < n; i++) {
        uint32_t r = reference[i];
#if FMU_STATES
        if (r < FMU_VALUES && fmu_variables[r].derivative >= 0) {
            store(value, i, dx[fmu_variables[r].derivative]);
            continue;
        }
#endif
        store(value, i, r == FMU_VALUES ? instance->time : instance->value[r]);
    }
    return result;
}

static int settable(const fmu_instance *instance, const fmu_variable *variable)
{
    unsigned now = 1u << instance->phase;
    switch (variable->role) {
    case FMU_INPUT:
    case FMU_TUNABLE:
        return !(now & (1u << FMU_TERMINATED | 1u << FMU_FAILED));
    case FMU_FIXED:
        return !!(now & BEFORE_RUN);
    case FMU_START:
        if (variable->state >= 0 && now & (1u << FMU_EVENT | 1u << FMU_CONTINUOUS)) return 1;
        return !!(now & BEFORE_RUN);
    default:
        return 0;
    }
}

static int within(const fmu_variable *v, double number)
{
    if (!isfinite(number)) return 0;
    return v->exclusive ? number > v->min && number < v->max
                        : number >= v->min && number <= v->max;
}

int fmu_set(fmu_instance *instance, fmu_kind kind, const uint32_t *reference, size_t n,
            const void *value, double (*load)(const void *value, size_t i))
{
    if (n && (!reference || !value)) {
        fmu_log(instance, "set: a pointer is NULL");
        return FMU_REFUSED;
    }
    for (size_t i = 0; i < n; i++) {
        const fmu_variable *variable = find(instance, reference[i], kind);
        if (!variable) return FMU_REFUSED;
        if (!settable(instance, variable)) {
            fmu_log(instance, "variable '%s' cannot be set in phase '%s'", variable->name,
                    PHASE[instance->phase]);
            return FMU_REFUSED;
        }
        int free = variable->role == FMU_INPUT
                   || (variable->state >= 0 && instance->phase > FMU_INITIALISATION);
        if (!free && !within(variable, load(value, i))) {
            fmu_log(instance, "variable '%s' cannot be %g: it must be finite and %s %g and %g",
                    variable->name, load(value, i),
                    variable->exclusive ? "strictly between" : "between", variable->min,
                    variable->max);
            return FMU_REFUSED;
        }
    }
    for (size_t i = 0; i < n; i++) instance->value[reference[i]] = load(value, i);
    return FMU_FINE;
}

/* ---- Co-Simulation ---- */

int fmu_step(fmu_instance *instance, double time, double h)
{
    if (fmu_in_phase(instance, "doStep", 1u << FMU_STEPPING)) return FMU_REFUSED;
    if (!(h > 0 && h <= LONGEST_STEP_S)) {
        fmu_log(instance, "doStep: the communication step is %g s, must be positive and at most %g",
                h, LONGEST_STEP_S);
        return FMU_REFUSED;
    }
    double slack = 1e-6 * (1 + fabs(instance->time));
    if (!(fabs(time - instance->time) <= slack)) {
        fmu_log(instance, "doStep: asked to continue at %.9g s, but time is %.9g s", time,
                instance->time);
        return FMU_REFUSED;
    }
    if (time + h > instance->stop_time + slack) {
        fmu_log(instance, "doStep: %.9g s is after the stop time %.9g s", time + h,
                instance->stop_time);
        return FMU_REFUSED;
    }
#if FMU_CS
    if (fmu_model_step(instance, h)) {
        instance->phase = FMU_FAILED;
        return FMU_REFUSED;
    }
#endif
    instance->time = time + h;
    return FMU_FINE;
}

/* ---- Model Exchange ---- */

#if FMU_STATES
static int counted(const fmu_instance *instance, const double *x, size_t n)
{
    if (x && n == FMU_STATES) return FMU_FINE;
    fmu_log(instance, "the model has %d continuous states, got an array of %lu", FMU_STATES,
            (unsigned long)n);
    return FMU_REFUSED;
}

int fmu_get_states(const fmu_instance *instance, double *x, size_t n)
{
    if (counted(instance, x, n)) return FMU_REFUSED;
    for (size_t k = 0; k < n; k++) x[k] = instance->value[fmu_states[k]];
    return FMU_FINE;
}

int fmu_set_states(fmu_instance *instance, const double *x, size_t n)
{
    if (counted(instance, x, n)) return FMU_REFUSED;
    for (size_t k = 0; k < n; k++) instance->value[fmu_states[k]] = x[k];
    return FMU_FINE;
}

int fmu_get_derivatives(const fmu_instance *instance, double *dx, size_t n)
{
    return counted(instance, dx, n) ? FMU_REFUSED : derivatives(instance, dx);
}
#endif

int fmu_differentiable(const fmu_instance *instance, const uint32_t *known, size_t n_known,
                       const uint32_t *unknown, size_t n_unknown)
{
    for (size_t i = 0; i < n_unknown; i++) {
        const fmu_variable *variable = find(instance, unknown[i], FMU_REAL);
        if (!variable) return FMU_REFUSED;
        if (variable->derivative < 0 && variable->state < 0) {
            fmu_log(instance, "'%s' is no unknown that can be differentiated", variable->name);
            return FMU_REFUSED;
        }
    }
    for (size_t i = 0; i < n_known; i++) {
        if (known[i] == FMU_VALUES) continue; /* time: FMI counts it among the knowns */
        const fmu_variable *variable = find(instance, known[i], FMU_REAL);
        if (!variable) return FMU_REFUSED;
        if (variable->role == FMU_CALCULATED) {
            fmu_log(instance, "nothing can be differentiated with respect to '%s'",
                    variable->name);
            return FMU_REFUSED;
        }
    }
    return FMU_FINE;
}
