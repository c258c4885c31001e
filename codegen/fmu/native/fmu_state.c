/* Saved states: everything that a later call could depend on, so that a tool can roll back.
 *
 * They belong to the instance that made them; as bytes they can be given to another one. A saved
 * state is the beginning of the instance and the model's memory; its bytes are that after a
 * checksum, which also covers the token: bytes of another FMU or byte order do not pass.
 */
#include "fmu.h"

#include <stdlib.h>
#include <string.h>

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
    fmu_refuse(instance, "%s",
               state ? "this state was not made by this instance, or has been freed"
                     : "the state is NULL");
    return NULL;
}

/* The state to overwrite, or a new one if *state is NULL. */
static fmu_saved *slot(fmu_instance *instance, void **state) {
    if (state && *state) return own(instance, *state);
    fmu_saved *s = state ? calloc(1, sizeof *s + state_size()) : NULL;
    if (!s) {
        fmu_refuse(instance, state ? "out of memory" : "saved state: a pointer is NULL");
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

#define REQUIRE_BYTES(pointer) /* and that the FMU can serialise at all */            \
    REQUIRE(ANY_PHASE);                                                               \
    if (!FMU_SERIALISES || !(pointer)) {                                              \
        fmu_refuse(instance, FMU_SERIALISES ? "saved state: a pointer is NULL"        \
                                            : "this FMU cannot serialise its state"); \
        return FMI(Error);                                                            \
    }

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
    if (size < sizeof(uint64_t) + state_size()) {
        fmu_refuse(instance, "a serialised state needs %lu bytes, got %lu",
                   (unsigned long)(sizeof(uint64_t) + state_size()), (unsigned long)size);
        return FMI(Error);
    }
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
    if (!whole || sum != checksum(content)) {
        fmu_refuse(instance, "these bytes are no state of this FMU");
        return FMI(Error);
    }
    fmu_saved *s = slot(instance, state);
    if (!s) return FMI(Error);
    memcpy(s->bytes, content, state_size());
    return FMI(OK);
}
