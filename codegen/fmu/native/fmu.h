/* What a model and the FMI layer share: the instance, its variables, the model's functions.
 *
 * A model (car.c, controller.c) is a few functions over one array of values. The layer (fmi.h),
 * which owns the instance, calls them, and does everything else that FMI demands: phases,
 * arguments, saved states. An FMU is compiled for one version, FMU_FMI; FMI(Name) is fmi2Name or
 * fmi3Name.
 *
 * A refused call has changed nothing and has sent one message, with the status that it returns:
 * Discard for a value outside the bounds of its variable, after which the simulation may go on;
 * Error for what the standard does not allow.
 */
#ifndef FMU_H
#define FMU_H

#include <stdarg.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>

#include "fmu_config.h" /* generated: FMU_VALUES, FMU_STATES, FMU_V_<name> of each value */

#if FMU_FMI == 2
#include "fmi2Functions.h"
#define FMI(name) fmi2##name
#define fmi2GetFMUState fmi2GetFMUstate /* in the spelling of 3.0 */
#define fmi2SetFMUState fmi2SetFMUstate
#define fmi2FreeFMUState fmi2FreeFMUstate
#define fmi2SerializedFMUStateSize fmi2SerializedFMUstateSize
#define fmi2SerializeFMUState fmi2SerializeFMUstate
#define fmi2DeserializeFMUState fmi2DeSerializeFMUstate
#else
#include "fmi3Functions.h"
#define FMI(name) fmi3##name
#endif

typedef FMI(Status) fmu_status;
#define FMU_OK FMI(OK)
#define FMU_WARNING FMI(Warning)

#if defined(__GNUC__)
#pragma GCC diagnostic ignored "-Wunused-parameter" /* FMI passes more than these FMUs need */
#else
#define __attribute__(x)
#endif

typedef enum {
    FMU_INSTANTIATED = 1,
    FMU_INITIALISATION = 2,
    FMU_EVENT = 4,      /* Model Exchange */
    FMU_CONTINUOUS = 8, /* Model Exchange */
    FMU_STEPPING = 16,  /* Co-Simulation */
    FMU_TERMINATED = 32,
    FMU_FAILED = 64 /* until reset, or until a saved state is set */
} fmu_phase;

typedef struct fmu_saved fmu_saved;
typedef struct fmu_instance fmu_instance;

/* Passes a message to the importer's logger; category: "logStatusError" ... */
typedef void fmu_report(const fmu_instance *instance, fmu_status status, const char *category,
                        const char *text);

struct fmu_instance {
    double value[FMU_VALUES]; /* by value reference; integers and booleans as doubles; the last is
                                 FMU_V_time [s] */
    double stop_time;         /* infinite where none was given */
    fmu_phase phase;

    /* A saved state holds what is above, and the model's memory. */
    void *model;     /* fmu_model_size() bytes, aligned to 64, zeroed before fmu_model_create */
    char *resources; /* path of the folder without the last separator, or NULL */
    char *name;
    void *block;          /* what was allocated */
    fmu_saved *saved;     /* states that this instance has made and that still live */
    fmu_report *report;   /* of the version */
    void (*logger)(void); /* the importer's, to be cast to FMI's type */
    void *environment;    /* the importer's */
};

/* Sends a message (printf format) with the status that the call is about to return, to the
 * importer's log. Returns the status. */
__attribute__((format(printf, 3, 4))) static inline fmu_status
fmu_note(const fmu_instance *instance, fmu_status status, const char *format, ...) {
    static const char *const categories[] = {"logStatusOK", "logStatusWarning", "logStatusDiscard",
                                             "logStatusError"};
    char text[512];
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(text, sizeof text, format, arguments);
    va_end(arguments);
    instance->report(instance, status, categories[status], text);
    return status;
}

#define FMU_ERROR(instance, ...) fmu_note(instance, FMI(Error), __VA_ARGS__)
#define fmu_refuse(...) (FMU_ERROR(__VA_ARGS__) == FMU_OK) /* false, after the message */

typedef enum {
    FMU_CALCULATED, /* never set from outside */
    FMU_FIXED,      /* set until the end of initialisation; states of Model Exchange also later */
    FMU_TUNABLE,    /* set at any time */
    FMU_INPUT       /* set at any time, to any value */
} fmu_role;

/* ---- the model; what is bool is false after fmu_refuse, else true ---- */

size_t fmu_model_size(void); /* bytes of memory that an instance needs beside the values */

/* At instantiation and at reset; values are at their start values. If it fails, there is no
 * instance. It must not allocate anything: no function of the model releases it. */
bool fmu_model_create(fmu_instance *instance);

/* At the end of initialisation mode: parameters and start values are finite and within their
 * bounds. Checks what else they must fulfil and sets the calculated outputs. */
bool fmu_model_initialise(fmu_instance *instance);

/* Co-Simulation: from time to time + h, 0 < h <= 1000; the caller advances the time. Returns OK,
 * after fmu_note Warning, or after fmu_refuse Error, which ends the simulation. */
fmu_status fmu_model_step(fmu_instance *instance, double h);

/* Model Exchange: derivatives [FMU_STATES] of the states at the instance's values. */
void fmu_model_derivatives(const fmu_instance *instance, double *dx);

/* Model Exchange: out = J in, both [FMU_VALUES], with the Jacobian J of all values by all values.
 * Only the rows of states (one for itself) and of their derivatives count. */
void fmu_model_directional(const fmu_instance *instance, const double *in, double *out);

#endif
