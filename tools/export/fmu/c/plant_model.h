/* What the plant keeps. */
#ifndef ATO_FMU_MODEL_H
#define ATO_FMU_MODEL_H

#include "ato_plant.h"

typedef struct {
    ato_plant_state state;
    ato_mailbox rx[@MESSAGES@];
    ato_mailbox tx[@MESSAGES@];
    int64_t phase;
    int64_t run;
} fmu_model;

#endif
