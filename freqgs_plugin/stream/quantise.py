"""Numbers of Gaussians as bytes: exact, or on a grid whose step bounds the error.

A column of numbers is stored as planes of bytes, the most significant first, because deflate finds what repeats there.
Grids lie where errors are seen evenly: logarithms of scales and decays, logits of opacities, asinh of the distance from
the scene's middle, the three smallest components of quaternions. A component that is the same in a whole level takes no
bytes.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int, Shaped

Part = Literal["core", "sh"]
"""what is sent first of a row, and the harmonics above the constant one"""
Warp = Literal["none", "exp", "sigmoid", "sinh", "smallest_three"]
"""from what lies on the grid to the value"""
NAMES = ("means", "scales", "quats", "opacities", "features_dc", "decay", "features_rest")
"""columns of a row, in the order in which they are stored"""
_LOGITS = (-6.0, 8.0)
"""beyond, an opacity is not drawn (1/255), or capped (0.999)"""
_LEAST = 1e-30
_LARGEST_WORD = 2**16 - 1
_LISTS = ("kept", "low", "step", "centre")
_THIRD = math.sqrt(0.5)


@dataclass(frozen=True)
class Steps:
    """Steps of the grids; errors are at most half of them."""

    scales: float
    """natural logarithm"""
    opacities: float
    """logit"""
    quats: float
    """of a component"""
    features_dc: float
    features_rest: float
    """coefficients"""
    decay: float = 0.02
    """natural logarithm"""


VARIANTS: Mapping[str, Steps | None] = {
    "exact": None,
    "fine": Steps(scales=0.02, opacities=0.06, quats=math.sqrt(2) / 1023, features_dc=1 / 128, features_rest=1 / 64),
    "balanced": Steps(scales=0.05, opacities=0.06, quats=math.sqrt(2) / 255, features_dc=1 / 64, features_rest=1 / 32),
    "small": Steps(scales=0.1, opacities=0.12, quats=math.sqrt(2) / 127, features_dc=1 / 32, features_rest=1 / 16),
}
"""name -> steps; None: float32, bit for bit. Positions have 16 bits in their box in all others"""


@dataclass(frozen=True)
class Coding:
    """How one column of a level is stored."""

    name: str
    part: Part
    components: int
    """numbers per row that are stored"""
    size: int
    """bytes per number: 1, 2 or 4; 4 are the bits of a float32"""
    kept: tuple[int, ...]
    """components that vary; the others are `low`"""
    low: tuple[float, ...]
    """value of 0, per component"""
    step: tuple[float, ...]
    """value of 1 minus value of 0, per component; without meaning for float32"""
    warp: Warp = "none"
    centre: tuple[float, ...] = ()
    """of `sinh`: value = centre + scale sinh(number)"""
    scale: float = 1.0

    @property
    def bytes_per_row(self) -> int:
        """Before deflate."""
        return self.size * len(self.kept)

    def json(self) -> dict[str, Any]:
        """Without what has its default; one step where all are the same. `coding_from` reads it."""
        found = {**vars(self), "kept": list(self.kept), "low": list(self.low), "step": list(self.step)}
        if len(self.kept) == self.components:
            del found["kept"]
        if len(set(self.step)) == 1:
            found["step"] = self.step[0]
        if self.warp != "sinh":
            del found["centre"], found["scale"]
        return found


def coding_from(found: Mapping[str, Any]) -> Coding:
    """`Coding.json`, back."""
    count = found["components"]
    values: dict[str, Any] = {"kept": range(count), **found}
    if not isinstance(values["step"], Sequence):
        values["step"] = [values["step"]] * count
    lists = {name: tuple(values[name]) for name in _LISTS if name in values}
    return Coding(**{**values, **lists})


def coding_of(name: str, values: Float[np.ndarray, "n c"], steps: Steps | None) -> Coding:
    """How to store a level's column.

    Raises:
        ValueError: a number is not finite.
    """
    if not np.isfinite(values).all():
        bad = int((~np.isfinite(values)).any(1).sum())
        raise ValueError(f"{name} of {bad} of {len(values)} Gaussians are not finite; remove these Gaussians.")
    part: Part = "sh" if name == "features_rest" else "core"
    if steps is None:
        low = values[0] if len(values) else np.zeros(values.shape[1], np.float32)
        kept = _kept(values.view(np.uint32) != low.view(np.uint32)[None])
        count = values.shape[1]
        return Coding(name, part, count, 4, kept, tuple(map(float, low)), (0.0,) * count)
    warp: Warp = _WARPS.get(name, "none")
    centre, scale = _middle(values) if warp == "sinh" else ((), 1.0)
    numbers = _unwarped(values, warp, centre, scale)
    low, high = (f(0) for f in (numbers.min, numbers.max)) if len(numbers) else (np.zeros(numbers.shape[1]),) * 2
    if name == "means":
        step = np.full(3, max(float((high - low).max()) / _LARGEST_WORD, 1e-12))
    else:
        # coarser where 16 bits would not do
        step = np.maximum(getattr(steps, name), (high - low) / _LARGEST_WORD)
        if warp == "smallest_three":
            step[3] = 1.0
        low = np.floor(low / step) * step
    low, step = low.astype(np.float64), step.astype(np.float64)
    grid = _grid(numbers, low, step)
    size = 1 if grid.size == 0 or grid.max() < 256 else 2
    kept = _kept(grid != grid[:1])
    if len(grid):
        low = np.where(np.isin(np.arange(len(low)), kept), low, low + grid[0] * step)
    return Coding(name, part, len(low), size, kept, tuple(low.tolist()), tuple(step.tolist()), warp, centre, scale)


_WARPS: Mapping[str, Warp] = {
    "means": "sinh",
    "scales": "exp",
    "quats": "smallest_three",
    "opacities": "sigmoid",
    "decay": "exp",
}


def encode_column(coding: Coding, values: Float[np.ndarray, "n c"]) -> bytes:
    """Rows as planes of bytes."""
    if coding.size == 4:
        words: Shaped[np.ndarray, "n k"] = np.ascontiguousarray(values).view(np.uint32)[:, list(coding.kept)]
    else:
        numbers = _unwarped(values, coding.warp, coding.centre, coding.scale)
        words = _grid(numbers, np.array(coding.low), np.array(coding.step))[:, list(coding.kept)]
    shifts = range(8 * (coding.size - 1), -1, -8)
    planes = [(words[:, k] >> shift).astype(np.uint8) for k in range(words.shape[1]) for shift in shifts]
    return b"".join(plane.tobytes() for plane in planes)


def decode_column(coding: Coding, data: bytes, rows: int) -> Float[np.ndarray, "n c"]:
    """`encode_column`, back; `data` holds `rows * coding.bytes_per_row` bytes."""
    planes = np.frombuffer(data, np.uint8).reshape(len(coding.kept), coding.size, rows).astype(np.uint32)
    words = np.zeros((len(coding.kept), rows), np.uint32)
    for plane in range(coding.size):
        words = (words << 8) | planes[:, plane]
    if coding.size == 4:
        exact = np.tile(np.array(coding.low, np.float32), (rows, 1))
        exact[:, list(coding.kept)] = words.T.copy().view(np.float32)
        return exact
    grid = np.zeros((rows, coding.components))
    grid[:, list(coding.kept)] = words.T
    numbers = np.array(coding.low) + grid * np.array(coding.step)
    return _warped(numbers, coding.warp, coding.centre, coding.scale).astype(np.float32)


def _kept(varies: np.ndarray) -> tuple[int, ...]:
    return tuple(np.flatnonzero(varies.any(0)).tolist())


def _grid(numbers: Float[np.ndarray, "n c"], low: np.ndarray, step: np.ndarray) -> Int[np.ndarray, "n c"]:
    return np.clip(np.round((numbers - low) / step), 0, _LARGEST_WORD).astype(np.int64)


def _middle(values: Float[np.ndarray, "n 3"]) -> tuple[tuple[float, ...], float]:
    """Medians of the positions and of how far they lie from there."""
    if not len(values):
        return (0.0, 0.0, 0.0), 1.0
    centre = np.median(values.astype(np.float64), axis=0)
    spread = float(np.median(np.abs(values - centre)))
    return tuple(centre.tolist()), spread if spread > 0 else 1.0


def _unwarped(values: np.ndarray, warp: Warp, centre: tuple[float, ...], scale: float) -> Float[np.ndarray, "n c"]:
    values = values.astype(np.float64)
    if warp == "exp":
        return np.log(np.maximum(values, _LEAST))
    if warp == "sigmoid":
        with np.errstate(divide="ignore"):
            return np.clip(np.log(values) - np.log1p(-values), *_LOGITS)
    if warp == "sinh":
        return np.arcsinh((values - np.array(centre)) / scale)
    return _smallest_three(values) if warp == "smallest_three" else values


def _warped(numbers: np.ndarray, warp: Warp, centre: tuple[float, ...], scale: float) -> Float[np.ndarray, "n c"]:
    if warp == "exp":
        return np.exp(numbers)
    if warp == "sigmoid":
        return 1 / (1 + np.exp(-numbers))
    if warp == "sinh":
        return np.array(centre) + scale * np.sinh(numbers)
    return _quaternion(numbers) if warp == "smallest_three" else numbers


def _smallest_three(quats: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 4"]:
    """The components but the largest, of the unit quaternion in which that one is positive, and which it is."""
    largest = np.abs(quats).argmax(1)[:, None]
    sign = np.where(np.take_along_axis(quats, largest, 1) < 0, -1.0, 1.0)
    unit = sign * quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), _LEAST)
    three = np.take_along_axis(unit, _OTHERS[largest[:, 0]], 1)
    return np.concatenate([np.clip(three, -_THIRD, _THIRD), largest], 1)


def _quaternion(numbers: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 4"]:
    largest = np.round(numbers[:, 3:]).astype(np.int64)
    quats = np.empty_like(numbers)
    np.put_along_axis(quats, _OTHERS[largest[:, 0]], numbers[:, :3], 1)
    rest = np.maximum(1 - np.square(numbers[:, :3]).sum(1, keepdims=True), 0)
    np.put_along_axis(quats, largest, np.sqrt(rest), 1)
    return quats


_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""components but the k-th"""
