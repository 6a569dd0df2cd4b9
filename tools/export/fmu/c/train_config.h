/* The numbers of the scenario. The table is read alone, by all instances. */
#ifndef ATO_TRAIN_CONFIG_H
#define ATO_TRAIN_CONFIG_H

#include "ato_train.h"

extern const ato_train_params ATO_TRAIN_PARAMS;
extern const ato_actuator_params ATO_TRAIN_ACTUATOR; /* forces act at once */
extern const ato_section_rows ATO_TRAIN_TRACK;

#endif
