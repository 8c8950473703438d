"""Which points no other point beats."""

import math
from collections.abc import Sequence


def pareto_front(points: Sequence[tuple[float | int, float | int]]) -> list[int]:
    """Numbers of the points (cost, error) that no other one beats in one and equals or beats in the other, by cost.

    Of equal points the first counts. Points that are not finite never do.
    """
    numbers = [i for i, point in enumerate(points) if all(math.isfinite(value) for value in point)]
    front, least = [], math.inf
    for i in sorted(numbers, key=lambda i: (*points[i], i)):
        if points[i][1] < least:
            front.append(i)
            least = points[i][1]
    return front
