"""Objects of the present scene that the photographs of a visit no longer show."""

import itertools

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ltgs_jax.geometry import C0
from ltgs_jax.scene import Splats

from .config import TemplateConfig
from .cut import components, neighbour_graph, random_walk
from .support import Support, Vantage, convex_footprint, fit_support

_LEAST_VOTES = 0.3  # pixels (αT) from which on a photograph sees a splat
_MOST_VOTES = 3.0  # pixels beyond which one photograph's word on a splat weighs no more
_TURNED = 0.07  # share of the evidence on what stands apart from which on it changed, be it by a turn where it stands
_OFF = 0.7  # share of the evidence on what was taken down which must say that it left
_ALIKE = 0.15  # difference of the middle colours, in 0…1, up to which two parts that touch are one thing
_WIDER = 1.2  # by which the outline of the middle 90 % is widened to be that of the whole
_FEW = 20  # splats beside what was taken down that tell how high the rest is
_CLEAN = 0.1  # share of the evidence that speaks against a level, up to which it needs no step there
_STEP = 1.5  # growth of an outline from which on one thing stands upon another


class Removal(eqx.Module):
    """Splats of the scene that left together: mask over the scene, the surface they stood on, votes in pixels, their
    share of the evidence on these splats, and the number of photographs with enough of them."""

    members: Bool[np.ndarray, " n"]
    support: Support | None
    votes: float
    share: float
    views: int = eqx.field(static=True)


def gone_evidence(
    seen: Float[np.ndarray, "v n"], evidence: Float[np.ndarray, "v n"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Evidence that each splat left, and that it stayed, in pixels.

    `seen` Σ αT per photograph, `evidence` Σ αT·e of the photograph's evidence e in −1…1. What is unchanged in one
    photograph counts twice: something that came hides a splat in one photograph, and not in the others.
    """
    mean = np.where(seen > _LEAST_VOTES, evidence / np.maximum(seen, 1e-9), 0)
    total = np.sum(np.minimum(seen, _MOST_VOTES) * np.where(mean < 0, 2 * mean, mean), axis=0)
    return np.maximum(total, 0), np.maximum(-total, 0)


def share_of(left: Float[np.ndarray, " n"], stayed: Float[np.ndarray, " n"]) -> float:
    """Share of the evidence that says that something left."""
    return float(left.sum() / max(left.sum() + stayed.sum(), 1e-9))


def taken_down(
    points: Float[np.ndarray, "n 3"],
    left: Float[np.ndarray, " n"],
    stayed: Float[np.ndarray, " n"],
    *,
    least: float,
    config: TemplateConfig = TemplateConfig(),
) -> Bool[np.ndarray, " n"] | None:
    """The splats of what was taken down from upon the rest; None where the evidence does not part at a level, where the
    outline does not step there unless hardly any evidence speaks against the level, or where either side has less than
    `least` pixels of evidence.

    `points`: their centres along two axes of the support and its normal. The level is the one at which the outline
    grows most, of the one that parts the evidence best, those nearly as good, and those below: the foot of what was
    taken down tells little.
    """
    height = points[:, 2]
    levels = np.quantile(height, np.linspace(0.1, 0.9, 17))

    def parts(level: float, off: float = _OFF, low: float = config.whole, least: float = least) -> bool:
        upper = height > level
        told = left[upper].sum() > least and stayed[~upper].sum() > least
        return told and share_of(left[upper], stayed[upper]) > off and share_of(left[~upper], stayed[~upper]) < low

    net = left - stayed
    told = np.array([net[height > level].sum() - net[height <= level].sum() for level in levels])
    best = int(np.argmax(told))
    if not parts(levels[best]):
        return None
    thick = 0.1 * np.ptp(height)
    # Above the best level what left would be counted with what stayed, and a round top is no step.
    levels = [level for i, level in enumerate(levels) if i <= best or told[i] > (1 - _CLEAN) * told[best]]
    growth = [
        _extent(points[(height > level - thick) & (height <= level)]) / max(_extent(points[height > level]), 1e-9)
        for level in levels
    ]
    step = int(np.argmax(growth))
    if growth[step] > _STEP:
        return height > levels[step]
    clean = parts(levels[best], off=1 - _CLEAN, low=_CLEAN, least=_CLEAN * (left + stayed).sum())
    return height > levels[best] if clean else None


def with_foot(points: Float[np.ndarray, "n 3"], part: Bool[np.ndarray, " n"]) -> tuple[Bool[np.ndarray, " n"], float]:
    """A part that was taken down, with its foot, and the level that it stood on: how high the rest reaches beside it.
    What of the rest is higher, below the part, is its foot; where nothing is beside it, its own lowest is the level.

    `points`: their centres along two axes of the support and its normal.
    """
    low, high = np.quantile(points[part, :2], [0.05, 0.95], axis=0)
    core = part & ((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1)
    below = _within_outline(points, np.flatnonzero(core), slice(None), np.eye(3)[:2], wider=_WIDER)
    beside = points[~part & ~below, 2]
    if len(beside) < _FEW:
        return part, float(np.quantile(points[part, 2], 0.02))
    level = float(np.quantile(beside, 0.95))
    if level > np.median(points[part, 2]):
        return part, float(np.quantile(points[part, 2], 0.02))
    return part | (below & (points[:, 2] > level)), level


def _extent(points: Float[np.ndarray, "n 3"]) -> float:
    """Area of the box, along the first two axes, that holds the central 90 % of points."""
    return float(np.prod(np.ptp(np.quantile(points[:, :2], [0.05, 0.95], axis=0), axis=0))) if len(points) else 0.0


def find_removed(
    splats: Splats,
    seen: Float[np.ndarray, "v n"],
    evidence: Float[np.ndarray, "v n"],
    vantage: Vantage,
    *,
    pixels: int,
    rng: np.random.Generator,
    config: TemplateConfig = TemplateConfig(),
) -> list[Removal]:
    """Cut out what left, one `Removal` for each solid thing, largest first.

    Splats with evidence of having left are grouped; around each group, above the surface it stands on, the evidence
    spreads over a graph of near splats to the sides that no photograph saw. What does not rise above its support (a
    shadow, the ground under something new) is no object.
    """
    left, stayed = gone_evidence(seen, evidence)
    changed = np.maximum(evidence, 0)
    least = config.min_pixels * pixels
    if left.sum() < least:
        return []
    means = np.asarray(splats.means, np.float64)
    colors = np.asarray(splats.sh[:, 0]) * C0 + 0.5
    removals, taken = [], np.zeros(len(means), bool)
    for group in sorted(_groups(means, np.flatnonzero(left > 0.5)), key=lambda g: -left[g].sum()):
        group = group[~taken[group]]
        if left[group].sum() < least:
            continue
        for members, support in _solids(splats, colors, group, left, stayed, vantage, rng, config):
            members = members & ~taken
            votes = float(left[members].sum())
            views = int(np.sum(changed[:, members].sum(axis=1) >= least))
            # One photograph alone may only have something in front of it: it must show more, and solid ground below.
            if votes >= least and (views >= 2 or (views == 1 and support is not None and votes >= 3 * least)):
                share = share_of(left[members], stayed[members])
                removals.append(Removal(members, support, votes, share, views))
                taken |= members
    return sorted(removals, key=lambda r: -r.votes)


def _groups(means: Float[np.ndarray, "n 3"], members: Int[np.ndarray, " m"], reach: float = 3.0) -> list[np.ndarray]:
    """Members nearer to each other than `reach` times their usual distance."""
    if len(members) < 8:
        return []
    spacing = np.median(cKDTree(means[members]).query(means[members], k=4)[0][:, 3])
    labels = components(means[members], reach * spacing)
    return [members[labels == i] for i in range(labels.max() + 1) if (labels == i).sum() >= 8]


def _islands(
    splats: Splats, height: Float[np.ndarray, " n"], local: Int[np.ndarray, " m"], floor: float, axes
) -> list[Int[np.ndarray, " p"]]:
    """Things that stand apart above a surface, each an array of indices among `local`.

    What is firm and clear of the surface makes an island; what is faint or low joins the one whose outline it is in.
    """
    means = np.asarray(splats.means, np.float64)
    firm = local[(np.asarray(splats.opacities)[local] > 0.2) & (height[local] > 2 * floor)]
    rest = np.setdiff1d(local, firm)
    islands = []
    for island in _groups(means, firm, reach=2.0):
        inside = _within_outline(means, island, rest, axes) & (height[rest] < 1.1 * height[island].max())
        islands.append(np.concatenate([island, rest[inside]]))
        rest = rest[~inside]
    return islands


def _within_outline(means, body, queries, axes, *, wider: float = 1.1) -> Bool[np.ndarray, " q"]:
    """Which splats lie over the convex outline, so much wider, that a body has on its support."""
    flat = means[body] @ axes.T
    return convex_footprint((flat - flat.mean(axis=0)) * wider + flat.mean(axis=0), means[queries] @ axes.T)


def _parts(
    splats, colors, height, local, body, floor, axes, left, stayed, config: TemplateConfig, *, apart: bool
) -> list[np.ndarray]:
    """What of the `local` splats above a support left, one array of indices for each solid thing.

    A thing that stands apart goes as a whole once a small part of it is seen to have changed: turned where it stands,
    it still has its own colours in most places. What touches its neighbours is cut from them by a random walk,
    unless only what stands `apart` is asked for.
    """
    means = np.asarray(splats.means, np.float64)
    size = np.linalg.norm(np.ptp(means[body], axis=0))
    parts, rest = [], local
    for island in _islands(splats, height, local, floor, axes):
        told = share_of(left[island], stayed[island])
        alone = np.linalg.norm(np.ptp(means[island], axis=0)) < 2 * size
        if told > _TURNED and alone and left[island].sum() > 0.1 * left[body].sum():
            parts.append(island)
            rest = np.setdiff1d(rest, island)
    if not apart and len(np.intersect1d(rest, body)) >= 8:
        graph = neighbour_graph(means[rest], colors[rest], color_scale=config.cut_color)
        # Capped, so that a splat that straddles the outline goes with its neighbours.
        probability = random_walk(graph, np.minimum(left[rest], 2), np.minimum(stayed[rest], 2))
        parts += _groups(means, rest[probability > 0.5])
    parts = [part for part in parts if left[part].sum() > 0.1 * left[body].sum()]
    return _joined(parts, means, colors, left, stayed)


def _joined(parts: list[np.ndarray], means, colors, left, stayed) -> list[np.ndarray]:
    """Parts with those that touch them, have their colours and left as clearly: the rim of a pan stands apart from its
    handle where a few splats of its bottom are low."""
    link = np.eye(len(parts), dtype=bool)
    trees = [cKDTree(means[part]) for part in parts]
    reach = [3 * np.median(tree.query(tree.data, k=min(4, tree.n))[0][:, -1]) for tree in trees]
    for i, j in itertools.combinations(range(len(parts)), 2):
        touch = trees[i].query(means[parts[j]])[0].min() < min(reach[i], reach[j])
        apart = np.linalg.norm(np.median(colors[parts[i]], axis=0) - np.median(colors[parts[j]], axis=0))
        both = min(share_of(left[part], stayed[part]) for part in (parts[i], parts[j]))
        link[i, j] = touch and apart < _ALIKE and both > _OFF
    count, labels = connected_components(csr_array(link), directed=False)
    return [np.concatenate([parts[i] for i in np.flatnonzero(labels == label)]) for label in range(count)]


def _above(members: Int[np.ndarray, " m"], height, noise: float, config: TemplateConfig):
    """How high above a support members reach, the height up to which they are that itself, and those above it."""
    top = np.quantile(height[members], 0.95) if len(members) else 0.0
    floor = max(config.flat * noise, 0.05 * top)
    return top, floor, members[height[members] > floor]


def _solids(splats: Splats, colors, group, left, stayed, vantage, rng, config: TemplateConfig):
    """The solid things in one group: masks of splats, with what is under them on the surface they stand on."""
    means = np.asarray(splats.means, np.float64)
    center = np.median(means[group], axis=0)
    radius = np.linalg.norm(means[group] - center, axis=1).max() + 1e-9
    near = np.linalg.norm(means - center, axis=1) < 3 * radius
    ground = near & (stayed > 0.5)
    support = fit_support(means[ground], np.minimum(stayed[ground], 5) + 1e-3, means[group], vantage, rng=rng)
    if support is None:
        members = np.zeros(len(means), bool)
        members[group] = True
        return [(members, None)]
    height, axes = support.height(means), support.frame()[:2]
    top, floor, body = _above(group, height, support.noise, config)
    if top < floor * 1.5:
        return []
    # Ground that something new came to stand upon hangs together with a thing beside it, which must then stand apart.
    ground_alone = left[body].sum() < 0.2 * left[group].sum()
    if ground_alone:
        top, floor, body = _above(body, height, support.noise, config)
    if len(body) < 8:
        return []
    local = np.flatnonzero(near & (height > floor))
    parts = _parts(splats, colors, height, local, body, floor, axes, left, stayed, config, apart=ground_alone)
    # What is under the body goes with it, its contact with the support included: the fill replaces that. So do splats
    # within its outline that nothing says stayed.
    free = near & (height > -floor) & (height < 1.1 * top) & (stayed <= left)
    free[np.concatenate([*parts, np.zeros(0, int)])] = False
    found = []
    for part in parts:
        below = np.flatnonzero(free)
        below = below[_within_outline(means, part, below, axes)]
        free[below] = False
        members = np.zeros(len(means), bool)
        members[part] = True
        members[below] = True
        found.append((members, support))
    return found
