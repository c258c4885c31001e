/* Drives the car's FMI 3.0 Co-Simulation FMU: loads the library named, takes commands
 * (d, delta_rate) as doubles from stdin, writes states (7) after each step of 20 ms to stdout.
 * Built for the library's platform with the FMU's sources at hand, for the names of variables. */
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

static void *library;

/* The library's function of that name, as its FMI type. */
#define FMI(function) ((function##TYPE *)FIND(library, #function))

int main(int count, char **argument) {
    fmi3ValueReference in[] = {FMU_V_d, FMU_V_delta_rate}, out[7];
    for (unsigned i = 0; i < 7; i++) out[i] = FMU_V_x + i;
    BINARY();
    if (count != 2 || !(library = LOAD(argument[1]))) return 2;
    fmi3Instance c = FMI(fmi3InstantiateCoSimulation)("car", FMU_TOKEN, NULL, 0, 0, 0, 0, NULL, 0,
                                                      NULL, NULL, NULL);
    if (!c || FMI(fmi3EnterInitializationMode)(c, 0, 0, 0, 0, 0) ||
        FMI(fmi3ExitInitializationMode)(c))
        return 1;
    double u[2], x[7];
    for (int k = 0; fread(u, sizeof u, 1, stdin) == 1; k++) {
        fmi3Boolean event, terminate, early;
        fmi3Float64 reached;
        if (FMI(fmi3SetFloat64)(c, in, 2, u, 2) ||
            FMI(fmi3DoStep)(c, k * 0.02, 0.02, 1, &event, &terminate, &early, &reached) ||
            FMI(fmi3GetFloat64)(c, out, 7, x, 7))
            return 1;
        fwrite(x, sizeof x, 1, stdout);
    }
    FMI(fmi3FreeInstance)(c);
    return 0;
}
