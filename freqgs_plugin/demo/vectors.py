"""Products of vectors by elementwise steps. BLAS chooses its kernels, and with them the last bits, by the processor:
with its matrix products, the scene would not be the same on two machines."""

import numpy as np
from jaxtyping import Float


def dot(a: Float[np.ndarray, "*#n d"], b: Float[np.ndarray, "*#n d"]) -> Float[np.ndarray, "..."]:
    """Scalar products over the last axis; the other axes broadcast."""
    total = a[..., 0] * b[..., 0]
    for k in range(1, a.shape[-1]):
        total = total + a[..., k] * b[..., k]
    return np.asarray(total)


def transform(matrix: Float[np.ndarray, "m d"], vectors: Float[np.ndarray, "*n d"]) -> Float[np.ndarray, "*n m"]:
    """`matrix` times each vector."""
    return np.stack([dot(row, vectors) for row in matrix], axis=-1)


def length(vectors: Float[np.ndarray, "*n d"]) -> Float[np.ndarray, "*n"]:
    """Euclidean norms over the last axis."""
    return np.asarray(np.sqrt(dot(vectors, vectors)))


def normalise(vectors: Float[np.ndarray, "*n d"]) -> Float[np.ndarray, "*n d"]:
    """Unit vectors of the same directions."""
    return vectors / length(vectors)[..., None]
