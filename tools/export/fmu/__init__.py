"""FMUs, FMI 3.0 Co-Simulation: the controller, the plant, or the bare train, from the same C that
the other exports are made of.

`variables` says what an importer sees, `description` writes it as XML, `sources` the C, `archive`
the file. `c/` holds what every FMU shares: the functions of FMI, the CAN node of FMI-LS-BUS.
"""
