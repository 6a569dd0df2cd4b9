"""How runs are made: SIL, MIL, HIL and their processes, faults, real time, replay."""
