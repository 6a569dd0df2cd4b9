/* What the controller keeps. */
#ifndef ATO_FMU_MODEL_H
#define ATO_FMU_MODEL_H

#include "ato.h"
#include "ato_can.h"

typedef struct {
    ato_state state;
    ato_word cells[2 * ATO_CELLS * ATO_WORDS]; /* learning memory */
    ato_mailbox rx[ATO_MESSAGE_COUNT];
    ato_mailbox tx[ATO_MESSAGE_COUNT];
    int64_t is_computed; /* this period's tick */
} fmu_model;

#endif
