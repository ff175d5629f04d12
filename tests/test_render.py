"""The fast renderer against the dense reference: values, gradients, modes, batches, overflow."""

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
from render_scenes import make_camera, make_splats

from ltgs_jax.geometry import SE3, Camera, stack_cameras
from ltgs_jax.render import RenderConfig, RenderPlan, plan_render, render, render_reference, splat_votes

_SLOW = pytest.mark.slow  # what other cases of the default suite reach as well
FIELDS = ("image", "alpha", "depth")


@pytest.fixture(autouse=True)
def _x64():
    with jax.enable_x64(True):
        yield


def _loss(draw, target):
    def loss(splats, camera, background):
        output = draw(splats, camera, background)
        return (
            jnp.sum(jnp.sin(3 * output.image) * target) + jnp.sum(output.alpha * target[..., 0]) + jnp.sum(output.depth)
        )

    return loss


def _moved(camera: Camera, tangent) -> Camera:
    return Camera(camera.cam_from_world @ SE3.exp(tangent), camera.K, camera.width, camera.height)


@pytest.mark.parametrize(
    ("width", "height"),
    [(45, 37), (1, 1), (64, 3), pytest.param(8, 8, marks=_SLOW), pytest.param(9, 17, marks=_SLOW)],
)
def test_image_equals_reference(width, height):
    splats, camera = make_splats(), make_camera(width, height)
    background = jnp.asarray([0.2, 0.5, 0.9])
    fast = render(splats, camera, background=background)
    slow = render_reference(splats, camera, background=background)
    assert int(fast.overflow) == 0
    assert float(slow.alpha.max()) > 0.3
    for name in FIELDS:
        np.testing.assert_allclose(getattr(fast, name), getattr(slow, name), rtol=0, atol=1e-10)


@pytest.mark.parametrize("config", [RenderConfig(tile_size=16), RenderConfig(chunk=4), RenderConfig(tiles_per_block=3)])
def test_image_does_not_depend_on_config(config):
    splats, camera = make_splats(), make_camera()
    np.testing.assert_allclose(
        render(splats, camera, config=config).image, render(splats, camera).image, rtol=0, atol=1e-12
    )


@pytest.mark.parametrize("degree", [0, pytest.param(1, marks=_SLOW), pytest.param(2, marks=_SLOW), 3])
def test_gradients_equal_reference(degree):
    splats, camera = make_splats(40, degree=degree), make_camera()
    plan = plan_render(splats, camera)
    target = jnp.asarray(np.random.default_rng(1).standard_normal((camera.height, camera.width, 3)))

    def gradients(draw):
        loss = _loss(draw, target)

        def moved(splats, tangent, K, background):
            return loss(splats, Camera(_moved(camera, tangent).cam_from_world, K, 45, 37), background)

        return jax.jit(jax.grad(moved, argnums=(0, 1, 2, 3)))(splats, jnp.zeros(6), camera.K, jnp.full(3, 0.3))

    fast = gradients(lambda s, c, b: render(s, c, background=b, plan=plan))
    slow = gradients(lambda s, c, b: render_reference(s, c, background=b))
    for a, b in zip(jax.tree.leaves(fast), jax.tree.leaves(slow), strict=True):
        assert float(jnp.abs(b).max()) > 0
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-9 * float(jnp.abs(b).max()))


@pytest.mark.parametrize("draw", [render, render_reference], ids=["render", "reference"])
def test_gradients_match_central_differences(draw):
    """Every lane of every gradient, one at a time: splats, pose, intrinsics, background."""
    splats, camera = make_splats(8, degree=1), make_camera(24, 20)
    target = jnp.asarray(np.random.default_rng(1).standard_normal((camera.height, camera.width, 3)))
    options = {"plan": plan_render(splats, camera)} if draw is render else {}
    loss = _loss(lambda s, c, b: draw(s, c, background=b, **options), target)
    start = (splats, jnp.zeros(6), camera.K, jnp.full(3, 0.3))
    flat, unflatten = jax.flatten_util.ravel_pytree(start)

    @jax.jit
    def value(vector):
        splats, tangent, K, background = unflatten(vector)
        return loss(splats, Camera(_moved(camera, tangent).cam_from_world, K, camera.width, camera.height), background)

    gradient = np.asarray(jax.jit(jax.grad(value))(flat))
    step = 1e-5
    differences = np.asarray(
        [(value(flat.at[i].add(step)) - value(flat.at[i].add(-step))) / (2 * step) for i in range(flat.size)]
    )
    lanes = jax.tree.leaves(unflatten(jnp.arange(flat.size, dtype=flat.dtype)))
    for lane in (np.asarray(lane, int).ravel() for lane in lanes):
        size = np.abs(differences[lane]).max()
        assert size > 0
        np.testing.assert_allclose(gradient[lane], differences[lane], rtol=0, atol=1e-6 * size)


@pytest.mark.parametrize("draw", [render, render_reference], ids=["render", "reference"])
def test_forward_mode_equals_reverse_mode(draw):
    splats, camera = make_splats(30), make_camera(24, 20)
    options = {"plan": plan_render(splats, camera)} if draw is render else {}

    def image(tangent):
        return draw(splats, _moved(camera, tangent), **options).image

    zero = jnp.zeros(6)
    forward, reverse = jax.jit(jax.jacfwd(image))(zero), jax.jit(jax.jacrev(image))(zero)
    assert float(jnp.abs(forward).max()) > 1e-2
    np.testing.assert_allclose(forward, reverse, rtol=0, atol=1e-10 * float(jnp.abs(forward).max()))


def test_batch_of_cameras_equals_one_by_one():
    splats = make_splats()
    cameras = [make_camera(seed=seed) for seed in range(3)]
    batch = stack_cameras(cameras)
    together = render(splats, batch)
    plan = plan_render(splats, batch)
    for i, camera in enumerate(cameras):
        alone = render(splats, camera)
        for name in FIELDS:
            np.testing.assert_allclose(getattr(together, name)[i], getattr(alone, name), rtol=0, atol=1e-12)
    target = jnp.asarray(np.random.default_rng(1).standard_normal(together.image.shape))
    batched = jax.grad(lambda s: jnp.sum(render(s, batch, plan=plan).image * target))(splats)
    single = [
        jax.grad(lambda s, c=c, t=t: jnp.sum(render(s, c, plan=plan).image * t))(splats)
        for c, t in zip(cameras, target, strict=True)
    ]
    for a, *parts in zip(jax.tree.leaves(batched), *map(jax.tree.leaves, single), strict=True):
        np.testing.assert_allclose(a, sum(parts), rtol=1e-9, atol=1e-10)


def test_tiles_give_patches_of_the_full_image():
    splats, camera = make_splats(), make_camera(45, 37)
    full = render(splats, camera)
    patches = render(splats, camera, tiles=jnp.asarray([7, 0, -1, 23]))
    assert patches.image.shape == (4, 8, 8, 3)
    padded = jnp.pad(full.image, ((0, 3), (0, 3), (0, 0)))
    np.testing.assert_allclose(patches.image[0], padded[8:16, 8:16], rtol=0, atol=1e-12)
    np.testing.assert_allclose(patches.image[1], padded[0:8, 0:8], rtol=0, atol=1e-12)
    assert float(patches.alpha[2].max()) == 0


def test_overflow_is_counted_and_a_small_plan_never_goes_unnoticed():
    splats, camera = make_splats(), make_camera()
    plan = plan_render(splats, camera)
    assert int(render(splats, camera, plan=plan).overflow) == 0
    assert int(render(splats, camera, plan=RenderPlan(intersections=50, rounds=plan.rounds)).overflow) > 0
    few = RenderPlan(intersections=plan.intersections, rounds=1)
    assert int(render(splats, camera, plan=few, config=RenderConfig(chunk=4)).overflow) > 0


def test_plan_is_required_under_jit():
    splats, camera = make_splats(), make_camera()
    with pytest.raises(ValueError, match="plan"):
        jax.jit(lambda s: render(s, camera).image)(splats)


def test_votes_are_the_weights_of_each_splat():
    splats, camera = make_splats(), make_camera()
    values = jnp.asarray(np.random.default_rng(0).uniform(size=(camera.height, camera.width, 2)))
    votes = splat_votes(splats, camera, values)
    blank = jnp.zeros((splats.count, 1))

    def one(i):
        weight = render_reference(splats, camera, colors=blank.at[i].set(1)).image
        return jnp.sum(weight * values, axis=(0, 1))

    np.testing.assert_allclose(votes, jax.lax.map(one, jnp.arange(splats.count)), rtol=0, atol=1e-10)


def test_two_runs_are_equal_bit_for_bit():
    splats, camera = make_splats(dtype=jnp.float32), make_camera(dtype=jnp.float32)
    first, second = (np.asarray(render(splats, camera).image) for _ in range(2))
    assert first.tobytes() == second.tobytes()
