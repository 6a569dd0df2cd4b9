/* Frames and their signals, for the bus of the FMU: fmu_frames.c is made from the DBC. */
#ifndef ATO_FMU_FRAMES_H
#define ATO_FMU_FRAMES_H

#include "fmu.h"

/* Inputs to frames, with a new end-to-end header, into the mailboxes. */
void fmu_frames_in(fmu_state *state, ato_mailbox *rx);
/* Fresh mailboxes to outputs. */
void fmu_frames_out(fmu_state *state, const ato_mailbox *tx);

#if FMU_CAN
/* Number of the mailbox of an identifier that this node receives, or sends, -1: none. */
int64_t fmu_frames_received(uint32_t identifier);
int64_t fmu_frames_sent(uint32_t identifier);
uint32_t fmu_frames_identifier(int64_t message);
#endif
/* Whether the end-to-end header of a frame fits its content. */
bool fmu_frames_intact(int64_t message, int64_t payload);
int64_t fmu_frames_run_state(int64_t payload); /* of RUN_CTRL */
int64_t fmu_frames_tick(int64_t payload);      /* of TRAIN_POSITION */

#endif
