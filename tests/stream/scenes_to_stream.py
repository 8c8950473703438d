"""Small random scenes of several levels, and servers that do what servers should not."""

import threading
from contextlib import contextmanager
from dataclasses import replace
from typing import ClassVar

import torch
from fake_run import fake_run, fake_views

from freqgs_plugin.stream.scene import StreamScene
from freqgs_plugin.stream.server import Handler, Server


def small_scene(n=600, levels=3, decay=False, width=80, height=60):
    """Larger Gaussians on coarser levels, harmonics of degree 1; seen from around."""
    run = fake_run(levels, n)
    shrink = 0.6 ** (run.gaussians.level - 1).float()
    gaussians = replace(run.gaussians, scales=run.gaussians.scales * shrink[:, None])
    if decay:
        gaussians = replace(gaussians, decay=torch.linspace(-0.05, 2.0, n))
    views = fake_views(3, width, height)
    return StreamScene(
        gaussians,
        run.background,
        True,
        2.0 if decay else None,
        [view.camera for view in views],
        [(view.name, view.camera) for view in views],
        "numba",
    )


@contextmanager
def served(folder, handler=Handler, mbits=None):
    """The address of a server."""
    with Server(folder, mbits=mbits, handler=handler) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


class Recording(Handler):
    """Keeps what was asked for."""

    asked: ClassVar[list] = []

    def do_GET(self):
        self.asked.append((self.path, self.headers.get("Range")))
        super().do_GET()


def deaf():
    """Ignores ranges."""

    class Deaf(Recording):
        asked: ClassVar[list] = []

        def do_GET(self):
            self.asked.append((self.path, self.headers.get("Range")))
            if "Range" in self.headers:
                del self.headers["Range"]
            Handler.do_GET(self)

    return Deaf


def breaking(after, times, wait=lambda: None):
    """Closes the line after so many bytes of the file of chunks, and `wait()`, so many times.

    What was sent and not read yet may be lost with the line.
    """

    class Breaking(Recording):
        asked: ClassVar[list] = []
        left = times

        def _send(self, stream, count):
            if not self.path.endswith(".bin") or type(self).left == 0:
                return super()._send(stream, count)
            type(self).left -= 1
            super()._send(stream, min(after, count))
            self.wfile.flush()
            wait()
            self.close_connection = True
            self.connection.shutdown(2)

    return Breaking


def damaging(at, times):
    """Flips a bit at this byte of the file of chunks, so many times."""

    class Damaging(Recording):
        asked: ClassVar[list] = []
        left = times

        def _send(self, stream, count):
            start = stream.tell()
            if not self.path.endswith(".bin") or not start <= at < start + count or type(self).left == 0:
                return super()._send(stream, count)
            type(self).left -= 1
            data = bytearray(stream.read(count))
            data[at - start] ^= 64
            self.wfile.write(data)

    return Damaging


def stalling(after):
    """Sends so many bytes of the file of chunks, and waits for `go`."""

    class Stalling(Recording):
        asked: ClassVar[list] = []
        go = threading.Event()

        def _send(self, stream, count):
            if self.path.endswith(".bin") and not self.go.is_set():
                super()._send(stream, min(after, count))
                self.wfile.flush()
                self.go.wait(60)
                count -= min(after, count)
            super()._send(stream, count)

    return Stalling
