"""Where the viewer's users have clicked, each in a picture of their own."""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from freqgs_plugin.types import Camera

Vector = tuple[float, float, float]


@dataclass
class Places:
    """What one client has clicked."""

    gaze: tuple[float, float] | None = None
    """shares of the picture's width and height: it stays there on the screen while the camera moves"""
    ray: tuple[Vector, Vector] | None = None
    """origin (world units) and direction of a click that no picture has followed yet"""
    target: tuple[Vector, float] | None = None
    """the point in the world that was clicked, and how far it was from the camera then (world units)"""


class Clicks:
    """Clicked places by client: nerfstudio shares its controls among all of them, and draws for each in a thread."""

    def __init__(self) -> None:
        self._places: dict[int | None, Places] = {}
        self._waiting: dict[int, tuple[str, Any]] = {}

    def of(self, client_id: int | None) -> Places:
        return self._places.setdefault(client_id, Places())

    def here(self) -> Places:
        """Of the client for whom this thread draws."""
        client = getattr(threading.current_thread(), "client", None)
        return self.of(None if client is None else client.client_id)

    def forget(self, client_id: int) -> None:
        """The client has left."""
        self._places.pop(client_id, None)
        self._waiting.pop(client_id, None)

    def next(self, client: Any, about: str, act: Callable[[Any], None]) -> None:
        """Call `act` with viser's event of the client's next click in the picture. Until then it cannot be dragged."""

        @client.scene.on_pointer_event(event_type="click")
        def clicked(event: Any) -> None:
            self._stop(client)
            act(event)

        self._waiting[client.client_id] = (about, client)

    def cancel(self, about: str) -> None:
        """Wait for no click that is meant for this any longer, of any client."""
        for what, client in list(self._waiting.values()):
            if what == about:
                self._stop(client)

    def _stop(self, client: Any) -> None:
        if self._waiting.pop(client.client_id, None) is not None:
            client.scene.remove_pointer_callback()


def sight(origin: Vector, direction: Vector, like: Float[Tensor, "n 3"]) -> Camera:
    """A camera of one pixel that looks along a ray: depth is the distance along it, world units."""
    z = torch.nn.functional.normalize(torch.tensor(direction, dtype=torch.float64), dim=0)
    # any axis that the ray is not parallel to
    other = torch.eye(3, dtype=torch.float64)[int(z.abs().argmin())]
    x = torch.nn.functional.normalize(torch.linalg.cross(other, z), dim=0)
    rotation = torch.stack([x, torch.linalg.cross(z, x), z])
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -(rotation @ torch.tensor(origin, dtype=torch.float64))
    K = torch.tensor([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return Camera(viewmat.to(like.device), K.to(like.device), 1, 1)
