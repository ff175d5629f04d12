"""Images of textured meshes by ray casting: light stored at the vertices, one ray per sample."""

import dataclasses

import numpy as np

from ltgs_jax.io import InputError

from .room import Light
from .shapes import Mesh

_LIGHT_SAMPLES = 6  # per side of a lamp
_SKY_SAMPLES = 32
_SKY_REACH = 1.2  # metres beyond which nothing darkens a corner
_AMBIENT = np.array([0.3, 0.31, 0.33])
_OFFSET = 1e-3  # metres that a ray starts above its surface


@dataclasses.dataclass(frozen=True)
class Hits:
    """What n rays meet: triangle (−1: nothing), barycentric u, v, distance along the ray."""

    faces: np.ndarray
    u: np.ndarray
    v: np.ndarray
    distances: np.ndarray


class Caster:
    """An Embree scene of one mesh."""

    def __init__(self, mesh: Mesh):
        try:
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        except ImportError:
            raise InputError(
                "making a capture needs the package embreex; install the extra: pip install 'ltgs-jax[demo]'"
            ) from None
        self.mesh = mesh
        self._scene = EmbreeScene()
        self._geometry = TriangleMesh(self._scene, mesh.vertices[mesh.faces].astype(np.float32))

    def cast(self, origins: np.ndarray, directions: np.ndarray) -> Hits:
        """The first triangle along each ray [n 3]."""
        found = self._scene.run(
            np.ascontiguousarray(origins, np.float32), np.ascontiguousarray(directions, np.float32), output=True
        )
        return Hits(found["primID"], found["u"], found["v"], found["tfar"])

    def distances(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Distance along each ray [n] to what it meets first, in lengths of its direction; huge without any."""
        origins, directions = (np.ascontiguousarray(a, np.float32) for a in (origins, directions))
        return self._scene.run(origins, directions, query="DISTANCE")


def light_vertices(caster: Caster, lights: list[Light]) -> np.ndarray:
    """Irradiance [v 3] at the vertices: lamps with soft shadows, and an ambient term dimmed in corners."""
    mesh = caster.mesh
    start = mesh.vertices + _OFFSET * mesh.normals
    total = np.zeros((len(start), 3))
    grid = (np.arange(_LIGHT_SAMPLES) + 0.5) / _LIGHT_SAMPLES
    for light in lights:
        gain = np.zeros(len(start))
        for a in grid:
            for b in grid:
                to_light = light.corner + a * light.sides[0] + b * light.sides[1] - start
                square = np.sum(to_light * to_light, axis=1)
                receives = np.sum(to_light * mesh.normals, axis=1)
                sends = -to_light @ light.normal
                facing = np.flatnonzero((receives > 0) & (sends > 0))
                free = caster.distances(start[facing], to_light[facing]) >= 1 - 1e-3
                lit = facing[free]
                gain[lit] += receives[lit] * sends[lit] / square[lit] ** 2
        area = np.linalg.norm(np.cross(*light.sides))
        total += gain[:, None] * light.radiance * area / len(grid) ** 2 / np.pi
    return total + _AMBIENT * _open_sky(caster, start)[:, None]


def _open_sky(caster: Caster, start: np.ndarray) -> np.ndarray:
    """Share [v] of the cosine-weighted hemisphere that is free, or blocked only farther than `_SKY_REACH`."""
    normals = caster.mesh.normals
    helper = np.where(np.abs(normals[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    across = np.cross(normals, helper)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    along = np.cross(normals, across)
    share = np.zeros(len(start))
    i = np.arange(_SKY_SAMPLES) + 0.5
    radius, phi = np.sqrt(i / _SKY_SAMPLES), np.pi * (1 + 5**0.5) * i
    for x, y, z in zip(radius * np.cos(phi), radius * np.sin(phi), np.sqrt(1 - radius**2), strict=True):
        reached = caster.distances(start, x * across + y * along + z * normals)
        share += np.clip(reached / _SKY_REACH, 0, 1)
    return share / _SKY_SAMPLES


class Shader:
    """Colours at hits: textures as linear reflectance, times the light of the vertices."""

    def __init__(self, caster: Caster, irradiance: np.ndarray):
        mesh = caster.mesh
        self._faces, self._materials = mesh.faces.astype(np.int32), mesh.materials.astype(np.int32)
        # One row per vertex, so that a hit gathers three rows and no more.
        self._attributes = np.column_stack([mesh.uv, irradiance]).astype(np.float32)
        sizes = np.array([texture.shape[:2] for texture in mesh.textures], dtype=np.int32)
        self._heights, self._widths = sizes[:, 0], sizes[:, 1]
        self._starts = np.concatenate([[0], np.cumsum(sizes.prod(axis=1))[:-1]]).astype(np.int32)
        linear = (np.arange(256, dtype=np.float32) / 255) ** np.float32(2.2)
        self._texels = linear[np.concatenate([texture.reshape(-1, 3) for texture in mesh.textures])]

    def __call__(self, hits: Hits) -> np.ndarray:
        """Linear radiance [n 3]; black where a ray meets nothing."""
        face = np.maximum(hits.faces, 0)
        a, b, c = self._faces[face].T
        u, v = hits.u[:, None], hits.v[:, None]
        rows = self._attributes
        values = (1 - u - v) * rows[a] + u * rows[b] + v * rows[c]
        radiance = values[:, 2:] * self._albedo(self._materials[face], values[:, 0], values[:, 1])
        radiance[hits.faces < 0] = 0
        return radiance

    def _albedo(self, material: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Bilinear texture look-up."""
        w, h = self._widths[material], self._heights[material]
        x = np.clip(u * w - 0.5, 0, w - 1.001).astype(np.float32)
        y = np.clip(v * h - 0.5, 0, h - 1.001).astype(np.float32)
        x0, y0 = x.astype(np.int32), y.astype(np.int32)
        fx, fy = (x - x0)[:, None], (y - y0)[:, None]
        at = self._starts[material] + y0 * w + x0
        top = self._texels[at] * (1 - fx) + self._texels[at + 1] * fx
        bottom = self._texels[at + w] * (1 - fx) + self._texels[at + w + 1] * fx
        return top * (1 - fy) + bottom * fy
