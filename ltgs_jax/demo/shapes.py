"""Textured meshes, fine enough that light stored at their vertices is smooth."""

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class Mesh:
    """v vertices with outward normals and texture coordinates, f triangles, each with one of the textures.

    `uv` in 0..1, v downwards from the texture's first row; `materials` [f] indexes `textures` (sRGB uint8 [h w 3]).
    """

    vertices: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    faces: np.ndarray
    materials: np.ndarray
    textures: tuple[np.ndarray, ...]

    def moved(self, matrix: np.ndarray) -> "Mesh":
        """The mesh under a rigid 4×4 motion."""
        vertices = self.vertices @ matrix[:3, :3].T + matrix[:3, 3]
        return dataclasses.replace(self, vertices=vertices, normals=self.normals @ matrix[:3, :3].T)


def join(meshes: list[Mesh]) -> Mesh:
    """Meshes as one; their textures follow one another."""
    vertex_starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    texture_starts = np.cumsum([0, *(len(mesh.textures) for mesh in meshes)])
    pairs = list(zip(meshes, vertex_starts, texture_starts, strict=False))
    return Mesh(
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        normals=np.concatenate([mesh.normals for mesh in meshes]),
        uv=np.concatenate([mesh.uv for mesh in meshes]),
        faces=np.concatenate([mesh.faces + start for mesh, start, _ in pairs]),
        materials=np.concatenate([mesh.materials + start for mesh, _, start in pairs]),
        textures=tuple(texture for mesh in meshes for texture in mesh.textures),
    )


def surface(points: np.ndarray, texture: np.ndarray) -> Mesh:
    """A grid of points [rows columns 3] as a mesh; the normal is right × up.

    Row 0 is the texture's first row (its top), column 0 its left; seen from outside, right × up points outwards.
    """
    rows, columns = points.shape[:2]
    right = np.gradient(points, axis=1)
    up = -np.gradient(points, axis=0)
    # Where a row shrinks to a point, its neighbour says which way is right.
    flat = np.linalg.norm(right, axis=-1) < 1e-9
    for row, inner in ((0, 1), (rows - 1, rows - 2)):
        right[row] = np.where(flat[row][:, None], right[inner], right[row])
    normals = np.cross(right, up)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    v, u = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns), indexing="ij")
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.stack([np.stack([a, d, c], -1), np.stack([a, c, b], -1)]).reshape(-1, 3)
    return Mesh(
        vertices=points.reshape(-1, 3).astype(np.float64),
        normals=normals.reshape(-1, 3),
        uv=np.stack([u, v], axis=-1).reshape(-1, 2),
        faces=faces,
        materials=np.zeros(len(faces), np.int64),
        textures=(texture,),
    )


def rectangle(corner, right, down, texture: np.ndarray, *, cell: float) -> Mesh:
    """A rectangle from its upper left corner along `right` and `down`, seen from the side that it faces."""
    corner, right, down = (np.asarray(v, dtype=np.float64) for v in (corner, right, down))
    columns = max(2, 1 + int(np.ceil(np.linalg.norm(right) / cell)))
    rows = max(2, 1 + int(np.ceil(np.linalg.norm(down) / cell)))
    s, t = np.linspace(0, 1, columns)[None, :, None], np.linspace(0, 1, rows)[:, None, None]
    return surface(corner + s * right + t * down, texture)


def box(size, textures: dict[str, np.ndarray], *, cell: float, base=(0.0, 0.0, 0.0)) -> Mesh:
    """An upright box on `base` (the middle of its footprint); faces `front` (−y), `right`, `back`, `left`, `top`.

    Faces without a texture are left out, so a bottom that nobody sees costs nothing (`bottom` is a face too).
    """
    (w, d, h), (x, y, z) = size, base
    left, right, front, back, low, high = x - w / 2, x + w / 2, y - d / 2, y + d / 2, z, z + h
    frames = {
        "front": ((left, front, high), (w, 0, 0), (0, 0, -h)),
        "right": ((right, front, high), (0, d, 0), (0, 0, -h)),
        "back": ((right, back, high), (-w, 0, 0), (0, 0, -h)),
        "left": ((left, back, high), (0, -d, 0), (0, 0, -h)),
        "top": ((left, back, high), (w, 0, 0), (0, -d, 0)),
        "bottom": ((left, front, low), (w, 0, 0), (0, d, 0)),
    }
    parts = []
    for face, texture in textures.items():
        corner, along, down = frames[face]
        parts.append(rectangle(corner, along, down, texture, cell=cell))
    return join(parts)


def lathe(profile, texture: np.ndarray, *, cell: float, segments: int = 36, inside: bool = False) -> Mesh:
    """A surface of revolution about z; `profile` runs [(radius, z), …] from its top edge to its bottom edge.

    Seen from outside the texture's left to right is counter-clockwise from above; `inside` turns the face inwards.
    """
    profile = np.asarray(profile, dtype=np.float64)
    lengths = np.linalg.norm(np.diff(profile, axis=0), axis=1)
    at = np.concatenate([[0], np.cumsum(lengths)])
    rows = max(2, 1 + int(np.ceil(at[-1] / cell)))
    samples = np.union1d(np.linspace(0, at[-1], rows), at)
    radius, height = (np.interp(samples, at, profile[:, i])[:, None] for i in range(2))
    angle = np.linspace(0, 2 * np.pi, segments + 1)[None, :]
    angle = -angle if inside else angle
    points = np.stack(
        [radius * np.cos(angle), radius * np.sin(angle), np.broadcast_to(height, (len(samples), segments + 1))], -1
    )
    return surface(points, texture)


def tube(path: np.ndarray, radius: float, texture: np.ndarray, *, segments: int = 10) -> Mesh:
    """A round tube along a curve [m 3] in the plane y = 0."""
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.array([0.0, 1.0, 0.0])
    across = np.cross(tangent, side)
    angle = np.linspace(0, 2 * np.pi, segments + 1)[None, :, None]
    ring = np.cos(angle) * across[:, None] + np.sin(angle) * side
    return surface(path[:, None] + radius * ring, texture)
