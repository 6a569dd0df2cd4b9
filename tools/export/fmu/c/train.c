/* The bare train as the model of an FMU: forces in, motion out. A force counts from the control
 * period on that begins with it. */
#include "ato_train_config.h"
#include "fmu.h"

static void show(fmu_state *state)
{
    const ato_train_state *train = &state->model.state;

    state->values[FMU_POSITION].real = train->position_m;
    state->values[FMU_SPEED].real = train->speed_m_s;
    state->values[FMU_ACCELERATION].real = train->acceleration_m_s2;
}

void fmu_model_reset(fmu_state *state) { (void)state; }

bool fmu_model_start(fmu_state *state)
{
    ato_train_reset(&ATO_TRAIN_PARAMS, &state->model.state);
    show(state);
    return true;
}

void fmu_model_period(fmu_state *state)
{
    fmu_model *own = &state->model;

    for (int i = 0; i < @FORCES@; i++) {
        own->actuator.target[i] = state->values[FMU_FORCE + i].real;
    }
    ato_train_advance(&ATO_TRAIN_PARAMS, ATO_TRAIN_TRACK, &own->state, &ATO_TRAIN_ACTUATOR,
        &own->actuator, 0.0);
    show(state);
}

void fmu_bus_start(fmu_state *state) { (void)state; }

int fmu_bus_period(fmu_state *state)
{
    fmu_model_period(state);
    return 0;
}
