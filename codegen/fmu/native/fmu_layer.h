/* What FMI 2.0 and 3.0 have in common: instances, phases, access to values, saved states.
 *
 * Functions that return int give FMU_FINE, or FMU_REFUSED after a message to the importer's log;
 * a refused call has changed nothing.
 */
#ifndef FMU_LAYER_H
#define FMU_LAYER_H

#include "fmu_model.h"

enum { FMU_FINE = 0, FMU_REFUSED = -1, FMU_NOT_FINITE = 1 };

typedef enum { FMU_REAL, FMU_INTEGER, FMU_BOOLEAN } fmu_kind;

typedef enum {
    FMU_CALCULATED, /* never set from outside */
    FMU_FIXED,      /* parameters: until the end of initialisation */
    FMU_TUNABLE,    /* parameters: always */
    FMU_START,      /* outputs and states with a start value: until the end of initialisation;
                       states of a Model Exchange FMU also later */
    FMU_INPUT       /* always, with any value */
} fmu_role;

typedef struct {
    const char *name;
    fmu_kind kind;
    fmu_role role;
    double start, min, max; /* min and max: -INFINITY and INFINITY where there are none */
    int exclusive;          /* min and max themselves are excluded */
    int state;              /* Model Exchange: which state this is, else -1 */
    int derivative;         /* Model Exchange: which state this is the derivative of, else -1 */
} fmu_variable;

/* The FMI version's own: passes a message to the importer. */
void fmu_emit(const fmu_instance *instance, const char *text);

/* NULL after a message if the token is not ours, memory is short or the model refuses. `plain`
 * is a folder path, with or without a separator at its end, or NULL. */
fmu_instance *fmu_new(const char *name, const char *token, const char *plain, void *logger,
                      void *environment);
void fmu_delete(fmu_instance *instance);
int fmu_reset(fmu_instance *instance);

int fmu_set_times(fmu_instance *instance, double start, int has_stop, double stop);
int fmu_enter_initialisation(fmu_instance *instance);
int fmu_exit_initialisation(fmu_instance *instance);
int fmu_terminate(fmu_instance *instance);
/* Refuses with the function's name unless the instance is in one of the phases (1 << phase). */
int fmu_in_phase(const fmu_instance *instance, const char *function, unsigned phases);

/* Values of one kind; get: FMU_NOT_FINITE if a derivative is not finite at this state. */
int fmu_get(const fmu_instance *instance, fmu_kind kind, const uint32_t *reference, size_t n,
            void *value, void (*store)(void *value, size_t i, double number));
int fmu_set(fmu_instance *instance, fmu_kind kind, const uint32_t *reference, size_t n,
            const void *value, double (*load)(const void *value, size_t i));
void fmu_store_real(void *value, size_t i, double number);
double fmu_load_real(const void *value, size_t i);

int fmu_step(fmu_instance *instance, double time, double h);

#if FMU_STATES
int fmu_get_states(const fmu_instance *instance, double *x, size_t n);
int fmu_set_states(fmu_instance *instance, const double *x, size_t n);
int fmu_get_derivatives(const fmu_instance *instance, double *dx, size_t n);
#endif
/* Checks the arguments of a directional or adjoint derivative. */
int fmu_differentiable(const fmu_instance *instance, const uint32_t *known, size_t n_known,
                       const uint32_t *unknown, size_t n_unknown);

/* Saved states belong to the instance that made them; as bytes they can be given to another. */
int fmu_save(fmu_instance *instance, void **state); /* *state: NULL, or a state to overwrite */
int fmu_restore(fmu_instance *instance, void *state);
int fmu_forget(fmu_instance *instance, void **state);
int fmu_serialised_size(fmu_instance *instance, void *state, size_t *size);
int fmu_serialise(fmu_instance *instance, void *state, unsigned char *bytes, size_t size);
int fmu_deserialise(fmu_instance *instance, const unsigned char *bytes, size_t size, void **state);

#endif
