"""Tasks over processes: all are done, each once, whatever dies meanwhile."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import process
from pathlib import Path

import pytest

from ato_hil.tools.session.spread import Lost, cores, spread


def square(number: int) -> int:
    return number * number


def die(task: tuple[str, int]) -> str:
    """Kills its process the first so many times that it is begun."""
    file, times = task
    begun = Path(file)
    count = int(begun.read_text()) + 1 if begun.exists() else 1
    begun.write_text(str(count))
    if count <= times:
        os.kill(os.getpid(), signal.SIGKILL)
    return f"begun {count} times"


def raises(number: int) -> int:
    if number == 1:
        raise ValueError("one")
    time.sleep(60.0)
    return number


def test_every_task_is_done_once_and_taken_as_workers_are_free() -> None:
    taken = []

    def tasks():
        for number in range(20):
            taken.append(number)
            yield number

    made = spread(square, tasks(), 2)
    results = [next(made)]
    assert len(taken) <= 4
    results += made
    assert sorted(results) == [(number, number * number) for number in range(20)]


def test_no_task_needs_no_process() -> None:
    assert list(spread(square, [])) == []
    assert cores() >= 1


def test_a_task_whose_process_is_killed_is_made_again_once(tmp_path: Path) -> None:
    tasks = [(str(tmp_path / f"{times}"), times) for times in (0, 1, 2)]
    results = dict(spread(die, tasks, 2))
    assert results == {0: "begun 1 times", 1: "begun 2 times", 2: Lost(2)}
    assert (tmp_path / "2").read_text() == "2"


def test_an_error_ends_all(tmp_path: Path) -> None:
    before = set(multiprocessing.active_children())
    with pytest.raises(ValueError, match="one"):
        list(spread(raises, [0, 1], 2))
    assert set(multiprocessing.active_children()) <= before


def test_what_lies_in_the_users_folder_is_not_imported(tmp_path: Path) -> None:
    script = (
        "from ato_hil.tools.session.spread import spread\n"
        "import os\n"
        "if __name__ == '__main__':\n"
        "    print(list(spread(os.getenv, ['PYTHONSAFEPATH'], 1)))\n"
    )
    (tmp_path / "numpy.py").write_text("raise SystemExit('imported')")
    done = subprocess.run(
        [sys.executable, "-P", "-c", script],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.strip() == "[(0, '1')]", done.stderr


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="looks for children in /proc")
def test_workers_end_with_a_parent_that_is_killed(tmp_path: Path) -> None:
    script = (
        "from ato_hil.tools.session.spread import spread\n"
        "import time\n"
        "print(list(spread(time.sleep, [0.0, 60.0], 1))) if __name__ == '__main__' else None\n"
    )
    parent = subprocess.Popen([sys.executable, "-P", "-c", script])
    listed = Path(f"/proc/{parent.pid}/task/{parent.pid}/children")
    workers: list[int] = []
    while len(workers) < 2 and parent.poll() is None:  # the worker, and the tracker of resources
        time.sleep(0.05)
        workers = [int(word) for word in listed.read_text().split()]
    time.sleep(1.0)
    parent.kill()
    parent.wait()
    ended = time.monotonic() + 60.0
    while any(Path(f"/proc/{worker}/cmdline").is_file() and
              Path(f"/proc/{worker}/cmdline").read_text() for worker in workers):  # fmt: skip
        assert time.monotonic() < ended, "a worker is still there"
        time.sleep(0.1)


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGTERM])
def test_a_terminal_that_is_closed_ends_all_without_a_word(number: signal.Signals) -> None:
    script = (
        "from ato_hil.tools.cli.console import end_as_with_ctrl_c\n"
        "from ato_hil.tools.session.spread import spread\n"
        "import time\n"
        "if __name__ == '__main__':\n"
        "    end_as_with_ctrl_c()\n"
        "    try:\n"
        "        for _ in spread(time.sleep, [0.0, 60.0], 1):\n"
        "            print('one', flush=True)\n"
        "    except KeyboardInterrupt:\n"
        "        raise SystemExit(130)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-P", "-c", script],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline() == "one\n"
        os.killpg(parent.pid, number)  # as the system does: to all of them
        _said, why = parent.communicate(timeout=60)
    assert (parent.returncode, why) == (130, "")


def test_ctrl_c_while_a_process_is_begun_waits_until_it_can_be_ended(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    start = process._ExecutorManagerThread.start

    def with_ctrl_c(thread: process._ExecutorManagerThread) -> None:
        signal.raise_signal(signal.SIGINT)
        start(thread)

    monkeypatch.setattr(process._ExecutorManagerThread, "start", with_ctrl_c)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            next(spread(square, range(3), 2))
    finally:
        signal.signal(signal.SIGINT, before)
    assert multiprocessing.active_children() == []
