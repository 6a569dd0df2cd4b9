"""The world: train dynamics, track, sensors, actuators, ATP, scenarios, and the process that runs
them."""
