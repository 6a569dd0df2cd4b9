/* The plant as the model of an FMU: it arms a run, drives it, ends it, and goes on to the next one.
 * Before and after a run it announces that until the controller's ATO_STATUS repeats it. */
#include "ato_plant_config.h"
#include "fmu_frames.h"

enum { ARMING, DRIVING, ENDING, DONE };
enum { SPEED_NOISE = @SPEED_NOISE@, DISTURBANCE = @DISTURBANCE@ }; /* streams of a run */

/* Random words: Philox 4x64 with 10 rounds, of Salmon and others, 2011, so that the word of a tick
 * is known without those before it. */

static uint64_t product(uint64_t a, uint64_t b, uint64_t *low)
{
    uint64_t a0 = a & 0xFFFFFFFFu, a1 = a >> 32, b0 = b & 0xFFFFFFFFu, b1 = b >> 32;
    uint64_t middle = a1 * b0 + (a0 * b0 >> 32);
    uint64_t other = a0 * b1 + (middle & 0xFFFFFFFFu);

    *low = a * b;
    return a1 * b1 + (middle >> 32) + (other >> 32);
}

static uint64_t word(uint64_t seed, uint64_t stream, uint64_t number)
{
    uint64_t c0 = number / 4 + 1, c1 = 0, c2 = 0, c3 = 0;

    for (int i = 0; i < 10; i++) {
        uint64_t low0, low2;
        uint64_t high0 = product(UINT64_C(0xD2E7470EE14C6C93), c0, &low0);
        uint64_t high2 = product(UINT64_C(0xCA5A826395121157), c2, &low2);

        c0 = high2 ^ c1 ^ seed;
        c1 = low2;
        c2 = high0 ^ c3 ^ stream;
        c3 = low0;
        seed += UINT64_C(0x9E3779B97F4A7C15);
        stream += UINT64_C(0xBB67AE8584CAA73B);
    }
    switch (number % 4) {
    case 0:
        return c0;
    case 1:
        return c1;
    case 2:
        return c2;
    default:
        return c3;
    }
}

static double uniform(uint64_t seed, uint64_t stream, uint64_t number)
{
    return (double)(word(seed, stream, number) >> 11) * (1.0 / 9007199254740992.0);
}

static double noise(uint64_t seed, uint64_t stream, uint64_t tick)
{
    double drawn[12], first, second, total;

    for (uint64_t i = 0; i < 12; i++) {
        drawn[i] = uniform(seed, stream, 12 * tick + i);
    }
    first = (drawn[0] + drawn[1]) + (drawn[2] + drawn[3]);
    second = (drawn[4] + drawn[5]) + (drawn[6] + drawn[7]);
    total = first + second;
    for (int i = 8; i < 12; i++) {
        total += drawn[i];
    }
    return total - 6.0;
}

static ato_chance chance_of(const fmu_state *state)
{
    ato_chance chance = { 0.0, 0.0, 0, 0 };
    uint64_t seed = (uint64_t)state->values[FMU_SEED].integer;
    uint64_t stream = (uint64_t)state->model.run << 8;
    uint64_t tick = (uint64_t)state->model.state.node.tick;

    if (ATO_PLANT_IS_NOISY != 0) {
        chance.speed_noise = noise(seed, stream + SPEED_NOISE, tick);
    }
    if (ATO_PLANT_DISTURBANCE_M_S2 > 0.0) {
        uint64_t value = tick / (uint64_t)ATO_PLANT_HOLD_TICKS;
        double drawn = 2.0 * uniform(seed, stream + DISTURBANCE, value) - 1.0;

        chance.disturbance_m_s2 = ATO_PLANT_DISTURBANCE_M_S2 * drawn;
    }
    return chance;
}

void fmu_model_reset(fmu_state *state) { (void)state; }

static void announce(fmu_state *state, int64_t run_state)
{
    ato_plant_announce(
        &state->model.state.node, run_state, state->model.run, state->model.tx);
}

bool fmu_model_start(fmu_state *state)
{
    int64_t first = state->values[FMU_FIRST_RUN].integer;
    int64_t last = state->values[FMU_LAST_RUN].integer;

    if (state->values[FMU_SEED].integer < 0 || first < 0 || last < first || last > @RUNS_MAX@) {
        return false;
    }
    state->model.run = first;
    state->model.phase = ARMING;
    announce(state, @ARMED@);
    return true;
}

static ato_plant_state_rows state_rows(fmu_state *state)
{
    ato_plant_state_rows rows = { &state->model.state, 1 };

    return rows;
}

static void sense(fmu_state *state)
{
    ato_chance chance = chance_of(state);
    ato_chance_table chances = { &chance, 1, 1 };
    ato_mailbox_table boxes = { state->model.tx, 1, FMU_MESSAGES };

    ato_plant_sense(
        ATO_PLANT_PARAMS, &ATO_PLANT_LIMITS, state_rows(state), chances, 0, boxes);
}

static void act(fmu_state *state)
{
    ato_chance chance = chance_of(state);
    ato_chance_table chances = { &chance, 1, 1 };
    ato_mailbox_table boxes = { state->model.rx, 1, FMU_MESSAGES };
    ato_truth truth;
    ato_truth_table truths = { &truth, 1, 1 };
    const double *values = &truth.position_m; /* all fields are of this type */

    ato_plant_act(
        ATO_PLANT_PARAMS, ATO_PLANT_TRACK, state_rows(state), chances, 0, boxes, truths);
    for (int i = 0; i < @TRUTHS@; i++) {
        state->values[FMU_TRUTH + i].real = values[i];
    }
}

void fmu_model_period(fmu_state *state)
{
    fmu_model *own = &state->model;

    switch (own->phase) {
    case ARMING:
        if (ato_plant_confirmed(&own->state.node, own->rx) == 0) {
            announce(state, @ARMED@);
            break;
        }
        ato_plant_begin(ATO_PLANT_PARAMS, state_rows(state));
        own->phase = DRIVING;
        sense(state);
        break;
    case DRIVING:
        act(state);
        if (own->state.node.tick < ATO_PLANT_TICKS) {
            sense(state);
            break;
        }
        own->phase = ENDING;
        announce(state, @ENDED@);
        break;
    case ENDING:
        if (ato_plant_confirmed(&own->state.node, own->rx) == 0) {
            announce(state, @ENDED@);
        } else if (own->run < state->values[FMU_LAST_RUN].integer) {
            own->run++;
            own->phase = ARMING;
            announce(state, @ARMED@);
        } else {
            own->phase = DONE;
        }
        break;
    default:
        break;
    }
    for (int32_t i = 0; i < FMU_MESSAGES; i++) {
        own->rx[i].fresh = 0;
    }
}

#if FMU_CAN
void fmu_model_frame(fmu_state *state, int64_t message)
{
    (void)state; /* it stays in its mailbox until the control period is over */
    (void)message;
}
#endif
