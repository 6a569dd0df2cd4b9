/* The functions of FMI 3.0 Co-Simulation around a model. A call that is out of place, or names a
 * variable that there is not, gives fmi3Error and a line to the importer's log; the state stays. */
#include "fmu.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define TIME_TOLERANCE (1e-6 * FMU_PERIOD_S)

typedef struct {
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
    bool is_logging;
    bool uses_events;
    bool may_return_early;
    fmu_state state;
} fmu_instance;

typedef struct {
    char magic[8];
    char token[FMU_TOKEN_LENGTH + 1];
} fmu_head;

static const fmu_variable VARIABLES[FMU_VARIABLES] = { FMU_VARIABLE_ROWS };

void fmu_say(fmi3Instance instance, fmi3Status status, const char *text)
{
    const fmu_instance *own = (const fmu_instance *)instance;

    if (own->log != NULL && (own->is_logging || status >= fmi3Error)) {
        own->log(own->environment, status, status >= fmi3Error ? "logStatusError" : "logEvents",
            text);
    }
}

static fmi3Status refused(fmi3Instance instance, const char *call, const char *why)
{
    char text[160];

    if (instance != NULL) {
        (void)snprintf(text, sizeof text, "%s: %s", call, why);
        fmu_say(instance, fmi3Error, text);
    }
    return fmi3Error;
}

static void reset(fmu_state *state)
{
    memset(state, 0, sizeof *state);
    for (int i = 0; i < FMU_VARIABLES; i++) {
        if (VARIABLES[i].type == FMU_FLOAT64) {
            state->values[i].real = VARIABLES[i].start;
        } else {
            state->values[i].integer = (int64_t)VARIABLES[i].start;
        }
    }
    fmu_model_reset(state);
}

const char *fmi3GetVersion(void) { return "3.0"; }

fmi3Status fmi3SetDebugLogging(
    fmi3Instance instance, fmi3Boolean loggingOn, size_t count, const fmi3String categories[])
{
    (void)count;
    (void)categories;
    ((fmu_instance *)instance)->is_logging = loggingOn;
    return fmi3OK;
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token,
    fmi3String resourcePath, fmi3Boolean visible, fmi3Boolean loggingOn, fmi3Boolean eventModeUsed,
    fmi3Boolean earlyReturnAllowed, const fmi3ValueReference required[], size_t requiredCount,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback logMessage,
    fmi3IntermediateUpdateCallback intermediateUpdate)
{
    fmu_instance *own;

    (void)name;
    (void)resourcePath;
    (void)visible;
    (void)required;
    (void)intermediateUpdate;
    if (token == NULL || strcmp(token, FMU_TOKEN) != 0 || requiredCount != 0) {
        if (logMessage != NULL) {
            logMessage(environment, fmi3Error, "logStatusError",
                "fmi3InstantiateCoSimulation: another instantiationToken than modelDescription.xml"
                " has, or intermediate variables, of which there are none");
        }
        return NULL;
    }
    own = calloc(1, sizeof *own);
    if (own == NULL) {
        return NULL;
    }
    own->environment = environment;
    own->log = logMessage;
    own->is_logging = loggingOn;
    own->uses_events = eventModeUsed;
    own->may_return_early = earlyReturnAllowed;
    reset(&own->state);
    return own;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token,
    fmi3String resourcePath, fmi3Boolean visible, fmi3Boolean loggingOn,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback logMessage)
{
    (void)name;
    (void)token;
    (void)resourcePath;
    (void)visible;
    (void)loggingOn;
    (void)environment;
    (void)logMessage;
    return NULL;
}

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token,
    fmi3String resourcePath, fmi3Boolean visible, fmi3Boolean loggingOn,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback logMessage,
    fmi3ClockUpdateCallback clockUpdate, fmi3LockPreemptionCallback lockPreemption,
    fmi3UnlockPreemptionCallback unlockPreemption)
{
    (void)name;
    (void)token;
    (void)resourcePath;
    (void)visible;
    (void)loggingOn;
    (void)environment;
    (void)logMessage;
    (void)clockUpdate;
    (void)lockPreemption;
    (void)unlockPreemption;
    return NULL;
}

void fmi3FreeInstance(fmi3Instance instance) { free(instance); }

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean toleranceDefined,
    fmi3Float64 tolerance, fmi3Float64 startTime, fmi3Boolean stopTimeDefined,
    fmi3Float64 stopTime)
{
    fmu_state *state = &((fmu_instance *)instance)->state;

    (void)toleranceDefined;
    (void)tolerance;
    (void)stopTimeDefined;
    (void)stopTime;
    if (state->mode != FMU_INSTANTIATED) {
        return refused(instance, "fmi3EnterInitializationMode", "expected a new instance");
    }
    state->mode = FMU_INITIALIZATION;
    state->start_s = startTime;
    state->time_s = startTime;
    return fmi3OK;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance)
{
    fmu_instance *own = (fmu_instance *)instance;

    if (own->state.mode != FMU_INITIALIZATION) {
        return refused(instance, "fmi3ExitInitializationMode", "not in Initialization Mode");
    }
    own->state.is_running = 1;
    if (!fmu_model_start(&own->state)) {
        return refused(instance, "fmi3ExitInitializationMode", "a parameter is out of its range");
    }
    fmu_bus_start(&own->state);
    own->state.mode = own->uses_events ? FMU_EVENT : FMU_STEP;
    return fmi3OK;
}

fmi3Status fmi3EnterEventMode(fmi3Instance instance)
{
    fmu_instance *own = (fmu_instance *)instance;

    if (own->state.mode != FMU_STEP || !own->uses_events) {
        return refused(instance, "fmi3EnterEventMode", "not in Step Mode, or without events");
    }
    own->state.mode = FMU_EVENT;
    return fmi3OK;
}

fmi3Status fmi3EnterStepMode(fmi3Instance instance)
{
    fmu_state *state = &((fmu_instance *)instance)->state;

    if (state->mode != FMU_EVENT) {
        return refused(instance, "fmi3EnterStepMode", "not in Event Mode");
    }
    state->mode = FMU_STEP;
    return fmi3OK;
}

fmi3Status fmi3Terminate(fmi3Instance instance)
{
    ((fmu_instance *)instance)->state.mode = FMU_TERMINATED;
    return fmi3OK;
}

fmi3Status fmi3Reset(fmi3Instance instance)
{
    reset(&((fmu_instance *)instance)->state);
    return fmi3OK;
}

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 currentCommunicationPoint,
    fmi3Float64 communicationStepSize, fmi3Boolean noSetFMUStatePriorToCurrentPoint,
    fmi3Boolean *eventHandlingNeeded, fmi3Boolean *terminateSimulation, fmi3Boolean *earlyReturn,
    fmi3Float64 *lastSuccessfulTime)
{
    fmu_instance *own = (fmu_instance *)instance;
    fmu_state *state = &own->state;
    double target_s = currentCommunicationPoint + communicationStepSize;

    (void)noSetFMUStatePriorToCurrentPoint;
    *eventHandlingNeeded = false;
    *terminateSimulation = false;
    *earlyReturn = false;
    *lastSuccessfulTime = state->time_s;
    if (state->mode != FMU_STEP) {
        return refused(instance, "fmi3DoStep", "not in Step Mode");
    }
    if (!(fabs(currentCommunicationPoint - state->time_s) <= TIME_TOLERANCE)
        || !(communicationStepSize > 0.0)) {
        return refused(instance, "fmi3DoStep", "expected a step onwards from where the last ended");
    }
    for (;;) {
        double due_s = state->start_s + (double)(state->periods + 1) * FMU_PERIOD_S;

        if (due_s > target_s + TIME_TOLERANCE) {
            break;
        }
        state->periods++;
        state->time_s = due_s;
        if (fmu_bus_period(state) == FMU_EVENT_NEEDED && own->uses_events) {
            *eventHandlingNeeded = true;
            if (own->may_return_early && due_s < target_s - TIME_TOLERANCE) {
                *earlyReturn = true;
                *lastSuccessfulTime = due_s;
                state->values[0].real = due_s;
                return fmi3OK;
            }
        }
    }
#if FMU_CAN
    if (state->bus.to_send_count > 0 && own->uses_events) {
        *eventHandlingNeeded = true; /* an importer that did not iterate its last event */
    }
#endif
    state->time_s = target_s;
    state->values[0].real = target_s;
    *lastSuccessfulTime = target_s;
    return fmi3OK;
}

/* Variables. The independent variable, time, has reference 0. */

static bool is_known(fmi3ValueReference reference, int type)
{
    return reference < FMU_VARIABLES && VARIABLES[reference].type == type;
}

static bool may_set(const fmu_state *state, fmi3ValueReference reference)
{
    switch (VARIABLES[reference].causality) {
    case FMU_INPUT:
        return state->mode != FMU_TERMINATED;
    case FMU_PARAMETER:
        return state->is_running == 0;
    default:
        return false;
    }
}

#define ACCESS(Type, kind, tag, member, from_value) \
    fmi3Status fmi3Get##Type(fmi3Instance instance, const fmi3ValueReference references[], \
        size_t count, kind values[], size_t valueCount) \
    { \
        const fmu_state *state = &((fmu_instance *)instance)->state; \
        if (count != valueCount) { \
            return refused(instance, "fmi3Get" #Type, "every variable is a scalar"); \
        } \
        for (size_t i = 0; i < count; i++) { \
            if (!is_known(references[i], tag)) { \
                return refused(instance, "fmi3Get" #Type, "no such variable of this type"); \
            } \
            values[i] = from_value(state->values[references[i]].member); \
        } \
        return fmi3OK; \
    } \
    fmi3Status fmi3Set##Type(fmi3Instance instance, const fmi3ValueReference references[], \
        size_t count, const kind values[], size_t valueCount) \
    { \
        fmu_state *state = &((fmu_instance *)instance)->state; \
        if (count != valueCount) { \
            return refused(instance, "fmi3Set" #Type, "every variable is a scalar"); \
        } \
        for (size_t i = 0; i < count; i++) { \
            if (!is_known(references[i], tag) || !may_set(state, references[i])) { \
                return refused(instance, "fmi3Set" #Type, \
                    "no such variable of this type that may be set now"); \
            } \
        } \
        for (size_t i = 0; i < count; i++) { \
            state->values[references[i]].member = values[i]; \
        } \
        return fmi3OK; \
    }

#define SAME(value) (value)
#define TRUTH(value) ((value) != 0)
ACCESS(Float64, fmi3Float64, FMU_FLOAT64, real, SAME)
ACCESS(Int64, fmi3Int64, FMU_INT64, integer, SAME)
ACCESS(Boolean, fmi3Boolean, FMU_BOOLEAN, integer, TRUTH)

/* Types of which there is no variable. */
#define NONE(Type, kind) \
    fmi3Status fmi3Get##Type(fmi3Instance instance, const fmi3ValueReference references[], \
        size_t count, kind values[], size_t valueCount) \
    { \
        (void)references; \
        (void)values; \
        (void)valueCount; \
        return count == 0 ? fmi3OK : refused(instance, "fmi3Get" #Type, "no such variable"); \
    } \
    fmi3Status fmi3Set##Type(fmi3Instance instance, const fmi3ValueReference references[], \
        size_t count, const kind values[], size_t valueCount) \
    { \
        (void)references; \
        (void)values; \
        (void)valueCount; \
        return count == 0 ? fmi3OK : refused(instance, "fmi3Set" #Type, "no such variable"); \
    }

NONE(Float32, fmi3Float32)
NONE(Int8, fmi3Int8)
NONE(UInt8, fmi3UInt8)
NONE(Int16, fmi3Int16)
NONE(UInt16, fmi3UInt16)
NONE(Int32, fmi3Int32)
NONE(UInt32, fmi3UInt32)
NONE(UInt64, fmi3UInt64)
NONE(String, fmi3String)

#if FMU_CAN

fmi3Status fmi3GetBinary(fmi3Instance instance, const fmi3ValueReference references[],
    size_t count, size_t sizes[], fmi3Binary values[], size_t valueCount)
{
    fmu_bus *bus = &((fmu_instance *)instance)->state.bus;

    for (size_t i = 0; i < count; i++) {
        if (count != valueCount || !is_known(references[i], FMU_BINARY)) {
            return refused(instance, "fmi3GetBinary", "no such variable");
        }
        if (references[i] == FMU_TX_DATA) {
            sizes[i] = (size_t)bus->to_send_count;
            values[i] = bus->to_send;
        } else {
            sizes[i] = (size_t)bus->received_count;
            values[i] = bus->received;
        }
    }
    return fmi3OK;
}

fmi3Status fmi3SetBinary(fmi3Instance instance, const fmi3ValueReference references[],
    size_t count, const size_t sizes[], const fmi3Binary values[], size_t valueCount)
{
    fmu_state *state = &((fmu_instance *)instance)->state;

    for (size_t i = 0; i < count; i++) {
        if (count != valueCount || references[i] != FMU_RX_DATA) {
            return refused(instance, "fmi3SetBinary", "no such variable that may be set");
        }
        if (!fmu_bus_set(state, values[i], sizes[i])) {
            return refused(instance, "fmi3SetBinary", "longer than its maxSize");
        }
    }
    return fmi3OK;
}

fmi3Status fmi3GetClock(fmi3Instance instance, const fmi3ValueReference references[], size_t count,
    fmi3Clock values[])
{
    fmu_state *state = &((fmu_instance *)instance)->state;

    for (size_t i = 0; i < count; i++) {
        if (references[i] == FMU_RX_CLOCK) {
            values[i] = state->bus.is_received != 0;
        } else if (references[i] == FMU_TX_CLOCK) {
            /* Active once for what there is to send. */
            values[i] = state->mode == FMU_EVENT && state->bus.to_send_count > 0
                && state->bus.is_told == 0;
            if (values[i]) {
                state->bus.is_told = 1;
            }
        } else {
            return refused(instance, "fmi3GetClock", "no such clock");
        }
    }
    return fmi3OK;
}

fmi3Status fmi3SetClock(fmi3Instance instance, const fmi3ValueReference references[], size_t count,
    const fmi3Clock values[])
{
    fmu_state *state = &((fmu_instance *)instance)->state;

    if (state->mode != FMU_EVENT) {
        return refused(instance, "fmi3SetClock", "not in Event Mode");
    }
    for (size_t i = 0; i < count; i++) {
        if (references[i] != FMU_RX_CLOCK) {
            return refused(instance, "fmi3SetClock", "no such clock that may be set");
        }
        state->bus.is_received = values[i] ? 1 : 0;
    }
    return fmi3OK;
}

#else

fmi3Status fmi3GetBinary(fmi3Instance instance, const fmi3ValueReference references[],
    size_t count, size_t sizes[], fmi3Binary values[], size_t valueCount)
{
    (void)references;
    (void)sizes;
    (void)values;
    (void)valueCount;
    return count == 0 ? fmi3OK : refused(instance, "fmi3GetBinary", "no such variable");
}

fmi3Status fmi3SetBinary(fmi3Instance instance, const fmi3ValueReference references[],
    size_t count, const size_t sizes[], const fmi3Binary values[], size_t valueCount)
{
    (void)references;
    (void)sizes;
    (void)values;
    (void)valueCount;
    return count == 0 ? fmi3OK : refused(instance, "fmi3SetBinary", "no such variable");
}

fmi3Status fmi3GetClock(fmi3Instance instance, const fmi3ValueReference references[], size_t count,
    fmi3Clock values[])
{
    (void)references;
    (void)values;
    return count == 0 ? fmi3OK : refused(instance, "fmi3GetClock", "no such clock");
}

fmi3Status fmi3SetClock(fmi3Instance instance, const fmi3ValueReference references[], size_t count,
    const fmi3Clock values[])
{
    (void)references;
    (void)values;
    return count == 0 ? fmi3OK : refused(instance, "fmi3SetClock", "no such clock");
}

#endif

fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance instance)
{
    (void)instance;
    return fmi3OK;
}

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance instance, fmi3Boolean *discreteStatesNeedUpdate,
    fmi3Boolean *terminateSimulation, fmi3Boolean *nominalsChanged, fmi3Boolean *valuesChanged,
    fmi3Boolean *nextEventTimeDefined, fmi3Float64 *nextEventTime)
{
    fmu_state *state = &((fmu_instance *)instance)->state;

    *discreteStatesNeedUpdate = false;
    *terminateSimulation = false;
    *nominalsChanged = false;
    *valuesChanged = false;
    *nextEventTimeDefined = false;
    *nextEventTime = 0.0;
    if (state->mode != FMU_EVENT) {
        return refused(instance, "fmi3UpdateDiscreteStates", "not in Event Mode");
    }
#if FMU_CAN
    fmu_bus_update(state);
    *discreteStatesNeedUpdate = state->bus.to_send_count > 0;
#endif
    return fmi3OK;
}

/* The state: one piece of memory without a pointer. */

fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *kept)
{
    if (*kept == NULL) {
        *kept = malloc(sizeof(fmu_state));
    }
    if (*kept == NULL) {
        return refused(instance, "fmi3GetFMUState", "no memory");
    }
    memcpy(*kept, &((fmu_instance *)instance)->state, sizeof(fmu_state));
    return fmi3OK;
}

fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState kept)
{
    if (kept == NULL) {
        return refused(instance, "fmi3SetFMUState", "expected a state");
    }
    memcpy(&((fmu_instance *)instance)->state, kept, sizeof(fmu_state));
    return fmi3OK;
}

fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *kept)
{
    (void)instance;
    free(*kept);
    *kept = NULL;
    return fmi3OK;
}

static fmu_head own_head(void)
{
    fmu_head head;

    memset(&head, 0, sizeof head);
    memcpy(head.magic, "ATO-FMU1", sizeof head.magic);
    memcpy(head.token, FMU_TOKEN, FMU_TOKEN_LENGTH);
    return head;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance instance, fmi3FMUState kept, size_t *size)
{
    (void)instance;
    (void)kept;
    *size = sizeof(fmu_head) + sizeof(fmu_state);
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(
    fmi3Instance instance, fmi3FMUState kept, fmi3Byte bytes[], size_t size)
{
    fmu_head head = own_head();

    if (kept == NULL || size < sizeof head + sizeof(fmu_state)) {
        return refused(instance, "fmi3SerializeFMUState", "expected a state and room for it");
    }
    memcpy(bytes, &head, sizeof head);
    memcpy(bytes + sizeof head, kept, sizeof(fmu_state));
    return fmi3OK;
}

fmi3Status fmi3DeserializeFMUState(
    fmi3Instance instance, const fmi3Byte bytes[], size_t size, fmi3FMUState *kept)
{
    fmu_head head = own_head();

    if (size != sizeof head + sizeof(fmu_state) || memcmp(bytes, &head, sizeof head) != 0) {
        return refused(instance, "fmi3DeserializeFMUState", "not a state of this FMU");
    }
    if (*kept == NULL) {
        *kept = malloc(sizeof(fmu_state));
    }
    if (*kept == NULL) {
        return refused(instance, "fmi3DeserializeFMUState", "no memory");
    }
    memcpy(*kept, bytes + sizeof head, sizeof(fmu_state));
    return fmi3OK;
}

/* What modelDescription.xml says that this FMU cannot do. */

#define CANNOT(name, parameters, unused) \
    fmi3Status name parameters \
    { \
        unused; \
        return refused(instance, #name, "not offered"); \
    }

CANNOT(fmi3GetNumberOfVariableDependencies,
    (fmi3Instance instance, fmi3ValueReference reference, size_t *count),
    (void)reference; (void)count)
CANNOT(fmi3GetVariableDependencies,
    (fmi3Instance instance, fmi3ValueReference dependent, size_t elements[],
        fmi3ValueReference independents[], size_t independentElements[],
        fmi3DependencyKind kinds[], size_t count),
    (void)dependent; (void)elements; (void)independents; (void)independentElements; (void)kinds;
    (void)count)
CANNOT(fmi3GetDirectionalDerivative,
    (fmi3Instance instance, const fmi3ValueReference unknowns[], size_t unknownCount,
        const fmi3ValueReference knowns[], size_t knownCount, const fmi3Float64 seed[],
        size_t seedCount, fmi3Float64 sensitivity[], size_t sensitivityCount),
    (void)unknowns; (void)unknownCount; (void)knowns; (void)knownCount; (void)seed;
    (void)seedCount; (void)sensitivity; (void)sensitivityCount)
CANNOT(fmi3GetAdjointDerivative,
    (fmi3Instance instance, const fmi3ValueReference unknowns[], size_t unknownCount,
        const fmi3ValueReference knowns[], size_t knownCount, const fmi3Float64 seed[],
        size_t seedCount, fmi3Float64 sensitivity[], size_t sensitivityCount),
    (void)unknowns; (void)unknownCount; (void)knowns; (void)knownCount; (void)seed;
    (void)seedCount; (void)sensitivity; (void)sensitivityCount)
CANNOT(fmi3EnterConfigurationMode, (fmi3Instance instance), (void)0)
CANNOT(fmi3ExitConfigurationMode, (fmi3Instance instance), (void)0)
CANNOT(fmi3GetIntervalDecimal,
    (fmi3Instance instance, const fmi3ValueReference references[], size_t count,
        fmi3Float64 intervals[], fmi3IntervalQualifier qualifiers[]),
    (void)references; (void)count; (void)intervals; (void)qualifiers)
CANNOT(fmi3GetIntervalFraction,
    (fmi3Instance instance, const fmi3ValueReference references[], size_t count,
        fmi3UInt64 counters[], fmi3UInt64 resolutions[], fmi3IntervalQualifier qualifiers[]),
    (void)references; (void)count; (void)counters; (void)resolutions; (void)qualifiers)
CANNOT(fmi3GetShiftDecimal,
    (fmi3Instance instance, const fmi3ValueReference references[], size_t count,
        fmi3Float64 shifts[]),
    (void)references; (void)count; (void)shifts)
CANNOT(fmi3GetShiftFraction,
    (fmi3Instance instance, const fmi3ValueReference references[], size_t count,
        fmi3UInt64 counters[], fmi3UInt64 resolutions[]),
    (void)references; (void)count; (void)counters; (void)resolutions)
CANNOT(fmi3SetIntervalDecimal,
    (fmi3Instance instance, const fmi3ValueReference references[], size_t count,
        const fmi3Float64 intervals[]),
    (void)references; (void)count; (void)intervals)
CANNOT(fmi3SetIntervalFraction,
    (fmi3Instance instance, const fmi3ValueReference references[], size_t count,
        const fmi3UInt64 counters[], const fmi3UInt64 resolutions[]),
    (void)references; (void)count; (void)counters; (void)resolutions)
CANNOT(fmi3SetShiftDecimal,
    (fmi3Instance instance, const fmi3ValueReference references[], size_t count,
        const fmi3Float64 shifts[]),
    (void)references; (void)count; (void)shifts)
CANNOT(fmi3SetShiftFraction,
    (fmi3Instance instance, const fmi3ValueReference references[], size_t count,
        const fmi3UInt64 counters[], const fmi3UInt64 resolutions[]),
    (void)references; (void)count; (void)counters; (void)resolutions)
CANNOT(fmi3EnterContinuousTimeMode, (fmi3Instance instance), (void)0)
CANNOT(fmi3CompletedIntegratorStep,
    (fmi3Instance instance, fmi3Boolean noSetFMUStatePriorToCurrentPoint,
        fmi3Boolean *enterEventMode, fmi3Boolean *terminateSimulation),
    (void)noSetFMUStatePriorToCurrentPoint; (void)enterEventMode; (void)terminateSimulation)
CANNOT(fmi3SetTime, (fmi3Instance instance, fmi3Float64 time), (void)time)
CANNOT(fmi3SetContinuousStates,
    (fmi3Instance instance, const fmi3Float64 states[], size_t count), (void)states; (void)count)
CANNOT(fmi3GetContinuousStateDerivatives,
    (fmi3Instance instance, fmi3Float64 derivatives[], size_t count), (void)derivatives; (void)count)
CANNOT(fmi3GetEventIndicators,
    (fmi3Instance instance, fmi3Float64 indicators[], size_t count), (void)indicators; (void)count)
CANNOT(fmi3GetContinuousStates,
    (fmi3Instance instance, fmi3Float64 states[], size_t count), (void)states; (void)count)
CANNOT(fmi3GetNominalsOfContinuousStates,
    (fmi3Instance instance, fmi3Float64 nominals[], size_t count), (void)nominals; (void)count)
CANNOT(fmi3GetNumberOfEventIndicators, (fmi3Instance instance, size_t *count), (void)count)
CANNOT(fmi3GetNumberOfContinuousStates, (fmi3Instance instance, size_t *count), (void)count)
CANNOT(fmi3GetOutputDerivatives,
    (fmi3Instance instance, const fmi3ValueReference references[], size_t count,
        const fmi3Int32 orders[], fmi3Float64 values[], size_t valueCount),
    (void)references; (void)count; (void)orders; (void)values; (void)valueCount)
CANNOT(fmi3ActivateModelPartition,
    (fmi3Instance instance, fmi3ValueReference clock, fmi3Float64 activationTime), (void)clock;
    (void)activationTime)
