"""Objects of the present scene that the photographs of a visit no longer show."""

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from ltgs_jax.geometry import C0
from ltgs_jax.scene import Splats

from .config import TemplateConfig
from .cut import components, neighbour_graph, random_walk
from .support import Support, convex_footprint, fit_support


class Removal(eqx.Module):
    """Splats of the scene that left together: mask over the scene, the surface they stood on, votes in pixels, and the
    number of photographs with enough of them."""

    members: Bool[np.ndarray, " n"]
    support: Support | None
    votes: float
    views: int = eqx.field(static=True)


def gone_evidence(
    seen: Float[np.ndarray, "v n"], changed: Float[np.ndarray, "v n"], *, least_votes: float = 0.3
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Evidence that each splat left, and that it stayed, in pixels.

    A splat left only if *every* photograph that sees it (by its votes αT) shows change there: what merely hides it in
    one photograph does not in another.
    """
    share = np.where(seen > least_votes, changed / np.maximum(seen, 1e-9), 1.0)
    least = share.min(axis=0)
    total = np.where((seen > least_votes).any(axis=0), seen.sum(axis=0), 0)
    return total * np.clip(2 * least - 1, 0, 1), total * np.clip(1 - 2 * least, 0, 1)


def find_removed(
    splats: Splats,
    seen: Float[np.ndarray, "v n"],
    changed: Float[np.ndarray, "v n"],
    cameras: Float[np.ndarray, "v 3"],
    *,
    pixels: int,
    rng: np.random.Generator,
    config: TemplateConfig = TemplateConfig(),
) -> list[Removal]:
    """Cut out what left, one `Removal` for each solid thing, largest first.

    Evidence from the votes spreads over a graph of near and like splats to the sides that no photograph saw; what does
    not rise above its support (a shadow, the ground under something new) is no object.
    """
    left, stayed = gone_evidence(seen, changed)
    least = config.min_pixels * pixels
    if left.sum() < least:
        return []
    means = np.asarray(splats.means, np.float64)
    colors = np.asarray(splats.sh[:, 0]) * C0 + 0.5
    graph = neighbour_graph(means, colors)
    probability = random_walk(graph, np.minimum(left, 5), np.minimum(stayed, 5))
    members = np.flatnonzero((probability > 0.5) & (stayed <= left))
    removals = []
    for group in _groups(means, members):
        if left[group].sum() < least:
            continue
        lifted = _lift(means, group, left, stayed, cameras, rng, config)
        if lifted is None:
            continue
        members, support = lifted
        views, votes = int(np.sum(changed[:, members].sum(axis=1) >= least)), float(left[members].sum())
        # One photograph alone may only have something in front of it: it must show more, and solid ground below.
        if views >= 2 or (views == 1 and support is not None and votes >= 3 * least):
            removals.append(Removal(members, support, votes, views))
    return sorted(removals, key=lambda r: -r.votes)


def _groups(means: Float[np.ndarray, "n 3"], members: np.ndarray, reach: float = 3.0) -> list[np.ndarray]:
    """Members nearer to each other than `reach` times their usual distance."""
    if len(members) < 8:
        return []
    spacing = np.median(cKDTree(means[members]).query(means[members], k=4)[0][:, 3])
    labels = components(means[members], reach * spacing)
    return [members[labels == i] for i in range(labels.max() + 1) if (labels == i).sum() >= 8]


def _lift(means, group, left, stayed, cameras, rng, config: TemplateConfig):
    """One group without the surface it stands on, and with the unseen splats that stand among it."""
    center = means[group].mean(axis=0)
    radius = np.linalg.norm(means[group] - center, axis=1).max() + 1e-9
    near = np.linalg.norm(means - center, axis=1) < 3 * radius
    ground = near & (stayed > 0.5)
    support = fit_support(means[ground], np.minimum(stayed[ground], 5) + 1e-3, means[group], cameras, rng=rng)
    members = np.zeros(len(means), bool)
    if support is None:
        members[group] = True
        return members, None
    height = support.height(means)
    top = np.quantile(height[group], 0.95)
    floor = max(config.flat * support.noise, 0.05 * top)
    if top < floor * 1.5 or np.sum(left[group] * (height[group] > floor)) < 0.2 * left[group].sum():
        return None
    body = group[height[group] > floor]
    axes = support.frame()[:2]
    # What is under the body goes with it, its contact with the support included: the fill replaces that.
    inside = near & (height > -floor) & (height < 1.1 * top) & (stayed <= left)
    index = np.flatnonzero(inside)
    flat = means[body] @ axes.T
    footprint = (flat - flat.mean(axis=0)) * 1.1 + flat.mean(axis=0)
    index = index[convex_footprint(footprint, means[index] @ axes.T)]
    members[body] = True
    members[index] = True
    return members, support
