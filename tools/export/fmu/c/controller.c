/* The controller as the model of an FMU: it acts on frames, or by the clock where they are missing.
 * ato.h is the manual of what it calls. */
#include "fmu_frames.h"

#define CATCH_UP_MOST @CATCH_UP_MAX@ /* ticks computed at once for frames that did not come */
#define TICK_HALF INT64_C(0x8000)

void fmu_model_reset(fmu_state *state) { (void)state; }

static const ato_params *params(const fmu_state *state)
{
#if ATO_TRAINS > 1
    return &ATO_PARAMS[state->values[FMU_TRAIN].integer];
#else
    (void)state;
    return &ATO_PARAMS[0];
#endif
}

bool fmu_model_start(fmu_state *state)
{
#if ATO_TRAINS > 1
    if (state->values[FMU_TRAIN].integer < 0 || state->values[FMU_TRAIN].integer >= ATO_TRAINS) {
        return false;
    }
#endif
    ato_init(params(state), &state->model.state, state->model.cells);
    return true;
}

static void clear(ato_mailbox *boxes)
{
    for (int32_t i = 0; i < ATO_MESSAGE_COUNT; i++) {
        boxes[i].fresh = 0;
    }
}

static void cycle(fmu_state *state, int64_t period)
{
    fmu_model *own = &state->model;

    (void)ato_cycle(
        params(state), ATO_PROFILE, &own->state, own->cells, own->rx, own->tx, period);
    clear(own->rx);
}

static bool announces(const ato_mailbox *run_ctrl)
{
    return fmu_frames_run_state(run_ctrl->payload) != ATO_RUNNING
        && fmu_frames_intact(ATO_RUN_CTRL_INDEX, run_ctrl->payload);
}

#if FMU_CAN

void fmu_model_period(fmu_state *state)
{
    fmu_model *own = &state->model;

    if (own->state.core.run_state == ATO_RUNNING && own->is_computed == 0) {
        cycle(state, 1); /* by the clock: the frames are late, or lost */
    }
    own->is_computed = 0;
}

void fmu_model_frame(fmu_state *state, int64_t message)
{
    fmu_model *own = &state->model;
    int64_t payload = own->rx[message].payload;
    int64_t ahead = 0;

    if (message == ATO_RUN_CTRL_INDEX && announces(&own->rx[message])) {
        cycle(state, 0);
        return;
    }
    if (message != ATO_TRAIN_POSITION_INDEX || !fmu_frames_intact(message, payload)) {
        return;
    }
    if (own->state.core.run_state == ATO_RUNNING) {
        ahead = fmu_frames_tick(payload) - own->state.core.tick + TICK_HALF;
        ahead = (ahead & (2 * TICK_HALF - 1)) - TICK_HALF;
    }
    if (ahead < 0) {
        return; /* of a tick that was computed without it */
    }
    if (ahead > 0) {
        ato_mailbox waiting[ATO_MESSAGE_COUNT];

        for (int32_t i = 0; i < ATO_MESSAGE_COUNT; i++) {
            waiting[i] = own->rx[i];
        }
        clear(own->rx);
        for (int64_t k = 0; k < ahead && k < CATCH_UP_MOST; k++) {
            cycle(state, 1);
        }
        for (int32_t i = 0; i < ATO_MESSAGE_COUNT; i++) {
            own->rx[i] = waiting[i];
        }
    }
    cycle(state, 1);
    own->is_computed = 1;
}

#else

void fmu_model_period(fmu_state *state)
{
    fmu_model *own = &state->model;

    if (own->rx[ATO_RUN_CTRL_INDEX].fresh != 0 && announces(&own->rx[ATO_RUN_CTRL_INDEX])) {
        for (int32_t i = 0; i < ATO_MESSAGE_COUNT; i++) {
            if (i != ATO_RUN_CTRL_INDEX) {
                own->rx[i].fresh = 0;
            }
        }
        cycle(state, 0);
    } else if (own->rx[ATO_TRAIN_POSITION_INDEX].fresh != 0
        || own->state.core.run_state == ATO_RUNNING) {
        cycle(state, 1);
    }
}

#endif
