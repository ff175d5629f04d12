"""A made-up capture with known truth, written as contract.md says."""

import dataclasses
import functools
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from ltgs_jax.geometry import Camera
from ltgs_jax.io import (
    CameraModel,
    ColmapImage,
    ColmapModel,
    InputError,
    write_bytes,
    write_colmap,
    write_image,
    write_json,
    write_labels,
)

from .raycast import Caster, Hits, Shader, light_vertices
from .room import make_lights, make_room
from .shapes import join
from .story import Story, tell
from .views import View, dense_views, sparse_views

_SUPERSAMPLES = 2  # per side of a pixel
_NOISE = 0.006  # standard deviation of the sensor, after the tone curve
_POINT_NOISE = 0.0015  # metres
_PIXEL_NOISE = 0.35  # pixels of an observation
_SLACK = 0.004  # metres between a point's distance and that of what its ray meets


def make_capture(
    folder: str | Path,
    *,
    scene: str = "turnover",
    seed: int = 0,
    width: int = 240,
    height: int = 180,
    dense: int = 30,
    update: int = 3,
    test: int = 4,
    points: int = 4000,
) -> Path:
    """Make a capture of four visits to a room, ray-cast, with its truth; the same arguments give the same files.

    `scene` is `move`, `turnover`, `clutter`, `nochange` or `light`; `seed` chooses room, objects and events; sizes in
    pixels; `dense` photographs at the first visit, `update` at each later one, `test` more at each; at most `points`
    sparse points. Returns the folder. Raises InputError when embreex is missing or the folder cannot be written,
    ValueError for an unknown scene.
    """
    folder = Path(folder)
    if (folder / "images").exists():
        raise InputError(f"{folder}: already holds a capture")
    rng = np.random.default_rng([seed, 7])
    story = tell(scene, rng)
    room, lights = make_room(rng), make_lights(rng)
    lens = CameraModel("PINHOLE", width, height, (0.95 * width, 0.95 * width, width / 2, height / 2))
    names = [f"IMG_{t:04d}" for t in range(len(story.visits))]
    views = [
        dense_views(rng, dense) + dense_views(rng, test)
        if t == 0
        else sparse_views(rng, update) + dense_views(rng, test)
        for t in range(len(names))
    ]
    stages: list[tuple[Caster, np.ndarray, Shader]] = []
    first: list[np.ndarray] = []
    exposure = 1.0
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for t, visit in enumerate(names):
            if t == 0 or story.visits[t] != story.visits[t - 1]:
                caster, owners = _set_stage(story, t, room)
                stages.append((caster, owners, Shader(caster, light_vertices(caster, lights))))
            caster, owners, shader = stages[-1]
            films = list(pool.map(functools.partial(_shoot, caster, shader, lens), views[t]))
            if t == 0:
                exposure = 0.88 / np.percentile(np.concatenate([film.reshape(-1, 3) for film in films]), 97.0)
            for i, film in enumerate(films):
                sensor = np.random.default_rng([seed, 11, t, i])
                image = _develop(film * exposure, sensor, changed_light=scene == "light" and t > 0)
                write_image(folder / "images" / visit / f"{i:03d}.png", image)
                ids = _owner_image(caster, owners, views[t][i], lens)
                write_labels(folder / "truth" / "masks" / visit / f"{i:03d}.png", ids)
                if t == 0 and i < dense:
                    first.append(image)
    model = _sparse_points(stages[0][0], views[0][:dense], first, lens, rng, points)
    write_colmap(folder / "sparse" / "0", _with_all_views(model, names, views, lens))
    _write_lists(folder, names, views, dense, update)
    write_json(folder / "truth" / "objects.json", _truth(story))
    return folder


def _set_stage(story: Story, t: int, room) -> tuple[Caster, np.ndarray]:
    """The caster of a visit, and to which thing each face belongs (0: the room, else its place in the story + 1)."""
    meshes, owners = [room], [np.zeros(len(room.faces), np.int64)]
    for identity, thing in enumerate(story.things, start=1):
        if thing.name in story.visits[t]:
            meshes.append(thing.mesh.moved(story.visits[t][thing.name].matrix()))
            owners.append(np.full(len(thing.mesh.faces), identity))
    return Caster(join(meshes)), np.concatenate(owners)


@functools.lru_cache(maxsize=4)
def _grid(lens: CameraModel, per_side: int) -> np.ndarray:
    """Directions (camera z 1) of a grid of samples per pixel, rows first: [n 3] float32."""
    K = lens.K()
    x = ((np.arange(lens.width * per_side) + 0.5) / per_side - K[0, 2]) / K[0, 0]
    y = ((np.arange(lens.height * per_side) + 0.5) / per_side - K[1, 2]) / K[1, 1]
    columns = *np.broadcast_arrays(x[None, :], y[:, None]), np.ones((len(y), len(x)))
    return np.stack(columns, axis=-1).reshape(-1, 3).astype(np.float32)


def _rays(view: View, lens: CameraModel, per_side: int) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions in the world of a grid of samples."""
    directions = _grid(lens, per_side) @ view.rotation.T.astype(np.float32)
    return np.broadcast_to(view.centre.astype(np.float32), directions.shape), directions


def _shoot(caster: Caster, shader: Shader, lens: CameraModel, view: View) -> np.ndarray:
    """Linear radiance [h w 3], averaged over the samples of each pixel."""
    k = _SUPERSAMPLES
    radiance = shader(caster.cast(*_rays(view, lens, k)))
    return radiance.reshape(lens.height, k, lens.width, k, 3).mean(axis=(1, 3))


def _owner_image(caster: Caster, owners: np.ndarray, view: View, lens: CameraModel) -> np.ndarray:
    """The id of what the ray through each pixel's centre meets, [h w]."""
    hits: Hits = caster.cast(*_rays(view, lens, 1))
    ids = np.where(hits.faces >= 0, owners[hits.faces], 0)
    return ids.reshape(lens.height, lens.width)


def _develop(film: np.ndarray, rng: np.random.Generator, *, changed_light: bool) -> np.ndarray:
    """An sRGB-like photograph in 0..1 with the sensor's noise; under other light also its own exposure and tone."""
    contrast = 0.0
    if changed_light:
        warmth = rng.uniform(-0.14, 0.14)
        film = film * 2 ** rng.uniform(-1, 1) * np.array([1 + warmth, 1.0, 1 - warmth])
        contrast = rng.uniform(-0.3, 0.3)
    image = np.clip(film, 0, 1) ** (1 / 2.2)
    image = image + contrast * (image * image * (3 - 2 * image) - image)
    return image + _NOISE * rng.standard_normal(image.shape)


def object_ids(scene: str, seed: int, t: int, cameras: Sequence[Camera]) -> list[np.ndarray]:
    """The object that each pixel of any cameras shows at visit t of a made-up room: ids [h w] as in truth/masks.

    `scene`, `seed` and the errors are those of `make_capture`.
    """
    rng = np.random.default_rng([seed, 7])
    story = tell(scene, rng)
    caster, owners = _set_stage(story, t, make_room(rng))
    ids = []
    for camera in cameras:
        (fx, _, cx), (_, fy, cy), _ = np.asarray(camera.K, float).tolist()
        lens = CameraModel("PINHOLE", camera.width, camera.height, (fx, fy, cx, cy))
        pose = np.asarray(camera.cam_from_world.as_matrix(), float)
        ids.append(_owner_image(caster, owners, View(pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3]), lens))
    return ids


def _sparse_points(
    caster: Caster,
    views: list[View],
    photographs: list[np.ndarray],
    lens: CameraModel,
    rng: np.random.Generator,
    count: int,
) -> ColmapModel:
    """Points on textured surfaces that at least two of the views see, with colours and noisy observations."""
    candidates, colors = [], []
    for view, image in zip(views, photographs, strict=True):
        weight = np.abs(np.diff(image.mean(axis=-1), axis=1, prepend=0)).ravel() + 0.01
        picked = rng.choice(weight.size, 3 * count // len(views), replace=False, p=weight / weight.sum())
        origins, directions = _rays(view, lens, 1)
        depth = caster.distances(origins[picked], directions[picked])
        candidates.append(origins[picked] + depth[:, None] * directions[picked])
        colors.append(image.reshape(-1, 3)[picked])
    order = rng.permutation(len(views) * (3 * count // len(views)))
    points, shades = np.concatenate(candidates)[order], np.concatenate(colors)[order]
    seen, pixels = [], []
    for view in views:
        xy, z = view.project(points, lens)
        inside = (z > 0.05) & (xy >= 0).all(axis=1) & (xy < [lens.width, lens.height]).all(axis=1)
        offset = points - view.centre
        length = np.linalg.norm(offset, axis=1)
        met = caster.distances(np.broadcast_to(view.centre, offset.shape), offset / length[:, None])
        # A matcher finds a point in most, not all, of the photographs that show it.
        seen.append(inside & (np.abs(met - length) < _SLACK) & (rng.random(len(points)) < 0.7))
        pixels.append(xy + _PIXEL_NOISE * rng.standard_normal(xy.shape))
    seen_in, pixels = np.stack(seen), np.stack(pixels)
    kept = np.flatnonzero(seen_in.sum(axis=0) >= 2)[:count]
    images, track = {}, []
    for i, view in enumerate(views):
        mine = np.flatnonzero(seen_in[i, kept])
        quat, xyz = view.cam_from_world()
        # _with_all_views, which knows the visits' names, gives it its name.
        images[i + 1] = ColmapImage("", 1, quat, xyz, pixels[i, kept[mine]], mine + 1)
        track.append(np.column_stack([mine, np.full(len(mine), i + 1), np.arange(len(mine))]))
    rows = np.concatenate(track)
    return ColmapModel(
        cameras={1: lens},
        images=images,
        point_ids=np.arange(1, len(kept) + 1),
        points=points[kept] + _POINT_NOISE * rng.standard_normal((len(kept), 3)),
        colors=np.rint(np.clip(shades[kept], 0, 1) * 255).astype(np.uint8),
        errors=np.full(len(kept), _PIXEL_NOISE),
        track=rows[np.lexsort((rows[:, 1], rows[:, 0]))],
    )


def _with_all_views(model: ColmapModel, names: list[str], views: list[list[View]], lens: CameraModel) -> ColmapModel:
    """The model with a name and a pose for every photograph."""
    images = {}
    for t, (visit, group) in enumerate(zip(names, views, strict=True)):
        for i, view in enumerate(group):
            name = f"{visit}/{i:03d}.png"
            if t == 0 and i + 1 in model.images:
                images[i + 1] = dataclasses.replace(model.images[i + 1], name=name)
            else:
                quat, xyz = view.cam_from_world()
                images[len(images) + 1] = ColmapImage(name, 1, quat, xyz, np.zeros((0, 2)), np.zeros(0, np.int64))
    return dataclasses.replace(model, images=images)


def _write_lists(folder: Path, names: list[str], views: list[list[View]], dense: int, update: int) -> None:
    changes, held_out = [], []
    for t, (visit, group) in enumerate(zip(names, views, strict=True)):
        used = dense if t == 0 else update
        photographs = [f"{visit}/{i:03d}.png" for i in range(len(group))]
        changes += photographs[:used] if t else []
        held_out += photographs[used:]
    for name, lines in (("changes", changes), ("test", held_out)):
        write_bytes(folder / "images" / f"{name}.txt", "".join(f"{line}\n" for line in lines).encode())


def _truth(story: Story) -> dict:
    return {
        "ids": {thing.name: identity for identity, thing in enumerate(story.things, start=1)},
        "extents": {thing.name: thing.extents for thing in story.things},
        "times": [{name: spot.matrix() for name, spot in spots.items()} for spots in story.visits],
    }
