/* A node of a CAN bus as FMI-LS-BUS 1.0 has it: operations in binary variables, told by clocks.
 *
 * Frames of other nodes, and what is for bus simulations alone, are passed over. With
 * BusNotifications the node keeps its error counters, sends again what lost the arbitration or met
 * an error, and is silent while it is bus-off; without, it ignores all that, as the standard asks. */
#include "fmu_frames.h"

#include <string.h>

/* Operations, by code and length. */
enum {
    FORMAT_ERROR = 0x01,
    TRANSMIT = 0x10,
    TRANSMIT_FD = 0x11,
    TRANSMIT_XL = 0x12,
    CONFIRM = 0x20,
    ARBITRATION_LOST = 0x30,
    BUS_ERROR = 0x31,
    CONFIGURATION = 0x40,
    STATUS = 0x41,
    WAKEUP = 0x42
};
enum { HEAD = 8, TRANSMIT_HEAD = 16, FRAME_BYTES = 8, FORMAT_ERROR_HEAD = 10 };
enum { CAN_BAUDRATE = 1, ARBITRATION_LOST_BEHAVIOR = 4, BUFFER_AND_RETRANSMIT = 1 };
enum { PRIMARY_ERROR_FLAG = 1 };
enum { ERROR_ACTIVE = 1, ERROR_PASSIVE = 2, BUS_OFF = 3 };
enum { PASSIVE_ABOVE = 127, OFF_ABOVE = 255, COUNTER_MOST = 256 };

static uint32_t number(const uint8_t *bytes, int count)
{
    uint32_t value = 0;

    for (int i = 0; i < count; i++) {
        value |= (uint32_t)bytes[i] << (8 * i);
    }
    return value;
}

static uint8_t *put_number(uint8_t *bytes, uint32_t value, int count)
{
    for (int i = 0; i < count; i++) {
        bytes[i] = (uint8_t)(value >> (8 * i) & 0xFF);
    }
    return bytes + count;
}

/* Room for an operation of this length, with its head; NULL: nobody fetches what is there. */
static uint8_t *append(fmu_bus *bus, uint32_t code, uint32_t length)
{
    uint8_t *at = bus->to_send + bus->to_send_count;

    if (bus->to_send_count + (int64_t)length > FMU_BINARY_MOST) {
        return NULL;
    }
    bus->to_send_count += (int64_t)length;
    return put_number(put_number(at, code, 4), length, 4);
}

static bool has_notifications(const fmu_state *state)
{
    return state->values[FMU_BUS_NOTIFICATIONS].integer != 0;
}

static void transmit(fmu_state *state, int64_t message, int64_t payload)
{
    fmu_bus *bus = &state->bus;
    uint8_t *at;

    if (bus->status == BUS_OFF) {
        return;
    }
    at = append(bus, TRANSMIT, TRANSMIT_HEAD + FRAME_BYTES);
    if (at == NULL) {
        return;
    }
    at = put_number(at, fmu_frames_identifier(message), 4);
    at = put_number(at, 0, 2); /* an identifier of 11 bits, no remote frame */
    at = put_number(at, FRAME_BYTES, 2);
    at = put_number(at, (uint32_t)((uint64_t)payload & 0xFFFFFFFFu), 4);
    (void)put_number(at, (uint32_t)((uint64_t)payload >> 32), 4);
    bus->sent[message] = payload;
    bus->is_unconfirmed[message] = 1;
}

/* What the model has left in its mailboxes. */
static void deliver(fmu_state *state)
{
    ato_mailbox *tx = state->model.tx;

    fmu_frames_out(state, tx);
    for (int64_t i = 0; i < FMU_MESSAGES; i++) {
        if (tx[i].fresh != 0) {
            transmit(state, i, tx[i].payload);
            tx[i].fresh = 0;
        }
    }
}

/* The node's state by its error counters; the bus is told when it changes. */
static void judge(fmu_state *state)
{
    fmu_bus *bus = &state->bus;
    int64_t status = ERROR_ACTIVE;
    uint8_t *at;

    if (bus->transmit_errors > OFF_ABOVE) {
        status = BUS_OFF;
    } else if (bus->transmit_errors > PASSIVE_ABOVE || bus->receive_errors > PASSIVE_ABOVE) {
        status = ERROR_PASSIVE;
    }
    state->values[FMU_TRANSMIT_ERRORS].integer = bus->transmit_errors;
    state->values[FMU_RECEIVE_ERRORS].integer = bus->receive_errors;
    state->values[FMU_NODE_STATE].integer = status;
    if (status != bus->status) {
        bus->status = status;
        at = append(bus, STATUS, HEAD + 1);
        if (at != NULL) {
            (void)put_number(at, (uint32_t)status, 1);
        }
    }
}

static void count(int64_t *counter, int64_t change)
{
    *counter += change;
    if (*counter < 0) {
        *counter = 0;
    } else if (*counter > COUNTER_MOST) {
        *counter = COUNTER_MOST;
    }
}

void fmu_bus_start(fmu_state *state)
{
    uint8_t *at;

    state->bus.status = ERROR_ACTIVE; /* as a bus simulation takes it to be */
    judge(state);
    at = append(&state->bus, CONFIGURATION, HEAD + 5);
    at = put_number(at, CAN_BAUDRATE, 1);
    (void)put_number(at, (uint32_t)state->values[FMU_BIT_RATE].integer, 4);
    at = append(&state->bus, CONFIGURATION, HEAD + 2);
    at = put_number(at, ARBITRATION_LOST_BEHAVIOR, 1);
    (void)put_number(at, BUFFER_AND_RETRANSMIT, 1);
    deliver(state);
}

int fmu_bus_period(fmu_state *state)
{
    fmu_bus *bus = &state->bus;

    if (bus->status == BUS_OFF) { /* 128 times 11 recessive bits are over */
        bus->transmit_errors = 0;
        bus->receive_errors = 0;
        judge(state);
    }
    fmu_model_period(state);
    deliver(state);
    return bus->to_send_count > 0 ? FMU_EVENT_NEEDED : 0;
}

bool fmu_bus_set(fmu_state *state, const uint8_t *bytes, size_t count_)
{
    if (count_ > FMU_BINARY_MOST) {
        return false;
    }
    if (count_ > 0) {
        memcpy(state->bus.received, bytes, count_);
    }
    state->bus.received_count = (int64_t)count_;
    return true;
}

static void refuse(fmu_bus *bus, const uint8_t *operation, uint32_t length)
{
    uint8_t *at = append(bus, FORMAT_ERROR, FORMAT_ERROR_HEAD + length);

    if (at != NULL) {
        at = put_number(at, length, 2);
        memcpy(at, operation, length);
    }
}

static void receive(fmu_state *state, const uint8_t *operation)
{
    int64_t message = fmu_frames_received(number(operation + 8, 4));
    bool is_ours = operation[12] == 0 && operation[13] == 0
        && number(operation + 14, 2) == FRAME_BYTES && message >= 0;
    uint64_t payload;

    count(&state->bus.receive_errors, -1);
    if (!is_ours || state->bus.status == BUS_OFF) {
        return;
    }
    payload = number(operation + TRANSMIT_HEAD, 4);
    payload |= (uint64_t)number(operation + TRANSMIT_HEAD + 4, 4) << 32;
    state->model.rx[message].payload = (int64_t)payload;
    state->model.rx[message].fresh = 1;
    fmu_model_frame(state, message);
    deliver(state);
}

/* What a bus simulation tells of a frame. */
static void notice(fmu_state *state, uint32_t code, const uint8_t *operation)
{
    fmu_bus *bus = &state->bus;
    int64_t message = fmu_frames_sent(number(operation + 8, 4));

    if (!has_notifications(state)) {
        return;
    }
    if (code == BUS_ERROR && operation[14] == 0) {
        count(&bus->receive_errors, operation[13] == PRIMARY_ERROR_FLAG ? 8 : 1);
    } else if (code == BUS_ERROR) {
        count(&bus->transmit_errors, 8);
    } else if (code == CONFIRM) {
        count(&bus->transmit_errors, -1);
    }
    judge(state);
    if (message < 0 || bus->is_unconfirmed[message] == 0) {
        return;
    }
    if (code == CONFIRM) {
        bus->is_unconfirmed[message] = 0;
    } else if (code == ARBITRATION_LOST || operation[14] != 0) {
        transmit(state, message, bus->sent[message]);
    }
}

/* Whether an operation has the length that its code and content ask for. */
static bool is_whole(const uint8_t *operation, uint32_t code, uint32_t length)
{
    switch (code) {
    case FORMAT_ERROR:
        return length >= FORMAT_ERROR_HEAD
            && length == FORMAT_ERROR_HEAD + number(operation + 8, 2);
    case TRANSMIT:
        return length >= TRANSMIT_HEAD && length == TRANSMIT_HEAD + number(operation + 14, 2);
    case TRANSMIT_FD:
        return length >= 17 && length == 17 + number(operation + 15, 2);
    case TRANSMIT_XL:
        return length >= 22 && length == 22 + number(operation + 20, 2);
    case CONFIRM:
    case ARBITRATION_LOST:
        return length == 12;
    case BUS_ERROR:
        return length == 15;
    case CONFIGURATION:
        return length > 9;
    case STATUS:
        return length == 9;
    case WAKEUP:
        return length == HEAD;
    default:
        return false;
    }
}

void fmu_bus_update(fmu_state *state)
{
    fmu_bus *bus = &state->bus;
    uint32_t at = 0, end = (uint32_t)bus->received_count;

    if (bus->is_told != 0) { /* the importer has it */
        bus->to_send_count = 0;
        bus->is_told = 0;
    }
    while (bus->is_received != 0 && at < end) {
        const uint8_t *operation = bus->received + at;
        uint32_t left = end - at;
        uint32_t code = left < HEAD ? 0 : number(operation, 4);
        uint32_t length = left < HEAD ? 0 : number(operation + 4, 4);

        if (length < HEAD || length > left) {
            refuse(bus, operation, left); /* where the next one begins is unknown */
            break;
        }
        if (!is_whole(operation, code, length)) {
            refuse(bus, operation, length);
        } else if (code == TRANSMIT) {
            receive(state, operation);
        } else if (code == CONFIRM || code == ARBITRATION_LOST || code == BUS_ERROR) {
            notice(state, code, operation);
        }
        at += length;
    }
    bus->is_received = 0;
    bus->received_count = 0;
}
