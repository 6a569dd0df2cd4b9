/* Start-up of the image that counts instructions, and its main: reads the file `calls` of the host
 * by semihosting, prints what drive.c finds. */
#include "drive.c"

#define WORDS_MAX_OF_FILE 1000000
#define STACK_PAINTED 8192u
#define PAINT 0xA5A5A5A5u

extern uint32_t stack_top[];

static int64_t words[WORDS_MAX_OF_FILE];

void *memset(void *to, int value, size_t n)
{
    unsigned char *byte = to;

    while (n-- > 0) {
        *byte++ = (unsigned char)value;
    }
    return to;
}

void *memcpy(void *to, const void *from, size_t n)
{
    unsigned char *byte = to;
    const unsigned char *source = from;

    while (n-- > 0) {
        *byte++ = *source++;
    }
    return to;
}

static int32_t host(int32_t operation, const void *arguments)
{
    register int32_t r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = arguments;

    __asm__ volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

static void print(const char *text, uint64_t number)
{
    char digits[24];
    int at = 23;

    digits[at] = 0;
    do {
        digits[--at] = (char)('0' + (int)(number % 10u));
        number /= 10u;
    } while (number > 0);
    host(0x04, text);
    host(0x04, &digits[at]);
}

/* Bytes of the stack that have been written, the counted ones being painted before. */
static uint32_t stack_used(uint32_t *from)
{
    uint32_t *at = from - STACK_PAINTED / 4u;

    while (at < from && *at == PAINT) {
        at++;
    }
    return (uint32_t)((from - at) * 4);
}

static __attribute__((noinline)) uint32_t *paint(void)
{
    uint32_t *from;

    __asm__ volatile("mov %0, sp" : "=r"(from));
    for (uint32_t *at = from - STACK_PAINTED / 4u; at < from; at++) {
        *(volatile uint32_t *)at = PAINT;
    }
    return from;
}

void reset(void)
{
    const char name[] = "calls";
    const uintptr_t open[3] = { (uintptr_t)name, 1, sizeof name - 1 };
    int32_t file = host(0x01, open);
    uintptr_t handle = (uintptr_t)file;
    int32_t size = host(0x0C, &handle);
    const uintptr_t read[3] = { handle, (uintptr_t)words, (uintptr_t)size };
    uint32_t *from, start, empty, used;
    result made;

    if (file < 0 || size < 8 || (size_t)size > sizeof words || host(0x06, read) != 0) {
        host(0x04, "no calls\n");
    } else {
        SYSTICK_RVR = 0xFFFFFFu;
        SYSTICK_CVR = 0;
        SYSTICK_CSR = 5;
        start = board_start();
        empty = board_instructions(start);
        from = paint();
        made = drive(words, (size_t)size / sizeof *words, 0);
        used = stack_used(from);
        print("calls ", made.calls);
        print(" digest ", made.digest);
        print(" fewest ", made.fewest - empty);
        print(" most ", made.most - empty);
        print(" at ", made.most_at);
        print(" stack ", used);
        host(0x04, "\n");
    }
    host(0x18, (const void *)0x20026);
    for (;;) {
    }
}

__attribute__((section(".vectors"), used)) static const void *const VECTORS[] = {
    stack_top, (const void *)reset,
    (const void *)reset, (const void *)reset,
};
