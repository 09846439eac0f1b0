/* The identified model in C: derivative of the state and an integrator with step size control.
 *
 * State y = [q (N), dq/dt (N), p_cap (N), p_rod (N), hidden]; M q'' = torques, and in each chamber
 * (V/b) dp/dt = flow in - A ds/dt (cap), + A ds/dt (rod). A locked joint stands still. Integrator:
 * Dormand and Prince's embedded pair 5(4) (Hairer, Norsett and Wanner, Solving Ordinary
 * Differential Equations I, table II.5.2). model.h is generated: sizes, constants, terms.
 */
#include <math.h>
#include <string.h>

#include "model.h"

#define STATES (4 * N + HIDDEN)
#define MIN_STEP 1e-7 /* [s] */

enum status { OK, LEFT_STROKE, NOT_FINITE, STEP_TOO_SMALL, BAD_INERTIA };

static const char *const REASONS[] = {
    "", "a piston went half a stroke past its end", "the state diverged",
    "the step needed fell below 0.1 us (the state diverged)",
    "the inertia matrix is not positive definite"};

/* One simulated bench: inputs (p_s, temperature, u) at `input_time` with their slopes. */
struct bench {
    double time, step;
    double y[STATES];
    double input_time, input[INPUTS], slope[INPUTS];
    double piston_start[N], speed_start[N], cap_start[N], rod_start[N];
    double last_time, last_input[INPUTS];
    long steps;
    int locked[N], extrapolate;
    int failure;
};

static double joint_angle(int i, double piston)
{
    const double *g = GEOMETRY[i];
    double a = g[PIN_A], c = g[PIN_C], length = piston + g[MID];
    if (g[GAIN] != 0.0)
        return piston;
    return acos((a * a + c * c - length * length) / (2.0 * a * c)) - g[OFFSET];
}

/* Lever arm ds/dq [m/rad] and piston position [m] at the angle q of a hydraulic joint. */
static double lever(int i, double q, double *piston)
{
    const double *g = GEOMETRY[i];
    double a = g[PIN_A], c = g[PIN_C], beta = q + g[OFFSET];
    double length = sqrt(a * a + c * c - 2.0 * a * c * cos(beta));
    if (g[GAIN] != 0.0) {
        *piston = q;
        return 1.0;
    }
    *piston = length - g[MID];
    return a * c * sin(beta) / length;
}

static int observe(const struct bench *b, double t, const double *y, double *common, double *x)
{
    double past = t - b->input_time, angle = 0.0;
    int inside = 1;
    common[TIME] = t;
    common[P_S] = b->input[0] + past * b->slope[0];
    common[P_TANK] = 0.0;
    common[TEMPERATURE] = b->input[1] + past * b->slope[1];
    for (int i = 0; i < N; i++) {
        const double *g = GEOMETRY[i];
        double half = 0.5 * g[STROKE];
        x[U * N + i] = b->input[2 + i] + past * b->slope[2 + i];
        x[Q * N + i] = y[i];
        x[QD * N + i] = y[N + i];
        angle += y[i];
        if (g[GAIN] != 0.0)
            angle += g[OFFSET];
        x[THETA * N + i] = angle;
        x[G * N + i] = lever(i, y[i], &x[S * N + i]);
        x[SD * N + i] = x[G * N + i] * y[N + i];
        if (g[GAIN] != 0.0) {
            x[P_CAP * N + i] = x[P_ROD * N + i] = x[V_CAP * N + i] = x[V_ROD * N + i] = 0.0;
            continue;
        }
        x[P_CAP * N + i] = y[2 * N + i];
        x[P_ROD * N + i] = y[3 * N + i];
        x[V_CAP * N + i] = g[DEAD_CAP] + (half + x[S * N + i]) * g[AREA_CAP];
        x[V_ROD * N + i] = g[DEAD_ROD] + (half - x[S * N + i]) * g[AREA_ROD];
        if (!(fabs(x[S * N + i]) < 2.0 * half) || x[V_CAP * N + i] <= 0.0
            || x[V_ROD * N + i] <= 0.0)
            inside = 0;
    }
    return inside;
}

/* Solve M qdd = load by Cholesky, M becoming its factor; 0 where M is not positive definite. */
static int accelerate(double *M, const double *load, double *qdd)
{
    for (int i = 0; i < N; i++)
        for (int j = 0; j <= i; j++) {
            double total = M[i * N + j];
            for (int k = 0; k < j; k++)
                total -= M[i * N + k] * M[j * N + k];
            if (i > j)
                M[i * N + j] = total / M[j * N + j];
            else if (total > 0.0)
                M[i * N + i] = sqrt(total);
            else
                return 0;
        }
    for (int i = 0; i < N; i++) {
        double total = load[i];
        for (int k = 0; k < i; k++)
            total -= M[i * N + k] * qdd[k];
        qdd[i] = total / M[i * N + i];
    }
    for (int i = N - 1; i >= 0; i--) {
        double total = qdd[i];
        for (int k = i + 1; k < N; k++)
            total -= M[k * N + i] * qdd[k];
        qdd[i] = total / M[i * N + i];
    }
    return 1;
}

static int rates(const struct bench *b, double t, double *y, double *dy)
{
    double common[4], x[X_ROWS * N], out[OUT_ROWS * N], M[N * N], qdd[N];
    if (!observe(b, t, y, common, x))
        return LEFT_STROKE;
    memset(out, 0, sizeof out);
    memset(M, 0, sizeof M);
    memset(dy, 0, STATES * sizeof *dy);
    for (int phase = PREPARE; phase <= CONTRIBUTE; phase++)
        contribute(phase, common, x, y + 4 * N, out, M, dy + 4 * N);
    for (int i = 0; i < N; i++) {
        const double *g = GEOMETRY[i];
        if (g[GAIN] != 0.0)
            out[TORQUE * N + i] += g[GAIN] * x[U * N + i];
        else
            out[TORQUE * N + i] += x[G * N + i]
                                   * (g[AREA_CAP] * x[P_CAP * N + i] - g[AREA_ROD] * x[P_ROD * N + i]);
    }
    for (int i = 0; i < N; i++)
        if (b->locked[i]) {
            for (int j = 0; j < N; j++)
                M[i * N + j] = M[j * N + i] = 0.0;
            M[i * N + i] = 1.0;
            out[TORQUE * N + i] = 0.0;
        }
    if (!accelerate(M, out + TORQUE * N, qdd))
        return BAD_INERTIA;
    for (int i = 0; i < N; i++) {
        const double *g = GEOMETRY[i];
        if (b->locked[i])
            continue;
        dy[i] = y[N + i];
        dy[N + i] = qdd[i];
        if (g[GAIN] != 0.0)
            continue;
        dy[2 * N + i]
            = (out[FLOW_CAP * N + i] - g[AREA_CAP] * x[SD * N + i]) / out[COMP_CAP * N + i];
        dy[3 * N + i]
            = (out[FLOW_ROD * N + i] + g[AREA_ROD] * x[SD * N + i]) / out[COMP_ROD * N + i];
    }
    return OK;
}

static double tolerance(int j)
{
    if (j < N)
        return ATOL_ANGLE;
    if (j < 2 * N)
        return ATOL_RATE;
    return j < 4 * N ? ATOL_PRESSURE : ATOL_HIDDEN;
}

static const double A[6][6] = {
    {1.0 / 5},
    {3.0 / 40, 9.0 / 40},
    {44.0 / 45, -56.0 / 15, 32.0 / 9},
    {19372.0 / 6561, -25360.0 / 2187, 64448.0 / 6561, -212.0 / 729},
    {9017.0 / 3168, -355.0 / 33, 46732.0 / 5247, 49.0 / 176, -5103.0 / 18656},
    {35.0 / 384, 0.0, 500.0 / 1113, 125.0 / 192, -2187.0 / 6784, 11.0 / 84}};
static const double C[6] = {1.0 / 5, 3.0 / 10, 4.0 / 5, 8.0 / 9, 1.0, 1.0};
static const double E[7] = {71.0 / 57600, 0.0, -71.0 / 16695, 71.0 / 1920,
                            -17253.0 / 339200, 22.0 / 525, -1.0 / 40};

/* Set the state to the start values, at rest for the hidden states. */
static void begin(struct bench *b, double time)
{
    memset(b->y, 0, sizeof b->y);
    for (int i = 0; i < N; i++) {
        double piston;
        b->y[i] = joint_angle(i, b->piston_start[i]);
        b->y[N + i] = b->locked[i] ? 0.0 : b->speed_start[i] / lever(i, b->y[i], &piston);
        b->y[2 * N + i] = b->cap_start[i];
        b->y[3 * N + i] = b->rod_start[i];
    }
    b->time = b->input_time = time;
    b->step = FIRST_STEP;
    b->failure = OK;
    b->steps = 0;
}

/* Integrate to `end`; return OK or why there is no state any more. */
static int advance(struct bench *b, double end)
{
    double k[7][STATES], trial[STATES];
    int after_failure = 0;
    int status = b->failure == OK ? rates(b, b->time, b->y, k[0]) : b->failure;
    while (status == OK && b->time < end - 1e-12) {
        double rest = end - b->time, h = fmax(fmin(b->step, rest), fmin(MIN_STEP, rest));
        double error = 0.0;
        for (int stage = 0; stage < 6 && status == OK; stage++) {
            for (int j = 0; j < STATES; j++) {
                double total = 0.0;
                for (int m = 0; m <= stage; m++)
                    total += A[stage][m] * k[m][j];
                trial[j] = b->y[j] + h * total;
            }
            status = rates(b, b->time + C[stage] * h, trial, k[stage + 1]);
        }
        for (int j = 0; j < STATES && status == OK; j++) {
            double e = 0.0;
            for (int m = 0; m < 7; m++)
                e += E[m] * k[m][j];
            e *= h / (tolerance(j) + RTOL * fmax(fabs(b->y[j]), fabs(trial[j])));
            error += e * e;
        }
        error = status == OK ? sqrt(error / STATES) : HUGE_VAL;
        if (!(error <= 1.0)) {
            if (h <= MIN_STEP) {
                if (status == OK)
                    status = error < HUGE_VAL ? STEP_TOO_SMALL : NOT_FINITE;
                break;
            }
            b->step = h * (error < 1e6 ? fmax(0.2, 0.9 * pow(error, -0.2)) : 0.2);
            after_failure = 1;
            status = OK;
            continue;
        }
        b->time += h;
        memcpy(b->y, trial, sizeof trial);
        memcpy(k[0], k[6], sizeof k[0]);
        /* A step cut short by `end` says nothing about the next one being too long. */
        double grown = h * fmin(0.9 * pow(fmax(error, 1e-8), -0.2), after_failure ? 1.0 : 5.0);
        b->step = h < rest ? grown : fmax(grown, b->step);
        after_failure = 0;
    }
    b->failure = status;
    return status;
}


/* Return output k: piston [m], its speed [m/s], cap and rod pressure [Pa] of joint after joint. */
static double output(const struct bench *b, int k)
{
    int i = k / OUTPUTS_PER_JOINT;
    double piston, arm = lever(i, b->y[i], &piston);
    switch (k % OUTPUTS_PER_JOINT) {
    case 0:
        return piston;
    case 1:
        return arm * b->y[N + i];
    case 2:
        return b->y[2 * N + i];
    default:
        return b->y[3 * N + i];
    }
}
