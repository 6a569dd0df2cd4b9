/* The numbers of the scenario. The tables are read alone, by all instances. */
#ifndef ATO_PLANT_CONFIG_H
#define ATO_PLANT_CONFIG_H

#include "ato_plant.h"

extern const ato_plant_params_rows ATO_PLANT_PARAMS;
extern const ato_limits ATO_PLANT_LIMITS; /* of ATP */
extern const ato_section_rows ATO_PLANT_TRACK;
extern const int64_t ATO_PLANT_TICKS;           /* control periods of a run */
extern const int64_t ATO_PLANT_IS_NOISY;        /* 1: the speed sensor has noise */
extern const double ATO_PLANT_DISTURBANCE_M_S2; /* largest, either way; 0: none */
extern const int64_t ATO_PLANT_HOLD_TICKS;      /* that a disturbance stays */

#endif
