/* From reset to main: vector table, memory, faults. */
#include <stddef.h>
#include <stdint.h>

#include "uart.h"

#define SYSTEM_EXCEPTIONS 16u
#define INTERRUPT_ENABLE(number) \
    (*(volatile uint32_t *)(0xE000E100u + 4u * ((number) / 32u))) /* NVIC_ISER */
#define STACK_PAINT 0xA5A5A5A5u

typedef void (*handler)(void);

/* Of the linker script. */
extern uint32_t stack_bottom[], stack_painted[], stack_top[];
extern uint32_t data_start[], data_end[], bss_start[], bss_end[];
extern const uint32_t data_load[];

int main(void);
void fault_report(const uint32_t *frame); /* in main.c; does not return */
uint32_t stack_used(void);
void reset(void);
void fault(void);
void *memcpy(void *restrict to, const void *restrict from, size_t count);
void *memset(void *to, int value, size_t count);

__attribute__((used, section(".vectors")))
const handler vectors[SYSTEM_EXCEPTIONS + UART_IRQ + 1u] = {
    [0] = (handler)(uintptr_t)stack_top,
    [1] = reset,
    [2] = fault, /* NMI */
    [3] = fault, /* hard fault: the others are not enabled, so they come as one */
    [SYSTEM_EXCEPTIONS + UART_IRQ] = uart_interrupt,
};

void reset(void)
{
    const uint32_t *load = data_load;

    for (uint32_t *word = data_start; word < data_end; word++) {
        *word = *load++;
    }
    for (uint32_t *word = bss_start; word < bss_end; word++) {
        *word = 0u;
    }
    /* All but what this function stands on itself. */
    for (volatile uint32_t *word = stack_bottom; word < stack_painted; word++) {
        *word = STACK_PAINT;
    }
    uart_begin();
    INTERRUPT_ENABLE(UART_IRQ) = 1u << (UART_IRQ % 32u);
    (void)main();
    for (;;) {
    }
}

/* Bytes of the stack that were ever used. */
uint32_t stack_used(void)
{
    const uint32_t *word = stack_bottom;

    while (word < stack_top && *word == STACK_PAINT) {
        word++;
    }
    return (uint32_t)((uintptr_t)stack_top - (uintptr_t)word);
}

/* A fault while the stack is used up would be one in the handler: it gets the stack anew. */
__attribute__((naked)) void fault(void)
{
    __asm__ volatile("mov r0, sp\n"
                     "ldr r1, =stack_top\n"
                     "mov sp, r1\n"
                     "bl fault_report\n");
}

/* The compiler emits calls of these. */
__attribute__((optimize("no-tree-loop-distribute-patterns")))
void *memcpy(void *restrict to, const void *restrict from, size_t count)
{
    unsigned char *target = to;
    const unsigned char *source = from;

    while (count-- > 0u) {
        *target++ = *source++;
    }
    return to;
}

__attribute__((optimize("no-tree-loop-distribute-patterns")))
void *memset(void *to, int value, size_t count)
{
    unsigned char *target = to;

    while (count-- > 0u) {
        *target++ = (unsigned char)value;
    }
    return to;
}
