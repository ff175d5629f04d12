"""What a run leaves behind: the files of contract.md."""

from collections.abc import Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ltgs_jax.geometry import SE3, Camera, rotation_angle
from ltgs_jax.io import (
    InputError,
    distort_labels,
    read_json,
    save_chronology,
    write_image,
    write_json,
    write_labels,
    write_ply,
    write_tracks,
)
from ltgs_jax.scene import Chronology, Splats, compose, drop_hidden

from .looks import Eye
from .reshaped import APART
from .state import Account

_STILL = 1e-3  # a pose that changed by less, in object sizes or radians, did not change


def write_outputs(
    out: Path,
    run,
    chronology: Chronology,
    initial: Splats,
    accounts: Sequence[Sequence[Account]],
    eye: Eye,
    store,
    progress,
) -> None:
    """Write the chronology, one PLY per visit and per object, tracks, masks and renders."""

    def compute():
        save_chronology(out, chronology)
        prefix = run.capture.folder.resolve().name
        scenes = [drop_hidden(compose(chronology, t)) for t in range(len(chronology.visits))]
        for t, scene in enumerate(scenes):
            write_ply(out / "splats" / f"{prefix}_{t:04d}.ply", scene)
        for k, template in enumerate(chronology.templates):
            write_ply(out / "objects" / _name_of(chronology, k), template.splats)
        write_ply(out / "initial.ply", initial)
        cameras = {p.name: p for p in run.capture.photographs if p.name in run.cameras}
        write_json(
            out / "cameras.json",
            {
                "capture": str(run.capture.folder.resolve()),
                "photographs": {
                    name: {"visit": p.visit, "role": p.role, **_camera_json(run.cameras[name])}
                    for name, p in cameras.items()
                },
            },
        )
        shown = [p for p in cameras.values() if (p.visit > 0 and p.role in ("update", "test")) or p.role == "test"]
        if not any(p.visit == 0 for p in shown):  # one, by which the first scene can be judged
            shown += [p for p in cameras.values() if p.visit == 0][:1]
        manifest = []
        for i, photograph in enumerate(shown):
            progress.step(i, len(shown), f"rendering {photograph.name}")
            camera = run.cameras[photograph.name]
            name = Path(photograph.name).with_suffix(".png")
            write_image(out / "renders" / name, eye.image(scenes[photograph.visit], camera))
            write_image(out / "renders_initial" / name, eye.image(initial, camera))
            entry = {
                "name": photograph.name,
                "visit": photograph.visit,
                "role": photograph.role,
                "capture_path": str(photograph.path.resolve()),
                "render_path": str(Path("renders") / name),
                "initial_render_path": str(Path("renders_initial") / name),
                "mask_path": None,
            }
            if photograph.role == "update":
                labels = object_labels(chronology, photograph.visit, camera, eye)
                write_labels(out / "masks" / name, distort_labels(labels, photograph))
                entry["mask_path"] = str(Path("masks") / name)
            manifest.append(entry)
        write_json(out / "report.json", {"photographs": manifest})
        identities = dict.fromkeys(m.identity for m in chronology.templates)
        on_renders = [_share_on_renders(run, t) for t in range(len(chronology.visits))]
        objects = [_track(chronology, identity, accounts, on_renders) for identity in identities]
        write_tracks(
            out / "tracks.json",
            visits=list(chronology.visits),
            photographs=[
                {"name": s.name, "status": s.status, "inliers": s.inliers, "reason": s.reason}
                for s in run.found.photographs
                if not s.name.startswith(f"{chronology.visits[0]}/")
            ],
            objects=objects,
        )
        return {}, {"counts": {"files": len(scenes) + len(objects) + 2 * len(shown), "objects": len(objects)}}

    store.run("outputs", never(), compute)


def never() -> str:
    """A key that no earlier run has: what is cheap to write is written again."""
    import secrets

    return secrets.token_hex(8)


def _camera_json(camera: Camera) -> dict:
    return {
        "width": camera.width,
        "height": camera.height,
        "K": np.asarray(camera.K, float).tolist(),
        "cam_from_world": {
            "wxyz": np.asarray(camera.cam_from_world.quat, float).tolist(),
            "xyz": np.asarray(camera.cam_from_world.xyz, float).tolist(),
        },
    }


def read_cameras(out: Path) -> tuple[Path, dict[str, tuple[int, str, Camera]]]:
    """The capture's folder, and visit, role and camera of each placed photograph, from cameras.json."""
    path = out / "cameras.json"
    content = read_json(path)
    try:
        cameras = {
            name: (
                int(entry["visit"]),
                str(entry["role"]),
                Camera(
                    SE3(
                        jnp.asarray(entry["cam_from_world"]["wxyz"], jnp.float32),
                        jnp.asarray(entry["cam_from_world"]["xyz"], jnp.float32),
                    ),
                    jnp.asarray(entry["K"], jnp.float32),
                    int(entry["width"]),
                    int(entry["height"]),
                ),
            )
            for name, entry in content["photographs"].items()
        }
        return Path(content["capture"]), cameras
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(f"{path}: is not a list of cameras ({error})") from None


def object_labels(chronology: Chronology, t: int, camera: Camera, eye: Eye) -> Int[np.ndarray, "h w"]:
    """Identity of the object that each pixel shows mostly, 0 where it shows none."""
    identities = sorted({m.identity for m in chronology.templates})
    if not identities:
        return np.zeros((camera.height, camera.width), np.int32)
    counts = [chronology.background.count, *[m.splats.count for m in chronology.templates]]
    owner = np.repeat([0, *[m.identity for m in chronology.templates]], counts)
    painted = eye.paint(compose(chronology, t), camera, owner[:, None] == np.asarray(identities))
    mostly = np.asarray(identities, np.int32)[painted.argmax(axis=-1)]
    return np.where(painted.max(axis=-1) > 0.5, mostly, 0)


def pose_change(a: SE3, b: SE3, size: float) -> tuple[float, float]:
    """Translation in object sizes and rotation in radians between two poses of a template."""
    motion = a.inverse() @ b
    moved = float(np.linalg.norm(np.asarray(motion.xyz))) / max(size, 1e-9)
    return moved, float(rotation_angle(motion.quat / jnp.linalg.norm(motion.quat)))


def _share_on_renders(run, visit: int) -> float:
    """Of a visit's photographs that are used, the share whose pose was found on renders of the first scene."""
    used = [p.name for p in run.posed(visit, "update")]
    return sum(name in run.on_renders for name in used) / max(len(used), 1)


def _track(
    chronology: Chronology, identity: int, accounts: Sequence[Sequence[Account]], on_renders: Sequence[float]
) -> dict:
    """The entry of one object in tracks.json: of each visit the template that shows, or showed last, and its pose.

    `on_renders`: of each visit, the share of its photographs whose pose was found on renders.
    """
    states_of = [k for k, m in enumerate(chronology.templates) if m.identity == identity]
    visible = np.asarray(chronology.visible)
    boxes = {k: _box_of(chronology.templates[k].splats) for k in states_of}
    shown = [next((k for k in states_of if visible[t, k]), None) for t in range(len(chronology.visits))]
    last, states = next((k for k in shown if k is not None), states_of[0]), []
    for t in range(1, len(chronology.visits)):
        before, now = shown[t - 1], shown[t]
        last = k = last if now is None else now
        pose = chronology.world_from_template[t, k]
        account = next((a for a in accounts[t] if a.template == k), None) if t < len(accounts) else None
        event = "still"
        if now is None:
            event = "removed" if before is not None else "unseen"
        elif before is None:
            event = "added"
        elif now != before:
            places, sizes = zip(
                *(_place_of(chronology, boxes[i], s, i) for s, i in ((t - 1, before), (t, now))), strict=True
            )
            event = "moved" if np.linalg.norm(places[1] - places[0]) > APART * max(sizes) else "new_state"
        else:
            _, size = _place_of(chronology, boxes[k], t, k)
            moved, turned = pose_change(chronology.world_from_template[t - 1, k], pose, size)
            if max(moved, turned) > _STILL:
                event = "moved"
        quat = np.asarray(pose.quat, float)
        axis = None if account is None else account.ambiguous_axis
        states.append(
            {
                "visit": t,
                "event": event,
                "visible": now is not None,
                "world_from_template": {
                    "wxyz": (quat / np.linalg.norm(quat)).tolist(),
                    "xyz": np.asarray(pose.xyz, float).tolist(),
                },
                "confidence": 1.0 if account is None else round(_confidence(account, on_renders[t]), 3),
                "inliers": 0 if account is None else account.views,
                "residual": 0.0 if account is None else account.residual,
                "ambiguous_axis": None if axis is None else [*axis],
            }
        )
    first = chronology.templates[states_of[0]]
    low, high = boxes[states_of[0]]
    return {
        "id": identity,
        "source_visit": first.source_visit,
        "splats": first.splats.count,
        "center": ((low + high) / 2).tolist(),
        "size": float(np.linalg.norm(high - low)),
        "states": states,
    }


def _place_of(chronology: Chronology, box: Float[np.ndarray, "2 3"], t: int, k: int) -> tuple[np.ndarray, float]:
    """Where the middle of a template's box is at visit t, in world coordinates, and its diagonal."""
    middle = chronology.world_from_template[t, k].apply(jnp.asarray(box.mean(axis=0), jnp.float32)[None])[0]
    return np.asarray(middle), float(np.linalg.norm(box[1] - box[0]))


def _box_of(splats: Splats) -> Float[np.ndarray, "2 3"]:
    """Corners of the box that holds the central 98 % of splats along each axis."""
    return np.quantile(np.asarray(splats.means, np.float64), [0.01, 0.99], axis=0)


def _name_of(chronology: Chronology, k: int) -> str:
    """The file of a template: by its object, and for a later state of it by the visit that first showed it too."""
    template = chronology.templates[k]
    later = any(m.identity == template.identity for m in chronology.templates[:k])
    return f"object_{template.identity:04d}{f'_{template.source_visit:04d}' if later else ''}.ply"


def _confidence(account: Account, on_renders: float) -> float:
    """Between 0 and 1: more photographs and a larger share of the error explained. A photograph whose pose was found on
    renders of the scene is no witness apart from the scene, and counts half."""
    witnesses = min(account.views, 3) * (1 - 0.5 * on_renders)
    return float(np.clip(account.gain, 0, 1) * (1 - 0.5**witnesses) / (1 - 0.5**3))
