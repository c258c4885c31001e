/* Drives two instances of the controller's FMI 3.0 FMU through a recording, from C alone:
 *
 *   fmu_controller RESOURCES STATES RESULTS
 *
 * STATES: rows of 7 doubles. RESULTS: per row d, delta_rate of the first instance. The second one
 * gets the rows backwards and is saved, restored and reset on the way. Code 1: a promise is broken
 * (the line says which). */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "check.h"
#include "fmi3Functions.h"
#include "fmu_config.h"

static void listen(fmi3InstanceEnvironment e, fmi3Status status, fmi3String kind, fmi3String text) {
    (void)e, (void)status, (void)kind;
    fprintf(stderr, "%s\n", text);
}

static fmi3Instance make(const char *name, const char *resources) {
    return fmi3InstantiateCoSimulation(name, FMU_TOKEN, resources, fmi3False, fmi3False, fmi3False,
                                       fmi3False, NULL, 0, NULL, listen, NULL);
}

static void begin(fmi3Instance i) {
    CHECK(fmi3EnterInitializationMode(i, fmi3False, 0, 0, fmi3False, 0) == fmi3OK);
    CHECK(fmi3ExitInitializationMode(i) == fmi3OK);
}

static void step(fmi3Instance i, int k, const double *x, double u[2]) {
    static const fmi3ValueReference in[] = {FMU_V_x,  FMU_V_y,     FMU_V_psi,  FMU_V_vx,
                                            FMU_V_vy, FMU_V_omega, FMU_V_delta};
    static const fmi3ValueReference out[] = {FMU_V_d, FMU_V_delta_rate};
    fmi3Boolean event, end, early;
    fmi3Float64 last;
    CHECK(fmi3SetFloat64(i, in, 7, x, 7) == fmi3OK);
    CHECK(fmi3DoStep(i, k * 0.02, 0.02, fmi3True, &event, &end, &early, &last) == fmi3OK);
    CHECK(fmi3GetFloat64(i, out, 2, u, 2) == fmi3OK);
    CHECK(isfinite(u[0]) && isfinite(u[1]));
}

static double *read_file(const char *path, size_t *n) {
    FILE *file = fopen(path, "rb");
    CHECK(file && fseek(file, 0, SEEK_END) == 0);
    const long size = ftell(file);
    rewind(file);
    double *data = malloc((size_t)size);
    CHECK(data && fread(data, 1, (size_t)size, file) == (size_t)size);
    fclose(file);
    *n = (size_t)size / sizeof *data;
    return data;
}

int main(int argc, char **argv) {
    CHECK(argc == 4);
    size_t n;
    double *states = read_file(argv[2], &n), u[2], again[2];
    const int rows = (int)(n / 7);
    CHECK(!make("nowhere", NULL) && !make("nothing", "/nonexistent/folder"));
    fmi3Instance one = make("one", argv[1]), two = make("two", argv[1]);
    CHECK(one && two);
    begin(one);
    begin(two);
    FILE *out = fopen(argv[3], "wb");
    CHECK(out);
    for (int k = 0, other = 0; k < rows; ++k, ++other) {
        step(one, k, &states[7 * k], u);
        CHECK(fwrite(u, sizeof u, 1, out) == 1);
        if (k % 50 == 49) {
            CHECK(fmi3Reset(two) == fmi3OK);
            begin(two);
            other = 0;
        }
        const double *x = &states[7 * (rows - 1 - k)];
        fmi3FMUState saved = NULL;
        CHECK(fmi3GetFMUState(two, &saved) == fmi3OK);
        step(two, other, x, u);
        CHECK(fmi3SetFMUState(two, saved) == fmi3OK);
        step(two, other, x, again);
        CHECK(memcmp(u, again, sizeof u) == 0);
        CHECK(fmi3FreeFMUState(two, &saved) == fmi3OK);
    }
    fclose(out);
    CHECK(fmi3Terminate(one) == fmi3OK);
    fmi3FreeInstance(one);
    fmi3FreeInstance(two);
    free(states);
    return 0;
}
