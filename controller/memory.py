"""Learning memory: what one run leaves for the next, on a grid of `decimation` control periods.

An array [2, cells, words] of int32 (or int16): one generation is read while the other is written,
so that a run in which a fault occurred is dropped whole, and linear interpolation never reads what
this run has just written. For every tick the memory gathers `before[w]` (what the previous runs
left for this tick) for the law, and takes `learn[w]` from it. The increment of a cell is the mean
of `learn` over the cell's ticks, added once to what the cell held, and clamped; it is stored
`lead` ticks earlier than it was measured, which is what keeps learning stable when the actuator
lags.

A law may instead recall the last run (`Recall`): each tick's `learn` then replaces what the cell
held, one cell a tick, and the law sees besides `before` the first words of a later tick (`ahead`)
and a zero-phase moving average of one word (`smooth`), both of the last run throughout.

Or its words lie along the track, a cell every `pitch`, and not along time: triangular memberships
delta of the two cells around the train, which sum to 1. `before` is their sum weighted by delta,
and each takes its share delta of `learn` at once, so that a run goes on with what it learns.

Contract: `gather` and `scatter` are steps of bounded time that run inside the tick; `start_run`,
`end_run` run between runs. The caller owns every buffer.
"""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
import numpy as np

from ato_hil.can_dbc.step import (
    Array,
    Int,
    Record,
    int64,
    step,
)
from ato_hil.controller import reference
from ato_hil.controller.q import (
    INT32_MAX,
    Q_POSITION,
    clamp,
    divide_round,
    round_shift,
    sat32,
)
from ato_hil.controller.quantise import CalibrationError, Recall, fixed, whole

WORDS_MAX = 22
AHEAD_WORDS = 2
SMOOTH_MAX = 64  # ticks either side
ONE = 1 << 30  # Q30

CELL = np.dtype(
    [
        ("before", np.int32, (WORDS_MAX,)),  # in: value that the previous runs left for this tick
        ("learn", np.int32, (WORDS_MAX,)),  # out: increment that this tick asks for; recall: value
        ("ahead", np.int32, (AHEAD_WORDS,)),  # in, recall: first words of a later tick
        ("smooth", np.int32),  # in, recall: mean of a word over the ticks around this one
        ("padding", np.int32),
    ],
    align=True,
)

MEMORY_PARAMS = np.dtype(
    [
        ("words", np.int32),  # words a cell, 0..WORDS_MAX; 0 is a law that does not learn
        ("cells", np.int32),
        ("decimation", np.int32),  # ticks a cell
        ("lead", np.int32),  # ticks
        ("linear", np.int32),  # 1: interpolate between cell centres, 0: hold
        ("weight", np.int32),  # 2^30 / (2 * decimation)
        ("scale", np.int32),  # value of one stored unit: 1, or a power of two for int16 storage
        ("recall", np.int32),  # 1: `learn` replaces what the cell held
        ("ahead", np.int32),  # recall: ticks from now to the cell in `ahead`
        ("smooth", np.int32),  # recall: ticks either side that `smooth` averages, 0..SMOOTH_MAX
        ("smooth_word", np.int32),  # recall: the word that it averages
        ("smooth_weight", np.int32),  # 2^30 / (2 smooth + 1)
        ("late_word", np.int32),  # recall: words from here on are of the tick before
        ("pitch", np.int32),  # along the track: m, Q15, from cell to cell; 0: along time
        ("low", np.int32, (WORDS_MAX,)),  # bounds of a value
        ("high", np.int32, (WORDS_MAX,)),
        ("initial", np.int32, (WORDS_MAX,)),  # value of every cell before the first run
    ],
    align=True,
)

MEMORY_STATE = np.dtype(
    [
        ("total", np.int64, (WORDS_MAX,)),  # of `learn` over the ticks of the open cell
        ("window", np.int64),  # recall: sum of the word that is averaged
        ("generation", np.int32),  # which half is read, 0 or 1
        ("read_cell", np.int32),
        ("read_phase", np.int32),  # tick inside the cell that is read; along the track: delta, Q30
        ("write_cell", np.int32),
        ("write_phase", np.int32),  # ticks summed in the cell that is written
        ("wait", np.int32),  # ticks until the first increment has somewhere to go
    ],
    align=True,
)

TOTAL_MAX = 1 << 48  # where the sum of a cell that no longer closes stops


# More than any run has; `calibrate` says how many this one may have.
Ticks = Annotated[int, msgspec.Meta(ge=0, le=1_000_000)]
Cells = Annotated[int, msgspec.Meta(ge=1, le=1_000_000)]


class MemorySettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Grid of the learning memory; a law that recalls the last run has one int32 cell a tick, one
    that learns along the track an int32 cell every pitch of its own, whatever this says."""

    decimation: Cells = 1  # control periods a cell
    lead_ticks: Ticks = 0  # what a tick learns from lies so far ahead
    interpolation: str = "hold"  # hold | linear
    storage: str = "int32"  # int32 | int16


def calibrate(params: np.ndarray, settings: MemorySettings, ticks: int) -> np.ndarray:
    """`params`, which have what a law says of its words, with the grid as well."""
    params["scale"] = 1
    if params["words"] == 0:
        return params
    decimation = whole("control.memory.decimation", settings.decimation, 1, ticks)
    lead = whole("control.memory.lead_ticks", settings.lead_ticks, 0, ticks)
    if settings.interpolation not in ("hold", "linear"):
        raise CalibrationError(
            f"control.memory.interpolation is {settings.interpolation!r}, expected hold or linear"
        )
    if settings.storage not in ("int32", "int16"):
        raise CalibrationError(
            f"control.memory.storage is {settings.storage!r}, expected int32 or int16"
        )
    params["cells"] = -(-ticks // decimation)
    params["decimation"] = decimation
    params["lead"] = lead
    params["linear"] = int(settings.interpolation == "linear")
    params["weight"] = round(2**30 / (2 * decimation))
    params["scale"] = 1 if settings.storage == "int32" else 2**16
    return params


def calibrate_recall(params: np.ndarray, recall: Recall) -> None:
    """Adds to the params what a law sees of the last run."""
    params["recall"] = 1
    params["ahead"] = recall.ahead_ticks
    params["smooth"] = recall.smooth_ticks
    params["smooth_word"] = recall.smooth_word
    params["smooth_weight"] = round(2**30 / (2 * recall.smooth_ticks + 1))
    params["late_word"] = recall.late_word


def calibrate_along_track(params: np.ndarray, pitch_m: float, profile: np.ndarray) -> None:
    """Lays the cells along the track, so that all of the profile lies between cells."""
    pitch = fixed("pitch_m", pitch_m, Q_POSITION)
    params["pitch"] = pitch
    params["cells"] = -(-reference.length(profile) // (pitch << 25)) + 1


def state_bounds(params: Any) -> dict[str, tuple[int, int]]:
    """Bounds of MEMORY_STATE with one record of MEMORY_PARAMS, by field."""
    cells, decimation = max(int(params["cells"]), 1), max(int(params["decimation"]), 1)
    widest = (2 * int(params["smooth"]) + 1) << 31
    return {
        "total": (-TOTAL_MAX, TOTAL_MAX),
        "window": (-widest, widest),
        "generation": (0, 1),
        "read_cell": (0, cells - 1),
        "read_phase": (0, ONE if int(params["pitch"]) > 0 else decimation - 1),
        "write_cell": (0, cells),
        "write_phase": (0, decimation),
        "wait": (0, max(int(params["lead"]), 0)),
    }


@step
def rewind(params: Record, state: Record, memory: Array, cell: Record) -> None:
    """The state at the start of a run; the generation stays. Words that are not stored are at their
    initial value throughout."""
    for w in range(WORDS_MAX):
        state.total[w] = 0
        cell.before[w] = params.initial[w]
    state.read_cell = 0
    state.read_phase = 0
    state.write_cell = 0
    state.write_phase = 0
    state.wait = params.lead
    if int64(params.recall) == 1:
        # Before tick 0 the first cell counts as many times as the window is wide.
        first = int64(memory[int64(state.generation), 0, int64(params.smooth_word)])
        state.window = (2 * int64(params.smooth) + 1) * first
        for k in range(1, SMOOTH_MAX):
            if k < int64(params.smooth):
                slide(params, state, memory, k - int64(params.smooth))


@step
def slide(params: Record, state: Record, memory: Array, here: Int) -> None:
    """Moves the window of the moving average from cell `here` - 1 to `here`; beyond both ends the
    first and the last cell go on."""
    generation = int64(state.generation)
    word = int64(params.smooth_word)
    half = int64(params.smooth)
    last = int64(params.cells) - 1
    enters = int64(memory[generation, clamp(here + half, int64(0), last), word])
    leaves = int64(memory[generation, clamp(here - 1 - half, int64(0), last), word])
    most = (2 * half + 1) << 31
    state.window = clamp(int64(state.window) + enters - leaves, -most, most)


@step
def recall(params: Record, state: Record, memory: Array, cell: Record) -> None:
    """`cell.ahead` and `cell.smooth` for the current tick."""
    here = int64(state.read_cell)
    later = min(here + int64(params.ahead), int64(params.cells) - 1)
    for w in range(AHEAD_WORDS):
        cell.ahead[w] = memory[int64(state.generation), later, w]
    slide(params, state, memory, here)
    # |window| <= 2^31 (2 smooth + 1): the product stays below 2^62.
    cell.smooth = sat32(round_shift(int64(state.window) * int64(params.smooth_weight), 30))


@step
def gather_along(params: Record, state: Record, memory: Array, cell: Record, position: Int) -> None:
    """`cell.before` at `position`; before the first and beyond the last cell, that cell's."""
    pitch = int64(params.pitch)
    last = int64(params.cells) - 1
    place = clamp(position, int64(0), last * pitch)
    here = place // max(pitch, int64(1))
    ahead = min(here + 1, last)
    delta = ((place - here * pitch) << 30) // max(pitch, int64(1))  # of the cell ahead
    delta = clamp(delta, int64(0), int64(ONE))
    live = 1 - int64(state.generation)
    for w in range(WORDS_MAX):
        if w < int64(params.words):
            near = int64(memory[live, here, w])
            far = int64(memory[live, ahead, w])
            cell.before[w] = sat32(near + round_shift((far - near) * delta, 30))
    state.read_cell = here
    state.read_phase = delta


@step
def scatter_along(params: Record, state: Record, memory: Array, cell: Record) -> None:
    """Shares `cell.learn` between the two cells that `gather_along` has read."""
    here = int64(state.read_cell)
    ahead = min(here + 1, int64(params.cells) - 1)
    delta = int64(state.read_phase)
    live = 1 - int64(state.generation)
    for w in range(WORDS_MAX):
        if w < int64(params.words):
            low = int64(params.low[w])
            high = int64(params.high[w])
            learn = int64(cell.learn[w])
            near = int64(memory[live, here, w]) + round_shift(learn * (ONE - delta), 30)
            memory[live, here, w] = clamp(near, low, high)
            far = int64(memory[live, ahead, w]) + round_shift(learn * delta, 30)
            memory[live, ahead, w] = clamp(far, low, high)


@step
def gather(params: Record, state: Record, memory: Array, cell: Record, position: Int) -> None:
    """`cell.before` for the current tick, with the train at `position` (m, Q15) from the start of
    the timetable, and the read position one tick on."""
    words = int64(params.words)
    if int64(params.pitch) > 0:
        gather_along(params, state, memory, cell, position)
    elif words > 0:
        generation = int64(state.generation)
        decimation = int64(params.decimation)
        here = int64(state.read_cell)
        phase = int64(state.read_phase)
        last = int64(params.cells) - 1
        # Distance from the cell's centre in half ticks; the neighbour on that side has the weight
        # |offset| / (2 D).
        offset = 2 * phase - (decimation - 1)
        neighbour = here
        if int64(params.linear) == 1:
            neighbour = here + 1 if offset > 0 else here - 1
        weight = abs(offset) * int64(params.weight)
        here = clamp(here, int64(0), last)
        neighbour = clamp(neighbour, int64(0), last)
        scale = int64(params.scale)
        for w in range(WORDS_MAX):
            if w < words:
                near = int64(memory[generation, here, w])
                far = int64(memory[generation, neighbour, w])
                value = near + round_shift((far - near) * weight, 30)
                cell.before[w] = sat32(value * scale)
        if int64(params.recall) == 1:
            recall(params, state, memory, cell)
        phase += 1
        if phase >= decimation:
            phase = int64(0)
            here = int64(state.read_cell) + 1
            state.read_cell = min(here, last)
        state.read_phase = phase


@step
def scatter(params: Record, state: Record, memory: Array, cell: Record) -> None:
    """Takes `cell.learn` of the current tick; closes the cell with its last tick."""
    words = int64(params.words)
    if int64(params.pitch) > 0:
        scatter_along(params, state, memory, cell)
    elif words > 0:
        if int64(state.wait) > 0:
            state.wait = int64(state.wait) - 1
        else:
            for w in range(WORDS_MAX):
                if w < words:
                    total = int64(state.total[w]) + int64(cell.learn[w])
                    state.total[w] = clamp(total, -int64(TOTAL_MAX), int64(TOTAL_MAX))
            decimation = int64(params.decimation)
            # Behind the last cell it stays full.
            state.write_phase = min(int64(state.write_phase) + 1, decimation)
            if int64(state.write_phase) >= decimation:
                close_cell(params, state, memory)


@step
def close_cell(params: Record, state: Record, memory: Array) -> None:
    """Adds the mean increment of the open cell to its value in the generation that is written;
    opens the next."""
    ticks = int64(state.write_phase)
    here = int64(state.write_cell)
    if ticks > 0 and here < int64(params.cells):
        scale = int64(params.scale)
        read = int64(state.generation)
        for w in range(WORDS_MAX):
            if w < int64(params.words):
                total = int64(state.total[w])
                mean = total if ticks == 1 else divide_round(total, ticks)
                before = int64(memory[read, here, w]) * scale
                there = here
                if int64(params.recall) == 1:
                    before = int64(0)
                    if w >= int64(params.late_word):
                        there = max(here - 1, int64(0))  # that of tick 0 is replaced by tick 1
                value = clamp(before + mean, int64(params.low[w]), int64(params.high[w]))
                if scale != 1:
                    highest = INT32_MAX // max(scale, int64(1))
                    value = min(divide_round(value, scale), highest)  # rounds up to 2^15
                memory[1 - read, there, w] = value
                state.total[w] = 0
        state.write_phase = 0
        state.write_cell = here + 1


def initial_memory(params: np.void, dtype: type = np.int32) -> np.ndarray:
    """Memory [2, cells, words] before the first run, all cells at `initial`."""
    cells, words = int(params["cells"]), int(params["words"])
    memory: np.ndarray = np.zeros((2, cells, words), dtype)
    scale = int(params["scale"])
    nearest = (params["initial"][:words].astype(np.int64) + scale // 2) // scale
    memory[:] = np.minimum(nearest, INT32_MAX // scale)
    return memory


def start_run(state: np.void, memory: np.ndarray) -> None:
    """The generation that will be written starts as a copy: cells that this run does not reach
    keep their value."""
    read = int(state["generation"])
    memory[1 - read] = memory[read]


def end_run(params: np.void, state: np.void, memory: np.ndarray, keep: bool) -> None:
    """Closes the open cell with the ticks that it had and, if the run is kept, makes it the one
    that is read."""
    if int(params["words"]) == 0:
        return
    if int(params["pitch"]) == 0:
        close_cell(params, state, memory)
    if keep:
        state["generation"] = 1 - int(state["generation"])
