"""A child process whose output is read line by line."""

import signal
import subprocess
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

PATIENCE = 20
"""seconds between asking a child to end and making it"""


@contextmanager
def child(command: Sequence[str], env: Mapping[str, str] | None = None) -> "Iterator[subprocess.Popen[str]]":
    """Run `command` for a block: output and errors are its `stdout`; if the block is left early, it is ended.

    A session of its own keeps Ctrl-C from the child, so that we end it in an orderly way. So do we when we are told to
    end (SIGTERM): a training that nobody waits for would go on, and write.
    """
    with ended_by_exception(), _running(command, env) as process:
        yield process


@contextmanager
def ended_by_exception() -> Iterator[None]:
    """SIGTERM raises SystemExit(143), so that blocks are left in order; signals reach the main thread only."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(number: int, frame: object) -> None:
        raise SystemExit(128 + number)

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def _running(command: Sequence[str], env: Mapping[str, str] | None) -> "Iterator[subprocess.Popen[str]]":
    process = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        env=env,
        start_new_session=True,
    )
    try:
        assert process.stdout is not None
        with process.stdout:
            yield process
        process.wait()
    finally:
        if process.poll() is None:
            process.terminate()
            try:
                process.wait(PATIENCE)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
