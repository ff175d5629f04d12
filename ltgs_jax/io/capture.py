"""A capture: photographs over visits, their cameras, the sparse points."""

import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ltgs_jax.geometry import SE3

from .colmap import ColmapImage, ColmapModel, find_colmap, read_colmap
from .files import InputError
from .images import ImageHeader, read_header
from .layouts import FLAT, Layout, find_layout, read_list
from .lens import CameraModel
from .photographs import Photograph
from .transforms import read_transforms

DENSE_VISIT = 16
"""A visit of at least this many photographs is dense: every 8th is held out when no test.txt says which."""
HOLD_OUT = 8


@dataclasses.dataclass(frozen=True)
class Observations:
    """Which photograph sees which sparse point: q rows of indices into `Capture.photographs` and `Capture.points`.

    `pixels` [q 2] in the stored (distorted) photograph, its corner at (0, 0).
    """

    photographs: np.ndarray
    points: np.ndarray
    pixels: np.ndarray


@dataclasses.dataclass(frozen=True)
class Capture:
    """Photographs over t visits with what is known of their cameras; m sparse points, colours in 0..1.

    `problems` are (name, reason) of what was left out or overridden.
    """

    folder: Path
    visits: tuple[str, ...]
    photographs: tuple[Photograph, ...]
    points: Float[np.ndarray, "m 3"]
    point_colors: Float[np.ndarray, "m 3"]
    point_observations: Observations
    colmap_model: Path | None
    initial_ply: Path | None
    problems: tuple[tuple[str, str], ...]

    def at(self, visit: int, *roles: str) -> tuple[Photograph, ...]:
        """The photographs of one visit, of the given roles (none given: all)."""
        return tuple(p for p in self.photographs if p.visit == visit and (not roles or p.role in roles))


def read_capture(folder: str | Path) -> Capture:
    """Read a capture folder (the layouts of contract.md); every photograph's header is read, no pixel is.

    A photograph that cannot be read is left out and named in `problems`; a visit without any other is an error.
    Raises InputError, one line, that names the folder, file or photograph.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder" if not folder.exists() else f"{folder}: expected a folder")
    layout = find_layout(folder)
    model_path = find_colmap(folder) or _first_visit_model(layout)
    model = None if model_path is None else read_colmap(model_path)
    if (folder / "transforms.json").is_file():
        posed, its_layout = read_transforms(folder)
        model = model or posed
        # Folders say more about visits than the file does; a flat images/ says nothing.
        layout = its_layout if layout is None or layout.visits == (FLAT,) else layout
    if layout is None:
        raise InputError(f"{folder}: no photographs found; expected {folder / 'images'}/<visit>/<photograph>")
    problems: list[tuple[str, str]] = []
    headers = _headers(layout, problems)
    index = _name_index(folder, layout)
    registered = _match_names(model, index)
    roles = _roles(layout, index, headers, problems)
    photographs = []
    for visit, files in enumerate(layout.photographs):
        for name, path in files:
            if name in headers:
                image = registered.get(name)
                photographs.append(_photograph(name, visit, path, headers[name], roles[name], folder, model, image))
    photographs = _with_shared_lenses(_with_checked_sizes(photographs, headers))
    points, colors, observations = _points(model, photographs, registered)
    initial = folder / "initial.ply"
    return Capture(
        folder=folder,
        visits=layout.visits,
        photographs=tuple(photographs),
        points=points,
        point_colors=colors,
        point_observations=observations,
        colmap_model=model_path,
        initial_ply=initial if initial.is_file() else None,
        problems=tuple(problems),
    )


def _first_visit_model(layout: Layout | None) -> Path | None:
    """CL-Splats keeps the model of the first visit inside its folder."""
    if layout is None:
        return None
    first = layout.photographs[0][0][1].parent
    inside = first if first.name == layout.visits[0] else first.parent
    return find_colmap(inside) if inside.name == layout.visits[0] else None


def _headers(layout: Layout, problems: list[tuple[str, str]]) -> dict[str, ImageHeader]:
    """Headers of all readable photographs; the others become problems, a visit without any an error."""
    headers = {}
    for visit, files in zip(layout.visits, layout.photographs, strict=True):
        reasons: list[tuple[str, str]] = []
        stems: dict[str, str] = {}
        for name, path in files:
            try:
                headers[name] = read_header(path)
            except InputError as error:
                reasons.append((name, str(error)))
            stem = name.rsplit(".", 1)[0]
            if name in headers and stems.setdefault(stem, name) != name:
                raise InputError(f"{path}: {stems[stem]} has the same name but for its suffix; rename one of them")
        if len(reasons) == len(files):
            raise InputError(f"visit {visit}: none of its photographs can be read; the first: {reasons[0][1]}")
        problems += reasons
    return headers


def _find_name(name: str, index: dict[str, str]) -> str | None:
    """The photograph that a foreign list means: its path, or the end of it that at least names the visit's folder."""
    parts = name.replace("\\", "/").split("/")
    ends = ["/".join(parts[start:]) for start in range(max(1, len(parts) - 1))]
    return next((index[end] for end in ends if end in index), None)


def _name_index(folder: Path, layout: Layout) -> dict[str, str]:
    """Photographs by their name and by each end of their path; where several share an end, the first visit's."""
    index = {name: name for files in layout.photographs for name, _ in files}
    for files in layout.photographs:
        for name, path in files:
            parts = path.relative_to(folder).parts
            for start in range(len(parts)):
                index.setdefault("/".join(parts[start:]), name)
    return index


def _match_names(model: ColmapModel | None, index: dict[str, str]) -> dict[str, ColmapImage]:
    """The image of the model behind each photograph."""
    if model is None:
        return {}
    found: dict[str, ColmapImage] = {}
    for image in model.images.values():
        name = _find_name(image.name, index)
        if name:
            found[name] = image
    return found


def _roles(
    layout: Layout, index: dict[str, str], headers: dict[str, ImageHeader], problems: list[tuple[str, str]]
) -> dict[str, str]:
    """What each photograph is for."""

    def listed(file: str) -> set[str] | None:
        names = read_list(layout.root / file)
        if names is None:
            return None
        found = set()
        for name in names:
            match = _find_name(name, index)
            if match:
                found.add(match)
            else:
                problems.append((name, f"{file} lists it, but there is no such photograph"))
        return found

    changes, test = listed("changes.txt"), listed("test.txt")
    roles = {}
    for visit, files in enumerate(layout.photographs):
        names = [name for name, _ in files if name in headers]
        held_out = set(names[::HOLD_OUT]) if len(names) >= DENSE_VISIT else set()
        if test is None and changes is not None and visit > 0:
            held_out -= changes
        for name in names:
            is_test = name in (held_out if test is None else test)
            used = "train" if visit == 0 else "update" if changes is None or name in changes else "unused"
            roles[name] = "test" if is_test else used
            if is_test and changes and name in changes:
                problems.append((name, "both changes.txt and test.txt list it: held out"))
    return roles


def _mask_path(folder: Path, name: str) -> Path | None:
    """masks/<visit>/<name>.png, with the photograph's suffix before it (as COLMAP does) or without."""
    plain = folder / "masks" / name
    return next((p for p in (Path(f"{plain}.png"), plain.with_suffix(".png")) if p.is_file()), None)


def _photograph(
    name: str, visit: int, path: Path, header: ImageHeader, role: str, folder: Path, model, image: ColmapImage | None
) -> Photograph:
    """A photograph with what the model says of it; `model` may be None where `image` is."""
    lens = camera = None
    if image is not None:
        lens = model.cameras[image.camera_id]
        camera = lens.camera(SE3(jnp.asarray(image.quat, jnp.float32), jnp.asarray(image.xyz, jnp.float32)))
    return Photograph(
        name=name,
        visit=visit,
        path=path,
        camera=camera,
        role=role,
        width=header.width,
        height=header.height,
        mask_path=_mask_path(folder, name),
        camera_model=lens,
        lens_given=lens is not None,
        has_alpha=header.channels in (2, 4),
        oriented=False,
        exif_focal=header.focal,
    )


def _with_checked_sizes(photographs: list[Photograph], headers: dict[str, ImageHeader]) -> list[Photograph]:
    """Photographs whose size agrees with their camera's.

    Turned by EXIF where that makes it agree; where all photographs of a camera were scaled alike, the camera is
    scaled. Raises InputError when photographs of one camera have several sizes.
    """
    groups: dict[CameraModel, list[Photograph]] = {}
    for photograph in photographs:
        if photograph.camera_model is not None:
            groups.setdefault(photograph.camera_model, []).append(photograph)
    checked = {}
    for lens, group in groups.items():
        turned = []
        for p in group:
            size = (p.width, p.height)
            swap = size != (lens.width, lens.height) and headers[p.name].orientation >= 5
            if swap and size[::-1] == (lens.width, lens.height):
                p = dataclasses.replace(p, width=p.height, height=p.width, oriented=True)
            turned.append(p)
        sizes = sorted({(p.width, p.height) for p in turned})
        if len(sizes) > 1:
            odd = next(p for p in turned if (p.width, p.height) != (lens.width, lens.height))
            listed = " and ".join(f"{w}×{h}" for w, h in sizes[:3])
            raise InputError(f"{odd.path}: photographs of one camera ({lens.model}) have several sizes: {listed}")
        for p in turned:
            checked[p.name] = _scaled_lens(p, lens)
    return [checked.get(p.name, p) for p in photographs]


def _scaled_lens(photograph: Photograph, lens: CameraModel) -> Photograph:
    width, height = photograph.width, photograph.height
    if (width, height) == (lens.width, lens.height):
        return photograph
    scale = width / lens.width
    if abs(height - lens.height * scale) > 1 + scale:
        raise InputError(
            f"{photograph.path}: is {width}×{height}, its camera in the model {lens.width}×{lens.height}: not a scaling"
        )
    scaled = lens.resized(width, height)
    camera = None if photograph.camera is None else scaled.camera(photograph.camera.cam_from_world)
    return dataclasses.replace(photograph, camera_model=scaled, camera=camera)


def _with_shared_lenses(photographs: list[Photograph]) -> list[Photograph]:
    """Photographs that the model does not list take the lens of those of their size, same visit first."""
    known = [p for p in photographs if p.camera_model is not None]
    shared = []
    for p in photographs:
        if p.camera_model is None:
            alike = [q for q in known if (q.width, q.height) == (p.width, p.height)]
            alike.sort(key=lambda q, p=p: q.visit != p.visit)
            p = dataclasses.replace(p, camera_model=alike[0].camera_model if alike else None)
        shared.append(p)
    return shared


def _points(model: ColmapModel | None, photographs: list[Photograph], registered: dict[str, ColmapImage]):
    """Sparse points, their colours, and who sees them."""
    if model is None:
        none = np.zeros(0, np.int64)
        return np.zeros((0, 3)), np.zeros((0, 3)), Observations(none, none, np.zeros((0, 2)))
    place = {id(registered[p.name]): index for index, p in enumerate(photographs) if p.name in registered}
    identity = {key: place[id(image)] for key, image in model.images.items() if id(image) in place}
    seen = np.array([image in identity for image in model.track[:, 1].tolist()], dtype=bool)
    track = model.track[seen]
    pixels = np.array([model.images[image].pixels[index] for _, image, index in track.tolist()]).reshape(-1, 2)
    photograph_indices = np.array([identity[image] for image in track[:, 1].tolist()], dtype=np.int64)
    observations = Observations(photograph_indices, track[:, 0], pixels)
    return model.points, model.colors / 255.0, observations
