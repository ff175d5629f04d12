"""The parts of photographs that a change touches, and the splats that show there: all that the long fit looks at."""

from collections.abc import Iterator, Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy import ndimage

from ltgs_jax.geometry import Camera
from ltgs_jax.render import RenderPlan, render
from ltgs_jax.scene import Splats, pad_splats

from .views import StreamedView, View, plan_for, size_of

_SIDE = 88  # 11 × 11 tiles, which the renderer works on at once
_SHOWS = 0.1  # share of a pixel's colour that touched splats give it, from which on the change touches the pixel
_LEAST = 12  # such pixels in a window, below which it is left out
_SEEN = 0.02  # Σ αT below which a splat has no part in a window
_INSIDE = 0.9  # share of what a splat paints in the windows that lies in touched pixels, from which on it may move
_BUCKET = 4096  # least count that splats are padded to


class Window(eqx.Module):
    """A square part of a photograph: its camera, pixels [s s 3] uint8, those that count [s s], the visit, and which
    splats of the scene show in it [m]."""

    camera: Camera
    image: np.ndarray
    mask: np.ndarray
    visit: int
    rows: Int[np.ndarray, " m"]


def window_side(sizes: Sequence[tuple[int, int]], share: float) -> int:
    """Side in pixels of the windows on photographs of these sizes: a share of the longer side, at least `_SIDE`, but no
    more than the smallest photograph holds."""
    longest = np.median([max(size) for size in sizes])
    return int(min(max(_SIDE, 8 * round(share * longest / 8)), min(min(size) for size in sizes)))


def crop_camera(camera: Camera, left: int, top: int, side: int) -> Camera:
    """The camera of a square part of its image."""
    shift = jnp.asarray([[0, 0, left], [0, 0, top], [0, 0, 0]], camera.K.dtype)
    return Camera(camera.cam_from_world, camera.K - shift, side, side)


def cover_region(region: Bool[np.ndarray, "h w"], side: int, margin: int) -> list[tuple[int, int]]:
    """Left and top of few squares that hold every true pixel: the parts that hang together in turn, the largest first,
    each with rows of squares evenly over its box and `margin` pixels around."""
    height, width = region.shape
    labels, count = ndimage.label(region, np.ones((3, 3)))
    left = region.copy()
    corners = []
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    for i in sorted(range(1, count + 1), key=lambda i: -sizes[i]):
        rows, columns = np.nonzero((labels == i) & left)
        if len(rows) == 0:
            continue
        starts = [
            _starts(values.min() - margin, values.max() + 1 + margin, side, length)
            for values, length in ((rows, height), (columns, width))
        ]
        for top in starts[0]:
            for x in starts[1]:
                part = left[top : top + side, x : x + side]
                if part.any():
                    corners.append((x, top))
                    part[:] = False
    return corners


def _starts(low: int, high: int, side: int, length: int) -> list[int]:
    """Where as few intervals as hold low…high start, within 0…length."""
    low, high = max(low, 0), min(high, length)
    count = max(1, -(-(high - low) // side))
    room = count * side - (high - low)
    starts = [low - room // 2 + i * side for i in range(count)]
    return sorted({int(np.clip(start, 0, length - side)) for start in starts})


class Shown(eqx.Module):
    """One visit: its photographs, the scene, and which of its splats [n] came, moved, or lie where something left."""

    views: tuple[View | StreamedView, ...]
    splats: Splats
    touched: Bool[np.ndarray, " n"]


def windows_of(visits: dict[int, Shown], *, side: int) -> tuple[list[Window], Float[np.ndarray, "n 2"]]:
    """Windows of side `side` on what change touches in the photographs of each visit; and what each splat paints (Σ αT)
    of their touched pixels, and of all. Scenes of all visits have the same splats, hidden where they do not show.

    A pixel is touched where touched splats give `_SHOWS` of its colour, dilated by a twentieth of a window.
    """
    margin = max(2, side // 20)
    parts = [
        (t, view, left, top, crop_camera(view.camera, left, top, side))
        for t, view, outline in _outlines(visits, margin)
        for left, top in cover_region(outline, side, margin)
    ]
    windows: list[Window] = []
    votes = np.zeros((next(iter(visits.values())).splats.count, 2))
    rows = [np.flatnonzero(_in_view(visits[t].splats, camera)) for t, *_, camera in parts]
    if not rows:
        return windows, votes
    bucket = _bucket(max(len(r) for r in rows))

    def scene(t: int, r: Int[np.ndarray, " m"]) -> Splats:
        return pad_splats(visits[t].splats[r], bucket)

    # One plan, and one number of splats, for the windows of all visits: one program.
    plan = plan_for((scene(t, r), camera) for r, (t, *_, camera) in zip(rows, parts, strict=True))
    for r, (t, view, left, top, camera) in zip(rows, parts, strict=True):
        flags = np.pad(visits[t].touched[r].astype(np.float32), (0, bucket - len(r)))
        count, cast = _window_votes(scene(t, r), camera, flags, margin, plan)
        if int(count) < _LEAST:
            continue
        votes[r] += np.asarray(cast)[: len(r)]
        part = np.s_[top : top + side, left : left + side]
        showing = r[np.asarray(cast)[: len(r), 1] > _SEEN]
        windows.append(Window(camera, view.image[part], view.mask[part], t, showing))
    return windows, votes


def within_change(votes: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
    """From the votes of all windows, the splats that show in touched pixels and hardly anywhere else."""
    return (votes[:, 0] > _SEEN) & (votes[:, 0] > _INSIDE * votes[:, 1])


def _outlines(
    visits: dict[int, Shown], margin: int
) -> Iterator[tuple[int, View | StreamedView, Bool[np.ndarray, "h w"]]]:
    """Visit, photograph and, dilated, where its touched splats would show in it if nothing stood before them."""
    bucket = _bucket(max(int(shown.touched.sum()) for shown in visits.values()))
    scenes = {t: pad_splats(shown.splats[shown.touched], bucket) for t, shown in visits.items()}
    every = [(t, view) for t, shown in visits.items() for view in shown.views]
    sizes = {size_of(view) for _, view in every}
    plans = {size: plan_for([(scenes[t], v.camera) for t, v in every if size_of(v) == size]) for size in sizes}
    for t, view in every:
        alpha = np.asarray(_alpha(scenes[t], view.camera, plans[size_of(view)]))
        yield t, view, ndimage.maximum_filter(alpha > _SHOWS, size=2 * margin + 1)


def _bucket(count: int) -> int:
    """The next power of two, at least `_BUCKET`: few sizes, few programs."""
    return max(_BUCKET, 1 << max(count - 1, 1).bit_length())


def _in_view(splats: Splats, camera: Camera) -> Bool[np.ndarray, " n"]:
    """Splats whose sphere of three standard deviations may meet the window, by its four planes; on the host."""
    R, t = np.asarray(camera.cam_from_world.as_matrix(), np.float32)[:3, :3], np.asarray(camera.cam_from_world.xyz)
    K = np.asarray(camera.K)
    local = np.asarray(splats.means) @ R.T + t
    reach = 3 * np.exp(np.asarray(splats.log_scales).max(axis=-1))
    inside = local[:, 2] + reach > 0
    for axis, size in ((0, camera.width), (1, camera.height)):
        low, high = -K[axis, 2] / K[axis, axis], (size - K[axis, 2]) / K[axis, axis]
        for slope, sign in ((low, 1), (high, -1)):
            distance = sign * (local[:, axis] - slope * local[:, 2]) / np.sqrt(1 + slope**2)
            inside &= distance > -reach - 0.01 * np.abs(local[:, 2])
    return inside


@eqx.filter_jit
def _alpha(splats: Splats, camera: Camera, plan: RenderPlan) -> Float[Array, "h w"]:
    return render(splats, camera, plan=plan).alpha


@partial(jax.jit, static_argnames=("margin", "plan"))
def _window_votes(splats: Splats, camera: Camera, flags, margin: int, plan: RenderPlan):
    # What flags show and what splats paint is one render, and its transpose.
    colors = jnp.stack([flags, jnp.zeros_like(flags)], axis=-1)
    image, pull = jax.vjp(lambda colors: render(splats, camera, plan=plan, colors=colors).image, colors)
    shown = image[..., 0] > _SHOWS
    window = (2 * margin + 1, 2 * margin + 1)
    near = jax.lax.reduce_window(shown, False, jax.lax.bitwise_or, window, (1, 1), "SAME")
    values = jnp.stack([near, jnp.ones_like(near)], axis=-1).astype(splats.means.dtype)
    return jnp.sum(shown), pull(values)[0]
