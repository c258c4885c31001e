/* Misuses the FMI 3.0 functions of a car's FMU, either kind; under sanitizers. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "check.h"
#include "fmi3Functions.h"
#include "fmu_config.h"

static int messages;

static void listen(fmi3InstanceEnvironment environment, fmi3Status status, fmi3String category,
                   fmi3String text) {
    (void)environment, (void)status, (void)category;
    messages += text[0] != 0;
}

#define IS(wanted, call) CHECK((call) == (wanted))
#define FINE(call) IS(fmi3OK, call)
#define BAD(call) IS(fmi3Error, call)

static fmi3Instance make(const char *token, const char *resources) {
#if !FMU_STATES
    return fmi3InstantiateCoSimulation("one", token, resources, 0, 1, 0, 0, NULL, 0, NULL, listen,
                                       NULL);
#else
    return fmi3InstantiateModelExchange("one", token, resources, 0, 1, NULL, listen);
#endif
}

static void states(fmi3Instance c) {
    fmi3FMUState a = NULL, b = NULL, none = NULL;
    size_t size = 0;
    FINE(fmi3GetFMUState(c, &a));
    FINE(fmi3GetFMUState(c, &a)); /* overwrites */
    FINE(fmi3GetFMUState(c, &b));
    FINE(fmi3SetFMUState(c, a));
    BAD(fmi3GetFMUState(c, NULL));
    BAD(fmi3SetFMUState(c, NULL));
    BAD(fmi3SetFMUState(c, &size));
    FINE(fmi3SerializedFMUStateSize(c, a, &size));
    BAD(fmi3SerializedFMUStateSize(c, a, NULL));
    unsigned char *bytes = malloc(size);
    BAD(fmi3SerializeFMUState(c, a, bytes, size - 1));
    BAD(fmi3SerializeFMUState(c, NULL, bytes, size));
    BAD(fmi3SerializeFMUState(c, a, NULL, size));
    FINE(fmi3SerializeFMUState(c, a, bytes, size));
    for (size_t i = 0; i < size; i++) {
        bytes[i] ^= 0x41;
        BAD(fmi3DeserializeFMUState(c, bytes, size, &none));
        bytes[i] ^= 0x41;
    }
    for (size_t n = 0; n < size; n += 7) BAD(fmi3DeserializeFMUState(c, bytes, n, &none));
    FINE(fmi3DeserializeFMUState(c, bytes, size, &none));
    FINE(fmi3SetFMUState(c, none));
    FINE(fmi3FreeFMUState(c, &none));
    FINE(fmi3FreeFMUState(c, &none)); /* NULL by now */
    fmi3FMUState stale = a;
    FINE(fmi3FreeFMUState(c, &a));
    BAD(fmi3SetFMUState(c, stale));
    BAD(fmi3FreeFMUState(c, &stale));
    free(bytes);
    /* b is left to fmi3FreeInstance */
}

static void values(fmi3Instance c) {
    fmi3ValueReference all[FMU_VALUES], strange[] = {FMU_VALUES, 0xffffffff};
    double v[FMU_VALUES];
    fmi3Int32 i = 0;
    fmi3Boolean b = 0;
    for (fmi3ValueReference k = 0; k < FMU_VALUES; k++) all[k] = k;
    FINE(fmi3GetFloat64(c, all, FMU_VALUES, v, FMU_VALUES));
    FINE(fmi3GetFloat64(c, NULL, 0, NULL, 0));
    BAD(fmi3GetFloat64(c, NULL, 1, v, 1));
    BAD(fmi3GetFloat64(c, all, 1, NULL, 1));
    BAD(fmi3GetFloat64(c, all, 1, v, 2));
    BAD(fmi3GetFloat64(c, strange, 1, v, 1));
    BAD(fmi3GetFloat64(c, strange + 1, 1, v, 1));
    BAD(fmi3SetFloat64(c, strange, 2, v, 2));
    BAD(fmi3SetFloat64(c, all + FMU_V_time, 1, v, 1));
    BAD(fmi3GetInt32(c, all, 1, &i, 1));
    BAD(fmi3SetInt32(c, all, 1, &i, 1));
    BAD(fmi3GetBoolean(c, all, 1, &b, 1));
    BAD(fmi3SetBoolean(c, all, 1, &b, 1));
    fmi3String text = "";
    BAD(fmi3SetString(c, all, 1, &text, 1));
    FINE(fmi3GetString(c, NULL, 0, NULL, 0));
    BAD(fmi3GetClock(c, all, 1, &b));
    BAD(fmi3EnterConfigurationMode(c));
    BAD(fmi3GetOutputDerivatives(c, all, 1, &i, v, 1));
    BAD(fmi3GetVariableDependencies(c, 0, NULL, NULL, NULL, NULL, 0));
}

static void run(fmi3Instance c) {
    double v[FMU_VALUES] = {0};
    fmi3Boolean yes;
    const fmi3ValueReference d = FMU_V_d, mass = FMU_V_mass_kg;
    double heavy = 1;
#if !FMU_STATES
    BAD(fmi3EnterContinuousTimeMode(c));
    BAD(fmi3SetTime(c, 1));
    BAD(fmi3GetDirectionalDerivative(c, &d, 1, &d, 1, v, 1, v, 1));
    double nan = NAN;
    FINE(fmi3SetFloat64(c, &d, 1, &nan, 1));
    for (int k = 0; k < 100; k++) FINE(fmi3DoStep(c, k * 0.02, 0.02, 0, &yes, &yes, &yes, v));
    FINE(fmi3DoStep(c, 2, 0.02, 0, NULL, NULL, NULL, NULL));
    BAD(fmi3DoStep(c, 2.02, NAN, 0, NULL, NULL, NULL, NULL));
    BAD(fmi3DoStep(c, 2.02, 1e300, 0, NULL, NULL, NULL, NULL));
#else
    fmi3ValueReference first = FMU_V_der_x, state = FMU_V_x, der[FMU_STATES], known[FMU_VALUES];
    double nominal[FMU_STATES], out[FMU_VALUES];
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
    double seed[FMU_VALUES] = {1, 1};
    FINE(fmi3GetDirectionalDerivative(c, der, FMU_STATES, known, FMU_V_der_x, seed, FMU_V_der_x,
                                      out, FMU_STATES));
    const fmi3ValueReference time = FMU_V_time;
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
#endif
    BAD(fmi3SetFloat64(c, &mass, 1, &heavy, 1));
    states(c);
    values(c);
    FINE(fmi3Terminate(c));
    BAD(fmi3Terminate(c));
    states(c);
}

int main(void) {
    char longest[5000];
    memset(longest, 'x', sizeof longest - 1);
    longest[sizeof longest - 1] = 0;
    BAD(fmi3Reset(NULL));
    fmi3FreeInstance(NULL);
    CHECK(!make("wrong", NULL) && !make(NULL, NULL) && !make(longest, NULL));
    CHECK(!fmi3InstantiateScheduledExecution("one", FMU_TOKEN, NULL, 0, 0, NULL, listen, NULL, NULL,
                                             NULL));
    fmi3Instance c = make(FMU_TOKEN, longest);
    CHECK(c);
    values(c);
    states(c);
    BAD(fmi3ExitInitializationMode(c));
    BAD(fmi3EnterInitializationMode(c, 0, 0, NAN, 0, 0));
    BAD(fmi3EnterInitializationMode(c, 0, 0, 1, 1, 0));
    for (int k = 0; k < 2; k++) {
        FINE(fmi3EnterInitializationMode(c, 0, 0, 0, 0, 0));
        values(c);
        states(c);
        FINE(fmi3ExitInitializationMode(c));
        run(c);
        FINE(fmi3Reset(c));
    }
    fmi3FreeInstance(c);
    CHECK(messages >= 100);
    puts("fine");
    return 0;
}
