"""The firmware: fixed-point laws, the cyclic task, learning memory, and the process that runs
them."""
