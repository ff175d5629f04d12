"""Points of the frozen map: keypoints joined over photographs of known pose, and triangulated."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float

Member = tuple[int, int]
"""(index of the photograph, index of its keypoint)"""


def join_tracks(matches: Iterable[tuple[float, Member, Member]]) -> list[list[Member]]:
    """Groups of keypoints, at most one per photograph, from pairwise matches (score, a, b), best score first.

    A match that would put two keypoints of one photograph into a group is left out, so that one wrong match costs
    one match and not the group.
    """
    group_of: dict[Member, list[Member]] = {}
    for _, a, b in sorted(matches, key=lambda match: (-match[0], match[1], match[2])):
        group_a, group_b = group_of.setdefault(a, [a]), group_of.setdefault(b, [b])
        if group_a is group_b or {image for image, _ in group_a} & {image for image, _ in group_b}:
            continue
        small, large = sorted((group_a, group_b), key=len)
        large += small
        for member in small:
            group_of[member] = large
    return [group for group in {id(g): g for g in group_of.values()}.values() if len(group) > 1]


def triangulate(
    cam_from_world: Float[np.ndarray, "v 3 4"], rays: Float[np.ndarray, "v 2"], *, max_error: float, min_angle: float
) -> tuple[Float[np.ndarray, "3"], np.ndarray] | None:
    """The point seen along rays (normalised image coordinates) of views, and which views agree with it.

    Linear triangulation; the worst view is dropped while one lies more than `max_error` (normalised) off. None when
    fewer than two remain, the point is behind a view, or the widest angle between rays is under `min_angle` rad.
    """
    keep = np.arange(len(rays))
    while len(keep) >= 2:
        poses = cam_from_world[keep]
        rows = rays[keep][..., None] * poses[:, 2:3] - poses[:, :2]
        _, _, vt = np.linalg.svd(rows.reshape(-1, 4), full_matrices=False)
        if abs(vt[-1, 3]) < 1e-9 * np.abs(vt[-1, :3]).max():
            return None
        point = vt[-1, :3] / vt[-1, 3]
        local = poses[:, :, :3] @ point + poses[:, :, 3]
        if (local[:, 2] <= 0).any():
            return None
        errors = np.linalg.norm(local[:, :2] / local[:, 2:] - rays[keep], axis=1)
        if errors.max() <= max_error:
            toward = np.einsum("vji,vj->vi", poses[:, :, :3], local)
            toward /= np.linalg.norm(toward, axis=1, keepdims=True)
            widest = np.arccos(np.clip((toward @ toward.T).min(), -1, 1))
            return (point, keep) if widest >= min_angle else None
        keep = np.delete(keep, np.argmax(errors))
    return None
