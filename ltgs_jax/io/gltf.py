"""Object poses over the visits as an animation in binary glTF 2.0, which 3D programs and web viewers play."""

import json
import struct
from pathlib import Path

import numpy as np

from ltgs_jax.scene import Chronology, Splats, ground_layers

from .files import write_bytes
from .packing import color_of_sh

_FLOAT, _POINTS = 5126, 0
_ARRAY_BUFFER = 34962
_SECONDS_PER_VISIT = 1.0


class _Buffer:
    """Binary data with its accessors."""

    def __init__(self):
        self.content = bytearray()
        self.views: list[dict] = []
        self.accessors: list[dict] = []

    def add(self, values: np.ndarray, *, is_vertex: bool) -> int:
        """Index of the accessor of float32 `values` [n], [n 3] or [n 4]."""
        values = np.ascontiguousarray(values, "<f4")
        kind = "SCALAR" if values.ndim == 1 else f"VEC{values.shape[1]}"
        view = {"buffer": 0, "byteOffset": len(self.content), "byteLength": values.nbytes}
        self.views.append(view | ({"target": _ARRAY_BUFFER} if is_vertex else {}))
        self.content += values.tobytes()
        flat = values.reshape(len(values), -1)
        bounds = {"min": flat.min(axis=0).tolist(), "max": flat.max(axis=0).tolist()}
        accessor = {"bufferView": len(self.views) - 1, "componentType": _FLOAT, "count": len(values), "type": kind}
        self.accessors.append(accessor | bounds)
        return len(self.accessors) - 1


def write_gltf(path: str | Path, chronology: Chronology, *, most_background: int = 50_000) -> None:
    """Write a .glb: a node per template with its pose keyed once a second per visit, its splats' centres as points.

    Poses move linearly between visits; what is not visible is scaled to 0, at once. The capture's frame is
    kept (glTF viewers take y as up). Of the background at most `most_background` points, evenly spread, are written.
    Raises InputError when the file cannot be written.
    """
    buffer = _Buffer()
    nodes: list[dict] = []
    meshes: list[dict] = []
    step = max(1, -(-chronology.background.count // most_background))
    channels: list[dict] = []
    samplers: list[dict] = []

    def animate(node: int, target: str, values: np.ndarray, interpolation: str) -> None:
        samplers.append({"input": clock, "output": buffer.add(values, is_vertex=False), "interpolation": interpolation})
        channels.append({"sampler": len(samplers) - 1, "target": {"node": node, "path": target}})
        nodes[node][target] = np.asarray(values[0], np.float32).tolist()

    def scales(shown: np.ndarray) -> np.ndarray:
        return np.repeat(shown[:, None].astype(float), 3, axis=1)

    times = np.arange(len(chronology.visits)) * _SECONDS_PER_VISIT
    quats = np.asarray(chronology.world_from_template.quat, np.float64)
    xyz = np.asarray(chronology.world_from_template.xyz, np.float64)
    visible = np.asarray(chronology.visible)
    ground = ground_layers(chronology)
    if chronology.templates or len(ground) > 1:
        clock = buffer.add(times, is_vertex=False)
    for since, splats in ground.items():
        name = "background" if since == 0 else f"background_from_{chronology.visits[since]}"
        node = _add_node(nodes, meshes, buffer, name, splats[::step])
        if since > 0:
            animate(node, "scale", scales(np.arange(len(times)) >= since), "STEP")
    for k, template in enumerate(chronology.templates):
        node = _add_node(nodes, meshes, buffer, _name(chronology, k), template.splats)
        animate(node, "translation", xyz[:, k], "LINEAR")
        animate(node, "rotation", _continuous(quats[:, k])[:, [1, 2, 3, 0]], "LINEAR")
        animate(node, "scale", scales(visible[:, k]), "STEP")
    document = {
        "asset": {"version": "2.0", "generator": "ltgs-jax"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        "extras": {"visits": list(chronology.visits), "seconds_per_visit": _SECONDS_PER_VISIT},
    }
    if buffer.content:
        document |= {"accessors": buffer.accessors, "bufferViews": buffer.views}
        document["buffers"] = [{"byteLength": len(buffer.content)}]
    if meshes:
        document["meshes"] = meshes
    if channels:
        document["animations"] = [{"name": "visits", "channels": channels, "samplers": samplers}]
    write_bytes(path, _glb(document, bytes(buffer.content)))


def _name(chronology: Chronology, k: int) -> str:
    """object_0001, with the number of its state where it has several."""
    identity = chronology.templates[k].identity
    states = [i for i, template in enumerate(chronology.templates) if template.identity == identity]
    return f"object_{identity:04d}" + (f"_state_{states.index(k)}" if len(states) > 1 else "")


def _add_node(nodes: list[dict], meshes: list[dict], buffer: _Buffer, name: str, splats: Splats) -> int:
    """A node with the splats' centres as coloured points; an empty node where there are none."""
    node: dict = {"name": name}
    if splats.count:
        # glTF's colours are linear.
        colors = np.clip(color_of_sh(np.asarray(splats.sh[:, 0])), 0, 1) ** 2.2
        attributes = {
            "POSITION": buffer.add(np.asarray(splats.means), is_vertex=True),
            "COLOR_0": buffer.add(colors, is_vertex=True),
        }
        meshes.append({"name": name, "primitives": [{"attributes": attributes, "mode": _POINTS}]})
        node["mesh"] = len(meshes) - 1
    nodes.append(node)
    return len(nodes) - 1


def _continuous(quats: np.ndarray) -> np.ndarray:
    """Unit quaternions [t 4] whose signs follow one another, so that a player turns the short way."""
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    unit = np.where(norms > 0, quats / np.where(norms > 0, norms, 1), [1.0, 0, 0, 0])
    for t in range(1, len(unit)):
        if unit[t] @ unit[t - 1] < 0:
            unit[t] = -unit[t]
    return unit


def _glb(document: dict, binary: bytes) -> bytes:
    """The container: a JSON chunk padded with spaces, a binary chunk padded with zeros, to 4 bytes each."""
    text = json.dumps(document).encode()
    chunks = [(b"JSON", text + b" " * (-len(text) % 4))]
    if binary:
        chunks.append((b"BIN\0", binary + b"\0" * (-len(binary) % 4)))
    body = b"".join(struct.pack("<I4s", len(content), kind) + content for kind, content in chunks)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body
