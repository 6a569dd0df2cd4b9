"""Train-control laws as fixed-point firmware, run against a train plant over CAN.

The folders of the repository are the packages in here, by links: `ato_hil.can_dbc`, `.controller`,
`.plant_sim`, `.tools`. A law of one's own imports from `ato_hil.law`.
"""
