import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from freqgs_plugin.functional.harmonics import basis, evaluate
from freqgs_plugin.functional.projection import rotation_rows
from freqgs_plugin.functional.similarity import Similarity, harmonics_rotation


def rotation(seed):
    return torch.from_numpy(Rotation.random(random_state=seed).as_matrix().copy())


def similarity(seed, scale=1.7):
    g = torch.Generator().manual_seed(seed)
    return Similarity(rotation(seed), torch.randn(3, generator=g, dtype=torch.float64), scale)


def directions(n=64, seed=0):
    g = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(n, 3, generator=g, dtype=torch.float64), dim=-1)


def matrices(quats):
    return torch.stack([torch.stack(row, -1) for row in rotation_rows(quats)], -2)


def _evaluate(coefficients, d):
    coefficients = coefficients.expand(len(d), -1, -1)
    return evaluate(coefficients[:, 0], coefficients[:, 1:], d)


@pytest.mark.parametrize("degree", range(5))
def test_rotated_harmonics_are_the_harmonics_of_rotated_directions(degree):
    sh = torch.randn(5, (degree + 1) ** 2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    move = similarity(degree)
    d = directions()
    for row in sh:
        before = _evaluate(row[None], d)
        after = _evaluate(move.harmonics(row[None]), d @ move.rotation.T)
        torch.testing.assert_close(after, before, rtol=0, atol=1e-13)


@pytest.mark.parametrize("degree", range(5))
def test_the_matrix_is_orthogonal_and_keeps_degrees_apart(degree):
    matrix = harmonics_rotation(rotation(3), degree)
    torch.testing.assert_close(matrix @ matrix.T, torch.eye(len(matrix), dtype=torch.float64), rtol=0, atol=1e-13)
    for low in range(degree + 1):
        inside = slice(low**2, (low + 1) ** 2)
        assert torch.count_nonzero(matrix[inside]) == torch.count_nonzero(matrix[inside, inside])


def test_two_rotations_are_one():
    a, b = rotation(1), rotation(2)
    both = harmonics_rotation(b @ a, 4)
    torch.testing.assert_close(harmonics_rotation(b, 4) @ harmonics_rotation(a, 4), both, rtol=0, atol=1e-12)


def test_a_quarter_turn_about_z_moves_x_to_y():
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    x, y = torch.eye(3, dtype=torch.float64)[:2]
    toward_x = basis(x[None], 1)[0]
    moved = harmonics_rotation(turn, 1) @ toward_x
    torch.testing.assert_close(moved, basis(y[None], 1)[0], rtol=0, atol=1e-14)


@given(st.integers(0, 50), st.integers(51, 100), st.floats(0.01, 50))
def test_after_is_one_after_the_other(a, b, scale):
    first, second = similarity(a, scale), similarity(b, 0.3)
    x = directions(6) * 3
    torch.testing.assert_close(second.after(first).points(x), second.points(first.points(x)), rtol=1e-11, atol=1e-11)
    torch.testing.assert_close(first.inverse().points(first.points(x)), x, rtol=1e-11, atol=1e-11)
    assert first.inverse().after(first).is_identity()


def test_it_is_nerfstudios_formula():
    move = similarity(4, 0.25)
    x = torch.tensor([[1.0, 2, 3]], dtype=torch.float64)
    homogeneous = torch.cat([x, torch.ones(1, 1)], -1)
    expected = (homogeneous @ torch.cat([move.rotation, move.translation[:, None]], 1).T) * 0.25
    torch.testing.assert_close(move.points(x), expected)


def test_quaternions_turn_and_keep_their_norm():
    quats = torch.randn(20, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    move = similarity(7)
    moved = move.quaternions(quats)
    torch.testing.assert_close(matrices(moved), move.rotation @ matrices(quats))
    torch.testing.assert_close(moved.norm(dim=-1), quats.norm(dim=-1))


def test_identity():
    assert Similarity.identity().is_identity()
    assert not similarity(1, 1.0).is_identity()
    assert not Similarity(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64), 1.001).is_identity()


def test_mirrors_and_stretches_are_refused():
    zero = torch.zeros(3, dtype=torch.float64)
    for diagonal in ([1.0, 1, -1], [1.0, 1, 1.1], [0.0, 0, 0]):
        with pytest.raises(ValueError, match="is no rotation"):
            Similarity(torch.diag(torch.tensor(diagonal, dtype=torch.float64)), zero, 1.0)
    for scale in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(ValueError, match="must be finite, scale > 0"):
            Similarity(torch.eye(3, dtype=torch.float64), zero, scale)
