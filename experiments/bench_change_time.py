"""Seconds and memory of detection per photograph, for `bench_change time`; content hardly matters: random splats."""

import ctypes
import gc
from collections.abc import Callable
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from experiments.bench_render import control, measure
from experiments.curves import random_scene
from ltgs_jax.detect import change_map, fit_tone
from ltgs_jax.features import Classical
from ltgs_jax.geometry import SE3, Camera
from ltgs_jax.pipeline import Config
from ltgs_jax.pipeline.looks import Eye, Observation, compare

_MB = 2**20


def make_photographs(count: int, width: int, height: int, splats: int) -> tuple[Eye, tuple, list[Observation]]:
    """A scene (`scene_at`) of random splats, and photographs of it with noise in which one rectangle differs."""
    rng, eye = np.random.default_rng(0), Eye()
    scene, camera = random_scene(splats, width, height)
    errors = np.full(splats, 0.1, np.float32)
    observations = []
    for i in range(count):
        shift = SE3(camera.cam_from_world.quat, jnp.asarray([0.01 * i, 0.0, 0.0], jnp.float32))
        moved = Camera(shift, camera.K, width, height)
        image = eye.image(scene, moved) + rng.normal(0, 0.01, (height, width, 3)).astype(np.float32)
        image[height // 3 : height // 2, width // 3 : width // 2] = image[
            : height // 2 - height // 3, : width // 2 - width // 3
        ]
        observations.append(Observation(f"{i}", moved, np.clip(image, 0, 1), np.ones((height, width), bool)))
    return eye, (scene, errors, None, None), observations


def time_parts(width: int, height: int, splats: int) -> dict[str, dict[str, float]]:
    """Median wall and CPU seconds of detection in one photograph, and of its parts, after a first call of each.

    `ratio`: CPU seconds over those of the control of `bench_render`, taken before and after.
    """
    eye, (scene, errors, _, _), (photograph,) = make_photographs(1, width, height, splats)
    front_end = Classical()
    look = eye.look(scene, photograph.camera, errors)

    def tone():
        return fit_tone(photograph.image, look.image, photograph.valid)

    def changes():
        return change_map(look.image, photograph.image, look.expected, photograph.valid, front_end)

    def everything():
        return tone(), compare(eye, (scene, errors, None, None), [photograph], front_end, Config())

    calls: dict[str, Callable] = {
        "light": tone,
        "render": lambda: eye.look(scene, photograph.camera, errors),
        "features of both images": lambda: [front_end.describe(image) for image in (look.image, photograph.image)],
        "change map, features included": changes,
        "all": everything,
    }
    for call in calls.values():
        call()
    before = control()
    times = {name: measure(call) for name, call in calls.items()}
    unit = (before + control()) / 2
    return {
        name: {"seconds": wall / 1e3, "seconds_cpu": cpu / 1e3, "ratio": cpu / unit}
        for name, (wall, cpu) in times.items()
    }


def peak_bytes(call: Callable[[], object]) -> int:
    """Largest resident size of this process during a call (Linux with glibc).

    What earlier work freed goes back to the kernel first, else it would hide what the call takes; then its mark is
    set back.
    """
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    Path("/proc/self/clear_refs").write_text("5")
    call()
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    return 1024 * int(line.split()[1])


def memory_growth(counts: tuple[int, int], width: int, height: int, splats: int) -> dict[str, float]:
    """Megabytes of peak memory per further photograph: of one visit at once, and one by one with the masks kept."""

    def together(count: int) -> None:
        eye, scene, observations = make_photographs(count, width, height, splats)
        compare(eye, scene, observations, Classical(), Config())

    def one_by_one(count: int) -> None:
        eye, scene, observations = make_photographs(1, width, height, splats)
        masks = [compare(eye, scene, observations, Classical(), Config()).masks[0] for _ in range(count)]
        assert len(masks) == count

    growth = {}
    for name, work in (("one by one", one_by_one), ("one visit at once", together)):
        work(1)
        small, large = (peak_bytes(lambda n=n, work=work: work(n)) for n in counts)
        growth[name] = (large - small) / (counts[1] - counts[0]) / _MB
    return growth
