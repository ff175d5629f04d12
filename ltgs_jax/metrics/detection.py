"""How right the masks, identities, events and poses of an update are, against a capture that brings its truth."""

from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Integer
from scipy.optimize import linear_sum_assignment

from ltgs_jax.geometry import SE3, rotation_angle

NO_CHANGE = ("still", "unseen")


def mask_iou(found: Bool[np.ndarray, "..."], true: Bool[np.ndarray, "..."]) -> float:
    """Intersection over union of two masks, pooled over all axes; 1 where both are empty.

    Raises ValueError when the shapes differ.
    """
    both, either, _ = _overlap(found, true)
    return both / either if either else 1.0


def mask_f1(found: Bool[np.ndarray, "..."], true: Bool[np.ndarray, "..."]) -> float:
    """F1 of two masks (harmonic mean of precision and recall), pooled over all axes; 1 where both are empty.

    Raises ValueError when the shapes differ.
    """
    both, _, total = _overlap(found, true)
    return 2 * both / total if total else 1.0


def _overlap(found: np.ndarray, true: np.ndarray) -> tuple[int, int, int]:
    """Pixels in both masks, in either, and the sum of the two."""
    found, true = np.asarray(found, bool), np.asarray(true, bool)
    if found.shape != true.shape:
        raise ValueError(f"found: expected the truth's shape {true.shape}, got {found.shape}")
    both, total = int((found & true).sum()), int(found.sum()) + int(true.sum())
    return both, total - both, total


def assign_objects(
    found: Sequence[Integer[np.ndarray, "_h _w"]],
    true: Sequence[Integer[np.ndarray, "_h _w"]],
    *,
    min_iou: float = 0.1,
) -> dict[int, int]:
    """True id of each found id, one to one, by the largest total IoU of their masks over all photographs.

    `found`, `true`: object ids of the same photographs, 0 = none. Pairs below `min_iou` are left out, and so is an id
    without a partner.

    Raises ValueError when the lists or the sizes of their images differ.
    """
    if len(found) != len(true) or any(np.shape(a) != np.shape(b) for a, b in zip(found, true, strict=False)):
        raise ValueError("found: expected as many label images as the truth, of the same sizes")
    if not found:
        return {}
    found_ids, found_index = np.unique(np.concatenate([np.ravel(a) for a in found]), return_inverse=True)
    true_ids, true_index = np.unique(np.concatenate([np.ravel(a) for a in true]), return_inverse=True)
    both = np.zeros((len(found_ids), len(true_ids)))
    np.add.at(both, (found_index, true_index), 1)
    iou = both / (both.sum(1, keepdims=True) + both.sum(0, keepdims=True) - both)
    iou[found_ids == 0] = iou[:, true_ids == 0] = 0
    rows, columns = linear_sum_assignment(-iou)
    return {int(found_ids[i]): int(true_ids[j]) for i, j in zip(rows, columns, strict=True) if iou[i, j] >= min_iou}


def event_f1(
    found: Mapping[tuple[int, int], str],
    true: Mapping[tuple[int, int], str],
    assignment: Mapping[int, int],
) -> float:
    """F1 of what happened to which object at which visit; 1 when nothing happened and nothing was said to.

    `found` and `true` give the event of each (object id, visit); `assignment` the true id of a found one. "still" and
    "unseen" are no events. An event counts as right when object, visit and kind agree; an event of a found object
    without a partner is a wrong one.
    """
    said = {(assignment.get(k, -k), t, event) for (k, t), event in found.items() if event not in NO_CHANGE}
    happened = {(k, t, event) for (k, t), event in true.items() if event not in NO_CHANGE}
    total = len(said) + len(happened)
    return 2 * len(said & happened) / total if total else 1.0


def rotation_deg(found: SE3, true: SE3, *, axis: Float[np.ndarray, "3"] | None = None) -> float:
    """Angle in degrees between two motions of one object, both from its first to its later pose in the world.

    `axis` (at the first pose) is an axis about which the object looks the same: then the angle is between the two
    places that the motions take the axis to.
    """
    delta = found.inverse() @ true
    if axis is None:
        return float(np.degrees(rotation_angle(delta.quat)))
    axis = np.asarray(axis) / np.linalg.norm(axis)
    moved = np.asarray(delta.rotmat()) @ axis
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(moved, axis)), moved @ axis)))


def translation_rel(found: SE3, true: SE3, *, center: Float[np.ndarray, "3"], size: float) -> float:
    """Distance between where two motions take the object's middle, as a fraction of its size.

    `center` is the middle at the first pose, in the world; `size` the object's diagonal, in scene units.
    """
    places = [np.asarray(motion.apply(jnp.asarray(center, motion.xyz.dtype)[None])) for motion in (found, true)]
    return float(np.linalg.norm(places[0] - places[1]) / size)
