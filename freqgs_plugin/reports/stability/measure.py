"""Puts one case to one setting: value error, gradient error, finite or not, time."""

import re
import time
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from freqgs_plugin.reports.stability.case import Bounded, Case, Compute, Nothing, Refused, Row, Setting, Tensors, Value

TRUTH = Setting("torch", torch.float64)
LEAST_SHARE = 1e-3
"""a gradient whose norm is under this share of the largest one's is compared with that share instead"""

NEGLIGIBLE = 1e-30
"""norm of a difference of gradients that counts as none"""


@dataclass(frozen=True)
class Evaluated:
    """Outputs, and the gradients of a fixed random functional of them."""

    outputs: dict[str, Tensor]
    gradients: dict[str, Tensor]


def evaluate(case: Case, compute: Compute, dtype: torch.dtype, device: str = "cpu") -> Evaluated:
    """Forward and backward on the case's inputs, rounded to float32 and then cast to `dtype`."""
    leaves = _leaves(case, dtype, device)
    with torch.autocast(device, dtype=case.autocast, enabled=case.autocast is not None):
        return _differentiate(leaves, [compute(leaves)])[0]


def truths(case: Case) -> list[Evaluated]:
    """The right answers, in float64; several where the case lies on a threshold."""
    leaves = _leaves(case, torch.float64, "cpu")
    if case.truth is None:
        return _differentiate(leaves, [case.compute(TRUTH)(leaves)])
    return _differentiate(leaves, case.truth(leaves))


def measure(case: Case, setting: Setting, answers: Sequence[Evaluated] | None = None, repeats: int = 3) -> Row:
    """The row of `case` for `setting`. `answers` saves computing `truths(case)` anew.

    The time is the median of `repeats` runs after the first; with 0, that of the first.
    """
    try:
        compute = case.compute(setting)
        actual, first = _timed(case, compute, setting)
        times = sorted(_timed(case, compute, setting)[1] for _ in range(repeats))
        milliseconds = times[repeats // 2] if repeats else first
    except Exception as error:  # any error at all is an outcome
        return _refused(case, setting, error)
    tensors = [*actual.outputs.values(), *actual.gradients.values()]
    finite = all(bool(torch.isfinite(t).all()) for t in tensors)
    if finite and case.truth is None and setting == TRUTH and isinstance(case.expected, Value):
        return _row(case, setting, "truth", None, None, True, milliseconds, True)
    if answers is None:
        answers = [] if isinstance(case.expected, Refused) else truths(case)
    value_error = gradient_error = None
    if finite and answers:
        value_error = max(
            (_value_error(actual.outputs[k], [a.outputs[k] for a in answers]) for k in answers[0].outputs), default=0.0
        )
        units = case.units(_leaves(case, torch.float64, "cpu"))
        gradient_error = min(_gradient_error(actual.gradients, a.gradients, units) for a in answers)
    expected = case.expected
    passed = False
    if finite and value_error is not None and gradient_error is not None:
        if isinstance(expected, Value):
            bounds = expected.tolerances(setting.dtype)
            passed = value_error <= bounds[0] and gradient_error <= bounds[1]
        elif isinstance(expected, Nothing):
            zero = not any(bool(g.any()) for k, g in actual.gradients.items() if k != "background")
            passed = value_error == 0 and zero
        elif isinstance(expected, Bounded):
            tolerance = expected.exact_value if setting.dtype == torch.float64 else expected.value
            largest = max(float(g.norm()) for g in actual.gradients.values())
            passed, gradient_error = value_error <= tolerance and largest <= expected.gradient, None
    outcome = "not finite" if not finite else "zero" if isinstance(expected, Nothing) and passed else "value"
    return _row(case, setting, outcome, value_error, gradient_error, finite, milliseconds, passed)


def _row(
    case: Case,
    setting: Setting,
    outcome: str,
    value_error: float | None,
    gradient_error: float | None,
    finite: bool,
    milliseconds: float | None,
    passed: bool,
) -> Row:
    of_case = (case.group, case.name, setting.backend, setting.precision, str(case.expected))
    return Row(*of_case, outcome, value_error, gradient_error, finite, milliseconds, passed)


def _leaves(case: Case, dtype: torch.dtype, device: str) -> dict[str, Tensor]:
    leaves = {}
    for name, value in case.inputs().items():
        if value.is_floating_point():
            value = value.detach().float().to(device, dtype, copy=True)
            value.requires_grad_(name not in case.fixed)
        leaves[name] = value
    return leaves


def _differentiate(leaves: Tensors, several: Sequence[Tensors]) -> list[Evaluated]:
    wanted = {name: leaf for name, leaf in leaves.items() if leaf.requires_grad}
    results = []
    for outputs in several:
        total = None
        for seed, (_, output) in enumerate(sorted(outputs.items())):
            if output.requires_grad:
                generator = torch.Generator().manual_seed(seed)
                weights = torch.randn(output.shape, generator=generator, dtype=torch.float64).to(output)
                term = (output * weights).sum()
                total = term if total is None else total + term
        gradients: dict[str, Tensor] = {name: torch.zeros_like(leaf) for name, leaf in wanted.items()}
        if total is not None and wanted:
            found = torch.autograd.grad(total, list(wanted.values()), allow_unused=True)
            gradients.update({n: g for n, g in zip(wanted, found, strict=True) if g is not None})
        results.append(Evaluated({k: v.detach().cpu() for k, v in outputs.items()}, _on_cpu(gradients)))
    return results


def _on_cpu(tensors: Tensors) -> dict[str, Tensor]:
    return {name: tensor.detach().cpu() for name, tensor in tensors.items()}


def _timed(case: Case, compute: Compute, setting: Setting) -> tuple[Evaluated, float]:
    """With milliseconds."""
    _wait(setting)
    start = time.perf_counter()
    result = evaluate(case, compute, setting.dtype, setting.device)
    _wait(setting)
    return result, 1000 * (time.perf_counter() - start)


def _wait(setting: Setting) -> None:
    if setting.device == "cuda":
        torch.cuda.synchronize()


def _value_error(actual: Tensor, answers: Sequence[Tensor]) -> float:
    """Greatest distance to the nearest answer, relative to the largest magnitude (at least 1)."""
    if actual.numel() == 0:
        return 0.0
    actual = actual.double()
    distance = torch.stack([(actual - answer).abs() for answer in answers]).amin(0)
    largest = max(float(answer.abs().max()) for answer in answers)
    return float(distance.max()) / max(1.0, largest)


def _gradient_error(actual: Tensors, expected: Tensors, units: Tensors) -> float:
    """Greatest relative error of a gradient, as norms over all rows, in natural units."""

    def norm(name: str, gradient: Tensor) -> float:
        return float((gradient.double() * units[name]).norm() if name in units else gradient.double().norm())

    sizes = {name: norm(name, gradient) for name, gradient in expected.items()}
    floor = LEAST_SHARE * max(sizes.values(), default=0.0)
    errors = [0.0]
    for name, gradient in expected.items():
        difference = norm(name, actual[name].double() - gradient)
        size = max(sizes[name], floor)
        errors.append(0.0 if difference <= NEGLIGIBLE else difference / size if size > 0 else float("inf"))
    return max(errors)


def _refused(case: Case, setting: Setting, error: Exception) -> Row:
    expected = case.expected
    passed = False
    if isinstance(expected, Refused):
        passed = isinstance(error, expected.error) and re.search(expected.message, str(error)) is not None
    outcome = f"{type(error).__name__}: {error}".splitlines()[0]
    return _row(case, setting, outcome, None, None, True, None, passed)
