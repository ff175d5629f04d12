"""Correspondences of two point sets by the features that their points carry."""

import numpy as np
from jaxtyping import Float, Int

# Rows of the similarity matrix that are held at once.
_BLOCK = 2048


def _top(a: np.ndarray, b: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Indices [n, k] and cosines [n, k] of the best of `b` for each of `a`, best first."""
    indices, cosines = [], []
    for start in range(0, len(a), _BLOCK):
        similarity = a[start : start + _BLOCK] @ b.T
        best = np.argsort(-similarity, axis=1, kind="stable")[:, :k]
        indices.append(best)
        cosines.append(np.take_along_axis(similarity, best, axis=1))
    return np.concatenate(indices), np.concatenate(cosines)


def _unit(features: np.ndarray) -> np.ndarray:
    norms = np.linalg.norm(features, axis=1, keepdims=True)
    return features / np.where(norms > 0, norms, 1)


def match_features(
    src_features: Float[np.ndarray, "n d"],
    dst_features: Float[np.ndarray, "m d"],
    *,
    top_k: int = 1,
    min_cosine: float = 0.0,
) -> tuple[Int[np.ndarray, " c"], Int[np.ndarray, " c"], Float[np.ndarray, " c"]]:
    """Correspondences (i, j) whose features are among each other's `top_k` nearest by cosine; 1 = mutual nearest.

    Features [n d] and [m d], any length. Returns the indices into both sets and the cosines, best first.
    Raises ValueError when the feature sizes differ or `top_k` < 1.
    """
    a, b = np.asarray(src_features), np.asarray(dst_features)
    if a.ndim != 2 or b.ndim != 2 or a.shape[1] != b.shape[1]:
        raise ValueError(f"dst_features: expected [m, {a.shape[-1]}] like src_features, got {list(b.shape)}")
    if top_k < 1:
        raise ValueError(f"top_k: expected at least 1, got {top_k}")
    if len(a) == 0 or len(b) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, a.dtype)
    a, b = _unit(a), _unit(b)
    forward, cosines = _top(a, b, min(top_k, len(b)))
    backward, _ = _top(b, a, min(top_k, len(a)))
    rows = np.repeat(np.arange(len(a)), forward.shape[1])
    cols, cosines = forward.ravel(), cosines.ravel()
    mutual = (backward[cols] == rows[:, None]).any(1) & (cosines >= min_cosine)
    rows, cols, cosines = rows[mutual], cols[mutual], cosines[mutual]
    order = np.argsort(-cosines, kind="stable")
    return rows[order], cols[order], cosines[order]
