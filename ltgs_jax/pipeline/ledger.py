"""What each visit added to the chronology, and what each addition bought: model only what a scene needs (design.md)."""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import numpy as np

from ltgs_jax.fit import VisitView, halved
from ltgs_jax.scene import Chronology, Splats, drop_hidden

from .looks import Eye
from .state import Account, composed

_ENOUGH = 320  # pixels along the longer side of a photograph that tell what something buys
_POSE, _SHADE, _BLOB = 7, 4, 5  # numbers for a pose, an object's shade at it, and a shadow's blob


def make_ledger(
    chronology: Chronology,
    accounts: Sequence[Sequence[Account]],
    views: Sequence[VisitView],
    eye: Eye,
    *,
    progress: Callable[[int, int, str], None] = lambda i, n, text: None,
) -> list[dict]:
    """A row for each account, and for the ground and the light of each visit: {"visit", "what", "parameters", "bytes",
    "gain_db", "evidence"}.

    Parameters are those that came with that visit, 4 bytes each. The gain is the PSNR over all of the visit's
    photographs, whole and small (`small_views`), less that of the same scene without the one thing: an object where and
    as it was at the visit before, ground or light left out. They are the photographs that the fit saw: a gain of
    nothing says that the addition was not worth its bytes, a high one not that it is right. The evidence is what
    proposed the pose of a known object, None elsewhere.
    """
    rows, views = [], small_views(views)
    names = chronology.visits
    for t in range(1, len(names)):
        seen = [v for v in views if v.visit == t]
        progress(t, len(names), f"what {names[t]} added and bought")
        without = _without(chronology, accounts[t] if t < len(accounts) else (), t)
        if not seen or not without:
            continue
        whole = squared_error(drop_hidden(composed(chronology, t)), seen, eye)
        for what, numbers, other, evidence in without:
            gain = 10 * np.log10(
                max(squared_error(drop_hidden(composed(other, t)), seen, eye), 1e-12) / max(whole, 1e-12)
            )
            rows.append(
                {
                    "visit": names[t],
                    "what": what,
                    "parameters": numbers,
                    "bytes": 4 * numbers,
                    "gain_db": round(float(gain), 3),
                    "evidence": evidence,
                }
            )
    return rows


def _without(
    chronology: Chronology, accounts: Sequence[Account], t: int
) -> list[tuple[str, int, Chronology, str | None]]:
    """What visit t added: in words, how many numbers it takes, the chronology without it, and what proposed its
    pose."""
    found = []
    poses, visible = jax.tree.map(np.array, (chronology.world_from_template, chronology.visible))
    for k in sorted({a.template for a in accounts}):
        account = next(a for a in accounts if a.template == k)
        kind = account.kind
        template = chronology.templates[k]
        numbers = _POSE if kind == "moved" else 0
        if template.source_visit == t:
            numbers += _numbers(template.splats)
        before = jax.tree.map(np.copy, (poses, visible))
        for leaf in jax.tree.leaves(before):
            leaf[t, k] = leaf[t - 1, k]
        other = eqx.tree_at(lambda c: (c.world_from_template, c.visible), chronology, before)
        found.append((f"object {template.identity} {kind}", numbers, other, account.evidence))
    if chronology.since is not None and (late := np.asarray(chronology.since) == t).any():
        logits = np.where(late, -np.inf, np.asarray(chronology.background.logit_opacities))
        other = eqx.tree_at(lambda c: c.background.logit_opacities, chronology, logits)
        found.append(("ground", _numbers(chronology.background[late]), other, None))
    if (dark := _unlit(chronology, t)) is not None:
        found.append(("light and shadows", *dark, None))
    return found


def _unlit(chronology: Chronology, t: int) -> tuple[int, Chronology] | None:
    """How many numbers the light that changed at visit t takes, and the chronology with objects lit as they were first
    seen and the ground as at the visit before; None where there are none."""
    numbers = 0
    if chronology.shade is not None:
        shade = np.array(chronology.shade)
        numbers += _SHADE * int((shade[t] != shade[t - 1]).any(axis=-1).sum())
        shade[t] = shade[t - 1]
        chronology = eqx.tree_at(lambda c: c.shade, chronology, shade)
    if chronology.shadows is not None:
        cast = np.array(chronology.shadows.cast)
        numbers += _BLOB * int((cast[t] & ~cast[:t].any(axis=0)).sum())
        cast[t] = cast[t - 1]
        chronology = eqx.tree_at(lambda c: c.shadows.cast, chronology, cast)
    return (numbers, chronology) if numbers else None


def _numbers(splats: Splats) -> int:
    """Parameters of splats; colours that depend on the direction count where there are any, as on disk."""
    rest = np.asarray(splats.sh)[:, 1:]
    shining, more = int(rest.any(axis=(1, 2)).sum()), int(np.prod(rest.shape[1:]))
    each = sum(int(np.prod(leaf.shape[1:])) for leaf in jax.tree.leaves(splats))
    return splats.count * (each - more) + shining * more


def small_views(views: Sequence[VisitView], enough: int = _ENOUGH) -> list[VisitView]:
    """Views as small as still tells what something buys: halved while their longer side keeps `enough` pixels."""
    small = []
    for v in views:
        view = v.view
        while max(view.camera.width, view.camera.height) >= 2 * enough:
            (view,) = halved([view])
        small.append(VisitView(view, v.visit))
    return small


def squared_error(scene: Splats, views: Sequence[VisitView], eye: Eye) -> float:
    """Mean squared error of a scene over photographs of it."""
    total, count = 0.0, 0
    for v in views:
        difference = eye.image(scene, v.view.camera) - np.asarray(v.view.image, np.float32) / 255
        total += float(np.sum(np.mean(difference**2, axis=-1)[v.view.mask]))
        count += int(v.view.mask.sum())
    return total / max(count, 1)
