/* Functional Mock-up Interface 3.0 for co-simulation (fmi-standard.org) around bench_model.c. */
#include <stdbool.h>
#include <stdint.h>
#include <stdlib.h>

#include "bench_model.c"
#include "variables.h"

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

typedef void *fmi3Instance;
typedef uint32_t fmi3ValueReference;
typedef int fmi3Status;
enum { fmi3OK, fmi3Warning, fmi3Discard, fmi3Error, fmi3Fatal };
typedef void (*fmi3Logger)(void *, fmi3Status, const char *, const char *);

struct instance {
    struct bench bench;
    fmi3Logger logger;
    void *environment;
    int initialised;
};

static fmi3Status fail(struct instance *s, const char *text)
{
    if (s->logger)
        s->logger(s->environment, fmi3Error, "logStatusError", text);
    return fmi3Error;
}

EXPORT const char *fmi3GetVersion(void) { return "3.0"; }

EXPORT fmi3Status fmi3SetDebugLogging(fmi3Instance c, bool on, size_t n, const char *const *names)
{
    (void)c, (void)on, (void)n, (void)names;
    return fmi3OK;
}

EXPORT fmi3Instance fmi3InstantiateCoSimulation(
    const char *name, const char *token, const char *resources, bool visible, bool logging,
    bool events, bool early_return, const fmi3ValueReference *intermediate, size_t intermediates,
    void *environment, fmi3Logger logger, void *intermediate_update)
{
    struct instance *s;
    (void)name, (void)resources, (void)visible, (void)logging, (void)early_return;
    (void)intermediate, (void)intermediate_update;
    if (!token || strcmp(token, TOKEN) != 0 || events || intermediates)
        return 0;
    s = calloc(1, sizeof *s);
    if (!s)
        return 0;
    s->logger = logger;
    s->environment = environment;
    set_defaults(&s->bench);
    return s;
}

EXPORT fmi3Instance fmi3InstantiateModelExchange(void) { return 0; }
EXPORT fmi3Instance fmi3InstantiateScheduledExecution(void) { return 0; }
EXPORT void fmi3FreeInstance(fmi3Instance c) { free(c); }

EXPORT fmi3Status fmi3EnterInitializationMode(fmi3Instance c, bool tolerance_given,
                                              double tolerance, double start, bool stop_given,
                                              double stop)
{
    (void)tolerance_given, (void)tolerance, (void)stop_given, (void)stop;
    begin(&((struct instance *)c)->bench, start);
    return fmi3OK;
}

EXPORT fmi3Status fmi3ExitInitializationMode(fmi3Instance c)
{
    ((struct instance *)c)->initialised = 1;
    return fmi3OK;
}

EXPORT fmi3Status fmi3Terminate(fmi3Instance c)
{
    (void)c;
    return fmi3OK;
}

EXPORT fmi3Status fmi3Reset(fmi3Instance c)
{
    struct instance *s = c;
    set_defaults(&s->bench);
    s->initialised = 0;
    return fmi3OK;
}

EXPORT fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference *vr, size_t n,
                                 double *value, size_t values)
{
    struct instance *s = c;
    (void)values;
    for (size_t k = 0; k < n; k++)
        if (!get_number(&s->bench, vr[k], &value[k]))
            return fail(s, "no Float64 variable has this value reference");
    return fmi3OK;
}

EXPORT fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference *vr, size_t n,
                                 const double *value, size_t values)
{
    struct instance *s = c;
    (void)values;
    for (size_t k = 0; k < n; k++)
        if (!set_number(&s->bench, vr[k], value[k], !s->initialised))
            return fail(s, "this Float64 variable cannot be set now");
    return fmi3OK;
}

EXPORT fmi3Status fmi3GetBoolean(fmi3Instance c, const fmi3ValueReference *vr, size_t n,
                                 bool *value, size_t values)
{
    struct instance *s = c;
    (void)values;
    for (size_t k = 0; k < n; k++) {
        const int *found = switch_value(&s->bench, vr[k]);
        if (!found)
            return fail(s, "no Boolean variable has this value reference");
        value[k] = *found != 0;
    }
    return fmi3OK;
}

EXPORT fmi3Status fmi3SetBoolean(fmi3Instance c, const fmi3ValueReference *vr, size_t n,
                                 const bool *value, size_t values)
{
    struct instance *s = c;
    (void)values;
    for (size_t k = 0; k < n; k++) {
        int *found = switch_value(&s->bench, vr[k]);
        if (!found || s->initialised)
            return fail(s, "this Boolean variable cannot be set now");
        *found = value[k];
        begin(&s->bench, s->bench.time);
    }
    return fmi3OK;
}

EXPORT fmi3Status fmi3DoStep(fmi3Instance c, double time, double length, bool no_set_state,
                             bool *event, bool *terminate, bool *early, double *reached)
{
    struct instance *s = c;
    int status = communicate(&s->bench, time, length);
    (void)no_set_state;
    *event = *terminate = *early = false;
    *reached = s->bench.time;
    return status == OK ? fmi3OK : fail(s, REASONS[status]);
}

EXPORT fmi3Status fmi3GetFMUState(fmi3Instance c, void **state)
{
    struct instance *s = c;
    return copy_state(state, &s->bench) ? fmi3OK : fail(s, "no memory for the state");
}

EXPORT fmi3Status fmi3SetFMUState(fmi3Instance c, void *state)
{
    memcpy(&((struct instance *)c)->bench, state, sizeof(struct bench));
    return fmi3OK;
}

EXPORT fmi3Status fmi3FreeFMUState(fmi3Instance c, void **state)
{
    (void)c;
    free(*state);
    *state = 0;
    return fmi3OK;
}

EXPORT fmi3Status fmi3SerializedFMUStateSize(fmi3Instance c, void *state, size_t *size)
{
    (void)c, (void)state;
    *size = sizeof(struct bench);
    return fmi3OK;
}

EXPORT fmi3Status fmi3SerializeFMUState(fmi3Instance c, void *state, uint8_t *bytes, size_t size)
{
    if (size < sizeof(struct bench))
        return fail(c, "too few bytes for the state");
    memcpy(bytes, state, sizeof(struct bench));
    return fmi3OK;
}

EXPORT fmi3Status fmi3DeserializeFMUState(fmi3Instance c, const uint8_t *bytes, size_t size,
                                          void **state)
{
    if (size < sizeof(struct bench))
        return fail(c, "too few bytes for a state");
    return copy_state(state, bytes) ? fmi3OK : fail(c, "no memory for the state");
}

/* What the standard asks every unit to export and the model does not have. */
#define REFUSED(name) \
    EXPORT fmi3Status name(fmi3Instance c) { return fail(c, #name " is not supported"); }
#define BOTH(type) REFUSED(fmi3Get##type) REFUSED(fmi3Set##type)
BOTH(Float32) BOTH(Int8) BOTH(UInt8) BOTH(Int16) BOTH(UInt16) BOTH(Int32) BOTH(UInt32)
BOTH(Int64) BOTH(UInt64) BOTH(String) BOTH(Binary) BOTH(Clock)
BOTH(IntervalDecimal) BOTH(IntervalFraction) BOTH(ShiftDecimal) BOTH(ShiftFraction)
REFUSED(fmi3GetNumberOfVariableDependencies)
REFUSED(fmi3GetVariableDependencies)
REFUSED(fmi3GetDirectionalDerivative)
REFUSED(fmi3GetAdjointDerivative)
REFUSED(fmi3EnterConfigurationMode)
REFUSED(fmi3ExitConfigurationMode)
REFUSED(fmi3EvaluateDiscreteStates)
REFUSED(fmi3UpdateDiscreteStates)
REFUSED(fmi3EnterContinuousTimeMode)
REFUSED(fmi3EnterEventMode)
REFUSED(fmi3CompletedIntegratorStep)
REFUSED(fmi3SetTime)
REFUSED(fmi3SetContinuousStates)
REFUSED(fmi3GetContinuousStateDerivatives)
REFUSED(fmi3GetEventIndicators)
REFUSED(fmi3GetContinuousStates)
REFUSED(fmi3GetNominalsOfContinuousStates)
REFUSED(fmi3GetNumberOfEventIndicators)
REFUSED(fmi3GetNumberOfContinuousStates)
REFUSED(fmi3EnterStepMode)
REFUSED(fmi3GetOutputDerivatives)
REFUSED(fmi3ActivateModelPartition)
