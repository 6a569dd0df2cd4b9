/* Processor in the loop: the exported firmware, driven over the serial line.
 *
 * A block is: 0xA5, kind, length of the content (2 bytes), content, CRC (2 bytes) over kind, length
 * and content; CRC-16 of polynomial 0x1021 from 0xFFFF. All numbers are little-endian.
 *
 *     H train (1)                      begin anew, as that train    -> h hello
 *     T period (1), frames             one call of ato_cycle        -> t frames
 *     S                                                             -> s state
 *     anything else, a wrong CRC                                    -> e reason (1)
 *     of its own accord, after a fault           -> f pc (4), lr (4); both 0: no stack is left
 *
 * A frame is its mailbox (1) and its eight bytes, which go as they are. */
#include "ato.h"
#include "uart.h"

#define PROTOCOL 1u
#define START 0xA5u
#define FRAME 9u
#define CONTENT_MAX 512u
#define SYSTICK(offset) (*(volatile uint32_t *)(0xE000E010u + (offset)))
#define SYSTICK_MASK 0xFFFFFFu
#define RING 1024u /* a power of two, more than a block */

ATO_ASSERT(2u + ATO_MESSAGE_COUNT * FRAME < CONTENT_MAX, a_block_holds_all_frames);
ATO_ASSERT(60u + sizeof(ato_information) < CONTENT_MAX, a_block_holds_the_hello);

enum { WRONG_CRC = 1, WRONG_KIND = 2, WRONG_LENGTH = 3, WRONG_CONTENT = 4, TOO_FAST = 5 };

int main(void);
void fault_report(const uint32_t *frame);
uint32_t stack_used(void);
extern uint32_t stack_bottom[]; /* lowest in RAM, by the linker script */

static volatile uint8_t ring[RING];
static volatile uint32_t ring_in, ring_out;
static volatile uint32_t overrun;

static uint8_t content[CONTENT_MAX];
static uint32_t length;

static uint32_t train;
static uint32_t most; /* of SysTick that a control period took */
static ato_state state;
static ato_word cells[2 * ATO_CELLS * ATO_WORDS];
static ato_mailbox rx[ATO_MESSAGE_COUNT];
static ato_mailbox tx[ATO_MESSAGE_COUNT];

void uart_received(uint8_t byte)
{
    if (ring_in - ring_out == RING) {
        overrun = 1u;
        return;
    }
    ring[ring_in % RING] = byte;
    ring_in = ring_in + 1u;
}

/* The next byte. Sleeps until there is one: an interrupt between look and sleep ends the sleep. */
static uint8_t get(void)
{
    uint8_t byte;

    for (;;) {
        __asm__ volatile("cpsid i" ::: "memory");
        if (ring_in != ring_out) {
            break;
        }
        __asm__ volatile("wfi\n cpsie i\n isb" ::: "memory");
    }
    __asm__ volatile("cpsie i" ::: "memory");
    byte = ring[ring_out % RING];
    ring_out = ring_out + 1u;
    return byte;
}

static uint32_t crc_of(uint32_t crc, uint32_t byte)
{
    crc ^= byte << 8;
    for (int bit = 0; bit < 8; bit++) {
        crc = ((crc & 0x8000u) != 0u) ? (crc << 1) ^ 0x1021u : crc << 1;
    }
    return crc & 0xFFFFu;
}

static void put32(uint32_t value)
{
    for (int i = 0; i < 4; i++) {
        content[length++] = (uint8_t)(value & 255u);
        value >>= 8;
    }
}

static void put64(uint64_t value)
{
    put32((uint32_t)(value & 0xFFFFFFFFu));
    put32((uint32_t)(value >> 32));
}

/* Sends `content` as a block. */
static void send(char kind)
{
    uint8_t head[3] = {(uint8_t)kind, (uint8_t)(length & 255u), (uint8_t)(length >> 8)};
    uint32_t crc = 0xFFFFu;

    uart_put(START);
    for (uint32_t i = 0; i < sizeof head; i++) {
        crc = crc_of(crc, head[i]);
        uart_put(head[i]);
    }
    for (uint32_t i = 0; i < length; i++) {
        crc = crc_of(crc, content[i]);
        uart_put(content[i]);
    }
    uart_put((uint8_t)(crc & 255u));
    uart_put((uint8_t)(crc >> 8));
}

static void refuse(uint8_t reason)
{
    content[0] = reason;
    length = 1u;
    send('e');
}

/* Reads a block into `content`; its kind, or 0 if it is none. */
static uint8_t receive(void)
{
    uint8_t head[3];
    uint32_t crc = 0xFFFFu;
    uint32_t found;

    while (get() != START) {
    }
    for (uint32_t i = 0; i < sizeof head; i++) {
        head[i] = get();
        crc = crc_of(crc, head[i]);
    }
    length = (uint32_t)head[1] | (uint32_t)head[2] << 8;
    if (length > CONTENT_MAX) {
        refuse(WRONG_LENGTH);
        return 0u;
    }
    for (uint32_t i = 0; i < length; i++) {
        content[i] = get();
        crc = crc_of(crc, content[i]);
    }
    found = get();
    found |= (uint32_t)get() << 8;
    if (overrun != 0u || found != crc) {
        refuse(overrun != 0u ? TOO_FAST : WRONG_CRC);
        overrun = 0u;
        return 0u;
    }
    return head[0];
}

/* What the generated code takes for granted, looked at while it runs: a bit for each that does not
 * hold. The bench names them, in this order. */
static uint32_t broken_assumptions(void)
{
    volatile int64_t minus_five = -5, three = 3, large = INT64_C(0x123456789ABCDEF0);
    volatile int32_t minus_one = -1;
    volatile uint32_t ordered = 0x01020304u;
    struct {
        int32_t first;
        int64_t second;
    } record;
    const ato_memory_params *grid = &ATO_PARAMS[0].memory;
    const uint8_t *start = (const uint8_t *)&ATO_PARAMS[0];
    bool holds[] = {
        (uint32_t)minus_one == 0xFFFFFFFFu && (minus_one & 3) == 3,
        minus_five >> 1 == -3 && minus_one >> 31 == -1,
        minus_five / three == -1 && minus_five % three == -2,
        large * three == INT64_C(0x369D0369D0369CD0) && large / minus_five ==
            INT64_C(-262353693492758064),
        sizeof(int8_t) == 1u && sizeof(int) >= 4u && sizeof(int64_t) == 8u,
        *(const volatile uint8_t *)&ordered == 0x04u,
        (uintptr_t)&record.second - (uintptr_t)&record == 8u && sizeof record == 16u,
        (uintptr_t)grid - (uintptr_t)start == offsetof(ato_params, memory),
        (uintptr_t)&rx[1] - (uintptr_t)&rx[0] == 16u && ((uintptr_t)&state & 7u) == 0u,
        state.core.run_state == 0 && cells[0] == 0, /* before ato_init: memory was cleared */
    };
    static bool looked;
    static uint32_t broken;

    if (!looked) {
        for (uint32_t i = 0; i < sizeof holds / sizeof holds[0]; i++) {
            broken |= holds[i] ? 0u : 1u << i;
        }
        looked = true;
    }
    return broken;
}

/* FNV-1a. */
static uint64_t digested(uint64_t digest, const void *start, size_t count)
{
    const uint8_t *byte = start;

    for (size_t i = 0; i < count; i++) {
        digest = (digest ^ byte[i]) * UINT64_C(1099511628211);
    }
    return digest;
}

static void hello(void)
{
    const uint8_t *information = (const uint8_t *)&ATO_INFORMATION;
    static const char board[32] = BOARD;
    uint64_t digest = UINT64_C(14695981039346656037);
    uint32_t broken = broken_assumptions();

    if (length != 1u || content[0] >= ATO_TRAINS) {
        refuse(WRONG_CONTENT);
        return;
    }
    train = content[0];
    ato_init(&ATO_PARAMS[train], &state, cells);
    digest = digested(digest, &ATO_PARAMS[train], sizeof ATO_PARAMS[train]);
    digest = digested(digest, ATO_PROFILE, sizeof ATO_PROFILE);
    length = 0u;
    put32(PROTOCOL);
    put32(broken);
    put32(*(const volatile uint32_t *)0xE000ED00u); /* CPUID */
    put64(digest);
    put32((uint32_t)sizeof cells);
    for (uint32_t i = 0; i < sizeof board; i++) {
        content[length++] = (uint8_t)board[i];
    }
    for (size_t i = 0; i < sizeof ATO_INFORMATION; i++) {
        content[length++] = information[i];
    }
    send('h');
}

static void cycle(void)
{
    int64_t period = content[0];
    uint32_t before;
    uint32_t took;

    if (length % FRAME != 1u) {
        refuse(WRONG_LENGTH);
        return;
    }
    for (uint32_t at = 1u; at < length; at += FRAME) {
        uint64_t payload = 0u;

        if (content[at] >= ATO_MESSAGE_COUNT) {
            refuse(WRONG_CONTENT);
            return;
        }
        for (uint32_t i = FRAME - 1u; i > 0u; i--) {
            payload = payload << 8 | content[at + i];
        }
        rx[content[at]].payload = (int64_t)payload;
        rx[content[at]].fresh = 1;
    }
    before = SYSTICK(8u);
    (void)ato_cycle(&ATO_PARAMS[train], ATO_PROFILE, &state, cells, rx, tx, period);
    took = (before - SYSTICK(8u)) & SYSTICK_MASK; /* it counts down */
    if (period != 0 && took > most) {
        most = took;
    }
    length = 0u;
    for (uint32_t i = 0; i < ATO_MESSAGE_COUNT; i++) {
        if (tx[i].fresh != 0) {
            content[length++] = (uint8_t)i;
            put64((uint64_t)tx[i].payload);
        }
        rx[i].fresh = 0;
        tx[i].fresh = 0;
    }
    send('t');
}

static void tell_state(void)
{
    length = 0u;
    put32((uint32_t)state.core.run_state);
    put32((uint32_t)state.core.iteration);
    put32((uint32_t)state.core.faults);
    put32(stack_used());
    put32(most);
    send('s');
}

/* `frame` is what the processor left on the stack: r0-r3, r12, lr, pc, xpsr. A stack that has run
 * over lies below RAM, and there is no frame. */
void fault_report(const uint32_t *frame)
{
    uint32_t pc = 0u;
    uint32_t lr = 0u;

    if (((uintptr_t)frame & 3u) == 0u && (uintptr_t)frame >= (uintptr_t)stack_bottom) {
        lr = frame[5];
        pc = frame[6];
    }
    length = 0u;
    put32(pc);
    put32(lr);
    send('f');
    for (;;) {
    }
}

int main(void)
{
    SYSTICK(4u) = SYSTICK_MASK; /* reload */
    SYSTICK(8u) = 0u;
    SYSTICK(0u) = 5u; /* on, at the processor's clock, no interrupt */
    for (;;) {
        switch (receive()) {
        case 0u:
            break;
        case 'H':
            hello();
            break;
        case 'T':
            cycle();
            break;
        case 'S':
            tell_state();
            break;
        default:
            refuse(WRONG_KIND);
            break;
        }
    }
}
