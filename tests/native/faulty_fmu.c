/* A Co-Simulation FMU for tests, FMI 2.0 (or 3.0 with -DFMI=3): a car so simple that it can be
 * checked by hand, with every fault that an FMU can have. `mode` chooses the fault, which strikes
 * in the step that reaches `at_s` (or at initialisation); the instantiation token chooses those
 * that come before any parameter. */
#include <math.h>
#include <signal.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#ifndef FMI
#define FMI 2
#endif
#if FMI == 3
#include "fmi3FunctionTypes.h"
typedef fmi3Float64 Real;
typedef fmi3Status Status;
#define F(name) fmi3##name
#define COUNT , size_t n_values /* an array has more values than variables */
#else
#include "fmi2FunctionTypes.h"
typedef fmi2Real Real;
typedef fmi2Status Status;
#define F(name) fmi2##name
#define COUNT
#endif

#pragma GCC diagnostic ignored "-Wunused-parameter" /* FMI passes more than this FMU needs */
#define EXPORT __attribute__((visibility("default")))

enum { OK, WARNING, DISCARD, ERROR, FATAL };

enum { REFERENCE_NAMES, VALUES }; /* both from tests/faulty_fmu.py */
enum { MODES };

typedef struct {
    double value[VALUES];
    double time;
    bool ended;
#if FMI == 3
    fmi3LogMessageCallback log;
    fmi3InstanceEnvironment environment;
#else
    const fmi2CallbackFunctions *callbacks;
#endif
} Car;

static int instances;

static void say(Car *car, int status, const char *text) {
#if FMI == 3
    car->log(car->environment, (fmi3Status)status, "faulty", text);
#else
    car->callbacks->logger(car->callbacks->componentEnvironment, "car", (fmi2Status)status,
                           "faulty", "%s", text);
#endif
}

static void wait_for_ever(void) {
    for (;;) sleep(1);
}

static Car *make(const char *token) {
    if (strcmp(token, "refuse") == 0 || (strcmp(token, "once") == 0 && instances > 0)) return NULL;
    if (strcmp(token, "abort") == 0) {
        fprintf(stderr, "no licence\n");
        abort();
    }
    Car *car = calloc(1, sizeof *car);
    car->value[INSTANCES] = ++instances;
    return car;
}

static Status initialise(Car *car) {
    switch ((int)car->value[MODE]) {
    case INIT_FAILS:
        say(car, ERROR, "this car has no wheels");
        return (Status)ERROR;
    case INIT_HANGS:
        wait_for_ever();
    case INIT_ABORTS:
        abort();
    }
    return (Status)OK;
}

static Status strike(Car *car) {
    switch ((int)car->value[MODE]) {
    case ABORT:
        say(car, ERROR, "the engine is on fire");
        abort();
    case SEGFAULT:
        raise(SIGSEGV);
        break;
    case EXIT:
        exit(3);
    case HANG:
        wait_for_ever();
    case NOT_A_NUMBER:
        car->value[VX] = NAN;
        break;
    case HUGE_VALUE:
        car->value[VX] = 1e9;
        break;
    case FAIL:
        say(car, ERROR, "a wheel came off");
        return (Status)ERROR;
    case WORST:
        return (Status)FATAL;
    case REFUSE:
        return (Status)DISCARD;
    case FLOOD_LOG:
        for (int i = 0; i < 20000; i++) say(car, i % 2 ? WARNING : OK, "all is well, as always");
        break;
    case FLOOD_STDOUT:
        for (int i = 0; i < 200000; i++) puts("all is well, as always, and as it will ever be");
        fflush(stdout);
        break;
    case SAY:
        fprintf(stderr, "assertion failed: wheels == 4\n");
        _exit(7);
    case SLOW:
        usleep(60000);
        break;
    case TERMINATE:
        car->ended = true;
        break;
    case ORPHAN: /* leaves a process behind */
        if (fork() == 0) pause();
        abort();
    case SCRIBBLE:
        for (int fd = 3; fd < 64; fd++)
            if (write(fd, "all work and no play makes a dull car", 37) < 0) continue;
        break;
    case CLOSE_ALL:
        for (int fd = 0; fd < 64; fd++) close(fd);
        break;
    }
    return (Status)OK;
}

static Status drive(Car *car, double t, double h) {
    double *v = car->value;
    if (fabs(t - car->time) > 1e-12) {
        say(car, ERROR, "steps do not follow each other");
        return (Status)ERROR;
    }
    v[X] += h * v[VX] * cos(v[PSI]);
    v[Y] += h * v[VX] * sin(v[PSI]);
    v[OMEGA] = v[VX] * v[DELTA] / 0.062;
    v[PSI] += h * v[OMEGA];
    v[VX] += h * (7.0 * v[D] - v[VX]);
    v[DELTA] += h * v[DELTA_RATE];
    v[GEAR_READ] = v[GEAR];
    v[LIGHT_READ] = v[LIGHT];
    car->time = t + h;
    return car->time >= v[AT_S] - 1e-9 ? strike(car) : (Status)OK;
}

#define REFERENCES void *c, const F(ValueReference) vr[], size_t n

#define ACCESS(Name, Type)                                                           \
    EXPORT Status F(Set##Name)(REFERENCES, const Type values[] COUNT) {              \
        for (size_t i = 0; i < n; i++) ((Car *)c)->value[vr[i]] = (double)values[i]; \
        return (Status)OK;                                                           \
    }                                                                                \
    EXPORT Status F(Get##Name)(REFERENCES, Type values[] COUNT) {                    \
        for (size_t i = 0; i < n; i++) values[i] = (Type)((Car *)c)->value[vr[i]];   \
        return (Status)OK;                                                           \
    }

ACCESS(Boolean, F(Boolean))

#if FMI == 3
ACCESS(Float64, fmi3Float64)
ACCESS(Float32, fmi3Float32)
ACCESS(Int32, fmi3Int32)
ACCESS(UInt8, fmi3UInt8)

EXPORT fmi3Instance fmi3InstantiateCoSimulation(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
    fmi3Boolean logging, fmi3Boolean events, fmi3Boolean early, const fmi3ValueReference required[],
    size_t count, fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
    fmi3IntermediateUpdateCallback update) {
    Car *car = make(token);
    if (car) car->environment = environment, car->log = log;
    return car;
}

EXPORT Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean d, fmi3Float64 tolerance,
                                          fmi3Float64 start, fmi3Boolean s, fmi3Float64 stop) {
    return (Status)OK;
}

EXPORT Status fmi3DoStep(fmi3Instance c, fmi3Float64 t, fmi3Float64 h, fmi3Boolean none,
                         fmi3Boolean *event, fmi3Boolean *terminate, fmi3Boolean *early,
                         fmi3Float64 *last) {
    Car *car = c;
    bool halfway = car->value[MODE] == EARLY && h > 1e-3;
    Status status = drive(car, t, halfway ? h / 2 : h);
    *event = false;
    *terminate = car->ended;
    *early = halfway;
    *last = car->time;
    return status;
}
#else
ACCESS(Real, fmi2Real)
ACCESS(Integer, fmi2Integer)

EXPORT fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String token,
                                     fmi2String resources, const fmi2CallbackFunctions *callbacks,
                                     fmi2Boolean visible, fmi2Boolean logging) {
    Car *car = make(token);
    if (car) car->callbacks = callbacks;
    return car;
}

EXPORT Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean d, Real tolerance, Real start,
                                  fmi2Boolean s, Real stop) {
    return (Status)OK;
}

EXPORT Status fmi2EnterInitializationMode(fmi2Component c) { return (Status)OK; }

EXPORT Status fmi2DoStep(fmi2Component c, Real t, Real h, fmi2Boolean none) {
    Status status = drive(c, t, h);
    return ((Car *)c)->ended ? (Status)DISCARD : status;
}

EXPORT Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind,
                                   fmi2Boolean *answer) {
    const Car *car = c;
    *answer = kind == fmi2Terminated && car->ended;
    return (Status)(car->value[MODE] == REFUSE ? DISCARD : OK); /* then it does not know */
}
#endif

EXPORT Status F(SetString)(REFERENCES, const F(String) values[] COUNT) {
    ((Car *)c)->value[LABEL_LENGTH] = (double)strlen(values[0]);
    return (Status)OK;
}

EXPORT Status F(ExitInitializationMode)(void *c) { return initialise(c); }
EXPORT Status F(Terminate)(void *c) { return (Status)OK; }
EXPORT void F(FreeInstance)(void *c) { free(c); }
