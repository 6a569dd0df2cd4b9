"""Tasks over a cluster that Dask has: `spread.spread` with the workers of a scheduler in place of
processes of this machine. From the extra `ato-hil[dask]`.

Dask gives a task whose worker has died to another one. A scheduler of our own (`local`) does so
once; another's does it as its `distributed.scheduler.allowed-failures` says.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator, Iterable
from contextlib import ExitStack
from typing import Any

from ato_hil.can_dbc.child import safe_path
from ato_hil.can_dbc.errors import InputError
from ato_hil.tools.session.spread import ATTEMPTS, Lost, cores

LOCAL = "local"
TASKS_EACH = 2  # that a thread of a worker has: one under way, one that waits
CONNECT_S = 20


def spread(
    function: Callable[[Any], Any],
    tasks: Iterable[Any],
    address: str,
    workers: int | None = None,
) -> Generator[tuple[int, Any], None, None]:
    """(place of a task, its result or `Lost`) as they are done, by the workers of the scheduler at
    `address`; with LOCAL, by `workers` processes of this machine, one for each core by default.

    Raises InputError if there is no Dask or no scheduler, and what the function raises.
    """
    try:
        import dask
        from distributed import Client, LocalCluster, as_completed
        from distributed.scheduler import KilledWorker
    except ImportError:
        text = "--dask needs Dask, which is not installed: pip install 'ato-hil[dask]'"
        raise InputError(text) from None
    given = enumerate(tasks)
    with ExitStack() as held:
        held.enter_context(safe_path())  # also of workers that are started in place of dead ones
        if address == LOCAL:
            once = {"distributed.scheduler.allowed-failures": ATTEMPTS - 1}
            held.enter_context(dask.config.set(once))
            cluster = LocalCluster(
                n_workers=workers or cores(),
                threads_per_worker=1,
                dashboard_address=None,
                silence_logs=logging.CRITICAL,
            )
            place: Any = held.enter_context(cluster)
        else:
            place = address
        try:
            client = held.enter_context(Client(place, timeout=CONNECT_S, set_as_default=False))
        except (OSError, ValueError) as error:
            raise InputError(f"--dask {address}: no scheduler answers there: {error}") from None
        busy: dict[Any, int] = {}
        done = as_completed(loop=client.loop)

        def give() -> None:
            """As many tasks as the workers that are there now have room for."""
            room = max(TASKS_EACH * sum(client.nthreads().values()), 1)
            while len(busy) < room and (task := next(given, None)) is not None:
                future = client.submit(function, task[1], pure=False)
                busy[future] = task[0]
                done.add(future)

        give()
        for future in done:
            index = busy.pop(future)
            try:
                result = future.result()
            except KilledWorker:
                result = Lost(ATTEMPTS)
            future.release()
            give()  # before the caller takes its time
            yield index, result
