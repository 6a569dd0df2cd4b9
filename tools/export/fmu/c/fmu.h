/* Between the functions of FMI (fmu.c), the bus (fmu_can.c or fmu_plain.c) and the model. */
#ifndef ATO_FMU_H
#define ATO_FMU_H

#include "fmi3.h"
#include "fmu_model.h"     /* fmu_model: what the model keeps */
#include "fmu_variables.h" /* names, types and start values of the variables */

typedef union {
    double real;
    int64_t integer; /* Boolean: 0 or 1 */
} fmu_value;

typedef enum { FMU_INSTANTIATED, FMU_INITIALIZATION, FMU_STEP, FMU_EVENT, FMU_TERMINATED } fmu_mode;

#if FMU_CAN
#define FMU_BINARY_MOST 4096 /* bytes of operations each way in one event */

/* The node's side of a CAN bus as FMI-LS-BUS has it. */
typedef struct {
    uint8_t received[FMU_BINARY_MOST]; /* operations set by the importer */
    uint8_t to_send[FMU_BINARY_MOST];  /* operations for it */
    int64_t received_count;
    int64_t to_send_count;
    int64_t is_received; /* Rx_Clock is active */
    int64_t is_told;     /* Tx_Clock has been read as active in this event */
    int64_t transmit_errors;
    int64_t receive_errors;
    int64_t status;                       /* CAN node state, as of operation Status */
    int64_t sent[FMU_MESSAGES];           /* payload last sent, for sending it again */
    int64_t is_unconfirmed[FMU_MESSAGES]; /* 1: neither confirmed nor given up */
} fmu_bus;
#else
typedef struct {
    int64_t counter[FMU_MESSAGES]; /* next end-to-end counter of what comes in as signals */
    int64_t run_state;             /* last that came in */
} fmu_bus;
#endif

/* All that fmi3GetFMUState keeps. No pointer is in it. */
typedef struct {
    int32_t mode;
    int32_t is_running; /* initialised: parameters are settled */
    double start_s;
    double time_s;
    int64_t periods; /* passed since the start */
    fmu_value values[FMU_VARIABLES];
    fmu_bus bus;
    fmu_model model;
} fmu_state;

/* fmu.c, for the others. */
void fmu_say(fmi3Instance instance, fmi3Status status, const char *text);

/* The bus. */
#define FMU_EVENT_NEEDED 1
void fmu_bus_start(fmu_state *state);
int fmu_bus_period(fmu_state *state); /* one period passed; FMU_EVENT_NEEDED or 0 */
#if FMU_CAN
bool fmu_bus_set(fmu_state *state, const uint8_t *bytes, size_t count); /* Rx_Data */
void fmu_bus_update(fmu_state *state);                                  /* end of an event */
#endif

/* The model. Each may leave fresh mailboxes in what it sends. */
void fmu_model_reset(fmu_state *state);  /* as instantiated */
bool fmu_model_start(fmu_state *state);  /* parameters are set: the first values; false: wrong */
void fmu_model_period(fmu_state *state); /* one period passed */
#if FMU_CAN
void fmu_model_frame(fmu_state *state, int64_t message); /* a frame has come */
#endif

#endif
