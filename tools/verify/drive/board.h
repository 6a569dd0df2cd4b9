/* A board of Arm's MPS2 series in the emulator: an instruction counter and a way to the host. */
#ifndef BOARD_H
#define BOARD_H

#include <stdint.h>

/* SysTick counts down at 25 MHz; with `-icount shift=6` an instruction takes 64 ns, 1.6 of it. */
#define SYSTICK_CSR (*(volatile uint32_t *)0xE000E010u)
#define SYSTICK_RVR (*(volatile uint32_t *)0xE000E014u)
#define SYSTICK_CVR (*(volatile uint32_t *)0xE000E018u)

static inline uint32_t board_start(void) { return SYSTICK_CVR; }

/* Instructions since then, up to ten million; within one. */
static inline uint32_t board_instructions(uint32_t start)
{
    return (((start - SYSTICK_CVR) & 0xFFFFFFu) * 5u + 4u) / 8u;
}

#endif
