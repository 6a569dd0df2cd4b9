"""`python -m ato_hil` is the command `ato-hil`."""

from ato_hil.tools.cli.main import main

if __name__ == "__main__":
    main()
