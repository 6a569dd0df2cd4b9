/* CMSDK APB UART of ARM's MPS2 boards. */
#include "uart.h"

#define DATA UART_REGISTER(0x00u)
#define STATE UART_REGISTER(0x04u)
#define CONTROL UART_REGISTER(0x08u)
#define INTERRUPT_CLEAR UART_REGISTER(0x0Cu)
#define DIVIDER UART_REGISTER(0x10u)

#define TX_FULL 1u
#define RX_FULL 2u
#define TX_ENABLE 1u
#define RX_ENABLE 2u
#define RX_INTERRUPT 8u
#define RX_PENDING 2u
#define FASTEST 16u

void uart_begin(void)
{
    DIVIDER = FASTEST;
    CONTROL = TX_ENABLE | RX_ENABLE | RX_INTERRUPT;
}

void uart_put(uint8_t byte)
{
    while ((STATE & TX_FULL) != 0u) {
    }
    DATA = byte;
}

void uart_interrupt(void)
{
    INTERRUPT_CLEAR = RX_PENDING; /* first: a byte that comes while this drains is signalled again */
    while ((STATE & RX_FULL) != 0u) {
        uart_received((uint8_t)DATA);
    }
}
