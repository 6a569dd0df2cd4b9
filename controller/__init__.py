"""The firmware of one train's controller: fixed-point laws, the cyclic task around them, learning
memory, calibration, and the process that runs them.

Contract. The firmware is one step, `firmware.build_tick(law)`:

    tick(params, profile, state, memory, rx, tx, period)

The caller calls it once a control period with `period` 1, and may call it in between with `period`
0 to have RUN_CTRL answered. It puts what has arrived into the mailboxes `rx`, takes what is to be
sent from `tx`, and clears both; the firmware knows neither bus nor clock nor file. When the run
state changes, the caller closes or opens the run's learning, `node.cycle`. A tick is
`firmware.before_law`, the step of the law, `firmware.after_law`. A law is a step as well,

    law(params, state, cell, inputs, outputs)

of the records in `interface`. Nothing that is in a mailbox, and no order of calls, makes a step
raise, divide by zero or leave its integers: a frame that fails its check is as good as none, and
the guard brakes when one is missing for too long. The same inputs give the same bits, on every
machine and in every mode.

Numbers. Signed integers only: int32 in records, int64 between them, saturated where they are
stored. A quantity at an interface has the format of `q`; a finer one is stated at its field.

Memory. The caller owns all of it: `params` and `profile`, which a tick only reads; `state`, which
outlives runs; `memory`, two generations of learned cells, the one in use and the one being made;
`rx`, `tx`, one mailbox a message of the DBC. Records have no hidden padding and hold no pointers:
their bytes are their content. Steps allocate nothing, for the compiler refuses one that would.

Timing. A tick takes bounded time: loops run over constant ranges or are bounded by one, nothing
waits. `ato-hil verify` counts the instructions of a law, and the time of law and tick beside C. A
frame of tick k is answered within tick k. Reaction times are those that `guard` states.

Threads. No module has a state of its own at run time: controllers are independent, and each may be
in a thread of its own, for compiled steps let the interpreter go. One controller is called by one
thread at a time; its mailboxes are touched between two calls only.

Calibration. The only float code, and no part of a tick: `calibration` makes PARAMS of the firmware
of a scenario's numbers, with the `calibrate` beside the step where a block or law has one.
`quantise.fixed` is the way from SI to integers, and names the key of a number that does not fit.

Where to begin: `interface` (records), `q` (arithmetic), a law (`laws/pid.py` is the shortest),
`firmware`, `guard`. `registry.Law` lists what a law's file has. Imports: this package knows
`can_dbc`, and never the plant.
"""
