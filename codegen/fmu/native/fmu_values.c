/* Access to variables: a call reads or writes all that it names, or none. */
#include "fmu.h"

#include <math.h>

#define ROW(name, kind, role, ...) {#name, FMU_##kind, FMU_##role, __VA_ARGS__},
const fmu_variable fmu_variables[FMU_VALUES] = {FMU_VARIABLES(ROW)};

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
        return fmu_note(instance, FMI(Error), "variable '%s' cannot be set in phase '%s'", v->name,
                        fmu_phase_name(instance));
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
