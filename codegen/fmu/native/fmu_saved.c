/* Saved states: everything that a later call could depend on, so that a tool can roll back. */
#include <stdlib.h>
#include <string.h>

#include "fmu_layer.h"

typedef struct {
    double value[FMU_VALUES];
    double time, start_time, stop_time;
    uint64_t phase;
} core;

struct fmu_saved {
    fmu_saved *next;
    core core;
    unsigned char model[];
};

typedef struct {
    uint64_t magic; /* also tells the byte order */
    uint64_t checksum; /* of all that follows */
    uint64_t size;
    char token[sizeof FMU_TOKEN];
} header;

static const uint64_t MAGIC = 0x4652534d55464201u;

static int is_ours(const fmu_instance *instance, const void *state)
{
    /* by address: a state that has been freed or belongs elsewhere is never looked into */
    for (const fmu_saved *s = instance->saved; s; s = s->next)
        if (s == state) return 1;
    fmu_log(instance, "this state was not made by this instance, or has been freed");
    return 0;
}

static int can_save(const fmu_instance *instance, int serialised, const void *pointer)
{
    if (FMU_SAVES < (serialised ? 2 : 1)) {
        fmu_log(instance, "this FMU cannot %s its state", serialised ? "serialise" : "save");
        return 0;
    }
    if (!pointer) fmu_log(instance, "FMU state: a pointer is NULL");
    return pointer != NULL;
}

static fmu_saved *add(fmu_instance *instance)
{
    fmu_saved *s = calloc(1, sizeof *s + fmu_model_size());
    if (!s) {
        fmu_log(instance, "out of memory");
        return NULL;
    }
    s->next = instance->saved;
    instance->saved = s;
    return s;
}

int fmu_save(fmu_instance *instance, void **state)
{
    if (!can_save(instance, 0, state)) return FMU_REFUSED;
    if (*state && !is_ours(instance, *state)) return FMU_REFUSED;
    fmu_saved *s = *state ? *state : add(instance);
    if (!s) return FMU_REFUSED;
    memcpy(s->core.value, instance->value, sizeof s->core.value);
    s->core.time = instance->time;
    s->core.start_time = instance->start_time;
    s->core.stop_time = instance->stop_time;
    s->core.phase = instance->phase;
    if (instance->model) memcpy(s->model, instance->model, fmu_model_size());
    *state = s;
    return FMU_FINE;
}

int fmu_restore(fmu_instance *instance, void *state)
{
    if (!can_save(instance, 0, state) || !is_ours(instance, state)) return FMU_REFUSED;
    const fmu_saved *s = state;
    memcpy(instance->value, s->core.value, sizeof s->core.value);
    instance->time = s->core.time;
    instance->start_time = s->core.start_time;
    instance->stop_time = s->core.stop_time;
    instance->phase = (fmu_phase)s->core.phase;
    if (instance->model) memcpy(instance->model, s->model, fmu_model_size());
    return FMU_FINE;
}

int fmu_forget(fmu_instance *instance, void **state)
{
    if (!state || !*state) return FMU_FINE;
    if (!is_ours(instance, *state)) return FMU_REFUSED;
    for (fmu_saved **link = &instance->saved; *link; link = &(*link)->next)
        if (*link == *state) {
            *link = (*link)->next;
            break;
        }
    free(*state);
    *state = NULL;
    return FMU_FINE;
}

void fmu_delete(fmu_instance *instance)
{
    while (instance->saved) {
        fmu_saved *s = instance->saved;
        instance->saved = s->next;
        free(s);
    }
    free(instance->name);
    free(instance->resources);
    free(instance->block);
}

/* ---- as bytes: header, core, model memory ---- */

static uint64_t checksum(const unsigned char *bytes, size_t size)
{
    uint64_t hash = 0xcbf29ce484222325u; /* FNV-1a */
    for (size_t i = 0; i < size; i++) hash = (hash ^ bytes[i]) * 0x100000001b3u;
    return hash;
}

static size_t serialised(void)
{
    return sizeof(header) + sizeof(core) + fmu_model_size();
}

static const size_t CHECKED_FROM = offsetof(header, size);

int fmu_serialised_size(fmu_instance *instance, void *state, size_t *size)
{
    if (!can_save(instance, 1, size) || !is_ours(instance, state)) return FMU_REFUSED;
    *size = serialised();
    return FMU_FINE;
}

int fmu_serialise(fmu_instance *instance, void *state, unsigned char *bytes, size_t size)
{
    if (!can_save(instance, 1, bytes) || !is_ours(instance, state)) return FMU_REFUSED;
    if (size < serialised()) {
        fmu_log(instance, "a serialised state needs %lu bytes, got %lu",
                (unsigned long)serialised(), (unsigned long)size);
        return FMU_REFUSED;
    }
    const fmu_saved *s = state;
    header h;
    memset(&h, 0, sizeof h);
    h.magic = MAGIC;
    h.size = serialised();
    memcpy(h.token, FMU_TOKEN, sizeof h.token);
    memcpy(bytes, &h, sizeof h);
    memcpy(bytes + sizeof h, &s->core, sizeof s->core);
    memcpy(bytes + sizeof h + sizeof s->core, s->model, fmu_model_size());
    h.checksum = checksum(bytes + CHECKED_FROM, serialised() - CHECKED_FROM);
    memcpy(bytes + offsetof(header, checksum), &h.checksum, sizeof h.checksum);
    return FMU_FINE;
}

int fmu_deserialise(fmu_instance *instance, const unsigned char *bytes, size_t size, void **state)
{
    if (!can_save(instance, 1, bytes) || !can_save(instance, 1, state)) return FMU_REFUSED;
    header h;
    memset(&h, 0, sizeof h);
    if (size >= serialised()) memcpy(&h, bytes, sizeof h);
    if (h.magic != MAGIC || h.size != serialised()
        || memcmp(h.token, FMU_TOKEN, sizeof h.token) != 0
        || h.checksum != checksum(bytes + CHECKED_FROM, serialised() - CHECKED_FROM)) {
        fmu_log(instance, "these bytes are no state of this FMU");
        return FMU_REFUSED;
    }
    core c;
    memcpy(&c, bytes + sizeof h, sizeof c);
    if (c.phase > FMU_FAILED || (*state && !is_ours(instance, *state))) return FMU_REFUSED;
    fmu_saved *s = *state ? *state : add(instance);
    if (!s) return FMU_REFUSED;
    s->core = c;
    memcpy(s->model, bytes + sizeof h + sizeof c, fmu_model_size());
    *state = s;
    return FMU_FINE;
}
