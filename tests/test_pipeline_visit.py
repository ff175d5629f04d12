"""What a visit's evidence is taken for: light or a thing, a burden or its foot, turned or as it stood."""

import json
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ltgs_jax.detect import ChangeMap
from ltgs_jax.fit import View, VisitView
from ltgs_jax.geometry import C0, SE3, Camera
from ltgs_jax.match import Instance
from ltgs_jax.pipeline import arrivals
from ltgs_jax.pipeline.arrivals import _left_beside, convincing
from ltgs_jax.pipeline.carried import carry_on
from ltgs_jax.pipeline.config import Config
from ltgs_jax.pipeline.departures import _went_along
from ltgs_jax.pipeline.ground import ground_shade, light_alone
from ltgs_jax.pipeline.in_place import _turned_candidates
from ltgs_jax.pipeline.ledger import small_views
from ltgs_jax.pipeline.looks import Evidence, Eye, Observation, on_host, still_changed
from ltgs_jax.pipeline.outputs import _name_of, _track
from ltgs_jax.pipeline.prune import drop_idle, late_splats, merge_ground, without
from ltgs_jax.pipeline.reshaped import join_states
from ltgs_jax.pipeline.state import (
    Account,
    State,
    add_template,
    composed,
    cut_background,
    extend_background,
    extend_template,
    hand_over,
    scene_at,
    set_from,
    split_template,
)
from ltgs_jax.scene import Splats, Template, concatenate_splats, drop_hidden, transform_splats
from ltgs_jax.template import Placement, Support
from ltgs_jax.template.background import flat_splats

_FLOOR = Support(np.array([0.0, 0, 1]), 0.0, 0.002)


def _box(rng, count: int, low, high, color=(0.5, 0.5, 0.5)) -> Splats:
    means = rng.uniform(low, high, (count, 3)).astype(np.float32)
    sh = np.tile(((np.float32(color) - 0.5) / C0)[None, None], (count, 1, 1)).astype(np.float32)
    quats, scales = np.tile(np.float32([1, 0, 0, 0]), (count, 1)), np.full((count, 3), np.log(0.02), np.float32)
    return Splats(means, quats, scales, np.full(count, 3, np.float32), sh)


def _shifted(x: float) -> SE3:
    return SE3(jnp.asarray([1.0, 0, 0, 0]), jnp.asarray([x, 0.0, 0]))


@pytest.fixture
def state() -> State:
    """A floor, and a thing upon another that moved together at the second of four visits."""
    rng = np.random.default_rng(2)
    floor = _box(rng, 400, [-1, -1, 0], [1, 1, 0], (0.6, 0.45, 0.3))
    start = State.of_initial(floor, np.zeros(400, np.float32), ("a", "b", "c", "d"))
    book, mug = (
        _box(rng, 100, [-0.2, -0.2, 0], [0.2, 0.2, 0.05]),
        _box(rng, 80, [-0.05, -0.05, 0.05], [0.05, 0.05, 0.2]),
    )
    stack = Splats(*(np.concatenate(pair) for pair in zip(vars(book).values(), vars(mug).values(), strict=True)))
    there = add_template(start, Template(stack, 1, 0), np.zeros(180, np.float32), _FLOOR, 0)
    return set_from(there, 1, 0, visible=True, pose=_shifted(0.6))


def test_one_gain_over_all_photographs_is_light_and_nothing_else_is():
    rng = np.random.default_rng(0)
    wood = [0.5 + 0.1 * rng.normal(size=(40, 40, 1)) * [1, 0.8, 0.5] for _ in range(3)]
    mask = np.zeros((40, 40), bool)
    mask[10:25, 10:25] = True
    masks = [mask] * 3
    for gain in (0.6, 1.4):
        found = light_alone([np.where(mask[..., None], gain * w, w) for w in wood], wood, masks)
        assert found == pytest.approx(gain, rel=0.1)
    printed = 0.3 + 0.4 * (rng.uniform(size=(40, 40, 1)) > 0.5) * np.ones(3)
    assert light_alone([np.where(mask[..., None], printed, w) for w in wood], wood, masks) is None
    plain = np.full((40, 40, 3), [0.5, 0.3, 0.6])
    assert light_alone([np.where(mask[..., None], plain, w) for w in wood], wood, masks) is None
    # One photograph in which it is a thing is enough, one that shows too little of it says nothing.
    shadows = [np.where(mask[..., None], 0.6 * w, w) for w in wood]
    assert light_alone([printed, *shadows[1:]], wood, masks) is None
    few = np.zeros((40, 40), bool)
    few[:4, :4] = True
    assert light_alone([printed, *shadows[1:]], wood, [few, mask, mask]) is not None
    assert light_alone(shadows, wood, [few] * 3) is None


def test_bright_ground_is_ground_only_where_a_shadow_may_have_left():
    rng = np.random.default_rng(1)
    floor = _box(rng, 800, [-1, -1, 0], [1, 1, 0], (0.5, 0.4, 0.3))
    patch = _box(rng, 60, [-0.1, -0.1, 0], [0.1, 0.1, 0.004], (0.65, 0.52, 0.39))
    assert ground_shade(patch, _FLOOR, floor, unshaded=True)[0] is True
    assert ground_shade(patch, _FLOOR, floor)[0] is False
    other = _box(rng, 60, [-0.1, -0.1, 0], [0.1, 0.1, 0.004], (0.3, 0.5, 0.75))
    assert ground_shade(other, _FLOOR, floor, unshaded=True)[0] is False


def test_what_is_light_or_ground_is_not_searched_for_known_objects_and_everything_is_tried_as_new_once(
    state, monkeypatch
):
    rng = np.random.default_rng(1)
    patch = _box(rng, 60, [-0.1, -0.1, 0], [0.1, 0.1, 0.004], (0.6, 0.45, 0.3))
    new = arrivals.NewObject(Template(patch, 2, 1), np.ones(60, bool), np.zeros((0, 4, 4), bool), 0.1, 1.0, 1.0, 0.5)
    volume = Instance(np.asarray(patch.means, np.float64), (), 3)
    light, ground, thing = (
        arrivals.Arrival(volume, _FLOOR, None, None, bared, gain)
        for bared, gain in ((0.0, 1.3), (0.9, None), (0.0, None))
    )
    tried, searched = [], []
    monkeypatch.setattr(arrivals, "_as_new", lambda s, t, arrival, *a, **k: tried.append(arrival) or new)
    monkeypatch.setattr(arrivals, "_searches", lambda s, t, arrival, *a, **k: searched.append(arrival) or {})
    hidden = set_from(state, 1, 0, visible=False)
    tools = {"eye": None, "config": Config(), "rng": rng, "progress": None}
    _, accounts, known, rest = arrivals._place_known(hidden, 1, {}, [light, ground, thing], [], None, None, **tools)
    assert searched == [thing]
    assert tried == [light, ground, thing]
    assert not accounts and not known and [arrival for arrival, _, _ in rest] == [light, ground, thing]


def test_a_new_object_may_mend_what_is_around_it_but_explains_no_more_itself_than_changed():
    def explains(gain: float, own_gain: float) -> bool:
        rng = np.random.default_rng(1)
        patch = _box(rng, 8, [-0.1, -0.1, 0], [0.1, 0.1, 0.1], (0.6, 0.2, 0.2))
        outlines = np.zeros((1, 4, 4), bool)
        new = arrivals.NewObject(Template(patch, 2, 1), np.ones(8, bool), outlines, 0.1, gain, own_gain, 0.5)
        return arrivals._explains(new, Config())

    assert explains(0.9, 0.9)
    assert explains(1.5, 1.0)
    assert not explains(1.5, 1.5)
    assert not explains(0.3, 0.3)


def test_haze_may_hide_what_is_plainly_something_else_and_nothing_else(state, monkeypatch):
    rng = np.random.default_rng(1)
    patch = _box(rng, 8, [-0.1, -0.1, 0], [0.1, 0.1, 0.01], (0.6, 0.2, 0.2))
    account = Account(0, "added", 1.0, 0.1, 3)

    def accepted(contrast: float, shown: float) -> bool:
        outlines = np.zeros((1, 4, 4), bool)
        new = arrivals.NewObject(Template(patch, 2, 1), np.ones(8, bool), outlines, 0.1, 1.0, 1.0, contrast)
        monkeypatch.setattr(arrivals, "_arrivals_of", lambda *a, **k: [])
        monkeypatch.setattr(arrivals, "_place_known", lambda s, *a, **k: (s, [], [], [(None, new, ())]))
        monkeypatch.setattr(arrivals, "_add_new", lambda s, *a: (s, account))
        monkeypatch.setattr(arrivals, "_shown", lambda *a, **k: shown)
        tools = {"eye": None, "config": Config(), "rng": rng, "progress": SimpleNamespace(note=print)}
        evidence = Evidence((), ())
        return len(arrivals.place_arrivals(state, 1, {}, [], [], evidence, [], None, None, **tools)[1]) == 1

    assert accepted(0.5, 0.7)
    assert not accepted(0.5, 0.4)
    assert accepted(0.8, 0.4)
    assert not accepted(0.8, 0.2)


def test_a_shadow_may_have_left_only_beside_where_something_stood(state):
    beside, far = np.full((5, 3), [0.3, 0.2, 0]), np.full((5, 3), [-4.0, 0, 0])
    assert _left_beside(state, 1, beside)
    assert not _left_beside(state, 1, far)
    still = set_from(state, 1, 0, visible=True, pose=_shifted(0.0))
    assert not _left_beside(still, 1, beside)


def test_the_foot_of_what_was_taken_down_joins_it(state):
    heights = np.asarray(state.chronology.templates[0].splats.means)[:, 2]
    upper = heights > 0.1
    parted = split_template(state, 0, upper, _FLOOR)
    parted = set_from(parted, 2, 1, visible=False)
    assert _went_along(parted, 2, 1, 0)
    assert not _went_along(set_from(parted, 1, 0, visible=True, pose=_shifted(0.3)), 2, 1, 0)
    foot = np.asarray(parted.chronology.templates[0].splats.means)[:, 2] > 0.05
    joined = hand_over(parted, 0, foot, 1)
    book, mug = (m.splats for m in joined.chronology.templates)
    assert (book.count, mug.count) == (100, 80)
    assert [len(e) for e in joined.template_errors] == [100, 80]


def test_what_looks_a_little_otherwise_all_over_is_looked_at_turned(state):
    eye, K = Eye(), jnp.asarray([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
    down = SE3(jnp.asarray([0.0, 1, 0, 0]), jnp.asarray([-0.3, 0.0, 2.5]))  # above the table, looking at it
    observations = [
        Observation(f"c/{i}.png", Camera(down, K, 64, 48), np.zeros((48, 64, 3)), np.ones((48, 64), bool))
        for i in (0, 1)
    ]

    def candidates(*scores: float) -> list[int]:
        nothing = np.zeros((48, 64), bool)
        changes = [ChangeMap(np.full((48, 64), s, np.float32), np.zeros((48, 64)), nothing, False) for s in scores]
        seen = observations[: len(scores)]
        evidence = Evidence((), tuple(changes))
        return [k for k, _ in _turned_candidates(state, 2, {}, seen, evidence, eye=eye)]

    assert candidates(1.8, 0.9) == [0]
    assert candidates(0.9, 0.4) == []
    assert candidates(3.0) == []  # one photograph may be wrong all over


def test_what_a_template_leaves_changed_where_it_is_put_is_counted_there_alone(state):
    eye, K = Eye(), jnp.asarray([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
    down = SE3(jnp.asarray([0.0, 1, 0, 0]), jnp.asarray([-0.3, 0.0, 2.5]))
    photograph = Observation("c/0.png", Camera(down, K, 64, 48), np.zeros((48, 64, 3)), np.ones((48, 64), bool))
    scene = scene_at(state, 2)
    cover = eye.cover(scene, [0], [photograph])[0]

    def evidence(mask) -> Evidence:
        return Evidence((), (ChangeMap(np.zeros((48, 64), np.float32), np.zeros((48, 64)), mask, False),))

    def left(before, after) -> float:
        return still_changed(scene, 0, [photograph], evidence(before), evidence(after), eye=eye)

    half = cover & (np.cumsum(cover).reshape(cover.shape) <= cover.sum() / 2)
    assert left(cover, ~cover) == 0  # what changed elsewhere is not its affair
    assert left(cover, half) == pytest.approx(0.5, abs=0.02)
    assert left(half, cover) > 1.9
    assert left(~cover, cover) == cover.sum()  # nothing had changed there


@pytest.mark.parametrize(("worth", "remains", "known"), [(0.1, 0.5, True), (0.1, 2.0, False), (0.6, 2.0, True)])
def test_a_known_object_that_changes_more_than_it_explains_is_not_what_came(state, monkeypatch, worth, remains, known):
    outlines = np.zeros((1, 4, 4), bool)
    found = Placement(_shifted(0.1), 0.1, worth, 0.9, 1.0, 1.0, outlines, None)
    box = _box(np.random.default_rng(1), 60, [-0.1, -0.1, 0], [0.1, 0.1, 0.1])
    new = arrivals.NewObject(Template(box, 2, 1), np.ones(60, bool), outlines, 0.1, worth, worth, 0.5)
    monkeypatch.setattr(arrivals, "_as_new", lambda *a, **k: new)
    monkeypatch.setattr(arrivals, "_placements", lambda *a, **k: {(0, 0): found})
    monkeypatch.setattr(arrivals, "_shape_beside", lambda *a: 1.0)
    monkeypatch.setattr(arrivals, "compare", lambda *a: None)
    monkeypatch.setattr(arrivals, "still_changed", lambda *a, **k: remains)
    came = arrivals.Arrival(Instance(np.asarray(box.means, np.float64), (), 1), _FLOOR, None, None, 0.0, None)
    hidden, lines = set_from(state, 1, 0, visible=False), []
    tools = {"eye": None, "config": Config(), "rng": None, "progress": SimpleNamespace(note=lines.append)}
    after, accounts, _, rest = arrivals._place_known(hidden, 1, {}, [came], [], None, None, **tools)
    assert bool(after.chronology.visible[1, 0]) == known == bool(accounts) == (not rest)
    assert any("2.00 times as many" in line for line in lines) == (not known)


def test_what_several_groups_cover_is_told_at_once_as_each_by_itself(state):
    book, mug = np.arange(180) < 100, np.arange(180) >= 100
    state = split_template(state, 0, mug, _FLOOR)
    eye, K = Eye(), jnp.asarray([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
    down = SE3(jnp.asarray([0.0, 1, 0, 0]), jnp.asarray([-0.3, 0.0, 2.5]))
    photograph = Observation("c/0.png", Camera(down, K, 64, 48), np.zeros((48, 64, 3)), np.ones((48, 64), bool))
    groups, scene = [[0], [1], [], [0, 1], [1]], scene_at(state, 2)
    together = [masks[0] for masks in eye.covers(scene, groups, [photograph])]
    alone = [eye.cover(scene, group, [photograph])[0] for group in groups]
    assert book.sum() == state.chronology.templates[0].splats.count
    assert together[0].sum() > together[1].sum() > 0 and not together[2].any()
    for a, b in zip(together, alone, strict=True):
        np.testing.assert_array_equal(a, b)
    assert eye.covers(scene, [], [photograph]) == []


@pytest.mark.parametrize(
    ("size", "small"), [((1280, 960), (320, 240)), ((639, 480), (639, 480)), ((480, 641), (240, 320))]
)
def test_what_something_buys_is_told_on_photographs_halved_while_they_keep_enough(size, small):
    width, height = size
    K = jnp.asarray([[60.0, 0, width / 2], [0, 60, height / 2], [0, 0, 1]])
    image = np.full((height, width, 3), 90, np.uint8)
    (view,) = small_views([VisitView(View(Camera(SE3.identity(), K, *size), image, np.ones((height, width), bool)), 3)])
    assert (view.view.camera.width, view.view.camera.height) == small
    assert view.view.image.shape == (*small[::-1], 3) and (view.view.image == 90).all()
    assert view.visit == 3


def test_an_account_keeps_the_axis_through_json():
    outlines = np.zeros((1, 2, 2), bool)
    found = Placement(SE3.identity(), 0.1, 0.5, 1.0, 0.6, 0.9, outlines, np.array([0.0, 0, 1]))
    account = Account.of_placed(3, "moved", found, 2)
    assert account.ambiguous_axis == (0, 0, 1)
    assert Account.from_json(account.to_json()) == account
    assert Account.from_json({**account.to_json(), "ambiguous_axis": None}).ambiguous_axis is None


def test_what_explains_more_than_the_change_is_no_account_of_it():
    outlines = np.zeros((1, 2, 2), bool)
    for gain, good in ((0.9, True), (1.2, True), (1.6, False)):
        found = Placement(SE3.identity(), 0.1, gain, 0.9, 0.8, 1.0, outlines, None)
        assert convincing(found, Config()) == good


@pytest.mark.parametrize(
    ("low", "high", "color", "joined"),
    [
        ([0.4, -0.3, 0], [0.8, 0.3, 0.04], (0.5, 0.5, 0.5), True),  # the same, opened
        ([0.4, -0.3, 0], [0.8, 0.3, 0.04], (0.9, 0.2, 0.1), False),  # something red in its place
        ([-0.8, -0.3, 0], [-0.4, 0.3, 0.04], (0.5, 0.5, 0.5), False),  # something like it elsewhere
        ([0.58, -0.02, 0], [0.62, 0.02, 0.04], (0.5, 0.5, 0.5), False),  # something small in its place
    ],
)
def test_what_comes_in_the_place_of_what_left_with_its_colours_is_that_in_a_new_state(state, low, high, color, joined):
    gone = set_from(state, 2, 0, visible=False)
    came = Template(_box(np.random.default_rng(7), 120, low, high, color), 2, 2)
    after = add_template(gone, came, np.zeros(120, np.float32), _FLOOR, 2)
    accounts = [Account(0, "removed", 0.6, 0.1, 3), Account(1, "added", 0.8, 0.1, 3)]
    after, told = join_states(after, 2, accounts)
    assert [m.identity for m in after.chronology.templates] == ([1, 1] if joined else [1, 2])
    assert [a.kind for a in told] == (["new_state"] if joined else ["removed", "added"])
    every = [[], [Account(0, "moved", 0.5, 0.1, 3)], told, []]
    track = _track(after.chronology, 1, every, [0.0] * 4)
    assert [s["event"] for s in track["states"]] == [
        "moved",
        "new_state" if joined else "removed",
        "still" if joined else "unseen",
    ]
    assert [s["visible"] for s in track["states"]] == [True, joined, joined]
    assert _name_of(after.chronology, 1) == ("object_0001_0002.ply" if joined else "object_0002.ply")
    if joined:
        assert track["states"][1]["confidence"] == pytest.approx(0.8)
        on_renders = _track(after.chronology, 1, every, [0.0, 0.0, 1.0, 0.0])["states"]
        assert on_renders[1]["confidence"] == pytest.approx(0.8 * (1 - 0.5**1.5) / (1 - 0.5**3), abs=1e-3)
        assert on_renders[0]["confidence"] == track["states"][0]["confidence"]
        # Closed again: the first template is there, and the object changed its state once more.
        again = set_from(set_from(after, 3, 1, visible=False), 3, 0, visible=True, pose=_shifted(0.6))
        assert _track(again.chronology, 1, every, [0.0] * 4)["states"][2]["event"] == "new_state"


def test_what_has_the_place_colours_and_shape_of_what_left_and_fits_none_of_its_poses_is_another_thing(state):
    gone = set_from(state, 2, 0, visible=False)
    stack = state.chronology.templates[0].splats
    came = Template(transform_splats(_shifted(0.6), stack), 2, 2)
    after = add_template(gone, came, np.zeros(stack.count, np.float32), _FLOOR, 2)
    after, told = join_states(after, 2, [Account(0, "removed", 0.6, 0.1, 3), Account(1, "added", 0.8, 0.1, 3)])
    assert [m.identity for m in after.chronology.templates] == [1, 2]
    assert [a.kind for a in told] == ["removed", "added"]
    assert told[1].gain < 0.1  # and is doubted


@pytest.mark.parametrize(
    ("color", "height", "known"),
    [((0.5, 0.5, 0.5), 0.2, True), ((0.9, 0.2, 0.1), 0.2, False), ((0.5, 0.5, 0.5), 0.07, False)],
)
@pytest.mark.parametrize(("left", "kind"), [(2, "moved"), (1, "added")])
def test_what_shows_another_side_elsewhere_is_known_by_colours_and_shape(state, color, height, known, left, kind):
    for t in (1, 2, 3):
        state = set_from(state, t, 0, visible=t < left, pose=_shifted(0.6))
    stack = state.chronology.templates[0].splats
    turned = transform_splats(
        SE3(jnp.asarray([np.cos(1), 0, 0, np.sin(1)], jnp.float32), jnp.asarray([-0.5, 0.3, 0.0])), stack
    )
    means = np.asarray(turned.means) * np.float32([1, 1, height / 0.2])
    sh = np.tile(((np.float32(color) - 0.5) / C0)[None, None], (stack.count, 1, 1))
    came = Template(eqx.tree_at(lambda s: (s.means, s.sh), turned, (means, sh)), 2, 2)
    after = add_template(state, came, np.zeros(stack.count, np.float32), _FLOOR, 2)
    accounts = [*([Account(0, "removed", 0.6, 0.1, 3)] if left == 2 else []), Account(1, "added", 0.8, 0.1, 3)]
    joined, told = join_states(after, 2, accounts)
    assert [m.identity for m in joined.chronology.templates] == ([1, 1] if known else [1, 2])
    assert [a.kind for a in told] == ([kind] if known else [a.kind for a in accounts])
    if not known:
        assert told[-1].gain == 0.8  # other colours, or another shape: nothing says that it is the same
    for a, b in zip(
        jax.tree.leaves(composed(joined.chronology, 2)), jax.tree.leaves(composed(after.chronology, 2)), strict=True
    ):
        np.testing.assert_allclose(a, b, atol=1e-6)
    if known:
        track = _track(joined.chronology, 1, [[], [], told, []], [0.0] * 4)["states"]
        assert [s["event"] for s in track] == (
            ["moved", "moved", "still"] if left == 2 else ["removed", "added", "still"]
        )
        assert track[1]["ambiguous_axis"] == pytest.approx([0, 0, 1], abs=1e-6)
        np.testing.assert_allclose(track[1]["world_from_template"]["xyz"], [-0.5, 0.3, 0], atol=0.02)
        assert track[1]["confidence"] == pytest.approx(0.8)
        assert joined.supports[1].height(np.zeros((1, 3)))[0] == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(("rival", "known"), [((0.5, 0.5, 0.5), False), ((0.2, 0.7, 0.3), True)])
def test_colours_tell_nothing_where_another_object_has_them_too(state, rival, known):
    for t in (1, 2, 3):
        state = set_from(state, t, 0, visible=False)
    rng, stack = np.random.default_rng(11), state.chronology.templates[0].splats
    tray = _box(rng, 90, [-0.9, -0.9, 0], [-0.4, -0.4, 0.01], rival)
    state = add_template(state, Template(tray, 2, 0), np.zeros(90, np.float32), _FLOOR, 0)
    came = Template(transform_splats(_shifted(-0.5), stack), 3, 2)
    after = add_template(state, came, np.zeros(stack.count, np.float32), _FLOOR, 2)
    joined, told = join_states(after, 2, [Account(2, "added", 0.8, 0.1, 3)])
    assert [m.identity for m in joined.chronology.templates] == [1, 2, 1 if known else 3]
    if not known:
        assert told[0].gain == 0.8


@pytest.mark.parametrize(("others", "known"), [((), True), ((3,), True), ((1,), False)])
def test_outlines_that_were_compared_and_are_others_outweigh_colours_and_shape(state, others, known):
    for t in (1, 2, 3):
        state = set_from(state, t, 0, visible=False)
    stack = state.chronology.templates[0].splats
    came = Template(transform_splats(_shifted(-0.5), stack), 2, 2)
    after = add_template(state, came, np.zeros(stack.count, np.float32), _FLOOR, 2)
    account = Account(1, "added", 0.8, 0.1, 3, other_than=others)
    assert Account.from_json(json.loads(json.dumps(account.to_json()))) == account
    joined, told = join_states(after, 2, [account])
    assert [m.identity for m in joined.chronology.templates] == [1, 1 if known else 2]
    assert told[0].gain == 0.8  # of all its colours; and where outlines speak against it, nothing is doubted


def test_what_comes_as_new_with_the_colours_of_what_is_gone_is_doubted_where_no_shape_tells(state):
    for t in (1, 2, 3):
        state = set_from(state, t, 0, visible=False)
    state = eqx.tree_at(lambda s: s.supports, state, (None,), is_leaf=lambda x: x is state.supports)
    stack = state.chronology.templates[0].splats
    after = add_template(
        state, Template(transform_splats(_shifted(-0.5), stack), 2, 2), np.zeros(stack.count, np.float32), _FLOOR, 2
    )
    joined, told = join_states(after, 2, [Account(1, "added", 0.8, 0.1, 3)])
    assert [m.identity for m in joined.chronology.templates] == [1, 2]
    assert told[0].gain < 0.1


def test_splats_that_buy_nothing_go_and_what_the_first_visit_brought_stays(state):
    rng, eye = np.random.default_rng(9), Eye()
    bright = _box(rng, 200, [-0.9, -0.6, 0.01], [-0.4, 0.6, 0.02], (0.9, 0.9, 0.2))
    idle = _box(rng, 300, [-0.9, -0.6, -0.4], [-0.4, 0.6, -0.3], (0.9, 0.1, 0.1))  # below the floor
    floor = _box(rng, 6000, [-1, -1, 0], [1, 1, 0.001], (0.6, 0.45, 0.3))
    state = extend_background(state, floor, np.zeros(6000, np.float32), np.zeros(6000, bool), 0)
    for part in (bright, idle):
        state = extend_background(state, part, np.zeros(part.count, np.float32), np.zeros(part.count, bool), 2)
    K, down = (
        jnp.asarray([[40.0, 0, 32], [0, 40, 24], [0, 0, 1]]),
        SE3(jnp.asarray([0.0, 1, 0, 0]), jnp.asarray([0.2, 0.0, 2.0])),
    )
    camera = Camera(down, K, 64, 48)
    views = []
    for t in (2, 3):
        image = np.rint(255 * eye.image(drop_hidden(composed(state.chronology, t)), camera)).astype(np.uint8)
        views.append(VisitView(View(camera, image, np.ones((48, 64), bool)), t))
    late = np.asarray(state.chronology.since) > 0
    after, gone = drop_idle(state, np.pad(late, (0, 180)), views, eye)
    since = np.asarray(after.chronology.since)
    heights = np.asarray(after.chronology.background.means)[since == 2, 2]
    assert (since == 0).sum() == 6400
    assert (heights < 0).sum() < 0.1 * 300 and (heights > 0).sum() > 0.9 * 200
    assert gone.sum() == 500 - (since == 2).sum() and not gone[~np.pad(late, (0, 180))].any()
    assert len(after.errors) == len(after.guessed) == len(since)
    untouched = State.of_initial(bright, np.zeros(200, np.float32), ("a", "b", "c", "d"))
    assert drop_idle(untouched, np.zeros(200, bool), views, eye)[1].sum() == 0


def test_what_a_fit_made_of_earlier_visits_is_carried_to_one_more(state):
    rng = np.random.default_rng(12)
    patch, mug = _box(rng, 60, [-0.9, -0.9, 0], [-0.6, -0.6, 0.01]), _box(rng, 30, [0.5, 0.5, 0], [0.6, 0.6, 0.1])
    before = extend_background(state, patch, np.zeros(60, np.float32), np.zeros(60, bool), 1)
    gone = np.zeros(400 + 60 + 180, bool)
    gone[430:460] = True  # half of the late ground bought nothing
    fitted = without(before, gone)
    brighter = fitted.chronology.templates[0].splats.sh + np.float32(0.1)
    poses = np.array(fitted.chronology.world_from_template.xyz)
    poses[1:, 0, 0] += 0.01
    shade, shadows = np.full((4, 1, 4), 0.2, np.float32), object()
    fitted = eqx.tree_at(
        lambda s: (s.chronology.templates[0].splats.sh, s.chronology.world_from_template.xyz, s.chronology.shade,
                   s.chronology.shadows),
        fitted, (brighter, poses, shade, shadows), is_leaf=lambda leaf: leaf is None,
    )  # fmt: skip
    # A visit later the stack moves on, something new comes, and some of the floor is cut out.
    later = cut_background(before, np.arange(460) < 25)
    later = set_from(later, 3, 0, visible=True, pose=_shifted(-0.4))
    later = add_template(later, Template(mug, 2, 3), np.zeros(30, np.float32), _FLOOR, 3)
    carried, dropped = carry_on(later, before, fitted, gone)
    chronology = carried.chronology
    assert dropped.sum() == 30 and not dropped[435:].any()
    assert chronology.background.count == 400 - 25 + 30 == len(carried.errors) == len(chronology.since)
    np.testing.assert_array_equal(chronology.templates[0].splats.sh, brighter)
    np.testing.assert_array_equal(chronology.templates[1].splats.means, mug.means)
    np.testing.assert_allclose(chronology.world_from_template.xyz[:, 0, 0], [0, 0.61, 0.61, -0.4], atol=1e-6)
    np.testing.assert_allclose(chronology.shade[:, :, 0], [[0.2, 0], [0.2, 0], [0.2, 0], [0, 0]], atol=1e-7)
    assert chronology.shadows is shadows
    # Nothing new: what the fit gave, as it is.
    same, dropped = carry_on(before, before, fitted, gone)
    assert eqx.tree_equal(same.chronology.background, fitted.chronology.background) and dropped.sum() == 30
    assert eqx.tree_equal(same.chronology.templates, fitted.chronology.templates)


def test_what_later_visits_added_to_an_object_of_the_first_is_theirs(state):
    rng = np.random.default_rng(10)
    floor, stack = state.chronology.background, state.chronology.templates[0].splats
    first = concatenate_splats([stack, floor])
    assert not late_splats(state, first).any()
    lid, mug = _box(rng, 20, [-0.1, -0.1, 0.2], [0.1, 0.1, 0.21]), _box(rng, 30, [0.5, 0.5, 0], [0.6, 0.6, 0.1])
    grown = extend_template(state, 0, lid, np.zeros(20, np.float32))
    grown = extend_background(grown, lid, np.zeros(20), np.zeros(20, bool), 1)
    grown = add_template(grown, Template(mug, 2, 2), np.zeros(30, np.float32), _FLOOR, 2)
    late = late_splats(grown, first)
    np.testing.assert_array_equal(late, np.repeat([False, True, False, True, True], [400, 20, 180, 20, 30]))


@pytest.fixture
def laid(state) -> State:
    """The same, with ground that two visits laid in plain squares, half of the first one printed."""
    grid = np.stack(np.meshgrid(np.arange(16), np.arange(16), indexing="ij"), axis=-1).reshape(-1, 2)
    plane = _FLOOR.frame()[:2]
    for t, corner in ((1, [-0.9, -0.9]), (3, [0.2, 0.2])):
        colors = np.full((256, 3), 0.4)
        if t == 1:
            colors[grid[:, 0] < 8] = np.where((grid[:128].sum(axis=1) % 2)[:, None], 0.3, 0.6)
        points = (np.asarray(corner) + 0.04 * grid) @ plane
        ground = flat_splats(points, colors, support=_FLOOR, spacing=0.04, opacity=0.95, coefficients=1)
        state = extend_background(state, on_host(ground), np.full(256, 0.1), np.arange(256) < 3, t)
    return state


def test_plain_ground_is_laid_with_fewer_splats_and_printed_ground_stays(laid):
    lean = merge_ground(laid)
    since = np.asarray(lean.chronology.since)
    before = laid.chronology
    for leaf, old in zip(jax.tree.leaves(lean.chronology.background), jax.tree.leaves(before.background), strict=True):
        np.testing.assert_array_equal(leaf[since == 0], old[np.asarray(before.since) == 0])
    assert (since == 1).sum() == 128 + 128 // 16
    assert (since == 3).sum() == 256 // 16
    assert len(lean.errors) == len(lean.guessed) == len(since)
    assert lean.guessed[since == 3].sum() == 1
    down = SE3(jnp.asarray([0.0, 1, 0, 0]), jnp.asarray([0.0, 0.0, 2.0]))
    camera = Camera(down, jnp.asarray([[80.0, 0, 80], [0, 80, 80], [0, 0, 1]]), 160, 160)
    eye = Eye()
    for t in (0, 1, 3):
        difference = eye.image(composed(lean.chronology, t), camera) - eye.image(composed(before, t), camera)
        assert np.abs(difference).mean() < (0.006 if t else 1e-6), t  # the squares' borders are softer
    inner = np.all(np.indices((16, 16)).reshape(2, -1) // 4 % 3 > 0, axis=0)  # neither of the first nor the last four
    places, _ = camera.project(jnp.asarray(before.background.means[np.asarray(before.since) == 3][inner]))
    column, row = np.floor(np.asarray(places)).astype(int).T
    assert inner.sum() == 64
    assert np.abs(difference[row, column]).max() < 0.02
