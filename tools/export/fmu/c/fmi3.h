/* What an FMU has to know of FMI 3.0: the types, and the functions that an importer calls. */
#ifndef ATO_FMI3_H
#define ATO_FMI3_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#if !defined(FMI3_Export)
#if defined(_WIN32)
#define FMI3_Export __declspec(dllexport)
#elif defined(__GNUC__)
#define FMI3_Export __attribute__((visibility("default")))
#else
#define FMI3_Export
#endif
#endif

typedef void *fmi3Instance;
typedef void *fmi3InstanceEnvironment;
typedef void *fmi3FMUState;
typedef uint32_t fmi3ValueReference;
typedef float fmi3Float32;
typedef double fmi3Float64;
typedef int8_t fmi3Int8;
typedef uint8_t fmi3UInt8;
typedef int16_t fmi3Int16;
typedef uint16_t fmi3UInt16;
typedef int32_t fmi3Int32;
typedef uint32_t fmi3UInt32;
typedef int64_t fmi3Int64;
typedef uint64_t fmi3UInt64;
typedef bool fmi3Boolean;
typedef char fmi3Char;
typedef const fmi3Char *fmi3String;
typedef uint8_t fmi3Byte;
typedef const fmi3Byte *fmi3Binary;
typedef bool fmi3Clock;

typedef enum { fmi3OK, fmi3Warning, fmi3Discard, fmi3Error, fmi3Fatal } fmi3Status;

/* What an importer is told of an interval or a dependency; no function here gives one. */
typedef int fmi3IntervalQualifier;
typedef int fmi3DependencyKind;

typedef void (*fmi3LogMessageCallback)(
    fmi3InstanceEnvironment environment, fmi3Status status, fmi3String category, fmi3String message);
typedef void (*fmi3ClockUpdateCallback)(fmi3InstanceEnvironment environment);
typedef void (*fmi3LockPreemptionCallback)(void);
typedef void (*fmi3UnlockPreemptionCallback)(void);
typedef void (*fmi3IntermediateUpdateCallback)(fmi3InstanceEnvironment environment,
    fmi3Float64 intermediateUpdateTime, fmi3Boolean intermediateVariableSetRequested,
    fmi3Boolean intermediateVariableGetAllowed, fmi3Boolean intermediateStepFinished,
    fmi3Boolean canReturnEarly, fmi3Boolean *earlyReturnRequested,
    fmi3Float64 *earlyReturnTime);

FMI3_Export const char *fmi3GetVersion(void);
FMI3_Export fmi3Status fmi3SetDebugLogging(
    fmi3Instance instance, fmi3Boolean loggingOn, size_t count, const fmi3String categories[]);

FMI3_Export fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token,
    fmi3String resourcePath, fmi3Boolean visible, fmi3Boolean loggingOn,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback logMessage);
FMI3_Export fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token,
    fmi3String resourcePath, fmi3Boolean visible, fmi3Boolean loggingOn, fmi3Boolean eventModeUsed,
    fmi3Boolean earlyReturnAllowed, const fmi3ValueReference required[], size_t requiredCount,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback logMessage,
    fmi3IntermediateUpdateCallback intermediateUpdate);
FMI3_Export fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token,
    fmi3String resourcePath, fmi3Boolean visible, fmi3Boolean loggingOn,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback logMessage,
    fmi3ClockUpdateCallback clockUpdate, fmi3LockPreemptionCallback lockPreemption,
    fmi3UnlockPreemptionCallback unlockPreemption);
FMI3_Export void fmi3FreeInstance(fmi3Instance instance);

FMI3_Export fmi3Status fmi3EnterInitializationMode(fmi3Instance instance,
    fmi3Boolean toleranceDefined, fmi3Float64 tolerance, fmi3Float64 startTime,
    fmi3Boolean stopTimeDefined, fmi3Float64 stopTime);
FMI3_Export fmi3Status fmi3ExitInitializationMode(fmi3Instance instance);
FMI3_Export fmi3Status fmi3EnterEventMode(fmi3Instance instance);
FMI3_Export fmi3Status fmi3EnterStepMode(fmi3Instance instance);
FMI3_Export fmi3Status fmi3Terminate(fmi3Instance instance);
FMI3_Export fmi3Status fmi3Reset(fmi3Instance instance);
FMI3_Export fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 currentCommunicationPoint,
    fmi3Float64 communicationStepSize, fmi3Boolean noSetFMUStatePriorToCurrentPoint,
    fmi3Boolean *eventHandlingNeeded, fmi3Boolean *terminateSimulation, fmi3Boolean *earlyReturn,
    fmi3Float64 *lastSuccessfulTime);
FMI3_Export fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance instance);
FMI3_Export fmi3Status fmi3UpdateDiscreteStates(fmi3Instance instance,
    fmi3Boolean *discreteStatesNeedUpdate, fmi3Boolean *terminateSimulation,
    fmi3Boolean *nominalsChanged, fmi3Boolean *valuesChanged, fmi3Boolean *nextEventTimeDefined,
    fmi3Float64 *nextEventTime);

#define FMI3_ACCESS(Type, kind) \
    FMI3_Export fmi3Status fmi3Get##Type(fmi3Instance instance, \
        const fmi3ValueReference references[], size_t count, kind values[], size_t valueCount); \
    FMI3_Export fmi3Status fmi3Set##Type(fmi3Instance instance, \
        const fmi3ValueReference references[], size_t count, const kind values[], \
        size_t valueCount)

FMI3_ACCESS(Float32, fmi3Float32);
FMI3_ACCESS(Float64, fmi3Float64);
FMI3_ACCESS(Int8, fmi3Int8);
FMI3_ACCESS(UInt8, fmi3UInt8);
FMI3_ACCESS(Int16, fmi3Int16);
FMI3_ACCESS(UInt16, fmi3UInt16);
FMI3_ACCESS(Int32, fmi3Int32);
FMI3_ACCESS(UInt32, fmi3UInt32);
FMI3_ACCESS(Int64, fmi3Int64);
FMI3_ACCESS(UInt64, fmi3UInt64);
FMI3_ACCESS(Boolean, fmi3Boolean);
FMI3_ACCESS(String, fmi3String);

FMI3_Export fmi3Status fmi3GetBinary(fmi3Instance instance, const fmi3ValueReference references[],
    size_t count, size_t sizes[], fmi3Binary values[], size_t valueCount);
FMI3_Export fmi3Status fmi3SetBinary(fmi3Instance instance, const fmi3ValueReference references[],
    size_t count, const size_t sizes[], const fmi3Binary values[], size_t valueCount);
FMI3_Export fmi3Status fmi3GetClock(fmi3Instance instance, const fmi3ValueReference references[],
    size_t count, fmi3Clock values[]);
FMI3_Export fmi3Status fmi3SetClock(fmi3Instance instance, const fmi3ValueReference references[],
    size_t count, const fmi3Clock values[]);

FMI3_Export fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *state);
FMI3_Export fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState state);
FMI3_Export fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *state);
FMI3_Export fmi3Status fmi3SerializedFMUStateSize(
    fmi3Instance instance, fmi3FMUState state, size_t *size);
FMI3_Export fmi3Status fmi3SerializeFMUState(
    fmi3Instance instance, fmi3FMUState state, fmi3Byte bytes[], size_t size);
FMI3_Export fmi3Status fmi3DeserializeFMUState(
    fmi3Instance instance, const fmi3Byte bytes[], size_t size, fmi3FMUState *state);

FMI3_Export fmi3Status fmi3GetNumberOfVariableDependencies(
    fmi3Instance instance, fmi3ValueReference reference, size_t *count);
FMI3_Export fmi3Status fmi3GetVariableDependencies(fmi3Instance instance,
    fmi3ValueReference dependent, size_t elements[], fmi3ValueReference independents[],
    size_t independentElements[], fmi3DependencyKind kinds[], size_t count);
FMI3_Export fmi3Status fmi3GetDirectionalDerivative(fmi3Instance instance,
    const fmi3ValueReference unknowns[], size_t unknownCount, const fmi3ValueReference knowns[],
    size_t knownCount, const fmi3Float64 seed[], size_t seedCount, fmi3Float64 sensitivity[],
    size_t sensitivityCount);
FMI3_Export fmi3Status fmi3GetAdjointDerivative(fmi3Instance instance,
    const fmi3ValueReference unknowns[], size_t unknownCount, const fmi3ValueReference knowns[],
    size_t knownCount, const fmi3Float64 seed[], size_t seedCount, fmi3Float64 sensitivity[],
    size_t sensitivityCount);
FMI3_Export fmi3Status fmi3EnterConfigurationMode(fmi3Instance instance);
FMI3_Export fmi3Status fmi3ExitConfigurationMode(fmi3Instance instance);
FMI3_Export fmi3Status fmi3GetIntervalDecimal(fmi3Instance instance,
    const fmi3ValueReference references[], size_t count, fmi3Float64 intervals[],
    fmi3IntervalQualifier qualifiers[]);
FMI3_Export fmi3Status fmi3GetIntervalFraction(fmi3Instance instance,
    const fmi3ValueReference references[], size_t count, fmi3UInt64 counters[],
    fmi3UInt64 resolutions[], fmi3IntervalQualifier qualifiers[]);
FMI3_Export fmi3Status fmi3GetShiftDecimal(fmi3Instance instance,
    const fmi3ValueReference references[], size_t count, fmi3Float64 shifts[]);
FMI3_Export fmi3Status fmi3GetShiftFraction(fmi3Instance instance,
    const fmi3ValueReference references[], size_t count, fmi3UInt64 counters[],
    fmi3UInt64 resolutions[]);
FMI3_Export fmi3Status fmi3SetIntervalDecimal(fmi3Instance instance,
    const fmi3ValueReference references[], size_t count, const fmi3Float64 intervals[]);
FMI3_Export fmi3Status fmi3SetIntervalFraction(fmi3Instance instance,
    const fmi3ValueReference references[], size_t count, const fmi3UInt64 counters[],
    const fmi3UInt64 resolutions[]);
FMI3_Export fmi3Status fmi3SetShiftDecimal(fmi3Instance instance,
    const fmi3ValueReference references[], size_t count, const fmi3Float64 shifts[]);
FMI3_Export fmi3Status fmi3SetShiftFraction(fmi3Instance instance,
    const fmi3ValueReference references[], size_t count, const fmi3UInt64 counters[],
    const fmi3UInt64 resolutions[]);
FMI3_Export fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance instance);
FMI3_Export fmi3Status fmi3CompletedIntegratorStep(fmi3Instance instance,
    fmi3Boolean noSetFMUStatePriorToCurrentPoint, fmi3Boolean *enterEventMode,
    fmi3Boolean *terminateSimulation);
FMI3_Export fmi3Status fmi3SetTime(fmi3Instance instance, fmi3Float64 time);
FMI3_Export fmi3Status fmi3SetContinuousStates(
    fmi3Instance instance, const fmi3Float64 states[], size_t count);
FMI3_Export fmi3Status fmi3GetContinuousStateDerivatives(
    fmi3Instance instance, fmi3Float64 derivatives[], size_t count);
FMI3_Export fmi3Status fmi3GetEventIndicators(
    fmi3Instance instance, fmi3Float64 indicators[], size_t count);
FMI3_Export fmi3Status fmi3GetContinuousStates(
    fmi3Instance instance, fmi3Float64 states[], size_t count);
FMI3_Export fmi3Status fmi3GetNominalsOfContinuousStates(
    fmi3Instance instance, fmi3Float64 nominals[], size_t count);
FMI3_Export fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance instance, size_t *count);
FMI3_Export fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance instance, size_t *count);
FMI3_Export fmi3Status fmi3GetOutputDerivatives(fmi3Instance instance,
    const fmi3ValueReference references[], size_t count, const fmi3Int32 orders[],
    fmi3Float64 values[], size_t valueCount);
FMI3_Export fmi3Status fmi3ActivateModelPartition(
    fmi3Instance instance, fmi3ValueReference clock, fmi3Float64 activationTime);

#endif
