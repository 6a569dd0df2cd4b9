"""The root of all errors about what a user gave."""


class InputError(ValueError):
    """Bad input: a scenario, law, DBC, bus name, file, environment. Its text is one line that names
    file, key and what was expected."""
