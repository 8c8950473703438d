"""What a stability case is: inputs, a differentiable computation, a truth in float64, and the outcome that is right."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

Group = Literal["geometry", "compositing", "decay", "losses", "autocast", "training"]
Tensors = Mapping[str, Tensor]
Compute = Callable[[Tensors], Tensors]
"""differentiable: named inputs -> named outputs, in the dtype and on the device of the inputs"""


class StabilityError(RuntimeError):
    """A report that could not be made, or some cases did not come out right; the message names them."""


@dataclass(frozen=True)
class Setting:
    """What computes: a backend in a dtype."""

    backend: str
    dtype: torch.dtype

    @property
    def device(self) -> str:
        return "cuda" if self.backend == "gsplat" else "cpu"

    @property
    def precision(self) -> str:
        """`float32` and the like."""
        return str(self.dtype).removeprefix("torch.")


@dataclass(frozen=True)
class Value:
    """Right: finite, and as near to the truth as the dtype allows."""

    value: float = 2e-5
    """greatest error of any output in float32, relative to the output's largest magnitude (at least 1)"""
    gradient: float = 1e-4
    """greatest error of any gradient in float32, relative to that gradient's norm"""
    exact_value: float = 1e-9
    """the same in float64"""
    exact_gradient: float = 1e-6

    def tolerances(self, dtype: torch.dtype) -> tuple[float, float]:
        return (self.exact_value, self.exact_gradient) if dtype == torch.float64 else (self.value, self.gradient)

    def __str__(self) -> str:
        return "value"


@dataclass(frozen=True)
class Bounded:
    """Right at a kink, where the gradient has no one value: a finite value near to the truth, a bounded gradient."""

    gradient: float
    """greatest norm of the gradient, of any dtype"""
    value: float = 2e-5
    """as in `Value`"""
    exact_value: float = 1e-9

    def __str__(self) -> str:
        return "value, bounded gradient"


@dataclass(frozen=True)
class Nothing:
    """Right: exactly what an empty scene gives, and gradients that are exactly zero."""

    def __str__(self) -> str:
        return "zero"


@dataclass(frozen=True)
class Refused:
    """Right: an error of this type whose message matches."""

    error: type[Exception]
    message: str
    """regular expression"""

    def __str__(self) -> str:
        return self.error.__name__


Expected = Value | Bounded | Nothing | Refused


@dataclass(frozen=True)
class Case:
    """One row of the table of cases: one question, put to every backend and dtype."""

    group: Group
    name: str
    inputs: Callable[[], Tensors]
    """float64; rounded to float32 before use, so that every dtype sees the same numbers"""
    compute: Callable[[Setting], Compute]
    truth: Callable[[Tensors], Sequence[Tensors]] | None
    """the right outputs, differentiable, from float64 inputs. Several where the input lies on a threshold: each element
    may then agree with any of them. None: `compute` in float64 torch"""
    expected: Expected
    settings: tuple[Setting, ...]
    units: Callable[[Tensors], Tensors] = field(default=lambda inputs: {})
    """factors that make a gradient one per natural unit: per pixel, per relative change, per radian"""
    fixed: frozenset[str] = frozenset()
    """inputs that need no gradient"""
    autocast: torch.dtype | None = None
    """half precision that forward and backward are asked to use, but not the truth"""
    large: bool = False
    """too long for the tests"""

    @property
    def id(self) -> str:
        return f"{self.group}: {self.name}"


@dataclass(frozen=True)
class Row:
    """What one setting made of one case."""

    group: str
    case: str
    backend: str
    dtype: str
    expected: str
    outcome: str
    """`value`, `zero`, `truth` (what the others are compared with), `not finite`, or the error with its message"""
    value_error: float | None
    """relative to the output's largest magnitude (at least 1); None where there is no picture to compare"""
    gradient_error: float | None
    """greatest relative error over all inputs' gradients; None where the truth is a bound"""
    finite: bool
    """all outputs and gradients"""
    milliseconds: float | None
    """forward and backward"""
    passed: bool
    note: str = ""
    """what else there is to say; `rmse`, loss and guard of a training run"""
