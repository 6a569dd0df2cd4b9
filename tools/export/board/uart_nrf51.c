/* UART of the nRF51 on the BBC micro:bit. */
#include "uart.h"

#define START_RX UART_REGISTER(0x000u)
#define START_TX UART_REGISTER(0x008u)
#define RX_READY UART_REGISTER(0x108u)
#define TX_READY UART_REGISTER(0x11Cu)
#define INTERRUPT_SET UART_REGISTER(0x304u)
#define ENABLE UART_REGISTER(0x500u)
#define RX_DATA UART_REGISTER(0x518u)
#define TX_DATA UART_REGISTER(0x51Cu)
#define BAUD_RATE UART_REGISTER(0x524u)

#define ENABLED 4u
#define BAUD_1M 0x10000000u
#define RX_INTERRUPT (1u << 2)

void uart_begin(void)
{
    BAUD_RATE = BAUD_1M;
    ENABLE = ENABLED;
    INTERRUPT_SET = RX_INTERRUPT;
    START_TX = 1u;
    START_RX = 1u;
}

void uart_put(uint8_t byte)
{
    TX_READY = 0u;
    TX_DATA = byte;
    while (TX_READY == 0u) {
    }
}

void uart_interrupt(void)
{
    while (RX_READY != 0u) {
        RX_READY = 0u;
        uart_received((uint8_t)RX_DATA);
    }
}
