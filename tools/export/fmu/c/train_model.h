/* What the train keeps. */
#ifndef ATO_FMU_MODEL_H
#define ATO_FMU_MODEL_H

#include "ato_train.h"

typedef struct {
    ato_train_state state;
    ato_actuator_state actuator; /* its forces are what comes in */
} fmu_model;

#endif
