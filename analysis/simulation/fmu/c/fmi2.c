/* Functional Mock-up Interface 2.0 for co-simulation (fmi-standard.org) around bench_model.c. */
#include <stdlib.h>

#include "bench_model.c"
#include "variables.h"

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

typedef void *fmi2Component;
typedef unsigned fmi2ValueReference;
typedef int fmi2Status;
enum { fmi2OK, fmi2Warning, fmi2Discard, fmi2Error, fmi2Fatal, fmi2Pending };
typedef void (*fmi2Logger)(void *, const char *, fmi2Status, const char *, const char *, ...);
typedef struct {
    fmi2Logger logger;
    void *(*allocate)(size_t, size_t);
    void (*release)(void *);
    void *finished;
    void *environment;
} fmi2Callbacks;

struct instance {
    struct bench bench;
    const fmi2Callbacks *callbacks;
    char name[200];
    int initialised;
};

static fmi2Status fail(struct instance *s, const char *text)
{
    if (s->callbacks && s->callbacks->logger)
        s->callbacks->logger(s->callbacks->environment, s->name, fmi2Error, "logStatusError", "%s",
                             text);
    return fmi2Error;
}

EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
EXPORT const char *fmi2GetVersion(void) { return "2.0"; }

EXPORT fmi2Component fmi2Instantiate(const char *name, int type, const char *guid,
                                     const char *resources, const fmi2Callbacks *callbacks,
                                     int visible, int logging)
{
    struct instance *s;
    (void)resources, (void)visible, (void)logging;
    if (type != 1 || !guid || strcmp(guid, TOKEN) != 0)
        return 0;
    s = calloc(1, sizeof *s);
    if (!s)
        return 0;
    s->callbacks = callbacks;
    strncpy(s->name, name ? name : "", sizeof s->name - 1);
    set_defaults(&s->bench);
    return s;
}

EXPORT void fmi2FreeInstance(fmi2Component c) { free(c); }

EXPORT fmi2Status fmi2SetDebugLogging(fmi2Component c, int on, size_t n, const char *const *names)
{
    (void)c, (void)on, (void)n, (void)names;
    return fmi2OK;
}

EXPORT fmi2Status fmi2SetupExperiment(fmi2Component c, int tolerance_given, double tolerance,
                                      double start, int stop_given, double stop)
{
    (void)tolerance_given, (void)tolerance, (void)stop_given, (void)stop;
    begin(&((struct instance *)c)->bench, start);
    return fmi2OK;
}

EXPORT fmi2Status fmi2EnterInitializationMode(fmi2Component c)
{
    (void)c;
    return fmi2OK;
}

EXPORT fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
    ((struct instance *)c)->initialised = 1;
    return fmi2OK;
}

EXPORT fmi2Status fmi2Terminate(fmi2Component c)
{
    (void)c;
    return fmi2OK;
}

EXPORT fmi2Status fmi2Reset(fmi2Component c)
{
    struct instance *s = c;
    set_defaults(&s->bench);
    s->initialised = 0;
    return fmi2OK;
}

EXPORT fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference *vr, size_t n, double *value)
{
    struct instance *s = c;
    for (size_t k = 0; k < n; k++)
        if (!get_number(&s->bench, vr[k], &value[k]))
            return fail(s, "no real variable has this value reference");
    return fmi2OK;
}

EXPORT fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference *vr, size_t n,
                              const double *value)
{
    struct instance *s = c;
    for (size_t k = 0; k < n; k++)
        if (!set_number(&s->bench, vr[k], value[k], !s->initialised))
            return fail(s, "this real variable cannot be set now");
    return fmi2OK;
}

EXPORT fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference *vr, size_t n, int *value)
{
    struct instance *s = c;
    for (size_t k = 0; k < n; k++) {
        const int *found = switch_value(&s->bench, vr[k]);
        if (!found)
            return fail(s, "no boolean variable has this value reference");
        value[k] = *found;
    }
    return fmi2OK;
}

EXPORT fmi2Status fmi2SetBoolean(fmi2Component c, const fmi2ValueReference *vr, size_t n,
                                 const int *value)
{
    struct instance *s = c;
    for (size_t k = 0; k < n; k++) {
        int *found = switch_value(&s->bench, vr[k]);
        if (!found || s->initialised)
            return fail(s, "this boolean variable cannot be set now");
        *found = value[k] != 0;
        begin(&s->bench, s->bench.time);
    }
    return fmi2OK;
}

EXPORT fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference *vr,
                                              size_t n, const int *order, const double *value)
{
    struct instance *s = c;
    for (size_t k = 0; k < n; k++) {
        if (vr[k] >= INPUTS || order[k] != 1)
            return fail(s, "only first derivatives of inputs can be set");
        s->bench.slope[vr[k]] = value[k];
    }
    return fmi2OK;
}

EXPORT fmi2Status fmi2DoStep(fmi2Component c, double time, double length, int no_set_state)
{
    struct instance *s = c;
    int status = communicate(&s->bench, time, length);
    (void)no_set_state;
    return status == OK ? fmi2OK : fail(s, REASONS[status]);
}

EXPORT fmi2Status fmi2GetFMUstate(fmi2Component c, void **state)
{
    struct instance *s = c;
    return copy_state(state, &s->bench) ? fmi2OK : fail(s, "no memory for the state");
}

EXPORT fmi2Status fmi2SetFMUstate(fmi2Component c, void *state)
{
    memcpy(&((struct instance *)c)->bench, state, sizeof(struct bench));
    return fmi2OK;
}

EXPORT fmi2Status fmi2FreeFMUstate(fmi2Component c, void **state)
{
    (void)c;
    free(*state);
    *state = 0;
    return fmi2OK;
}

EXPORT fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, void *state, size_t *size)
{
    (void)c, (void)state;
    *size = sizeof(struct bench);
    return fmi2OK;
}

EXPORT fmi2Status fmi2SerializeFMUstate(fmi2Component c, void *state, char *bytes, size_t size)
{
    if (size < sizeof(struct bench))
        return fail(c, "too few bytes for the state");
    memcpy(bytes, state, sizeof(struct bench));
    return fmi2OK;
}

EXPORT fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const char *bytes, size_t size,
                                          void **state)
{
    if (size < sizeof(struct bench))
        return fail(c, "too few bytes for a state");
    return copy_state(state, bytes) ? fmi2OK : fail(c, "no memory for the state");
}

/* What the model does not have: variables of other types, derivatives, asynchronous steps. */
#define REFUSED(name, ...)                                   \
    EXPORT fmi2Status name(fmi2Component c, __VA_ARGS__)     \
    {                                                        \
        return fail(c, #name " is not supported");           \
    }
#define EMPTY(name, type)                                                                      \
    EXPORT fmi2Status name(fmi2Component c, const fmi2ValueReference *vr, size_t n, type value) \
    {                                                                                          \
        (void)vr, (void)value;                                                                 \
        return n ? fail(c, #name ": no variable has this value reference") : fmi2OK;           \
    }
EMPTY(fmi2GetInteger, int *)
EMPTY(fmi2SetInteger, const int *)
EMPTY(fmi2GetString, const char **)
EMPTY(fmi2SetString, const char *const *)
REFUSED(fmi2GetDirectionalDerivative, const fmi2ValueReference *u, size_t nu,
        const fmi2ValueReference *k, size_t nk, const double *du, double *dk)
REFUSED(fmi2GetRealOutputDerivatives, const fmi2ValueReference *vr, size_t n, const int *order,
        double *value)
REFUSED(fmi2GetStatus, int kind, fmi2Status *value)
REFUSED(fmi2GetRealStatus, int kind, double *value)
REFUSED(fmi2GetIntegerStatus, int kind, int *value)
REFUSED(fmi2GetBooleanStatus, int kind, int *value)
REFUSED(fmi2GetStringStatus, int kind, const char **value)
EXPORT fmi2Status fmi2CancelStep(fmi2Component c) { return fail(c, "no step is under way"); }
