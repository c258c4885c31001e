/* Misuses the FMI 2.0 functions of a car's FMU; under sanitizers. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "check.h"
#include "fmi2Functions.h"
#include "fmu_config.h"

static int messages;

static void listen(fmi2ComponentEnvironment environment, fmi2String name, fmi2Status status,
                   fmi2String category, fmi2String text, ...) {
    (void)environment, (void)name, (void)status, (void)category;
    messages += text[0] != 0;
}

#define IS(wanted, call) CHECK((call) == (wanted))
#define FINE(call) IS(fmi2OK, call)
#define BAD(call) IS(fmi2Error, call)

static fmi2CallbackFunctions callbacks = {listen, NULL, NULL, NULL, NULL};

static fmi2Component make(const char *token, const char *uri) {
    return fmi2Instantiate("one", fmi2CoSimulation, token, uri, &callbacks, 0, 1);
}

static void states(fmi2Component c) {
    fmi2FMUstate a = NULL, none = NULL;
    size_t size = 0;
    FINE(fmi2GetFMUstate(c, &a));
    FINE(fmi2SetFMUstate(c, a));
    FINE(fmi2SerializedFMUstateSize(c, a, &size));
    char *bytes = malloc(size);
    BAD(fmi2SerializeFMUstate(c, a, bytes, size - 1));
    FINE(fmi2SerializeFMUstate(c, a, bytes, size));
    for (size_t i = 0; i < size; i++) {
        bytes[i] ^= 0x41;
        BAD(fmi2DeSerializeFMUstate(c, bytes, size, &none));
        bytes[i] ^= 0x41;
    }
    FINE(fmi2DeSerializeFMUstate(c, bytes, size, &none));
    FINE(fmi2FreeFMUstate(c, &none));
    fmi2FMUstate stale = a;
    FINE(fmi2FreeFMUstate(c, &a));
    BAD(fmi2SetFMUstate(c, stale));
    free(bytes);
}

static void values(fmi2Component c) {
    fmi2ValueReference all[FMU_VALUES], strange = FMU_VALUES;
    double v[FMU_VALUES];
    int i = 0;
    fmi2String text = "";
    for (fmi2ValueReference k = 0; k < FMU_VALUES; k++) all[k] = k;
    FINE(fmi2GetReal(c, all, FMU_VALUES, v));
    FINE(fmi2GetReal(c, NULL, 0, NULL));
    BAD(fmi2GetReal(c, NULL, 1, v));
    BAD(fmi2SetReal(c, all, 1, NULL));
    BAD(fmi2GetReal(c, &strange, 1, v));
    BAD(fmi2SetReal(c, &strange, 1, v));
    BAD(fmi2GetInteger(c, all, 1, &i));
    BAD(fmi2SetBoolean(c, all, 1, &i));
    BAD(fmi2SetString(c, all, 1, &text));
    FINE(fmi2GetString(c, NULL, 0, NULL));
    BAD(fmi2SetRealInputDerivatives(c, all, 1, &i, v));
    BAD(fmi2GetRealOutputDerivatives(c, all, 1, &i, v));
    BAD(fmi2GetDirectionalDerivative(c, all, 1, all, 1, v, v));
    FINE(fmi2GetRealStatus(c, fmi2LastSuccessfulTime, v));
    IS(fmi2Discard, fmi2GetRealStatus(c, fmi2LastSuccessfulTime, NULL));
    IS(fmi2Discard, fmi2GetStatus(c, fmi2DoStepStatus, NULL));
    BAD(fmi2CancelStep(c));
}

int main(void) {
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
    BAD(fmi2Reset(NULL));
    fmi2FreeInstance(NULL);
    CHECK(!make("%s%n", NULL) && !make(NULL, NULL) && !make(longest, NULL));
    CHECK(!fmi2Instantiate("one", fmi2ModelExchange, FMU_TOKEN, NULL, &callbacks, 0, 0));
    CHECK(!fmi2Instantiate("one", fmi2CoSimulation, FMU_TOKEN, NULL, NULL, 0, 0));
    for (size_t k = 0; k < sizeof locations / sizeof *locations; k++) {
        fmi2Component c = make(FMU_TOKEN, locations[k]);
        CHECK(c);
        fmi2FreeInstance(c);
    }
    fmi2Component c = make(FMU_TOKEN, NULL);
    fmi2ValueReference d = FMU_V_d, mass = FMU_V_mass_kg;
    double nan = NAN, heavy = 1;
    values(c);
    states(c);
    BAD(fmi2ExitInitializationMode(c));
    BAD(fmi2SetupExperiment(c, 0, 0, NAN, 0, 0));
    for (int k = 0; k < 2; k++) {
        FINE(fmi2SetupExperiment(c, 0, 0, 0, 0, 0));
        IS(fmi2Discard, fmi2SetReal(c, &mass, 1, &nan));
        FINE(fmi2EnterInitializationMode(c));
        BAD(fmi2SetupExperiment(c, 0, 0, 0, 0, 0));
        FINE(fmi2ExitInitializationMode(c));
        BAD(fmi2SetReal(c, &mass, 1, &heavy));
        FINE(fmi2SetReal(c, &d, 1, &nan));
        for (int i = 0; i < 100; i++) FINE(fmi2DoStep(c, i * 0.02, 0.02, 1));
        BAD(fmi2DoStep(c, 2, -1, 1));
        values(c);
        states(c);
        FINE(fmi2Terminate(c));
        fmi2Boolean wants_an_end = 1;
        FINE(fmi2GetBooleanStatus(c, fmi2Terminated, &wants_an_end));
        CHECK(!wants_an_end);
        BAD(fmi2DoStep(c, 2, 0.02, 1));
        FINE(fmi2Reset(c));
    }
    fmi2FreeInstance(c);
    CHECK(messages >= 100);
    puts("fine");
    return 0;
}
