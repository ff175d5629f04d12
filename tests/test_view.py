"""The viewer: what it sends, what its controls do, and, where there is Chromium, what a person sees."""

import json
import signal
import subprocess
import sys
import time
import urllib.request

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from headless import open_browser
from scipy.spatial.transform import Rotation

from ltgs_jax.geometry import C0, SE3, Camera
from ltgs_jax.io import InputError, load_chronology, save_chronology
from ltgs_jax.report import up_direction
from ltgs_jax.scene import Chronology, Shadows, Splats, Template
from ltgs_jax.view.layers import extent_of, layer_of, place_at, viewpoint_of

viser = pytest.importorskip("viser", reason="the extra [view] is not installed")
from ltgs_jax.view import start  # noqa: E402

VISITS = ("before", "after", "later")
WIDTH, HEIGHT, FOCAL = 160, 120, 150.0


def _splats(center, color, *, count=200, spread=0.08, scale=0.02, seed=0):
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(count, 4))
    sh = np.broadcast_to((np.asarray(color) - 0.5) / C0, (count, 1, 3))
    means = np.asarray(center) + rng.uniform(-spread, spread, (count, 3))
    fields = (means, quats, np.full((count, 3), np.log(scale)), np.full(count, 3.0), sh)
    return Splats(*(jnp.asarray(field, jnp.float32) for field in fields))


def _chronology():
    """A grey wall 3 in front of the camera; a red object that moves right, a green one that comes at the last visit."""
    rng = np.random.default_rng(1)
    wall = _splats((0, 0, 3), (0.6, 0.6, 0.6), count=700, spread=0, scale=0.08)
    places = np.column_stack([rng.uniform(-1.4, 1.4, 700), rng.uniform(-1, 1, 700), np.full(700, 3.0)])
    wall = Splats(jnp.float32(places), wall.quats, wall.log_scales, wall.logit_opacities, wall.sh)
    templates = (
        Template(_splats((-0.5, 0, 2), (0.9, 0.1, 0.1)), 4, 0),
        Template(_splats((0, 0.4, 2), (0.1, 0.8, 0.1), seed=2), 9, 2),
    )
    quats = np.zeros((3, 2, 4))
    quats[..., 0] = 1
    xyz = np.zeros((3, 2, 3))
    xyz[1:, 0, 0] = 0.8
    visible = np.array([[True, False], [True, False], [True, True]])
    poses = SE3(jnp.float32(quats), jnp.float32(xyz))
    return Chronology(wall, templates, poses, jnp.asarray(visible), jnp.zeros((0, 3, 2)), VISITS)


def _pose(x=0.0):
    return {"wxyz": [1, 0, 0, 0], "xyz": [x, 0, 0]}


@pytest.fixture
def folder(tmp_path):
    save_chronology(tmp_path, _chronology())
    state = {"visible": True, "confidence": 0.9, "inliers": 9, "residual": 0.1, "ambiguous_axis": None}
    known = {"splats": 200, "center": [0, 0, 2], "size": 0.3}
    moved = {"visit": 1, "event": "moved", "world_from_template": _pose(0.8), **state}
    came = {"visit": 2, "event": "added", "world_from_template": _pose(), **state}
    objects = [
        {"id": 4, "source_visit": 0, "states": [moved], **known},
        {"id": 9, "source_visit": 2, "states": [came], **known},
    ]
    K = [[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]
    camera = {"K": K, "width": WIDTH, "height": HEIGHT, "cam_from_world": _pose()}
    photographs = [{"name": f"{visit}/0.png", "visit": visit, "role": "update"} for visit in VISITS]
    files = {
        "tracks": {"version": 1, "visits": VISITS, "photographs": [], "objects": objects},
        "report": {"photographs": photographs},
        "cameras": {"capture": "/somewhere", "photographs": {entry["name"]: camera for entry in photographs}},
    }
    for name, value in files.items():
        (tmp_path / f"{name}.json").write_text(json.dumps(value))
    return tmp_path


@pytest.fixture
def viewer(folder):
    viewer = start(folder, port=18080)
    yield viewer
    viewer.server.stop()


def test_a_layer_is_what_the_splats_are():
    splats = _splats((1, 2, 3), (0.2, 0.5, 1.4), count=5)
    splats = Splats(
        splats.means,
        splats.quats.at[0].set(0),
        splats.log_scales + jnp.asarray([0.0, 1.0, -1.0]),
        splats.logit_opacities.at[4].set(-20),
        splats.sh,
    )
    layer = layer_of(splats)
    assert layer.centers.shape == (4, 3) and layer.opacities.shape == (4, 1)
    for i in range(4):
        quat = np.asarray(splats.quats[i]) if i else np.array([1.0, 0, 0, 0])
        rotation = Rotation.from_quat(quat, scalar_first=True).as_matrix()
        expected = rotation @ np.diag(np.exp(2 * np.asarray(splats.log_scales[i]))) @ rotation.T
        np.testing.assert_allclose(layer.covariances[i], expected, rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(layer.rgbs[0], [0.2, 0.5, 1.0], atol=1e-6)
    np.testing.assert_allclose(layer.tinted((255, 0, 0), strength=1.0)[0], [1, 0, 0])


def test_between_visits_an_object_goes_the_straight_way():
    turn = Rotation.from_rotvec([0, 0, np.radians(80)])
    quats = jnp.asarray(np.stack([[1.0, 0, 0, 0], -2 * turn.as_quat(scalar_first=True)])[:, None], jnp.float32)
    poses = SE3(quats, jnp.asarray([[[0.0, 0, 0]], [[1.0, 2, 3]]]))
    splats = _splats((0, 0, 0), (0, 0, 0), count=3)
    chronology = Chronology(
        splats, (Template(splats, 1, 0),), poses, jnp.ones((2, 1), bool), jnp.zeros((0, 3, 2)), ("a", "b")
    )
    place = place_at(chronology, 0, 0.25)
    assert place.visible
    np.testing.assert_allclose(place.xyz, [0.25, 0.5, 0.75], atol=1e-6)
    between = Rotation.from_quat(place.wxyz, scalar_first=True).as_rotvec(degrees=True)
    np.testing.assert_allclose(between, [0, 0, 20], atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(place_at(chronology, 0, 1).wxyz), 1)


def test_an_object_that_comes_appears_half_way():
    chronology = _chronology()
    assert [place_at(chronology, 1, t).visible for t in (0, 1, 1.4, 1.6, 2)] == [False, False, False, True, True]
    np.testing.assert_allclose(place_at(chronology, 0, 1.5).xyz, [0.8, 0, 0], atol=1e-6)


def test_viewpoints():
    quat = Rotation.from_euler("xyz", [0.3, -0.2, 1.0]).as_quat(scalar_first=True)
    camera = Camera(SE3(jnp.float32(quat), jnp.float32([1, 2, 3])), jnp.diag(jnp.float32([200, 100, 1])), 50, 80)
    view = viewpoint_of(camera)
    np.testing.assert_allclose(view.position, camera.center(), atol=1e-6)
    assert view.fov == pytest.approx(2 * np.arctan(40 / 100))
    down_in_world = Rotation.from_quat(view.wxyz, scalar_first=True).apply([0, 1, 0])
    np.testing.assert_allclose(camera.cam_from_world.rotmat() @ down_in_world, [0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(up_direction([camera]), -down_in_world, atol=1e-6)
    np.testing.assert_array_equal(up_direction([]), [0, -1, 0])


def test_the_extent_does_not_mind_strays():
    splats = _splats((1, 1, 1), (0, 0, 0))
    far = Splats(splats.means.at[0].set(1e6), splats.quats, splats.log_scales, splats.logit_opacities, splats.sh)
    middle, reach = extent_of(layer_of(far))
    np.testing.assert_allclose(middle, [1, 1, 1], atol=0.03)
    assert 0.05 < reach < 0.2
    assert extent_of(layer_of(splats[:0]))[1] == 1


def test_the_controls(viewer):
    red, green = viewer._objects
    assert (red.visible, green.visible) == (True, False)
    assert "before" in viewer._happened.content and "first visit" in viewer._happened.content
    viewer.show_visit(1, animated=False)
    np.testing.assert_allclose(red.position, [0.8, 0, 0], atol=1e-6)
    assert "object 4 moved by 0.8" in viewer._happened.content
    assert viewer._photograph.value == "after/0.png" and viewer._slider.value == 1
    viewer.show_visit(2)
    assert green.visible and "object 9 came (0.90)" in viewer._happened.content
    viewer.hide(9)
    assert not green.visible
    viewer.show_visit(1, animated=False)
    viewer.show_visit(2, animated=False)
    assert not green.visible, "hidden stays hidden over visits"
    viewer.hide(9, False)
    assert green.visible
    plain = red.rgbs.copy()
    viewer.highlight(4)
    assert not np.array_equal(red.rgbs, plain) and viewer._chosen.value == "object 4"
    viewer.highlight(None)
    assert viewer._chosen.value == "none"
    assert np.array_equal(red.rgbs, plain) and not viewer._labels
    viewer._show_frusta.value = True
    viewer._refresh()
    assert [viewer._frusta[f"{visit}/0.png"].visible for visit in VISITS] == [False, False, True]


def test_colours_are_those_of_the_visit(folder):
    chronology = load_chronology(folder)
    shade = jnp.zeros((3, len(chronology.templates), 4)).at[1, 0, 0].set(-0.7)
    middle = np.asarray(chronology.background.means)[0]
    blob = Shadows(jnp.asarray(middle)[None], jnp.asarray([0.1]), jnp.asarray([-0.7]), jnp.asarray([[0], [1], [0]]) > 0)
    lit = eqx.tree_at(lambda c: (c.shade, c.shadows), chronology, (shade, blob), is_leaf=lambda leaf: leaf is None)
    save_chronology(folder, lit)
    viewer = start(folder, port=18080)
    try:
        handles = viewer._objects[0], viewer._ground[0]
        before = [np.asarray(handle.rgbs, float).sum() for handle in handles]
        viewer.show_visit(1, animated=False)
        assert all(np.asarray(h.rgbs, float).sum() < b for h, b in zip(handles, before, strict=True))
        viewer.show_visit(0, animated=False)
        assert [np.asarray(handle.rgbs, float).sum() for handle in handles] == before
    finally:
        viewer.server.stop()


def test_a_folder_without_photographs_can_be_viewed(folder):
    (folder / "report.json").unlink()
    viewer = start(folder, port=18080)
    try:
        viewer.show_visit(2, animated=False)
        assert viewer._objects[1].visible
    finally:
        viewer.server.stop()


def test_a_broken_chronology_is_named(folder):
    (folder / "chronology.safetensors").write_bytes(b"short")
    with pytest.raises(InputError, match=r"chronology\.safetensors"):
        start(folder, port=18080)


def test_the_command_serves_until_it_is_interrupted(folder):
    # A shell's background job ignores SIGINT, and its children with it; a terminal's does not.
    heed = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    program = heed + "import sys; from ltgs_jax.cli import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", program, "view", str(folder), "--port", "18090"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        line = next(line for line in process.stdout if line.startswith("http://"))
        with urllib.request.urlopen(line.split()[0], timeout=60) as page:
            assert page.status == 200
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60) == 0
        assert "Traceback" not in process.stderr.read()
    finally:
        process.kill()
        process.communicate()


def _wait_for_client(viewer):
    deadline = time.monotonic() + 60
    while not viewer.server.get_clients():
        assert time.monotonic() < deadline, "the page does not connect"
        time.sleep(0.1)
    return next(iter(viewer.server.get_clients().values()))


def _settled_render(client, view):
    """The page's own render, once the wall is there and two in a row agree: splats are sorted a while later."""
    options = {"wxyz": view.wxyz, "position": view.position, "fov": view.fov}
    deadline, before = time.monotonic() + 120, None
    while True:
        image = client.get_render(HEIGHT, WIDTH, **options)[..., :3].astype(int)
        if before is not None and (image < 200).mean() > 0.5 and np.abs(image - before).max() < 30:
            return image
        assert time.monotonic() < deadline, "the page does not settle"
        before = image
        time.sleep(0.5)


def _pixels_that_differ(image, other):
    """Columns and rows of the pixels that differ, and which part of the image they are."""
    rows, columns = np.nonzero(np.abs(image - other).max(-1) > 60)
    return columns, rows, rows.size / image.shape[0] / image.shape[1]


def test_each_visit_looks_different_where_it_should(viewer, tmp_path):
    """Renders of the page itself: the red object jumps to the right, then the green one comes below the middle."""
    with open_browser(tmp_path / "profile", width=700, height=420) as page:
        page.open(f"http://localhost:{viewer.server.get_port()}")
        client = _wait_for_client(viewer)
        images = []
        for visit in range(3):
            viewer.show_visit(visit, animated=False)
            time.sleep(1)
            images.append(_settled_render(client, viewer._viewpoints["before/0.png"]))
            assert VISITS[visit] in page.evaluate("document.body.innerText")
        shot = page.screenshot()
        errors = page.errors
    assert len(shot) > 10_000
    columns, _, part = _pixels_that_differ(images[1], images[0])
    left, right = columns[columns < WIDTH / 2], columns[columns >= WIDTH / 2]
    assert 0.01 < part < 0.2
    # x = ∓0.5, 0.3 at depth 2 with a focal length of 150 px
    assert abs(left.mean() - (WIDTH / 2 - 37.5)) < 4 and abs(right.mean() - (WIDTH / 2 + 22.5)) < 4
    columns, rows, part = _pixels_that_differ(images[2], images[1])
    assert 0.005 < part < 0.1
    assert abs(columns.mean() - WIDTH / 2) < 4 and abs(rows.mean() - (HEIGHT / 2 + 30)) < 4
    # viser's own: a bounding sphere that three.js asks of instanced splats, an image URL it lets go of early
    own = [error for error in errors if "computeBoundingSphere" not in error and "blob:" not in error]
    assert not own
