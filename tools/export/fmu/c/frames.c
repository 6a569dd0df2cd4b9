/* A signal and the variable that has its value. */
typedef struct {
    ato_signal place;
    double scale;        /* physical unit of a raw unit */
    int32_t variable;    /* reference, -1: none */
    int32_t multiplexed; /* only where Index has this value, -1: always */
} frame_signal;

/* A frame and the variables that belong to it. */
typedef struct {
    int32_t message; /* number of its mailbox */
    int32_t fresh;   /* reference of the variable, -1: none */
    int32_t payload; /* likewise */
    int32_t first;   /* of SIGNALS */
    int32_t count;
    uint32_t identifier;
    int64_t data_id;
} frame;

@TABLES@
static fmu_value *value_of(fmu_state *state, int32_t reference)
{
    static fmu_value nowhere;

    return reference < 0 ? &nowhere : &state->values[reference];
}

#if !FMU_CAN
static int64_t raw_of(const fmu_state *state, const frame_signal *signal)
{
    const fmu_value *value = &state->values[signal->variable];
    double scaled;

    if (signal->scale == 1.0) {
        return saturate(&signal->place, value->integer);
    }
    scaled = floor(value->real / signal->scale + 0.5);
    if (!(scaled > -4294967296.0)) { /* not a number, too */
        scaled = -4294967296.0;
    } else if (scaled > 4294967296.0) {
        scaled = 4294967296.0;
    }
    return saturate(&signal->place, (int64_t)scaled);
}

/* A run begins: its frames are counted from 0, as the bench counts them. */
static void begin_run(fmu_state *state)
{
#if RUN_STATE_INPUT >= 0
    int64_t run_state = state->values[RUN_STATE_INPUT].integer;

    if (run_state == RUNNING && state->bus.run_state != RUNNING) {
        for (int32_t i = 0; i < FMU_MESSAGES; i++) {
            state->bus.counter[i] = 0;
        }
    }
    state->bus.run_state = run_state;
#else
    (void)state;
#endif
}

void fmu_frames_in(fmu_state *state, ato_mailbox *rx)
{
    begin_run(state);
    for (int32_t i = 0; i < FRAMES_IN; i++) {
        const frame *own = &FRAMES[i];
        int64_t *counter = &state->bus.counter[own->message];
        int64_t word = 0;

        rx[own->message].fresh = 0;
        if (state->values[own->fresh].integer == 0) {
            continue;
        }
        for (int32_t k = own->first; k < own->first + own->count; k++) {
            word += put(&SIGNALS[k].place, raw_of(state, &SIGNALS[k]));
        }
        word = protect(word, *counter, own->data_id);
        *counter = next_counter(*counter);
        rx[own->message].payload = word;
        rx[own->message].fresh = 1;
        state->values[own->payload].integer = word;
    }
}
#endif

void fmu_frames_out(fmu_state *state, const ato_mailbox *tx)
{
    for (int32_t i = FRAMES_IN; i < FRAMES_ALL; i++) {
        const frame *own = &FRAMES[i];
        int64_t word = tx[own->message].payload;
        int64_t index = -1;

        value_of(state, own->fresh)->integer = tx[own->message].fresh;
        if (tx[own->message].fresh == 0) {
            continue;
        }
        value_of(state, own->payload)->integer = word;
        for (int32_t k = own->first; k < own->first + own->count; k++) {
            const frame_signal *signal = &SIGNALS[k];
            int64_t raw = get(word, &signal->place);

            if (k == own->first) {
                index = raw;
            }
            if (signal->multiplexed >= 0 && signal->multiplexed != index) {
                continue;
            }
            if (signal->scale == 1.0) {
                value_of(state, signal->variable)->integer = raw;
            } else {
                value_of(state, signal->variable)->real = (double)raw * signal->scale;
            }
        }
    }
}

#if FMU_CAN
static int64_t with_identifier(uint32_t identifier, int32_t first, int32_t end)
{
    for (int32_t i = first; i < end; i++) {
        if (FRAMES[i].identifier == identifier) {
            return FRAMES[i].message;
        }
    }
    return -1;
}

int64_t fmu_frames_received(uint32_t identifier)
{
    return with_identifier(identifier, 0, FRAMES_IN);
}

int64_t fmu_frames_sent(uint32_t identifier)
{
    return with_identifier(identifier, FRAMES_IN, FRAMES_ALL);
}

uint32_t fmu_frames_identifier(int64_t message)
{
    for (int32_t i = 0; i < FRAMES_ALL; i++) {
        if (FRAMES[i].message == message) {
            return FRAMES[i].identifier;
        }
    }
    return 0;
}
#endif

bool fmu_frames_intact(int64_t message, int64_t payload)
{
    for (int32_t i = 0; i < FRAMES_ALL; i++) {
        if (FRAMES[i].message == message) {
            return check(payload, -1, FRAMES[i].data_id) == CHECK_OK;
        }
    }
    return false;
}

int64_t fmu_frames_run_state(int64_t payload) { return get(payload, &RUN_STATE); }

int64_t fmu_frames_tick(int64_t payload) { return get(payload, &TICK); }
