"""A child process whose output is read line by line."""

import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

PATIENCE = 20
"""seconds between asking a child to end and making it"""


@contextmanager
def child(command: Sequence[str], env: Mapping[str, str] | None = None) -> "Iterator[subprocess.Popen[str]]":
    """Run `command` for a block: output and errors are its `stdout`; if the block is left early, it is ended.

    A session of its own keeps Ctrl-C from the child, so that we end it in an orderly way.
    """
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
