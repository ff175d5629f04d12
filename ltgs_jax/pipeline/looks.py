"""The present scene as a visit's photographs should show it, rendered with few compilations."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ltgs_jax.detect import ChangeMap, change_map, dilate
from ltgs_jax.features import FrontEnd
from ltgs_jax.geometry import Camera, eval_sh
from ltgs_jax.match import Cone
from ltgs_jax.render import RenderOutput, RenderPlan, plan_render, render, splat_votes
from ltgs_jax.scene import Splats, pad_splats
from ltgs_jax.template import Refiner, Vantage, unlikeness

from .config import Config

_CHANNELS = 3  # that are painted, or voted for, at once: any number of them is one program
_BUCKET = 8192  # splats are padded to one multiple of this, so that a cut or an addition compiles nothing anew
_ROOM = 1.15  # what that leaves for splats to come


class Observation(eqx.Module):
    """One photograph of a visit, in the light of the first: camera, colours in 0…1, pixels that count."""

    name: str = eqx.field(static=True)
    camera: Camera
    image: Float[np.ndarray, "h w 3"]
    valid: Bool[np.ndarray, "h w"]


class Look(eqx.Module):
    """What the scene shows to one camera."""

    image: Float[np.ndarray, "h w 3"]
    alpha: Float[np.ndarray, "h w"]
    depth: Float[np.ndarray, "h w"]
    expected: Float[np.ndarray, "h w"]


def on_host(splats: Splats) -> Splats:
    """The same splats as NumPy arrays: cutting and joining them then compiles nothing."""
    return jax.tree.map(np.asarray, splats)


@eqx.filter_jit
def _show(splats: Splats, camera: Camera, value, plan: RenderPlan):
    """The image, and one more value of the splats [n 1] composited with it."""
    direction = splats.means - camera.center()
    direction = direction / jnp.maximum(jnp.linalg.norm(direction, axis=-1, keepdims=True), 1e-9)
    colors = jnp.concatenate([eval_sh(splats.sh, direction), value], axis=-1)
    return render(splats, camera, plan=plan, colors=colors)


@eqx.filter_jit
def _paint(splats: Splats, camera: Camera, values, plan: RenderPlan):
    return render(splats, camera, plan=plan, colors=values).image


@eqx.filter_jit
def _votes(splats: Splats, camera: Camera, values, plan: RenderPlan):
    return splat_votes(splats, camera, values, plan=plan)


class Eye:
    """Renders whole photographs by few programs: one number of splats, padded, for all scenes, and one generous plan
    per image size; either grows when it no longer serves."""

    def __init__(self) -> None:
        self._count = 0
        self._plans: dict[tuple[int, int, int], RenderPlan] = {}
        self.refiner = Refiner()

    def _padded(self, splats: Splats) -> Splats:
        if splats.count > self._count:
            self._count = -(-round(_ROOM * splats.count) // _BUCKET) * _BUCKET
        return pad_splats(splats, self._count)

    def _plan(self, padded: Splats, camera: Camera) -> RenderPlan:
        key = (padded.count, camera.width, camera.height)
        needed = plan_render(padded, camera, slack=1.0)
        held = self._plans.get(key)
        if held is None or needed.intersections > held.intersections or needed.rounds > held.rounds:
            roomy = plan_render(padded, camera, slack=1.8)
            held = (
                roomy
                if held is None
                else RenderPlan(max(roomy.intersections, held.intersections), max(roomy.rounds, held.rounds))
            )
            self._plans[key] = held
        return held

    def _show(self, splats: Splats, camera: Camera, value: Float[np.ndarray, " n"]) -> RenderOutput:
        padded = self._padded(splats)
        value = np.pad(np.asarray(value, np.float32), (0, padded.count - splats.count))[:, None]
        return _show(padded, camera, value, self._plan(padded, camera))

    def look(self, splats: Splats, camera: Camera, errors: Float[np.ndarray, " n"]) -> Look:
        """Image, alpha, depth and expected dissimilarity; where little is, nothing is expected to agree."""
        out = self._show(splats, camera, errors)
        image, alpha = np.asarray(out.image), np.asarray(out.alpha)
        unknown = np.clip(1 - 2 * alpha, 0, 1)
        return Look(np.clip(image[..., :3], 0, 1), alpha, np.asarray(out.depth), image[..., 3] + unknown)

    def image(self, splats: Splats, camera: Camera) -> Float[np.ndarray, "h w 3"]:
        """The image alone, in 0…1."""
        return np.clip(np.asarray(self._show(splats, camera, np.zeros(splats.count)).image)[..., :3], 0, 1)

    def paint(self, splats: Splats, camera: Camera, values: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "h w c"]:
        """Any values of the splats, composited as colours are."""
        if values.shape[1] == 1:
            return np.asarray(self._show(splats, camera, values[:, 0]).image)[..., 3:]
        padded, count = self._padded(splats), values.shape[1]
        plan = self._plan(padded, camera)
        room = (0, padded.count - splats.count), (0, -count % _CHANNELS)
        parts = np.split(np.pad(np.asarray(values, np.float32), room), range(_CHANNELS, count, _CHANNELS), axis=1)
        return np.concatenate([_paint(padded, camera, part, plan) for part in parts], axis=-1)[..., :count]

    def cover(
        self, scene: tuple, templates: Sequence[int], observations: Sequence[Observation]
    ) -> list[Bool[np.ndarray, "h w"]]:
        """The pixels of each photograph in which a scene (`scene_at`) shows mostly these templates."""
        return self.covers(scene, [templates], observations)[0]

    def covers(
        self, scene: tuple, groups: Sequence[Sequence[int]], observations: Sequence[Observation]
    ) -> list[list[Bool[np.ndarray, "h w"]]]:
        """For each group of templates, the pixels of each photograph in which a scene (`scene_at`) shows mostly it."""
        splats, _, owner, _ = scene
        if not groups:
            return []
        theirs = np.stack([np.isin(owner, np.asarray(group, int) + 1) for group in groups], axis=-1)
        painted = [self.paint(splats, o.camera, theirs) > 0.5 for o in observations]
        return [[mostly[..., i] for mostly in painted] for i in range(len(groups))]

    def votes(self, splats: Splats, camera: Camera, values: Float[np.ndarray, "h w m"]) -> Float[np.ndarray, "n m"]:
        """Σ αT·value per splat."""
        padded, count = self._padded(splats), values.shape[2]
        values = np.pad(np.asarray(values, np.float32), ((0, 0), (0, 0), (0, -count % _CHANNELS)))
        votes = _votes(padded, camera, values, self._plan(padded, camera))
        return np.asarray(votes)[: splats.count, :count]


class Evidence(eqx.Module):
    """Looks at the scene, and what every photograph says of change."""

    looks: tuple[Look, ...]
    changes: tuple[ChangeMap, ...]

    @property
    def masks(self) -> list[Bool[np.ndarray, "h w"]]:
        """The pixels of each photograph that changed."""
        return [change.mask for change in self.changes]


def compare(
    eye: Eye, scene: tuple, observations: Sequence[Observation], front_end: FrontEnd, config: Config
) -> Evidence:
    """Every photograph against the scene (`scene_at`) as its camera sees it."""
    splats, errors, *_ = scene
    looks = [eye.look(splats, o.camera, errors) for o in observations]
    changes = [
        change_map(look.image, o.image, look.expected, o.valid, front_end, config=config.detect)
        for look, o in zip(looks, observations, strict=True)
    ]
    return Evidence(tuple(looks), tuple(changes))


def still_changed(
    scene: tuple, template: int, observations: Sequence[Observation], before: Evidence, after: Evidence, *, eye: Eye
) -> float:
    """Of the change where a scene (`scene_at`) shows a template, the share that is still seen with it there: from the
    evidence without it and with it. Above 1 where it changes more than it explains.

    The test is detection's own: what the template shows there, against what its splats are expected to leave.
    """
    cover = eye.cover(scene, [template], observations)

    def seen(evidence: Evidence) -> int:
        return sum(int((c & mask).sum()) for c, mask in zip(cover, evidence.masks, strict=True))

    return seen(after) / max(seen(before), 1)


def unlike_where_different(
    images: Sequence[Float[np.ndarray, "h w 3"]], others: Sequence[Float[np.ndarray, "h w 3"]], observations
) -> tuple[float, float, float]:
    """Mean unlikeness to the photographs of two renders of each, over the pixels in which they differ; and the share of
    all pixels that these are."""
    sums = np.zeros(3)
    for image, other, o in zip(images, others, observations, strict=True):
        different = dilate(np.abs(image - other).max(axis=-1) > 0.05, 1) & o.valid
        both = np.concatenate([unlikeness(shown[None], o.image[None], o.valid[None]) for shown in (image, other)])
        sums += [*(both * different).sum(axis=(1, 2)), different.sum()]
    area = sum(o.valid.size for o in observations)
    return float(sums[0] / max(sums[2], 1)), float(sums[1] / max(sums[2], 1)), float(sums[2] / area)


def vantage_of(observations: Sequence[Observation]) -> Vantage:
    """Where the photographs were taken from."""
    poses = [np.asarray(o.camera.cam_from_world.as_matrix(), np.float64) for o in observations]
    return Vantage.of_cameras(np.linalg.inv(np.stack(poses)))


def projection_of(camera: Camera) -> Float[np.ndarray, "3 4"]:
    """K·[R t] in float64."""
    K = np.asarray(camera.K, np.float64)
    return K @ np.asarray(camera.cam_from_world.as_matrix(), np.float64)[:3]


def cone_of(camera: Camera, silhouette: Bool[np.ndarray, "h w"], valid: Bool[np.ndarray, "h w"], look: Look) -> Cone:
    """A photograph's evidence as `match` takes it."""
    return Cone(projection_of(camera), silhouette, valid, look.depth)
