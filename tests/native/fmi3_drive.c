/* Drives the car's FMI 3.0 Co-Simulation FMU: commands (d, delta_rate) as doubles on stdin, states
 * (7) after each step of 20 ms on stdout. Linked with the FMU's sources for any processor. */
#include <stdio.h>

#include "fmi3Functions.h"
#include "fmu_config.h"

int main(void)
{
    fmi3ValueReference in[] = {FMU_V_d, FMU_V_delta_rate}, out[7];
    for (unsigned i = 0; i < 7; i++) out[i] = FMU_V_x + i;
    fmi3Instance c = fmi3InstantiateCoSimulation("car", FMU_TOKEN, NULL, 0, 0, 0, 0, NULL, 0, NULL,
                                                 NULL, NULL);
    if (!c || fmi3EnterInitializationMode(c, 0, 0, 0, 0, 0) || fmi3ExitInitializationMode(c))
        return 1;
    double u[2], x[7];
    for (int k = 0; fread(u, sizeof u, 1, stdin) == 1; k++) {
        if (fmi3SetFloat64(c, in, 2, u, 2)
            || fmi3DoStep(c, k * 0.02, 0.02, 1, NULL, NULL, NULL, NULL)
            || fmi3GetFloat64(c, out, 7, x, 7))
            return 1;
        fwrite(x, sizeof x, 1, stdout);
    }
    fmi3FreeInstance(c);
    return 0;
}
