/* Drives an FMI 3.0 Co-Simulation FMU: loads the library named first, with the resources named
 * second if there are any. Of the car it takes commands (d, delta_rate) as doubles from stdin and
 * writes states (7) after each step of 20 ms to stdout; with CONTROLLER defined, the other way
 * round. Built for the library's platform with the FMU's sources at hand, for the names of
 * variables. */
#include <stdio.h>

#define FMI3_FUNCTION_PREFIX
#include "fmi3FunctionTypes.h"
#include "fmu_config.h"

#ifdef _WIN32
#include <fcntl.h>
#include <io.h>
#include <windows.h>
#define LOAD(path) ((void *)LoadLibraryA(path))
#define FIND(library, name) ((void *)GetProcAddress((HMODULE)(library), name))
#define BINARY() (_setmode(0, _O_BINARY), _setmode(1, _O_BINARY))
#else
#include <dlfcn.h>
#define LOAD(path) dlopen(path, RTLD_NOW | RTLD_LOCAL)
#define FIND(library, name) dlsym(library, name)
#define BINARY() ((void)0)
#endif

#ifdef CONTROLLER
enum { FIRST_INPUT = FMU_V_x, INPUTS = 7, FIRST_OUTPUT = FMU_V_d, OUTPUTS = 2 };
#else
enum { FIRST_INPUT = FMU_V_d, INPUTS = 2, FIRST_OUTPUT = FMU_V_x, OUTPUTS = 7 };
#endif

static void *library;

/* The library's function of that name, as its FMI type. */
#define FMI(function) ((function##TYPE *)FIND(library, #function))

int main(int count, char **argument) {
    fmi3ValueReference in[INPUTS], out[OUTPUTS];
    for (unsigned i = 0; i < INPUTS; i++) in[i] = FIRST_INPUT + i;
    for (unsigned i = 0; i < OUTPUTS; i++) out[i] = FIRST_OUTPUT + i;
    BINARY();
    if (count < 2 || !(library = LOAD(argument[1]))) return 2;
    fmi3Instance c = FMI(fmi3InstantiateCoSimulation)(
        "one", FMU_TOKEN, count > 2 ? argument[2] : NULL, 0, 0, 0, 0, NULL, 0, NULL, NULL, NULL);
    if (!c || FMI(fmi3EnterInitializationMode)(c, 0, 0, 0, 0, 0) ||
        FMI(fmi3ExitInitializationMode)(c))
        return 1;
    double given[INPUTS], said[OUTPUTS];
    for (int k = 0; fread(given, sizeof given, 1, stdin) == 1; k++) {
        fmi3Boolean event, terminate, early;
        fmi3Float64 reached;
        if (FMI(fmi3SetFloat64)(c, in, INPUTS, given, INPUTS) ||
            FMI(fmi3DoStep)(c, k * 0.02, 0.02, 1, &event, &terminate, &early, &reached) ||
            FMI(fmi3GetFloat64)(c, out, OUTPUTS, said, OUTPUTS))
            return 1;
        fwrite(said, sizeof said, 1, stdout);
    }
    FMI(fmi3FreeInstance)(c);
    return 0;
}
