"""Parameters of a checkpoint without what says nothing: harmonics of zero, attributes that are all the same.

Rows are sorted by the SH degree that each Gaussian needs, the highest first. The coefficients of band d,
[n_d, 2d+1, 3], are stored for the first n_d rows alone, as `packed_rest.d`; all others are zero. A tensor whose rows
are all equal keeps its shape, and is stored as one row: torch writes it so, and reads it again without being told.
"""

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

_REST, _LEVEL, _BAND = "gauss_params.features_rest", "level", "packed_rest."


def needed_degree(rest: Float[Tensor, "n k 3"]) -> Int[Tensor, " n"]:
    """The highest degree with a coefficient that is not 0; 0 where there is none."""
    degree = torch.zeros(len(rest), dtype=torch.int64, device=rest.device)
    for d in range(1, round((rest.shape[1] + 1) ** 0.5)):
        degree[(rest[:, d * d - 1 : (d + 1) ** 2 - 1] != 0).flatten(1).any(1)] = d
    return degree


def packing_order(rest: Float[Tensor, "n k 3"]) -> Int[Tensor, " n"]:
    """Rows in the order that `pack` asks for, otherwise as they were."""
    return torch.argsort(needed_degree(rest), descending=True, stable=True)


def pack(state: Mapping[str, Any]) -> dict[str, Any]:
    """A model's state, rows in `packing_order`, with nothing stored twice.

    Raises:
        ValueError: rows in another order.
    """
    packed = {name: _one_row(value) if _is_rows(name) else value for name, value in state.items()}
    level = state[_LEVEL]
    if not len(level) or int(level.max()) < 256:
        packed[_LEVEL] = _one_row(level.to(torch.uint8))
    rest = packed.pop(_REST)
    degree = needed_degree(rest)
    if len(degree) and bool((degree.diff() > 0).any()):
        raise ValueError("rows are not sorted by the degree that they need; take them in `packing_order` first.")
    if not rest.shape[1]:
        packed[_REST] = rest
    for d in range(1, round((rest.shape[1] + 1) ** 0.5)):
        needing = int((degree >= d).sum())
        packed[f"{_BAND}{d}"] = rest[:needing, d * d - 1 : (d + 1) ** 2 - 1].clone()
    return packed


def unpack(state: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """What `pack` was given; names begin with `prefix`. A state that is not packed is returned as it is.

    Raises:
        ValueError: bands are missing, or have shapes that do not belong together.
    """
    begin = f"{prefix}{_BAND}"
    bands = {name.removeprefix(begin): value for name, value in state.items() if name.startswith(begin)}
    plain = {name: value for name, value in state.items() if not name.startswith(begin)}
    level = plain.get(f"{prefix}{_LEVEL}")
    if isinstance(level, Tensor) and level.dtype == torch.uint8:
        plain[f"{prefix}{_LEVEL}"] = level.to(torch.int32)
    if not bands:
        return plain
    means = state[f"{prefix}gauss_params.means"]
    highest = len(bands)
    rest = means.new_zeros(len(means), (highest + 1) ** 2 - 1, 3)
    for d in range(1, highest + 1):
        band = bands.get(str(d))
        if band is None or band.shape[1:] != (2 * d + 1, 3) or len(band) > len(means):
            shape = "is missing" if band is None else f"has the shape {list(band.shape)}"
            raise ValueError(
                f"the packed harmonics of degree {d} of {len(means):,} Gaussians: {shape}. The checkpoint is damaged; "
                "copy it again, or trim the run again."
            )
        rest[: len(band), d * d - 1 : (d + 1) ** 2 - 1] = band
    plain[f"{prefix}{_REST}"] = rest
    return plain


def constant_rows(state: Mapping[str, Any]) -> list[str]:
    """Attributes of which all Gaussians have the same value."""
    names = (name for name, value in state.items() if _is_rows(name) and len(value) > 1 and value[0].numel())
    return [name.removeprefix("gauss_params.") for name in names if _is_one_row(state[name])]


def _is_rows(name: str) -> bool:
    return name.startswith("gauss_params.") or name == _LEVEL


def _is_one_row(value: Tensor) -> bool:
    return len(value) > 0 and bool((value == value[:1]).all())


def _one_row(value: Tensor) -> Tensor:
    return value[:1].clone().expand_as(value) if _is_one_row(value) else value.clone()
