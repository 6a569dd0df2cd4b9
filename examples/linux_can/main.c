/* The exported firmware as a controller node on a CAN bus of Linux, in the place of ours:
 *
 *     ato-hil export c subway --out ato
 *     make -C examples/linux_can EXPORT=$PWD/ato
 *     examples/linux_can/ato_controller vcan0 &
 *     ato-hil run subway --bus socketcan:vcan0 --external controller
 *
 * It answers RUN_CTRL at once and TRAIN_POSITION with a control period. In real time a period also
 * starts by the clock, half a period after its TRAIN_POSITION was expected. It runs until a signal
 * ends it, and keeps what it has learned for as long. */
#define _GNU_SOURCE

#include <errno.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <sys/timerfd.h>
#include <time.h>
#include <unistd.h>

#include "ato.h"
#include "ato_can.h"

#define PERIOD_NS (ATO_TRAIN_POSITION_CYCLE_MS * 1000000L)
#define CATCH_UP_MAX 100 /* periods computed at once */
#define REAL_TIME 1u     /* RUN_CTRL.Pace */

static ato_state state;
static ato_word cells[2 * ATO_CELLS * ATO_WORDS];
static ato_mailbox rx[ATO_MESSAGE_COUNT], tx[ATO_MESSAGE_COUNT];
static const ato_params *params = ATO_PARAMS;
static int bus, timer;

static void fail(const char *what)
{
    fprintf(stderr, "ato_controller: %s: %s\n", what, strerror(errno));
    exit(1);
}

static void open_bus(const char *name)
{
    struct can_filter filters[ATO_MESSAGE_COUNT];
    struct sockaddr_can address = {.can_family = AF_CAN};
    struct ifreq interface = {0};

    if (strlen(name) >= sizeof interface.ifr_name) {
        errno = ENODEV;
        fail(name);
    }
    memcpy(interface.ifr_name, name, strlen(name));
    bus = socket(PF_CAN, SOCK_RAW, CAN_RAW);
    if (bus < 0 || ioctl(bus, SIOCGIFINDEX, &interface) < 0) {
        fail(name);
    }
    for (int i = 0; i < ATO_MESSAGE_COUNT; i++) {
        filters[i].can_id = (canid_t)ATO_FRAME_ID[i];
        filters[i].can_mask = CAN_EFF_FLAG | CAN_RTR_FLAG | CAN_SFF_MASK;
    }
    address.can_ifindex = interface.ifr_ifindex;
    if (setsockopt(bus, SOL_CAN_RAW, CAN_RAW_FILTER, filters, sizeof filters) < 0 ||
        bind(bus, (const struct sockaddr *)&address, sizeof address) < 0) {
        fail(name);
    }
}

/* First in `first_ns`, then every period; 0: never. */
static void set_timer(long first_ns)
{
    struct itimerspec when = {0};

    when.it_value.tv_nsec = first_ns;
    when.it_interval.tv_nsec = first_ns == 0 ? 0 : PERIOD_NS;
    if (timerfd_settime(timer, 0, &when, NULL) < 0) {
        fail("timer");
    }
}

static uint64_t word_of(const struct can_frame *frame)
{
    uint64_t word = 0;

    for (int i = CAN_MAX_DLEN - 1; i >= 0; i--) {
        word = word << 8 | frame->data[i];
    }
    return word;
}

/* Whether CRC-8 and Data-ID nibble of AUTOSAR's Profile 11 are those of a message. */
static bool intact(uint64_t word, unsigned data_id)
{
    uint8_t bytes[9] = {(uint8_t)data_id, 0};
    unsigned crc = 0;

    for (int i = 1; i < 8; i++) {
        bytes[i + 1] = (uint8_t)(word >> 8 * i);
    }
    for (size_t i = 0; i < sizeof bytes; i++) {
        crc ^= bytes[i];
        for (int bit = 0; bit < 8; bit++) {
            crc = (crc & 0x80u) != 0 ? (crc << 1 ^ 0x1Du) & 0xFFu : crc << 1;
        }
    }
    return crc == (word & 0xFFu) && (word >> 12 & 15u) == (data_id >> 8 & 15u);
}

/* Sends what waits in the mailboxes, in order; they are stale then. */
static void send_all(void)
{
    for (int i = 0; i < ATO_MESSAGE_COUNT; i++) {
        struct can_frame frame = {.can_id = (canid_t)ATO_FRAME_ID[i], .can_dlc = CAN_MAX_DLEN};

        if (tx[i].fresh == 0) {
            continue;
        }
        tx[i].fresh = 0;
        for (int k = 0; k < CAN_MAX_DLEN; k++) {
            frame.data[k] = (uint8_t)((uint64_t)tx[i].payload >> 8 * k);
        }
        while (write(bus, &frame, sizeof frame) < 0) {
            if (errno != ENOBUFS && errno != EINTR) {
                fail("bus");
            }
            nanosleep(&(struct timespec){.tv_nsec = 100000}, NULL); /* the queue is full */
        }
    }
}

static void cycle(int period)
{
    (void)ato_cycle(params, ATO_PROFILE, &state, cells, rx, tx, period);
    for (int i = 0; i < ATO_MESSAGE_COUNT; i++) {
        rx[i].fresh = 0;
    }
}

/* Control periods whose TRAIN_POSITION did not come; what waits in the mailboxes goes on waiting. */
static void cycle_alone(int count)
{
    ato_mailbox waiting[ATO_MESSAGE_COUNT];

    memcpy(waiting, rx, sizeof rx);
    for (int i = 0; i < ATO_MESSAGE_COUNT; i++) {
        rx[i].fresh = 0;
    }
    for (; count > 0; count--) {
        cycle(1);
    }
    memcpy(rx, waiting, sizeof rx);
}

static void take(const struct can_frame *frame)
{
    static bool real_time;
    uint64_t word = word_of(frame);
    bool good;
    int index = 0;

    while (index < ATO_MESSAGE_COUNT && (canid_t)ATO_FRAME_ID[index] != frame->can_id) {
        index++;
    }
    if (index == ATO_MESSAGE_COUNT || frame->can_dlc != CAN_MAX_DLEN) {
        return;
    }
    good = intact(word, ATO_DATA_ID[index]);
    if (good || rx[index].fresh == 0) { /* noise does not push out a frame that waits */
        rx[index].payload = (int64_t)word;
        rx[index].fresh = 1;
    }
    if (!good) {
        return;
    }
    if (index == ATO_RUN_CTRL_INDEX && (word >> 16 & 7u) != ATO_RUNNING) {
        real_time = (word >> 19 & 1u) == REAL_TIME;
        set_timer(0);
        cycle(0);
        send_all();
    } else if (index == ATO_TRAIN_POSITION_INDEX) {
        /* Which tick, against the one that comes here: later, now, or one that was done without. */
        int ahead = (int16_t)(uint16_t)((word >> 48) - (uint64_t)state.core.tick);

        if (state.core.run_state != ATO_RUNNING || !real_time) {
            ahead = 0;
        }
        if (ahead < 0) {
            return; /* it waits for the next period */
        }
        cycle_alone(ahead < CATCH_UP_MAX ? ahead : CATCH_UP_MAX);
        cycle(1);
        if (real_time) {
            set_timer(PERIOD_NS + PERIOD_NS / 2);
        }
        send_all();
    }
}

int main(int argc, char **argv)
{
    int train = argc > 2 ? atoi(argv[2]) : 0;
    struct pollfd waiting[2] = {{.events = POLLIN}, {.events = POLLIN}};

    if (argc < 2 || argc > 3 || train < 0 || train >= ATO_TRAINS) {
        fprintf(stderr, "usage: ato_controller INTERFACE [TRAIN, from 0]\n");
        return 1;
    }
    params = &ATO_PARAMS[train];
    open_bus(argv[1]);
    timer = timerfd_create(CLOCK_MONOTONIC, 0);
    if (timer < 0) {
        fail("timer");
    }
    waiting[0].fd = bus;
    waiting[1].fd = timer;
    ato_init(params, &state, cells);
    for (;;) {
        struct can_frame frame;
        uint64_t expired;

        if (poll(waiting, 2, -1) < 0 && errno != EINTR) {
            fail("poll");
        }
        if ((waiting[0].revents & (POLLIN | POLLERR)) != 0) { /* first: a frame may be late */
            if (read(bus, &frame, sizeof frame) != (ssize_t)sizeof frame) {
                fail(argv[1]);
            }
            take(&frame);
        } else if ((waiting[1].revents & POLLIN) != 0) {
            if (read(timer, &expired, sizeof expired) == (ssize_t)sizeof expired) {
                cycle_alone(expired < CATCH_UP_MAX ? (int)expired : CATCH_UP_MAX);
                send_all();
            }
        }
    }
}
