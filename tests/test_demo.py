"""The built-in captures: what they hold agrees with their truth, by the cameras that a user reads."""

import itertools
import json
import sys

import numpy as np
import pytest

from ltgs_jax import demo, io
from ltgs_jax.demo.room import TABLE_SIZE, TABLE_TOP
from ltgs_jax.demo.story import tell

pytest.importorskip("embreex", reason="the extra `demo` is not installed")

SMALL = {"width": 96, "height": 72, "dense": 8, "update": 2, "test": 1, "points": 500}


@pytest.fixture(scope="module")
def turnover(tmp_path_factory):
    return demo.make_capture(tmp_path_factory.mktemp("turnover") / "capture", scene="turnover", seed=3, **SMALL)


def truth_of(folder) -> dict:
    return json.loads((folder / "truth" / "objects.json").read_text())


def test_it_is_a_capture(turnover):
    capture = io.read_capture(turnover)
    assert capture.visits == ("IMG_0000", "IMG_0001", "IMG_0002", "IMG_0003") and not capture.problems
    counts = [(len(capture.at(t, "train", "update")), len(capture.at(t, "test"))) for t in range(4)]
    assert counts == [(8, 1), (2, 1), (2, 1), (2, 1)]
    assert all(p.camera is not None and p.lens_given for p in capture.photographs)
    images = [io.load_image(p) for p in capture.photographs]
    means = np.array([image.mean() for image in images])
    assert np.all((means > 0.2) & (means < 0.8)) and min(image.std() for image in images) > 0.08


def test_masks_lie_where_the_truth_puts_the_objects(turnover):
    """Corners of each object's box, by its pose and the photograph's camera, bound its mask; boxes are tight."""
    truth, capture = truth_of(turnover), io.read_capture(turnover)
    seen = 0
    for photograph in capture.photographs:
        labels = io.read_labels(turnover / "truth" / "masks" / photograph.name)
        assert labels.shape == (72, 96)
        present = {truth["ids"][name] for name in truth["times"][photograph.visit]}
        assert set(np.unique(labels)) - {0} <= present
        for name, pose in truth["times"][photograph.visit].items():
            w, d, h = truth["extents"][name]
            corners = np.array(list(itertools.product((-w / 2, w / 2), (-d / 2, d / 2), (0, h))))
            world = corners @ np.array(pose)[:3, :3].T + np.array(pose)[:3, 3]
            pixels, depths = photograph.camera.project(world.astype(np.float32))
            rows, columns = np.nonzero(labels == truth["ids"][name])
            if len(rows) < 20 or np.min(depths) < 0:
                continue
            low, high = np.asarray(pixels).min(axis=0), np.asarray(pixels).max(axis=0)
            assert np.all(low <= [columns.min() + 1, rows.min() + 1])
            assert np.all(high >= [columns.max(), rows.max()])
            inside = np.all(low > 2) and np.all(high < [94, 70])
            if inside and len(rows) > 60:
                seen += 1
                assert (columns.max() - columns.min() + 1) > 0.5 * (high[0] - low[0])
    assert seen > 20


def test_sparse_points_lie_where_they_are_seen(turnover):
    capture = io.read_capture(turnover)
    seen = capture.point_observations
    assert len(capture.points) > 300
    assert np.all(np.bincount(seen.points, minlength=len(capture.points)) >= 2)
    dense = [i for i, p in enumerate(capture.photographs) if p.role == "train"]
    assert set(np.unique(seen.photographs)) <= set(dense)
    residuals, differences = [], []
    for index in dense:
        mine = seen.photographs == index
        photograph = capture.photographs[index]
        pixels = np.asarray(photograph.camera.project(capture.points.astype(np.float32))[0])[seen.points[mine]]
        residuals.append(np.linalg.norm(pixels - seen.pixels[mine], axis=1))
        column, row = np.clip(pixels, 0, [95, 71]).astype(int).T
        differences.append(np.abs(io.load_image(photograph)[row, column] - capture.point_colors[seen.points[mine]]))
    # 0.35 px of each coordinate and 1.5 mm of the point, 1.5 m away.
    assert 0.3 < np.median(np.concatenate(residuals)) < 0.7
    assert np.median(np.concatenate(differences)) < 0.06


def test_the_same_arguments_give_the_same_files_and_other_seeds_others(tmp_path):
    tiny = {"width": 32, "height": 24, "dense": 3, "update": 1, "test": 1, "points": 50}
    first = demo.make_capture(tmp_path / "a", scene="nochange", seed=5, **tiny)
    second = demo.make_capture(tmp_path / "b", scene="nochange", seed=5, **tiny)
    third = demo.make_capture(tmp_path / "c", scene="light", seed=6, **tiny)
    files = sorted(path.relative_to(first) for path in first.rglob("*") if path.is_file())
    assert len(files) == 2 * (4 + 3 * 2) + 2 + 3 + 1
    for file in files:
        assert (first / file).read_bytes() == (second / file).read_bytes()
    assert truth_of(first)["times"][0] != truth_of(third)["times"][0]
    for folder in (first, third):
        times = truth_of(folder)["times"]
        assert times[0] == times[1] == times[2] == times[3]


def test_light_changes_photographs_of_later_visits_alone():
    from ltgs_jax.demo.capture import _develop

    film = np.full((8, 8, 3), 0.4)
    plain = _develop(film, np.random.default_rng(0), changed_light=False).mean(axis=(0, 1))
    others = [_develop(film, np.random.default_rng(seed), changed_light=True).mean(axis=(0, 1)) for seed in range(20)]
    np.testing.assert_allclose(plain, 0.4 ** (1 / 2.2), atol=0.01)
    assert np.ptp([other.mean() for other in others]) > 0.2 and np.ptp([other[0] - other[2] for other in others]) > 0.05


@pytest.mark.parametrize("scene", demo.SCENES)
def test_stories_keep_things_apart_and_on_the_table(scene):
    for seed in range(4):
        story = tell(scene, np.random.default_rng(seed))
        assert len(story.visits) == 4 and 4 <= len(story.visits[0]) <= 6
        reach = {thing.name: thing.reach for thing in story.things}
        for visit in story.visits:
            for a, b in itertools.combinations(visit, 2):
                distance = np.hypot(visit[a].x - visit[b].x, visit[a].y - visit[b].y)
                stacked = abs(visit[a].z - visit[b].z) > 0.01
                assert stacked or distance > reach[a] + reach[b] - 0.021
            for spot in visit.values():
                assert abs(spot.x) < TABLE_SIZE[0] / 2 and abs(spot.y) < TABLE_SIZE[1] / 2 and spot.z >= TABLE_TOP


def events(story) -> set[str]:
    found = set()
    for before, after in itertools.pairwise(story.visits):
        for name in before.keys() | after.keys():
            if name not in after:
                found.add("removed")
            elif name not in before:
                known = any(name in visit for visit in story.visits[: story.visits.index(after)])
                found.add("put back" if known else "added")
            elif before[name] != after[name]:
                same_place = np.hypot(before[name].x - after[name].x, before[name].y - after[name].y) < 1e-9
                found.add("turned" if same_place else "moved")
    return found


@pytest.mark.parametrize(
    ("scene", "expected"),
    [
        ("move", {"moved", "turned"}),
        ("turnover", {"moved", "turned", "added", "removed", "put back"}),
        ("clutter", {"moved", "added", "removed"}),
        ("nochange", set()),
        ("light", set()),
    ],
)
def test_stories_hold_the_events_of_their_scene(scene, expected):
    assert events(tell(scene, np.random.default_rng(1))) == expected


def test_faults_are_named(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="scene: expected one of move"):
        demo.make_capture(tmp_path, scene="flood")
    (tmp_path / "images").mkdir()
    with pytest.raises(io.InputError, match="already holds"):
        demo.make_capture(tmp_path)
    monkeypatch.setitem(sys.modules, "embreex", None)
    monkeypatch.setitem(sys.modules, "embreex.mesh_construction", None)
    with pytest.raises(io.InputError, match=r"ltgs-jax\[demo\]"):
        demo.make_capture(tmp_path / "new", **SMALL)
