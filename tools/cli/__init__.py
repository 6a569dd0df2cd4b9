"""The command line `ato-hil`, its doctor, and the pages made from it."""
