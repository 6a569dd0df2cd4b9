"""`ato-hil export c`: the firmware as C99, from the Python steps themselves.

`source` reads steps. `translate` turns them into C functions: it has the statements, `expressions`
what stands in them, `places` where variables are declared, `program` the functions that are reached
and their names, `lines` how C is laid out. `records` turns dtypes into structs, `firmware` puts a
law's files together, `folder` writes what a firmware engineer gets; `closed_loop` puts the plant's
steps around it.
"""

from __future__ import annotations

from ato_hil.can_dbc.errors import InputError


class ExportError(InputError):
    """What cannot be exported; one line, with file and line where there is one."""
