"""What the long fit made of the visits so far, carried over to a chronology that has one more."""

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Int

from ltgs_jax.geometry import SE3
from ltgs_jax.scene import Splats

from .prune import without
from .state import State


def carry_on(state: State, before: State, fitted: State, gone: Bool[np.ndarray, " n"]) -> tuple[State, np.ndarray]:
    """A state with the splats, poses, shades and shadows that an earlier fit gave to what it has of the state `before`
    that fit; and which of its own splats went, since they were `gone` then, as a mask over background and templates.

    `fitted` is what came of `before` less `gone`. What is the same in both states, bit for bit, is one thing; what a
    visit since then cut, built or moved is as that visit left it. A template that both have keeps its place in the row.
    """
    splats, drop = [], []
    known, at = [before.chronology.background, *(m.splats for m in before.chronology.templates)], 0
    after = [fitted.chronology.background, *(m.splats for m in fitted.chronology.templates)]
    for k, part in enumerate([state.chronology.background, *(m.splats for m in state.chronology.templates)]):
        if k >= len(known):
            splats.append(part)
            drop.append(np.zeros(part.count, bool))
            continue
        went = gone[at : at + known[k].count]
        at += known[k].count
        row = _rows_in(part, known[k])
        drop.append((row >= 0) & went[row])
        kept = np.cumsum(~went) - 1
        mine = np.flatnonzero((row >= 0) & ~drop[-1])
        splats.append(_with_rows(part, mine, after[k], kept[row[mine]]))
    background, *templates = splats
    count = len(known) - 1
    old, then, now = (s.chronology for s in (before, fitted, state))
    same = np.all(
        [
            (np.asarray(a)[:, :count] == np.asarray(b)).all(axis=-1)
            for a, b in zip(*map(_pose, (now, old)), strict=True)
        ],
        axis=0,
    )
    quat, xyz = (np.array(leaf) for leaf in _pose(now))
    for leaf, fit in zip((quat, xyz), _pose(then), strict=True):
        leaf[:, :count][same] = np.asarray(fit)[same]
    shade = None
    if then.shade is not None:
        shade = np.zeros((*xyz.shape[:2], 4), np.float32)
        shade[:, :count][same] = np.asarray(then.shade)[same]
    carried = eqx.tree_at(
        lambda s: (
            s.chronology.background, s.chronology.world_from_template, s.chronology.shade, s.chronology.shadows,
            *(m.splats for m in s.chronology.templates),
        ),
        state,
        (background, SE3(quat, xyz), shade, then.shadows, *templates),
        is_leaf=lambda leaf: leaf is None,
    )  # fmt: skip
    dropped = np.concatenate(drop)
    return without(carried, dropped), dropped


def _pose(chronology) -> tuple:
    return chronology.world_from_template.quat, chronology.world_from_template.xyz


def _rows_in(splats: Splats, known: Splats) -> Int[np.ndarray, " n"]:
    """Which row of `known` each splat is, bit for bit; -1 where none is."""

    def names(part: Splats) -> list[bytes]:
        table = [np.asarray(leaf).reshape(part.count, -1) for leaf in (part.means, part.log_scales, part.quats)]
        return [row.tobytes() for row in np.concatenate(table, axis=1)]

    rows = {name: i for i, name in enumerate(names(known))}
    return np.array([rows.get(name, -1) for name in names(splats)], int)


def _with_rows(splats: Splats, rows: Int[np.ndarray, " m"], others: Splats, theirs: Int[np.ndarray, " m"]) -> Splats:
    """Splats with some rows taken from others."""
    leaves = []
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh"):
        leaf = np.array(getattr(splats, name))
        leaf[rows] = np.asarray(getattr(others, name))[theirs]
        leaves.append(leaf)
    return Splats(*leaves)
