/* FMI 3.0 functions for what these FMUs do not have. An importer may load every symbol strictly,
 * and may call a getter or setter with no variable at all. */
#include "fmi3Functions.h"
#include "fmu_layer.h"

static fmi3Status absent(fmi3Instance c, const char *function)
{
    if (c) fmu_log(c, "%s: this FMU does not have that", function);
    return fmi3Error;
}

static fmi3Status none(fmi3Instance c, size_t n, const char *function)
{
    return c && n == 0 ? fmi3OK : absent(c, function);
}

fmi3Instance fmi3InstantiateScheduledExecution(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
    fmi3Boolean logging, fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
    fmi3ClockUpdateCallback update, fmi3LockPreemptionCallback lock,
    fmi3UnlockPreemptionCallback unlock)
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging;
    (void)update, (void)lock, (void)unlock;
    if (log) log(environment, fmi3Error, "logStatusError", "this FMU is of another kind");
    return NULL;
}

#define NO_VARIABLES(name, type)                                                                   \
    fmi3Status fmi3Get##name(fmi3Instance c, const fmi3ValueReference vr[], size_t n,              \
                             type value[], size_t n_values)                                        \
    {                                                                                              \
        (void)vr, (void)value, (void)n_values;                                                     \
        return none(c, n, __func__);                                                               \
    }                                                                                              \
    fmi3Status fmi3Set##name(fmi3Instance c, const fmi3ValueReference vr[], size_t n,              \
                             const type value[], size_t n_values)                                  \
    {                                                                                              \
        (void)vr, (void)value, (void)n_values;                                                     \
        return none(c, n, __func__);                                                               \
    }

NO_VARIABLES(Float32, fmi3Float32)
NO_VARIABLES(Int8, fmi3Int8)
NO_VARIABLES(UInt8, fmi3UInt8)
NO_VARIABLES(Int16, fmi3Int16)
NO_VARIABLES(UInt16, fmi3UInt16)
NO_VARIABLES(UInt32, fmi3UInt32)
NO_VARIABLES(Int64, fmi3Int64)
NO_VARIABLES(UInt64, fmi3UInt64)
NO_VARIABLES(String, fmi3String)

fmi3Status fmi3GetBinary(fmi3Instance c, const fmi3ValueReference vr[], size_t n, size_t sizes[],
                         fmi3Binary value[], size_t n_values)
{
    (void)vr, (void)sizes, (void)value, (void)n_values;
    return none(c, n, __func__);
}

fmi3Status fmi3SetBinary(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                         const size_t sizes[], const fmi3Binary value[], size_t n_values)
{
    (void)vr, (void)sizes, (void)value, (void)n_values;
    return none(c, n, __func__);
}

fmi3Status fmi3GetClock(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Clock value[])
{
    (void)vr, (void)value;
    return none(c, n, __func__);
}

fmi3Status fmi3SetClock(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                        const fmi3Clock value[])
{
    (void)vr, (void)value;
    return none(c, n, __func__);
}

fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance c, fmi3ValueReference vr, size_t *n)
{
    (void)vr, (void)n;
    return absent(c, __func__);
}

fmi3Status fmi3GetVariableDependencies(fmi3Instance c, fmi3ValueReference dependent,
                                       size_t of_dependent[], fmi3ValueReference independents[],
                                       size_t of_independents[], fmi3DependencyKind kinds[],
                                       size_t n)
{
    (void)dependent, (void)of_dependent, (void)independents, (void)of_independents, (void)kinds;
    (void)n;
    return absent(c, __func__);
}

fmi3Status fmi3EnterConfigurationMode(fmi3Instance c)
{
    return absent(c, __func__);
}

fmi3Status fmi3ExitConfigurationMode(fmi3Instance c)
{
    return absent(c, __func__);
}

fmi3Status fmi3EnterStepMode(fmi3Instance c)
{
    return absent(c, __func__);
}

fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance c)
{
    return absent(c, __func__);
}

fmi3Status fmi3ActivateModelPartition(fmi3Instance c, fmi3ValueReference clock, fmi3Float64 time)
{
    (void)clock, (void)time;
    return absent(c, __func__);
}

fmi3Status fmi3GetOutputDerivatives(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                                    const fmi3Int32 orders[], fmi3Float64 value[], size_t n_values)
{
    (void)vr, (void)orders, (void)value, (void)n_values;
    return none(c, n, __func__);
}

fmi3Status fmi3GetIntervalDecimal(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                                  fmi3Float64 intervals[], fmi3IntervalQualifier qualifiers[])
{
    (void)vr, (void)intervals, (void)qualifiers;
    return none(c, n, __func__);
}

fmi3Status fmi3GetIntervalFraction(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                                   fmi3UInt64 counters[], fmi3UInt64 resolutions[],
                                   fmi3IntervalQualifier qualifiers[])
{
    (void)vr, (void)counters, (void)resolutions, (void)qualifiers;
    return none(c, n, __func__);
}

fmi3Status fmi3GetShiftDecimal(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                               fmi3Float64 shifts[])
{
    (void)vr, (void)shifts;
    return none(c, n, __func__);
}

fmi3Status fmi3GetShiftFraction(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                                fmi3UInt64 counters[], fmi3UInt64 resolutions[])
{
    (void)vr, (void)counters, (void)resolutions;
    return none(c, n, __func__);
}

fmi3Status fmi3SetIntervalDecimal(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                                  const fmi3Float64 intervals[])
{
    (void)vr, (void)intervals;
    return none(c, n, __func__);
}

fmi3Status fmi3SetIntervalFraction(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                                   const fmi3UInt64 counters[], const fmi3UInt64 resolutions[])
{
    (void)vr, (void)counters, (void)resolutions;
    return none(c, n, __func__);
}

fmi3Status fmi3SetShiftDecimal(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                               const fmi3Float64 shifts[])
{
    (void)vr, (void)shifts;
    return none(c, n, __func__);
}

fmi3Status fmi3SetShiftFraction(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                                const fmi3UInt64 counters[], const fmi3UInt64 resolutions[])
{
    (void)vr, (void)counters, (void)resolutions;
    return none(c, n, __func__);
}

#if !FMU_STATES
fmi3Status fmi3SetContinuousStates(fmi3Instance c, const fmi3Float64 x[], size_t n)
{
    (void)x;
    return none(c, n, __func__);
}

fmi3Status fmi3GetContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n)
{
    (void)x;
    return none(c, n, __func__);
}

fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, fmi3Float64 dx[], size_t n)
{
    (void)dx;
    return none(c, n, __func__);
}

fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance c, fmi3Float64 nominal[], size_t n)
{
    (void)nominal;
    return none(c, n, __func__);
}
#endif
