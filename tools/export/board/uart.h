/* The serial line of a board: bytes come by interrupt into a ring, bytes go by waiting. A board gives
 * UART_BASE and UART_IRQ to the compiler. */
#ifndef UART_H
#define UART_H

#include <stdint.h>

#define UART_REGISTER(offset) (*(volatile uint32_t *)(UART_BASE + (offset)))

void uart_begin(void);
void uart_put(uint8_t byte);
void uart_interrupt(void); /* stands in the vector table */

/* In main.c: what uart_interrupt got. */
void uart_received(uint8_t byte);

#endif
