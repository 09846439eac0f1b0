/* Value references shared by both versions of the interface, and access by them. */
enum { INPUT_VR = 0, OUTPUT_VR = 1000, START_VR = 2000, CONSTANT_VR = 3000, LOCKED_VR = 4000,
       EXTRAPOLATE_VR = 4100, TIME_VR = 9999 };

static double *start_value(struct bench *b, unsigned vr)
{
    unsigned k = vr - START_VR;
    double *const tables[] = {b->piston_start, b->speed_start, b->cap_start, b->rod_start};
    return vr >= START_VR && k < 4 * N ? &tables[k % 4][k / 4] : 0;
}

/* Read a number; 0 where no variable has this reference. */
static int get_number(struct bench *b, unsigned vr, double *value)
{
    double *start = start_value(b, vr);
    if (vr < INPUTS)
        *value = b->input[vr];
    else if (vr >= OUTPUT_VR && vr < OUTPUT_VR + N * OUTPUTS_PER_JOINT)
        *value = output(b, (int)(vr - OUTPUT_VR));
    else if (vr >= CONSTANT_VR && vr < CONSTANT_VR + CONSTANTS)
        *value = CONSTANT[vr - CONSTANT_VR];
    else if (vr == TIME_VR)
        *value = b->time;
    else if (start)
        *value = *start;
    else
        return 0;
    return 1;
}

/* Write a number; 0 where no variable with this reference can be written now. */
static int set_number(struct bench *b, unsigned vr, double value, int before_start)
{
    double *start = start_value(b, vr);
    if (vr < INPUTS) {
        b->input[vr] = value;
        return 1;
    }
    if (start && before_start) {
        *start = value;
        begin(b, b->time);
        return 1;
    }
    return 0;
}

static void set_defaults(struct bench *b)
{
    memset(b, 0, sizeof *b);
    memcpy(b->input, DEFAULT_INPUT, sizeof b->input);
    for (int i = 0; i < N; i++) {
        b->piston_start[i] = DEFAULT_START[i][0];
        b->cap_start[i] = DEFAULT_START[i][2];
        b->rod_start[i] = DEFAULT_START[i][3];
    }
    begin(b, 0.0);
}

/* A boolean variable's place, 0 where none has this reference. */
static int *switch_value(struct bench *b, unsigned vr)
{
    if (vr == EXTRAPOLATE_VR)
        return &b->extrapolate;
    return vr >= LOCKED_VR && vr < LOCKED_VR + N ? &b->locked[vr - LOCKED_VR] : 0;
}

/* Integrate one communication step; the inputs' slopes act within it only. */
static int communicate(struct bench *b, double time, double length)
{
    int status;
    b->time = b->input_time = time;
    if (b->extrapolate && b->steps && time > b->last_time)
        for (int k = 0; k < INPUTS; k++)
            if (b->slope[k] == 0.0)
                b->slope[k] = (b->input[k] - b->last_input[k]) / (time - b->last_time);
    b->last_time = time;
    b->steps++;
    memcpy(b->last_input, b->input, sizeof b->input);
    status = advance(b, time + length);
    memset(b->slope, 0, sizeof b->slope);
    return status;
}

/* Copy a bench's state from `bytes` to `state`, allocated where it is null; 0 without memory. */
static int copy_state(void **state, const void *bytes)
{
    if (!*state)
        *state = malloc(sizeof(struct bench));
    if (*state)
        memcpy(*state, bytes, sizeof(struct bench));
    return *state != 0;
}
