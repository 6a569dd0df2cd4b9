/* Without a bus: signals are variables, and frames are made of them here. */
#include "fmu_frames.h"

static void clear(ato_mailbox *boxes)
{
    for (int32_t i = 0; i < FMU_MESSAGES; i++) {
        boxes[i].fresh = 0;
    }
}

void fmu_bus_start(fmu_state *state)
{
    fmu_frames_out(state, state->model.tx);
    clear(state->model.tx);
}

int fmu_bus_period(fmu_state *state)
{
    fmu_frames_in(state, state->model.rx);
    fmu_model_period(state);
    fmu_frames_out(state, state->model.tx);
    clear(state->model.rx);
    clear(state->model.tx);
    return 0;
}
