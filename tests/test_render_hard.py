"""Hard cases of the renderer, each with its expected outcome."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from render_scenes import make_camera, make_splats

from ltgs_jax.geometry import SE3, Camera
from ltgs_jax.render import RenderConfig, RenderPlan, plan_render, render, render_reference
from ltgs_jax.scene import Splats, transform_splats

# One size and one plan for all cases, so that one program serves them.
COUNT, WIDTH, HEIGHT = 8, 20, 14
PLAN = RenderPlan(intersections=4096, rounds=64)
CONFIG = RenderConfig(chunk=4)  # short rounds compile faster


@pytest.fixture(autouse=True)
def _x64():
    with jax.enable_x64(True):
        yield


def _scene(dtype=jnp.float64) -> Splats:
    return make_splats(COUNT, dtype=dtype, seed=3, degree=1, scale=0.3, logit=1.0)


def _camera(dtype=jnp.float64) -> Camera:
    camera = make_camera(WIDTH, HEIGHT, dtype=dtype)
    return Camera(SE3.identity(dtype=dtype), camera.K, WIDTH, HEIGHT)


def _loss(output):
    return jnp.sum(jnp.sin(output.image)) + jnp.sum(output.alpha) + jnp.sum(output.depth)


@functools.cache
def _fast():
    def both(splats, camera):
        def loss(splats, camera):
            output = render(splats, camera, plan=PLAN, config=CONFIG)
            return _loss(output), output

        (_, output), gradients = jax.value_and_grad(loss, argnums=(0, 1), has_aux=True)(splats, camera)
        return output, gradients

    return jax.jit(both)


@functools.cache
def _slow():
    return jax.jit(render_reference)


def _edited(field: str, value, row=3, dtype=jnp.float64) -> Splats:
    splats = _scene(dtype)
    return eqx.tree_at(
        lambda s: getattr(s, field), splats, getattr(splats, field).at[row].set(jnp.asarray(value, dtype))
    )


def _assert_finite(tree) -> None:
    for leaf in jax.tree.leaves(tree):
        assert bool(jnp.all(jnp.isfinite(leaf)))


def _assert_equals_reference(splats: Splats, camera: Camera | None = None, atol=1e-9) -> None:
    camera = _camera() if camera is None else camera
    output, gradients = _fast()(splats, camera)
    expected = _slow()(splats, camera)
    assert int(output.overflow) == 0
    for name in ("image", "alpha", "depth"):
        np.testing.assert_allclose(getattr(output, name), getattr(expected, name), rtol=0, atol=atol)
    _assert_finite(gradients)


def _assert_culled(splats: Splats, row=3) -> None:
    """The image is that without the row, and so are the gradients; the row's own are zero."""
    hidden = eqx.tree_at(
        lambda s: s.logit_opacities, _scene(splats.means.dtype), _scene().logit_opacities.at[row].set(-jnp.inf)
    )
    hidden = jax.tree.map(lambda leaf: leaf.astype(splats.means.dtype), hidden)
    camera = _camera(splats.means.dtype)
    output, gradients = _fast()(splats, camera)
    expected, expected_gradients = _fast()(hidden, camera)
    np.testing.assert_array_equal(output.image, expected.image)
    _assert_finite((output, gradients))
    for a, b in zip(jax.tree.leaves(gradients), jax.tree.leaves(expected_gradients), strict=True):
        np.testing.assert_array_equal(a, b)
    for leaf in jax.tree.leaves(gradients[0]):
        assert float(jnp.abs(leaf[row]).max()) == 0


@pytest.mark.parametrize(
    "log_scales",
    [[-np.inf] * 3, [-80.0] * 3, [np.log(1e-4)] * 3, [np.log(0.5), np.log(0.5e-4), np.log(0.5e-4)], [6.0] * 3],
    ids=["zero", "tiny", "smaller_than_a_pixel", "aspect_1e4", "covering_the_image"],
)
def test_scales(log_scales):
    _assert_equals_reference(_edited("log_scales", log_scales))


def test_aspect_1e4_in_float32_is_close_to_float64():
    splats = _edited("log_scales", [np.log(30.0), np.log(3e-3), np.log(3e-3)])
    single = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), splats)
    output, gradients = _fast()(single, _camera(jnp.float32))
    np.testing.assert_allclose(output.image, _slow()(splats, _camera()).image, rtol=0, atol=2e-5)
    _assert_finite(gradients)


@pytest.mark.parametrize("mean", [[0, 0, 0], [0, 0, -3.0], [0.1, 0.1, 0.009]], ids=["centre", "behind", "too_near"])
def test_on_the_camera_centre_behind_and_before_the_near_plane_is_culled(mean):
    _assert_culled(_edited("means", mean))


def test_across_the_near_plane_is_drawn():
    _assert_equals_reference(_edited("means", [0.001, 0.002, 0.0101]))


@pytest.mark.parametrize("logit", [50.0, -50.0, np.inf, -np.inf])
def test_opacities_of_0_and_1(logit):
    _assert_equals_reference(_edited("logit_opacities", logit))


def test_zero_quaternion_is_the_identity_and_length_does_not_matter():
    _assert_equals_reference(_edited("quats", [0.0, 0, 0, 0]))
    zero, _ = _fast()(_edited("quats", [0.0, 0, 0, 0]), _camera())
    one, _ = _fast()(_edited("quats", [1.0, 0, 0, 0]), _camera())
    np.testing.assert_array_equal(zero.image, one.image)
    for factor in (1e-30, 7.0, -1e30):
        scaled, gradients = _fast()(_edited("quats", factor * _scene().quats[3]), _camera())
        np.testing.assert_allclose(scaled.image, _fast()(_scene(), _camera())[0].image, rtol=0, atol=1e-12)
        _assert_finite(gradients)


def test_equal_depths_are_blended_by_index():
    splats = _scene()
    same = eqx.tree_at(lambda s: s.means, splats, splats.means.at[:, 2].set(3.0))
    _assert_equals_reference(same)
    reversed_image = _fast()(same[::-1], _camera())[0].image
    assert float(jnp.abs(reversed_image - _fast()(same, _camera())[0].image).max()) > 1e-3


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e38, -1e38, 1e-40], ids=str)
@pytest.mark.parametrize("slot", ["means_x", "means_z", "quats", "log_scales", "logit_opacities", "sh"])
def test_poison_is_culled_or_harmless(slot, value):
    """A meaningful value is drawn as meant (an infinite logit is an opacity of 0 or 1), any other culls its splat."""
    field, _, axis = slot.partition("_") if slot.startswith("means") else (slot, "", "")
    splats = _scene(jnp.float32)
    leaf = getattr(splats, field)
    index = {"means": (3, 2 if axis == "z" else 0), "logit_opacities": (3,), "sh": (3, 0, 0)}.get(field, (3, 1))
    poisoned = eqx.tree_at(lambda s: getattr(s, field), splats, leaf.at[index].set(jnp.float32(value)))
    tiny = value == 1e-40
    meant = {
        "logit_opacities": not np.isnan(value),
        "log_scales": value < 0 or tiny,
        "quats": np.isfinite(value),
    }.get(field, tiny)
    if not meant or (field, axis, tiny) == ("means", "z", True):
        _assert_culled(poisoned)
        return
    output, gradients = _fast()(poisoned, _camera(jnp.float32))
    _assert_finite((output, gradients))
    bounded = np.clip(value, -1e30, 1e30) if field != "quats" else np.sign(value) * min(abs(value), 1e30)
    same = eqx.tree_at(lambda s: getattr(s, field), _scene(), getattr(_scene(), field).at[index].set(bounded))
    np.testing.assert_allclose(output.image, _slow()(same, _camera()).image, rtol=0, atol=1e-4)


def test_a_camera_that_is_not_finite_is_named():
    camera = _camera()
    broken = Camera(camera.cam_from_world, camera.K.at[0, 0].set(jnp.nan), WIDTH, HEIGHT)
    with pytest.raises(ValueError, match="camera"):
        render(_scene(), broken)
    output, gradients = _fast()(_scene(), broken)
    _assert_finite((output, gradients))
    assert float(output.alpha.max()) == 0


def test_valid_but_extreme_is_not_culled():
    """A scene in micrometres, and one in light years: the image does not know."""
    for factor in (1e-2, 1e6, 1e12):
        splats = _scene(jnp.float32)
        scaled = eqx.tree_at(
            lambda s: (s.means, s.log_scales),
            splats,
            (splats.means * factor, splats.log_scales + np.float32(np.log(factor))),
        )
        output, gradients = _fast()(scaled, _camera(jnp.float32))
        np.testing.assert_allclose(output.image, _slow()(_scene(), _camera()).image, rtol=0, atol=1e-4)
        assert float(jnp.abs(gradients[0].logit_opacities).min()) > 0
        _assert_finite(gradients)


def test_all_culled_gives_the_background():
    splats = eqx.tree_at(lambda s: s.logit_opacities, _scene(), jnp.full(COUNT, -jnp.inf))
    output, gradients = _fast()(splats, _camera())
    assert float(jnp.abs(output.image).max()) == float(output.alpha.max()) == float(output.depth.max()) == 0
    _assert_finite(gradients)


@pytest.mark.parametrize("count", [0, 1])
def test_no_splat_and_one_splat(count):
    splats = _scene()[:count]
    background = jnp.asarray([0.1, 0.2, 0.3])
    output = render(splats, _camera(), background=background)
    expected = background if count == 0 else render_reference(splats, _camera(), background=background).image
    np.testing.assert_allclose(output.image, jnp.broadcast_to(expected, output.image.shape), rtol=0, atol=1e-12)


def test_principal_point_outside_of_the_image():
    camera = _camera()
    _assert_equals_reference(_scene(), Camera(camera.cam_from_world, camera.K.at[0, 2].set(-4.0), WIDTH, HEIGHT))


def test_ten_thousand_layers_on_one_pixel():
    count = 10_000
    rng = np.random.default_rng(0)
    splats = Splats(
        means=jnp.asarray(np.stack([np.zeros(count), np.zeros(count), rng.uniform(1, 2, count)], axis=1)),
        quats=jnp.asarray(rng.standard_normal((count, 4))),
        log_scales=jnp.full((count, 3), np.log(0.2)),
        logit_opacities=jnp.full(count, -4.0),
        sh=jnp.asarray(rng.standard_normal((count, 1, 3))),
    )
    camera = Camera(SE3.identity(dtype=jnp.float64), jnp.asarray([[2.0, 0, 0.5], [0, 2.0, 0.5], [0, 0, 1]]), 1, 1)
    plan = plan_render(splats, camera)

    def value(draw):
        return jax.jit(jax.value_and_grad(lambda s: _loss(draw(s))))(splats)

    fast, fast_gradients = value(lambda s: render(s, camera, plan=plan))
    slow, slow_gradients = value(lambda s: render_reference(s, camera))
    np.testing.assert_allclose(fast, slow, rtol=1e-10)
    # The floor is for the orientations of these round splats, whose gradient is 0 but for rounding.
    for a, b in zip(jax.tree.leaves(fast_gradients), jax.tree.leaves(slow_gradients), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-9 * float(jnp.abs(b).max()) + 1e-14)


def test_permuting_splats_leaves_the_image():
    permuted = _scene()[jnp.asarray(np.random.default_rng(0).permutation(COUNT))]
    np.testing.assert_array_equal(_fast()(permuted, _camera())[0].image, _fast()(_scene(), _camera())[0].image)


def test_a_splat_behind_an_opaque_wall_is_not_seen():
    splats = _scene()
    wall = slice(0, 3)
    splats = eqx.tree_at(
        lambda s: (s.means, s.log_scales, s.logit_opacities),
        splats,
        (
            splats.means.at[wall].set(jnp.asarray([0, 0, 1.0])),
            splats.log_scales.at[wall].set(4.0),
            splats.logit_opacities.at[wall].set(50.0),
        ),
    )
    hidden = eqx.tree_at(lambda s: s.logit_opacities, splats, splats.logit_opacities.at[3:].set(-jnp.inf))
    output, gradients = _fast()(splats, _camera())
    np.testing.assert_array_equal(output.image, _fast()(hidden, _camera())[0].image)
    assert float(jnp.abs(gradients[0].sh[3:]).max()) == 0


def test_rotating_world_cameras_and_harmonics_leaves_the_image():
    motion = SE3.exp(jnp.asarray([0.3, -2.0, 1.0, 0.5, 1.0, -0.7]))
    camera = _camera()
    moved = Camera(camera.cam_from_world @ motion.inverse(), camera.K, WIDTH, HEIGHT)
    output, _ = _fast()(transform_splats(motion, _scene()), moved)
    np.testing.assert_allclose(output.image, _fast()(_scene(), camera)[0].image, rtol=0, atol=1e-10)
