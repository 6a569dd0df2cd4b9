/* A small train as an FMU, FMI 2.0 Co-Simulation: one mass, resistance a + b v + c v^2, no rolling
 * back. Variables: 0 force in N; 1 position in m, 2 speed in m/s, 3 acceleration in m/s^2; 4 mass in
 * kg. It stands without any header of the standard: what it needs of it is declared here. */
#include <stdlib.h>
#include <string.h>

typedef void *fmi2Component;
typedef unsigned int fmi2ValueReference;
typedef double fmi2Real;
typedef int fmi2Integer;
typedef int fmi2Boolean;
typedef const char *fmi2String;
typedef enum { fmi2OK, fmi2Warning, fmi2Discard, fmi2Error, fmi2Fatal, fmi2Pending } fmi2Status;

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

enum { FORCE, POSITION, SPEED, ACCELERATION, MASS, VALUES };

static const double A = 0.01, B = 2e-4, C = 2e-5; /* m/s^2, 1/s, 1/m */

EXPORT fmi2Component fmi2Instantiate(fmi2String name, int kind, fmi2String guid,
    fmi2String resources, const void *callbacks, fmi2Boolean visible, fmi2Boolean logging)
{
    double *value = strcmp(guid, "{train-of-examples}") == 0 ? calloc(VALUES, sizeof(double)) : NULL;

    (void)name, (void)kind, (void)resources, (void)callbacks, (void)visible, (void)logging;
    if (value != NULL) {
        value[MASS] = 200e3;
    }
    return value;
}

EXPORT fmi2Status fmi2DoStep(fmi2Component train, fmi2Real time, fmi2Real step, fmi2Boolean last)
{
    double *value = train;
    double before = value[SPEED];
    double resistance = A + before * (B + C * before);
    double after = before + step * (value[FORCE] / value[MASS] - resistance);

    (void)time, (void)last;
    value[SPEED] = after > 0.0 ? after : 0.0;
    value[POSITION] += 0.5 * step * (before + value[SPEED]);
    value[ACCELERATION] = (value[SPEED] - before) / step;
    return fmi2OK;
}

EXPORT fmi2Status fmi2SetReal(
    fmi2Component train, const fmi2ValueReference where[], size_t count, const fmi2Real values[])
{
    for (size_t i = 0; i < count; i++) {
        if (where[i] != FORCE && where[i] != MASS) {
            return fmi2Error;
        }
        ((double *)train)[where[i]] = values[i];
    }
    return fmi2OK;
}

EXPORT fmi2Status fmi2GetReal(
    fmi2Component train, const fmi2ValueReference where[], size_t count, fmi2Real values[])
{
    for (size_t i = 0; i < count; i++) {
        if (where[i] >= VALUES) {
            return fmi2Error;
        }
        values[i] = ((const double *)train)[where[i]];
    }
    return fmi2OK;
}

EXPORT void fmi2FreeInstance(fmi2Component train) { free(train); }
EXPORT fmi2Status fmi2SetupExperiment(fmi2Component train, fmi2Boolean has_tolerance,
    fmi2Real tolerance, fmi2Real start, fmi2Boolean has_stop, fmi2Real stop)
{
    (void)train, (void)has_tolerance, (void)tolerance, (void)start, (void)has_stop, (void)stop;
    return fmi2OK;
}
EXPORT fmi2Status fmi2EnterInitializationMode(fmi2Component train)
{
    (void)train;
    return fmi2OK;
}
EXPORT fmi2Status fmi2ExitInitializationMode(fmi2Component train)
{
    (void)train;
    return fmi2OK;
}
EXPORT fmi2Status fmi2Terminate(fmi2Component train)
{
    (void)train;
    return fmi2OK;
}
EXPORT const char *fmi2GetVersion(void) { return "2.0"; }
EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }

/* What else an importer looks up, and this train does not offer. */
#define NONE(name) \
    EXPORT fmi2Status name(void) { return fmi2Error; }
NONE(fmi2SetDebugLogging)
NONE(fmi2Reset)
NONE(fmi2GetInteger)
NONE(fmi2GetBoolean)
NONE(fmi2GetString)
NONE(fmi2SetInteger)
NONE(fmi2SetBoolean)
NONE(fmi2SetString)
NONE(fmi2GetFMUstate)
NONE(fmi2SetFMUstate)
NONE(fmi2FreeFMUstate)
NONE(fmi2SerializedFMUstateSize)
NONE(fmi2SerializeFMUstate)
NONE(fmi2DeSerializeFMUstate)
NONE(fmi2GetDirectionalDerivative)
NONE(fmi2SetRealInputDerivatives)
NONE(fmi2GetRealOutputDerivatives)
NONE(fmi2CancelStep)
NONE(fmi2GetStatus)
NONE(fmi2GetRealStatus)
NONE(fmi2GetIntegerStatus)
NONE(fmi2GetBooleanStatus)
NONE(fmi2GetStringStatus)
