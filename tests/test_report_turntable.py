"""Templates rendered alone: from outside, from above, upright, filling the frame, each side its own."""

import jax.numpy as jnp
import numpy as np
import pytest

from ltgs_jax.geometry import C0, SE3
from ltgs_jax.io import save_chronology, write_json
from ltgs_jax.report import write_report
from ltgs_jax.report.turntable import turntable
from ltgs_jax.scene import Chronology, Splats, Template

UP = np.array([0.0, 0.0, 1.0])
COLORS = np.array([[0.9, 0.1, 0.1], [0.1, 0.8, 0.1], [0.1, 0.1, 0.9], [0.9, 0.8, 0.1]])


def _block(middle, size, count):
    """A block of splats whose four upright sides have a colour each, with a white top."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (count, 3))
    axis = np.argmax(np.abs(points[:, :2]), axis=1)
    side = axis + 2 * (np.take_along_axis(points[:, :2], axis[:, None], 1)[:, 0] < 0)
    colors = np.where((points[:, 2] > 0.9)[:, None], 0.95, COLORS[side])
    quats = np.zeros((count, 4))
    quats[:, 0] = 1
    scales = np.full((count, 3), np.log(0.08 * size))
    fields = (np.asarray(middle) + size * points, quats, scales, np.full(count, 5.0), (colors - 0.5)[:, None] / C0)
    return Splats(*(jnp.asarray(field, jnp.float32) for field in fields))


@pytest.fixture(scope="module")
def chronology():
    blocks = (_block((5, -3, 2), 0.1, 1500), _block((0, 0, 0), 20.0, 700))
    templates = tuple(Template(splats, k + 1, 0) for k, splats in enumerate(blocks))
    poses = SE3.identity((1, 2))
    return Chronology(blocks[0][:3], templates, poses, jnp.ones((1, 2), bool), jnp.zeros((0, 3, 2)), ("first",))


@pytest.fixture(scope="module")
def sides(chronology):
    return turntable(chronology, UP)


@pytest.mark.parametrize("k", [0, 1])
def test_every_object_fills_its_frame(sides, k):
    for image in sides[k]:
        rows, columns = np.nonzero(image[..., 3] > 0.5)
        side = image.shape[0]
        assert 0.4 * side < np.ptp(rows) < side - 1 and 0.4 * side < np.ptp(columns) < side - 1
        assert abs(rows.mean() - side / 2) < 0.1 * side and abs(columns.mean() - side / 2) < 0.1 * side
        assert image[0, 0, 3] == 0


def test_each_side_is_seen_once_and_the_top_is_above(sides):
    fronts = []
    for image in sides[0]:
        middle = image[60:100, 50:95, :3].reshape(-1, 3).mean(0)
        fronts.append(int(np.argmin(np.linalg.norm(COLORS - middle, axis=1))))
        rows, _ = np.nonzero((image[..., :3].min(-1) > 0.7) & (image[..., 3] > 0.9))
        assert rows.size and rows.mean() < image.shape[0] / 2, "the white top is in the upper half"
    assert sorted(fronts) == [0, 1, 2, 3]


def test_no_template_is_no_fault(chronology):
    assert turntable(Chronology.of_initial(chronology.background, ("first",)), UP) == []


def test_the_page_shows_them(chronology, tmp_path):
    save_chronology(tmp_path, chronology)
    known = {"source_visit": 0, "splats": 700, "center": [0, 0, 0], "size": 1, "states": []}
    objects = [{"id": identity, **known} for identity in (1, 2)]
    write_json(tmp_path / "tracks.json", {"version": 1, "visits": ["first"], "objects": objects})
    page = write_report(tmp_path).read_text()
    assert page.count("data:image/webp") == 8
