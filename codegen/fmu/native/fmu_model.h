/* What a model is to the FMI layers: a few functions over one array of values.
 *
 * fmi2.c and fmi3.c (with fmu_layer.c) do everything that FMI asks for: phases, arguments, logging,
 * saved states. They own the instance; a model reads and writes its values and its own memory.
 * The generated fmu_config.h gives FMU_VALUES and, for every variable, its place FMU_V_<name>.
 */
#ifndef FMU_MODEL_H
#define FMU_MODEL_H

#include <stddef.h>
#include <stdint.h>

#include "fmu_config.h" /* generated: FMU_VALUES, FMU_V_<name>, FMU_CS, FMU_ME, FMU_STATES */

typedef enum {
    FMU_INSTANTIATED,
    FMU_INITIALISATION,
    FMU_EVENT,      /* Model Exchange only */
    FMU_CONTINUOUS, /* Model Exchange only */
    FMU_STEPPING,   /* Co-Simulation only */
    FMU_TERMINATED,
    FMU_FAILED      /* a step failed: until reset, or until a saved state is set */
} fmu_phase;

typedef struct fmu_saved fmu_saved;

typedef struct fmu_instance {
    /* for the model */
    double value[FMU_VALUES]; /* by value reference; integers and booleans as doubles */
    double time;              /* s */
    void *model;              /* fmu_model_size() bytes, aligned to 64, zeroed before
                                 fmu_model_create; NULL if that is 0 */

    /* the layers' own */
    void *block; /* what was allocated */
    char *name;
    char *resources; /* plain path of the folder without the last separator, or NULL */
    fmu_phase phase;
    double start_time, stop_time; /* stop_time: infinity where none was given */
    fmu_saved *saved;             /* the states made by this instance that still live */
    void *logger, *environment;   /* the importer's */
} fmu_instance;

/* Bytes of memory that one instance of the model needs beyond the values. */
size_t fmu_model_size(void);

/* At instantiation and at reset; values are at their start values. Returns 0, or -1 after fmu_log:
 * then there is no instance. resources: path of the FMU's resources folder, or NULL. Must not
 * leave anything behind that only a counterpart of this function could release: there is none. */
int fmu_model_create(fmu_instance *instance, const char *resources);

/* At the end of initialisation mode: parameters and start values are there, finite and within
 * their min and max. Checks what else they must fulfil and sets the calculated outputs.
 * Returns 0, or -1 after fmu_log. */
int fmu_model_initialise(fmu_instance *instance);

/* Co-Simulation: from time to time + h, 0 < h <= 1000; the layer advances time. Returns 0,
 * or -1 after fmu_log. */
int fmu_model_step(fmu_instance *instance, double h);

/* Model Exchange: derivatives of the states [FMU_STATES] at the instance's values. */
int fmu_model_derivatives(const fmu_instance *instance, double *dx);

/* Model Exchange: out[unknown] = sum over known of d unknown / d known * seed[known], and the
 * adjoint out[known] = sum over unknown of seed[unknown] * d unknown / d known. Unknowns are
 * derivatives of states or states, knowns states, inputs, parameters or time, whose reference is
 * FMU_VALUES; the layer has checked that. Only called if FMU_DERIVATIVES is 1. */
int fmu_model_directional(const fmu_instance *instance, const uint32_t *known, size_t n_known,
                          const double *seed, const uint32_t *unknown, size_t n_unknown,
                          double *out);
int fmu_model_adjoint(const fmu_instance *instance, const uint32_t *unknown, size_t n_unknown,
                      const double *seed, const uint32_t *known, size_t n_known, double *out);

/* An error message (printf format) to the importer's log. */
#if defined(__GNUC__)
__attribute__((format(printf, 2, 3)))
#endif
void fmu_log(const fmu_instance *instance, const char *format, ...);

#endif
