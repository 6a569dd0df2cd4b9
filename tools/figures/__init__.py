"""The papers' figures from the folders that `ato-hil run` leaves: one file a paper."""
