/* Drives the exported firmware with calls from a file: on the host for the sanitizers and the
 * coverage, on a board (ATO_BOARD) to count instructions.
 *
 * The file holds int64: 1 first, to see that it is whole; then of each call its period and the
 * number of frames, and of each frame its mailbox and payload. Printed: calls, FNV-1a digest of the
 * frames sent and of the learning memory at the end; on a board also the fewest and the most
 * instructions of a call with period 1 and the bytes of stack used.
 *
 * Variants of the calibration, for what no scenario uses: 1 has a hold brake, a largest
 * acceleration and speed, short windows of progress, a memory of three cells and of halves that
 * smooths; 2 also a timetable that stands.
 */
#include "ato.h"

#ifdef ATO_BOARD
#include "board.h"
#else
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
static uint32_t board_start(void) { return 0; }
static uint32_t board_instructions(uint32_t start) { return start; }
#endif

#ifndef ATO_TRAIN
#define ATO_TRAIN 0
#endif

static ato_state state;
static ato_word cells[2 * ATO_CELLS * ATO_WORDS];
static ato_mailbox rx[ATO_MESSAGE_COUNT];
static ato_mailbox tx[ATO_MESSAGE_COUNT];
static ato_params params;
static const ato_segment STANDING[1] = { { INT32_MAX, 0 } };

typedef struct {
    uint64_t digest;
    uint32_t calls;
    uint32_t fewest;
    uint32_t most;
    uint32_t most_at; /* call, from 0 */
} result;

static void digest(result *made, int64_t number)
{
    uint64_t bits = (uint64_t)number;

    for (int i = 0; i < 8; i++) {
        made->digest = (made->digest ^ (bits & 255u)) * UINT64_C(1099511628211);
        bits >>= 8;
    }
}

static result drive(const int64_t *words, size_t count, int variant)
{
    const ato_segment *profile = variant == 2 ? STANDING : ATO_PROFILE;
    result made = { UINT64_C(14695981039346656037), 0, UINT32_MAX, 0, 0 };
    size_t at = 1;

    params = ATO_PARAMS[ATO_TRAIN];
    if (variant > 0) {
        params.guard.hold_brake = -(1 << 26);
        params.guard.acceleration_max = 1 << 26;
        params.plausibility.speed_max = 1 << 28;
        params.plausibility.window = 10;
        params.memory.scale = 2;
        params.memory.smooth = 3;
        params.memory.smooth_weight = (1 << 30) / 7;
        if (params.memory.cells > 3) {
            params.memory.cells = 3;
        }
    }
    if (variant == 2) {
        params.reference.segment_count = 1;
    }
    if (variant == 3) {
        params.guard.atp_releases = 1;
    }
    ato_init(&params, &state, cells);
    while (at + 1 < count) {
        int64_t period = words[at];
        int64_t frames = words[at + 1];
        uint32_t start, took;

        at += 2;
        for (size_t i = 0; i < ATO_MESSAGE_COUNT; i++) {
            rx[i].fresh = 0;
            tx[i].fresh = 0;
        }
        for (; frames > 0 && at + 1 < count; frames--, at += 2) {
            rx[words[at]].payload = words[at + 1];
            rx[words[at]].fresh = 1;
        }
        start = board_start();
        (void)ato_cycle(&params, profile, &state, cells, rx, tx, period);
        took = board_instructions(start);
        if (period == 1 && state.core.run_state == ATO_RUNNING) {
            if (took < made.fewest) {
                made.fewest = took;
            }
            if (took > made.most) {
                made.most = took;
                made.most_at = made.calls;
            }
        }
        for (size_t i = 0; i < ATO_MESSAGE_COUNT; i++) {
            if (tx[i].fresh != 0) {
                digest(&made, tx[i].payload);
            }
        }
        made.calls++;
    }
    for (size_t i = 0; i < sizeof cells / sizeof cells[0]; i++) {
        digest(&made, cells[i]);
    }
    return made;
}

#ifndef ATO_BOARD
int main(int argc, char **argv)
{
    FILE *file = argc > 1 ? fopen(argv[1], "rb") : NULL;
    int64_t *words;
    long size;
    result made;

    if (file == NULL || fseek(file, 0, SEEK_END) != 0 || (size = ftell(file)) < 0) {
        return 2;
    }
    rewind(file);
    words = malloc((size_t)size + 1);
    if (words == NULL || fread(words, 1, (size_t)size, file) != (size_t)size || words[0] != 1) {
        return 2;
    }
    made = drive(words, (size_t)size / sizeof *words, argc > 2 ? atoi(argv[2]) : 0);
    printf("%" PRIu32 " calls, digest %" PRIu64 "\n", made.calls, made.digest);
    free(words);
    return fclose(file) == 0 ? 0 : 2;
}
#endif
