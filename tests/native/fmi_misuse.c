/* Misuses the FMI functions of a car's FMU, of either version and kind; under sanitizers. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "check.h"
#include "fmu.h"

#define IS(wanted, call) CHECK((call) == (wanted))
#define FINE(call) IS(FMI(OK), call)
#define BAD(call) IS(FMI(Error), call)

static int messages;

#if FMU_FMI == 2
#define REAL(verb, c, reference, n, v) fmi2##verb##Real(c, reference, n, v)
#define INTEGER(verb, c, reference, n, v) fmi2##verb##Integer(c, reference, n, v)
#define OTHER(verb, kind, c, reference, n, v) fmi2##verb##kind(c, reference, n, v)

static void listen(void *environment, fmi2String name, fmi2Status status, fmi2String category,
                   fmi2String text, ...) {
    messages += text[0] != 0;
}

static fmi2CallbackFunctions callbacks = {listen, NULL, NULL, NULL, NULL};

static void *make(const char *token, const char *uri) {
    return fmi2Instantiate("one", fmi2CoSimulation, token, uri, &callbacks, 0, 1);
}
#else
#define REAL(verb, c, reference, n, v) fmi3##verb##Float64(c, reference, n, v, n)
#define INTEGER(verb, c, reference, n, v) fmi3##verb##Int32(c, reference, n, v, n)
#define OTHER(verb, kind, c, reference, n, v) fmi3##verb##kind(c, reference, n, v, n)

static void listen(void *environment, fmi3Status status, fmi3String category, fmi3String text) {
    messages += text[0] != 0;
}

static void *make(const char *token, const char *resources) {
#if !FMU_STATES
    return fmi3InstantiateCoSimulation("one", token, resources, 0, 1, 0, 0, NULL, 0, NULL, listen,
                                       NULL);
#else
    return fmi3InstantiateModelExchange("one", token, resources, 0, 1, NULL, listen);
#endif
}
#endif

static void states(void *c) {
    void *a = NULL, *b = NULL, *none = NULL;
    size_t size = 0;
    FINE(FMI(GetFMUState)(c, &a));
    FINE(FMI(GetFMUState)(c, &a)); /* overwrites */
    FINE(FMI(GetFMUState)(c, &b));
    FINE(FMI(SetFMUState)(c, a));
    BAD(FMI(GetFMUState)(c, NULL));
    BAD(FMI(SetFMUState)(c, NULL));
    BAD(FMI(SetFMUState)(c, &size));
    FINE(FMI(SerializedFMUStateSize)(c, a, &size));
    BAD(FMI(SerializedFMUStateSize)(c, a, NULL));
    FMI(Byte) *bytes = malloc(size);
    BAD(FMI(SerializeFMUState)(c, a, bytes, size - 1));
    BAD(FMI(SerializeFMUState)(c, NULL, bytes, size));
    BAD(FMI(SerializeFMUState)(c, a, NULL, size));
    FINE(FMI(SerializeFMUState)(c, a, bytes, size));
    for (size_t i = 0; i < size; i++) {
        bytes[i] ^= 0x41;
        BAD(FMI(DeserializeFMUState)(c, bytes, size, &none));
        bytes[i] ^= 0x41;
    }
    for (size_t n = 0; n < size; n += 7) BAD(FMI(DeserializeFMUState)(c, bytes, n, &none));
    FINE(FMI(DeserializeFMUState)(c, bytes, size, &none));
    FINE(FMI(SetFMUState)(c, none));
    FINE(FMI(FreeFMUState)(c, &none));
    FINE(FMI(FreeFMUState)(c, &none)); /* NULL by now */
    void *stale = a;
    FINE(FMI(FreeFMUState)(c, &a));
    BAD(FMI(SetFMUState)(c, stale));
    BAD(FMI(FreeFMUState)(c, &stale));
    free(bytes);
    /* b is left to the end of the instance */
}

static void values(void *c) {
    FMI(ValueReference) all[FMU_VALUES], strange[] = {FMU_VALUES, 0xffffffff};
    double v[FMU_VALUES];
    FMI(Boolean) b = 0;
    FMI(String) text = "";
    int i = 0;
    for (unsigned k = 0; k < FMU_VALUES; k++) all[k] = k;
    FINE(REAL(Get, c, all, FMU_VALUES, v));
    FINE(REAL(Get, c, NULL, 0, NULL));
    BAD(REAL(Get, c, NULL, 1, v));
    BAD(REAL(Get, c, all, 1, NULL));
    BAD(REAL(Set, c, all, 1, NULL));
    BAD(REAL(Get, c, strange, 1, v));
    BAD(REAL(Get, c, strange + 1, 1, v));
    BAD(REAL(Set, c, strange, 2, v));
    BAD(REAL(Set, c, all + FMU_V_time, 1, v));
    BAD(INTEGER(Get, c, all, 1, &i));
    BAD(INTEGER(Set, c, all, 1, &i));
    BAD(OTHER(Get, Boolean, c, all, 1, &b));
    BAD(OTHER(Set, Boolean, c, all, 1, &b));
    BAD(OTHER(Set, String, c, all, 1, &text));
    FINE(OTHER(Get, String, c, NULL, 0, NULL));
#if FMU_FMI == 2
    BAD(fmi2SetRealInputDerivatives(c, all, 1, &i, v));
    BAD(fmi2GetRealOutputDerivatives(c, all, 1, &i, v));
    BAD(fmi2GetDirectionalDerivative(c, all, 1, all, 1, v, v));
    FINE(fmi2GetRealStatus(c, fmi2LastSuccessfulTime, v));
    IS(fmi2Discard, fmi2GetRealStatus(c, fmi2LastSuccessfulTime, NULL));
    IS(fmi2Discard, fmi2GetStatus(c, fmi2DoStepStatus, NULL));
    BAD(fmi2CancelStep(c));
#else
    BAD(fmi3GetFloat64(c, all, 1, v, 2));
    BAD(fmi3GetClock(c, all, 1, &b));
    BAD(fmi3EnterConfigurationMode(c));
    BAD(fmi3GetOutputDerivatives(c, all, 1, &i, v, 1));
    BAD(fmi3GetVariableDependencies(c, 0, NULL, NULL, NULL, NULL, 0));
#endif
}

#if FMU_FMI == 2
static fmi2Status enter(void *c, double start, double stop) {
    const fmi2Status status = fmi2SetupExperiment(c, 0, 0, start, stop < start, stop);
    return status == fmi2OK ? fmi2EnterInitializationMode(c) : status;
}

static void drive(void *c) {
    fmi2Boolean wants_an_end = 1;
    BAD(fmi2SetupExperiment(c, 0, 0, 0, 0, 0));
    for (int k = 0; k < 100; k++) FINE(fmi2DoStep(c, k * 0.02, 0.02, 1));
    BAD(fmi2DoStep(c, 2, -1, 1));
    FINE(fmi2GetBooleanStatus(c, fmi2Terminated, &wants_an_end));
    CHECK(!wants_an_end);
}

static void instantiate(void) {
    char longest[9000];
    const char *locations[] = {
        NULL,        "",
        "file:",     "file://",
        "file:///",  "file:///a%2",
        "file:/%",   "file:///C:/%41%zz",
        longest,     "http://a/b",
        "/a%20b/",   "a/b",
        "C:\\a",     "C:",
        ":",         "%",
        longest + 8,
    };
    memset(longest, 'x', sizeof longest - 1);
    memcpy(longest, "file:///", 8);
    longest[sizeof longest - 1] = 0;
    CHECK(!fmi2Instantiate("one", fmi2ModelExchange, FMU_TOKEN, NULL, &callbacks, 0, 0));
    CHECK(!fmi2Instantiate("one", fmi2CoSimulation, FMU_TOKEN, NULL, NULL, 0, 0));
    for (size_t k = 0; k < sizeof locations / sizeof *locations; k++) {
        fmi2Component c = make(FMU_TOKEN, locations[k]);
        CHECK(c);
        fmi2FreeInstance(c);
    }
}
#else
static fmi3Status enter(void *c, double start, double stop) {
    return fmi3EnterInitializationMode(c, 0, 0, start, stop < start, stop);
}

static void instantiate(void) {
    CHECK(!fmi3InstantiateScheduledExecution("one", FMU_TOKEN, NULL, 0, 0, NULL, listen, NULL, NULL,
                                             NULL));
}

#if !FMU_STATES
static void drive(void *c) {
    double v[FMU_VALUES] = {0};
    fmi3Boolean yes;
    const fmi3ValueReference d = FMU_V_d;
    BAD(fmi3EnterContinuousTimeMode(c));
    BAD(fmi3SetTime(c, 1));
    BAD(fmi3GetDirectionalDerivative(c, &d, 1, &d, 1, v, 1, v, 1));
    for (int k = 0; k < 100; k++) FINE(fmi3DoStep(c, k * 0.02, 0.02, 0, &yes, &yes, &yes, v));
    FINE(fmi3DoStep(c, 2, 0.02, 0, NULL, NULL, NULL, NULL));
    BAD(fmi3DoStep(c, 2.02, NAN, 0, NULL, NULL, NULL, NULL));
    BAD(fmi3DoStep(c, 2.02, 1e300, 0, NULL, NULL, NULL, NULL));
}
#else
static void drive(void *c) {
    double v[FMU_VALUES] = {0};
    fmi3Boolean yes;
    const fmi3ValueReference d = FMU_V_d, time = FMU_V_time;
    fmi3ValueReference first = FMU_V_der_x, state = FMU_V_x, der[FMU_STATES], known[FMU_VALUES];
    double nominal[FMU_STATES], out[FMU_VALUES], seed[FMU_VALUES] = {1, 1};
    for (unsigned k = 0; k < FMU_STATES; k++) der[k] = first + k;
    for (unsigned k = 0; k < FMU_VALUES; k++) known[k] = k;
    BAD(fmi3DoStep(c, 0, 0.02, 0, &yes, &yes, &yes, v));
    BAD(fmi3SetContinuousStates(c, v, FMU_STATES));
    FINE(fmi3UpdateDiscreteStates(c, &yes, &yes, &yes, &yes, &yes, v));
    FINE(fmi3EnterContinuousTimeMode(c));
    BAD(fmi3UpdateDiscreteStates(c, NULL, NULL, NULL, NULL, NULL, NULL));
    FINE(fmi3GetContinuousStates(c, v, FMU_STATES));
    FINE(fmi3SetContinuousStates(c, v, FMU_STATES));
    BAD(fmi3SetContinuousStates(c, v, FMU_STATES - 1));
    BAD(fmi3GetContinuousStateDerivatives(c, NULL, FMU_STATES));
    FINE(fmi3GetContinuousStateDerivatives(c, v, FMU_STATES));
    FINE(fmi3GetNominalsOfContinuousStates(c, nominal, FMU_STATES));
    FINE(fmi3CompletedIntegratorStep(c, 1, &yes, &yes));
    BAD(fmi3SetTime(c, NAN));
    FINE(fmi3SetTime(c, 1));
    FINE(fmi3GetDirectionalDerivative(c, der, FMU_STATES, known, FMU_V_der_x, seed, FMU_V_der_x,
                                      out, FMU_STATES));
    out[0] = 1;
    FINE(fmi3GetDirectionalDerivative(c, der, 1, &time, 1, seed, 1, out, 1));
    CHECK(out[0] == 0);
    BAD(fmi3GetDirectionalDerivative(c, &time, 1, &state, 1, seed, 1, out, 1));
    BAD(fmi3GetDirectionalDerivative(c, der, 1, &first, 1, seed, 1, out, 1));
    BAD(fmi3GetDirectionalDerivative(c, &d, 1, &state, 1, seed, 1, out, 1));
    BAD(fmi3GetDirectionalDerivative(c, der, 1, &state, 1, seed, 2, out, 1));
    BAD(fmi3GetDirectionalDerivative(c, der, 1, NULL, 1, seed, 1, out, 1));
    BAD(fmi3GetAdjointDerivative(c, der, 1, &state, 1, seed, 1, NULL, 1));
    double absurd[FMU_STATES] = {NAN, 1e308, 1e308, INFINITY, 1, 1, 1};
    FINE(fmi3SetContinuousStates(c, absurd, FMU_STATES));
    IS(fmi3Discard, fmi3GetContinuousStateDerivatives(c, v, FMU_STATES));
    FINE(fmi3SetContinuousStates(c, seed, FMU_STATES));
    FINE(fmi3EnterEventMode(c));
}
#endif
#endif

int main(void) {
    char longest[9000];
    const FMI(ValueReference) d = FMU_V_d, mass = FMU_V_mass_kg;
    double nan = NAN, heavy = 1;
    memset(longest, 'x', sizeof longest - 1);
    longest[sizeof longest - 1] = 0;
    BAD(FMI(Reset)(NULL));
    FMI(FreeInstance)(NULL);
    CHECK(!make("%s%n", NULL) && !make(NULL, NULL) && !make(longest, NULL));
    instantiate();
    void *c = make(FMU_TOKEN, longest);
    CHECK(c);
    values(c);
    states(c);
    BAD(FMI(ExitInitializationMode)(c));
    BAD(enter(c, NAN, NAN));
    BAD(enter(c, 1, 0));
    for (int k = 0; k < 2; k++) {
        IS(FMI(Discard), REAL(Set, c, &mass, 1, &nan));
        FINE(enter(c, 0, 0));
        values(c);
        states(c);
        FINE(FMI(ExitInitializationMode)(c));
        BAD(REAL(Set, c, &mass, 1, &heavy));
        if (!FMU_STATES) FINE(REAL(Set, c, &d, 1, &nan));
        drive(c);
        values(c);
        states(c);
        FINE(FMI(Terminate)(c));
        BAD(FMI(Terminate)(c));
        states(c);
        FINE(FMI(Reset)(c));
    }
    FMI(FreeInstance)(c);
    CHECK(messages >= 100);
    puts("fine");
    return 0;
}
