/* See br_files.h. Bytes are put together one by one, so that the host's byte order and
 * alignment do not matter. */
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "br_files.h"

#define SCHEMA 3
#define LINE_BYTES 512
#define WHOLE_MAX 1000000
#define WEIGHTS_MAGIC "BRFMGPWT"
#define PATH_BYTES_MAX (BR_FILE_HEAD_BYTES + 8 + (size_t)BR_PATH_CAPACITY * BR_PATH_COLUMNS * 8)

/* A file being read, and what is left of it. */
typedef struct {
    const char *name;
    const unsigned char *at;
    size_t left;
    char *text; /* for the sentence that says what is wrong */
    size_t text_size;
} reader;

static int wrong(const reader *r, const char *what, const char *remedy) {
    snprintf(r->text, r->text_size, "%s %s: %s", r->name, what, remedy);
    return -1;
}

static const char *const ANEW = "export it again, or put the file back";

static uint64_t read_integer(reader *r, int bytes) {
    uint64_t value = 0;
    for (int i = 0; i < bytes; ++i) value |= (uint64_t)r->at[i] << (8 * i);
    r->at += bytes;
    r->left -= (size_t)bytes;
    return value;
}

static double read_double(reader *r) {
    const uint64_t bits = read_integer(r, 8);
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static void read_doubles(reader *r, double *values, size_t n) {
    for (size_t i = 0; i < n; ++i) values[i] = read_double(r);
}

static uint64_t fnv1a(const unsigned char *data, size_t n) {
    uint64_t hash = 14695981039346656037u;
    for (size_t i = 0; i < n; ++i) hash = (hash ^ data[i]) * 1099511628211u;
    return hash;
}

/* The file of the folder, opened; NULL: there is none. */
static FILE *opened(const char *folder, const char *name) {
    const size_t length = strlen(folder) + strlen(name) + 2;
    char *path = malloc(length);
    if (!path) return NULL;
    snprintf(path, length, "%s/%s", folder, name);
    FILE *file = fopen(path, "rb");
    free(path);
    return file;
}

/* The whole file into memory of its size at most, and one byte more. */
static int read_file(reader *r, const char *folder, unsigned char *data, size_t most) {
    if (!data) return wrong(r, "does not fit into memory", "close other programs");
    FILE *file = opened(folder, r->name);
    if (!file) return wrong(r, "is missing or cannot be read", ANEW);
    r->at = data;
    r->left = fread(data, 1, most + 1, file);
    const int failed = ferror(file);
    fclose(file);
    if (failed) return wrong(r, "cannot be read", ANEW);
    if (r->left > most)
        return wrong(r, "is longer than this controller has room for",
                     "export it for this one, or build with more --path-rows or --gp-capacity");
    return 0;
}

/* Checks the head, and passes it. */
static int pass_head(reader *r, const char *magic) {
    if (r->left < BR_FILE_HEAD_BYTES) return wrong(r, "has an impossible length", ANEW);
    if (memcmp(r->at, magic, 8)) return wrong(r, "is a file of another kind", ANEW);
    r->at += 8, r->left -= 8;
    if (read_integer(r, 4) != SCHEMA) return wrong(r, "has another schema", "export it again");
    const uint64_t body = read_integer(r, 4), hash = read_integer(r, 8);
    (void)read_integer(r, 8);
    if (body != r->left) return wrong(r, "is cut off or too long", ANEW);
    if (hash != fnv1a(r->at, r->left)) return wrong(r, "is damaged (checksum)", ANEW);
    return 0;
}

static int load_path(reader *r, br_mpc *mpc) {
    const size_t row = BR_PATH_COLUMNS * 8;
    if (r->left < 8 + row || (r->left - 8) % row)
        return wrong(r, "does not hold whole rows", "export it again");
    const double spacing = read_double(r);
    const size_t count = r->left / row;
    double *table = malloc(count * row);
    if (!table) return wrong(r, "does not fit into memory", "close other programs");
    read_doubles(r, table, count * BR_PATH_COLUMNS);
    const br_mpc_error error = br_mpc_set_path(mpc, table, (int)count, spacing);
    free(table);
    return error ? wrong(r, br_mpc_error_text(error), "export it again") : 0;
}

/* One output; its arrays follow each other in numbers. */
static int load_output(reader *r, br_mpc_gp *gp, double *numbers) {
    if (r->left < BR_GP_HEAD_BYTES) return wrong(r, "is cut off", ANEW);
    const uint64_t kernel = read_integer(r, 4), n = read_integer(r, 4);
    if (kernel > BR_KERNEL_MATERN25) return wrong(r, "has an unknown kernel", "train again");
    if (n > BR_GP_CAPACITY)
        return wrong(r, "has more training points than this controller has room for",
                     "train with fewer points or build with a larger capacity");
    gp->kernel = (int)kernel;
    gp->n = (int)n;
    gp->offset = read_double(r);
    gp->scale = read_double(r);
    gp->signal = read_double(r);
    gp->noise = read_double(r);
    const size_t count = BR_NZ + (size_t)n * (BR_NZ + 1);
    if (r->left < count * 8) return wrong(r, "is cut off", ANEW);
    read_doubles(r, numbers, count);
    gp->length_scales = numbers;
    gp->inputs = numbers + BR_NZ;
    gp->alpha = gp->inputs + (size_t)n * BR_NZ;
    return 0;
}

typedef br_mpc_error use(br_mpc *mpc, const br_mpc_gp outputs[BR_NE]);

/* numbers: room for BR_WEIGHTS_NUMBERS; version: NULL, or where to put it. */
static int take_weights(reader *r, br_mpc *mpc, use *loads, double *numbers, const char *identity,
                        char *version) {
    if (!numbers) return wrong(r, "does not fit into memory", "close other programs");
    if (r->left < BR_IDENTITY_BYTES + BR_VERSION_BYTES) return wrong(r, "is cut off", ANEW);
    if (strncmp((const char *)r->at, identity, BR_IDENTITY_BYTES))
        return wrong(r, "was learned for another model, car or time step",
                     "train with those of this controller");
    const char *named = (const char *)r->at + BR_IDENTITY_BYTES;
    if (!memchr(named, 0, BR_VERSION_BYTES)) return wrong(r, "has a version without end", ANEW);
    r->at += BR_IDENTITY_BYTES + BR_VERSION_BYTES;
    r->left -= BR_IDENTITY_BYTES + BR_VERSION_BYTES;
    br_mpc_gp outputs[BR_NE];
    for (size_t j = 0; j < BR_NE; ++j)
        if (load_output(r, &outputs[j], numbers + j * (BR_WEIGHTS_NUMBERS / BR_NE))) return -1;
    if (r->left) return wrong(r, "is too long", ANEW);
    const br_mpc_error error = loads(mpc, outputs);
    if (error) return wrong(r, br_mpc_error_text(error), "train again");
    if (version) memcpy(version, named, BR_VERSION_BYTES);
    return 0;
}

int br_files_stage(br_mpc *mpc, const unsigned char *file, size_t bytes, double *numbers,
                   const char *identity, char version[BR_VERSION_BYTES], char *text, size_t size) {
    reader r = {
        .name = BR_FILE_WEIGHTS, .at = file, .left = bytes, .text = text, .text_size = size};
    return pass_head(&r, WEIGHTS_MAGIC) ||
                   take_weights(&r, mpc, br_mpc_stage_weights, numbers, identity, version)
               ? -1
               : 0;
}

int br_files_load(br_mpc *mpc, const char *folder, const char *identity,
                  char version[BR_VERSION_BYTES], char *text, size_t size) {
    reader path = {.name = BR_FILE_PATH, .text = text, .text_size = size};
    reader weights = {.name = BR_FILE_WEIGHTS, .text = text, .text_size = size};
    const size_t most = PATH_BYTES_MAX > BR_WEIGHTS_BYTES ? PATH_BYTES_MAX : BR_WEIGHTS_BYTES;
    unsigned char *data = malloc(most + 1);
    double *numbers = malloc(BR_WEIGHTS_NUMBERS * sizeof *numbers);
    const int failed = read_file(&path, folder, data, PATH_BYTES_MAX) ||
                       pass_head(&path, "BRFMPATH") || load_path(&path, mpc) ||
                       read_file(&weights, folder, data, BR_WEIGHTS_BYTES) ||
                       pass_head(&weights, WEIGHTS_MAGIC) ||
                       take_weights(&weights, mpc, br_mpc_set_weights, numbers, identity, version);
    free(numbers);
    free(data);
    return failed ? -1 : 0;
}

/* --- settings --- */

typedef struct {
    const char *name;
    double *number; /* or */
    int *whole;
    int count; /* of numbers; 0: one */
    int found;
} setting;

#define SPACE " \t\r\n"

/* The numbers of one line, "name number ...", into the setting of its name. */
static int take_line(const reader *r, char *line, setting *settings, int count) {
    line[strcspn(line, "#")] = 0;
    char *name = line + strspn(line, SPACE);
    if (!*name) return 0;
    char *at = name + strcspn(name, SPACE), *end = at;
    if (*at) *at++ = 0;
    int i = 0;
    while (i < count && strcmp(settings[i].name, name)) ++i;
    if (i == count) return wrong(r, "has an unknown name", name);
    double value = 0;
    for (int n = 0; n < (settings[i].count ? settings[i].count : 1); ++n, at = end) {
        value = strtod(at, &end);
        if (end == at) return wrong(r, "lacks a number", name);
        if (!settings[i].whole) settings[i].number[n] = value;
    }
    if (end[strspn(end, SPACE)]) return wrong(r, "has more than a number", name);
    settings[i].found = 1;
    if (!settings[i].whole) return 0;
    if (!(value >= 0 && value <= WHOLE_MAX && value == floor(value)))
        return wrong(r, "has no whole number from 0 to 1000000", name);
    *settings[i].whole = (int)value;
    return 0;
}

/* Every one of the settings, once at least. */
static int read_settings(const reader *r, const char *folder, setting *settings, int count) {
    FILE *file = opened(folder, r->name);
    if (!file) return wrong(r, "is missing or cannot be read", ANEW);
    char line[LINE_BYTES];
    int failed = 0;
    while (!failed && fgets(line, sizeof line, file))
        failed = strlen(line) + 1 >= sizeof line ? wrong(r, "has a line that is too long", line)
                 : !strchr(line, '\n')
                     ? wrong(r, "is cut off in its last line", "export it again, or end that line")
                     : take_line(r, line, settings, count);
    if (!failed && ferror(file)) failed = wrong(r, "is missing or cannot be read", ANEW);
    fclose(file);
    for (int i = 0; i < count && !failed; ++i)
        if (!settings[i].found) failed = wrong(r, "lacks a line", settings[i].name);
    return failed;
}

/* What follows from the settings that have been read. */
static void derive(br_settings *to) {
    const br_mpc_parameters *p = &to->parameters;
    br_driving *d = &to->driving;
    const br_estimation learned = to->with_weights;
    to->with_weights = to->without_weights;
    memcpy(to->with_weights.acceleration, learned.acceleration, sizeof learned.acceleration);
    to->with_weights.acceleration_s = learned.acceleration_s;
    d->u_low[BR_INDEX_DUTY] = p->d_min;
    d->u_high[BR_INDEX_DUTY] = p->d_max;
    d->u_high[BR_INDEX_DELTA_RATE] = p->delta_rate_max_radps;
    d->u_low[BR_INDEX_DELTA_RATE] = -p->delta_rate_max_radps;
}

int br_files_settings(const char *folder, br_settings *to, char *text, size_t size) {
    const reader r = {.name = BR_FILE_SETTINGS, .text = text, .text_size = size};
    br_mpc_parameters *p = &to->parameters;
    br_driving *d = &to->driving;
    br_mpc_probation *w = &to->probation;
    br_estimation *estimation = &to->without_weights, *learned = &to->with_weights;
#define OF_PARAMETERS(field) {.name = #field, .number = &p->field},
#define COUNT_OF_PARAMETERS(field) {.name = #field, .whole = &p->field},
#define OF_DRIVING(field) {.name = #field, .number = &d->field},
#define COUNT_OF_DRIVING(field) {.name = #field, .whole = &d->field},
#define OF_PROBATION(field) {.name = #field, .number = &w->field},
#define COUNT_OF_PROBATION(field) {.name = #field, .whole = &w->field},
    setting settings[] = {
        BR_PARAMETERS(OF_PARAMETERS) BR_SOLVER_FIELDS(OF_PARAMETERS, COUNT_OF_PARAMETERS)
            BR_DRIVING_FIELDS(OF_DRIVING, COUNT_OF_DRIVING)
                BR_PROBATION_FIELDS(OF_PROBATION, COUNT_OF_PROBATION){
                    .name = "resolution", .number = w->resolution, .count = BR_NE},
        {.name = "start", .number = estimation->start, .count = BR_NB},
        {.name = "drift", .number = estimation->drift, .count = BR_NB},
        {.name = "acceleration", .number = estimation->acceleration, .count = BR_NE},
        {.name = "acceleration_s", .number = &estimation->acceleration_s},
        {.name = "learned_acceleration", .number = learned->acceleration, .count = BR_NE},
        {.name = "learned_acceleration_s", .number = &learned->acceleration_s},
        {.name = "yaw_lag_s", .number = &estimation->yaw_lag_s},
        {.name = "understeer", .number = &estimation->understeer},
        {.name = "gate", .number = &estimation->gate}};
    if (read_settings(&r, folder, settings, sizeof settings / sizeof settings[0])) return -1;
    derive(to);
    return 0;
}
