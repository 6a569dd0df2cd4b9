/* Between the runs: what controller/node.py and controller/memory.py do around the tick. */

void ato_init(const ato_params *params, ato_state *state, ato_word *cells)
{
    unsigned char *byte = (unsigned char *)state;
    const ato_memory_params *grid = &params->memory;

    for (size_t i = 0; i < sizeof *state; i++) {
        byte[i] = 0;
    }
    for (int64_t i = 0; i < ATO_MESSAGE_COUNT; i++) {
        state->links[i].counter = -1; /* no frame received yet */
    }
    for (int64_t w = 0; w < grid->words; w++) {
        int64_t nearest = floor_div(grid->initial[w] + floor_div(grid->scale, 2), grid->scale);
        int64_t value = min64(nearest, floor_div(INT32_MAX, grid->scale));

        for (int64_t here = 0; here < grid->cells; here++) {
            cells[cell_at(0, here, w)] = (ato_word)value;
            cells[cell_at(1, here, w)] = (ato_word)value;
        }
    }
}

/* The generation that will be written starts as a copy: cells that this run does not reach keep
 * their value. */
static void start_run(const ato_params *params, const ato_state *state, ato_word *cells)
{
    int64_t read = state->memory.generation;

    for (int64_t here = 0; here < params->memory.cells; here++) {
        for (int64_t w = 0; w < params->memory.words; w++) {
            cells[cell_at(1 - read, here, w)] = cells[cell_at(read, here, w)];
        }
    }
}

/* Closes the open cell with the ticks that it had and, if no fault blocks it, makes the generation
 * of this run the one that is read. */
static void end_run(const ato_params *params, ato_state *state, ato_word *cells)
{
    if (params->memory.words == 0) {
        return;
    }
    if (params->memory.pitch == 0) {
        memory_close_cell(&params->memory, &state->memory, cells);
    }
    if ((state->core.faults & ATO_FAULTS_THAT_BLOCK_LEARNING) == 0) {
        state->memory.generation = 1 - state->memory.generation;
    }
}

int64_t ato_cycle(const ato_params *params, const ato_segment *profile, ato_state *state,
    ato_word *cells, const ato_mailbox *rx, ato_mailbox *tx, int64_t period)
{
    int64_t before = state->core.run_state;

    ato_tick(params, profile, state, cells, rx, tx, period);
    if (state->core.run_state == ATO_ARMED) {
        start_run(params, state, cells);
    } else if (state->core.run_state == ATO_ENDED && before == ATO_RUNNING) {
        end_run(params, state, cells);
        return 1;
    }
    return 0;
}
