"""Binning is exact, local rendering is a part of the whole, devices share the work."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from render_scenes import make_camera, make_splats

from ltgs_jax.render import RenderConfig, gather_tiles, plan_render, render, scatter_tiles, tiles_of_mask
from ltgs_jax.render.binning import bin_splats
from ltgs_jax.render.grid import Grid
from ltgs_jax.render.project import project_splats


@pytest.fixture(autouse=True)
def _x64():
    with jax.enable_x64(True):
        yield


def test_each_splat_is_in_just_the_tiles_that_it_reaches():
    """Against α at every pixel of every tile; a tile may be listed beyond need only by the rounding margin, and for
    ellipses that pass between its pixel centres."""
    splats, camera = make_splats(200, seed=5, scale=0.08), make_camera(61, 43)
    grid = Grid(61, 43, 8, 1)
    cameras = jax.tree.map(lambda leaf: leaf[None], camera)
    projected = jax.jit(lambda s, c: project_splats(s, c, near=0.01))(splats, cameras)
    bins = jax.jit(lambda p: bin_splats(p, grid, 4096))(projected)
    assert int(bins.overflow) == 0
    listed = np.zeros((grid.count, splats.count), bool)
    for tile, (start, count) in enumerate(zip(bins.starts, bins.counts, strict=True)):
        members = np.asarray(bins.splats[start : start + count])
        listed[tile, members] = True
        assert np.all(np.diff(np.asarray(projected.depths)[members]) >= 0)

    def exponents(step: float, *, inside: bool) -> np.ndarray:
        """The least exponent of every splat over every tile, on a grid of points from pixel centre to pixel centre."""
        side = np.arange(0, 7 + step / 2, step) + 0.5
        origins = np.asarray(grid.origins())
        x = origins[:, None, None, None, 0] + side[None, None, :, None] + np.zeros((1, side.size, 1, 1))
        y = origins[:, None, None, None, 1] + side[None, :, None, None] + np.zeros((1, 1, side.size, 1))
        p = jax.tree.map(np.asarray, projected)
        dx, dy = x - p.means2d[:, 0], y - p.means2d[:, 1]
        sigma = 0.5 * ((dx * p.inverse_a) ** 2 + ((dy - p.slope * dx) * p.inverse_b) ** 2)
        if inside:  # what a tile at the border has beyond the image is no pixel
            sigma = np.where((x < 61) & (y < 43), sigma, np.inf)
        return sigma.min(axis=(1, 2))

    reach = np.where(np.asarray(projected.visible), np.asarray(projected.reach), -1)
    at_pixels, between = exponents(1.0, inside=True) <= reach, exponents(0.125, inside=False) <= reach + 0.45
    assert at_pixels.sum() > 300
    assert not np.any(at_pixels & ~listed)
    assert not np.any(listed & ~between)


def test_patches_are_the_image_and_gradients_of_the_region_are_those_of_the_whole():
    splats, camera = make_splats(), make_camera(45, 37)
    mask = np.zeros((37, 45), bool)
    mask[9:20, 30:45] = True
    tiles = tiles_of_mask(mask)
    # Tile columns 3 to 5 and rows 1 to 2 of a grid of 6 columns, padded to eight.
    assert np.asarray(tiles).tolist() == [9, 10, 11, 15, 16, 17, -1, -1]
    plan, local = plan_render(splats, camera), plan_render(splats, camera, tiles=tiles)
    assert local.rounds <= plan.rounds
    whole = render(splats, camera, plan=plan)
    patches = render(splats, camera, tiles=tiles, plan=local)
    np.testing.assert_allclose(
        jnp.where((tiles >= 0)[:, None, None, None], patches.image, 0) * _inside(tiles, whole.alpha),
        gather_tiles(whole.image, tiles),
        rtol=0,
        atol=1e-12,
    )
    canvas = scatter_tiles(jnp.zeros_like(whole.image), tiles, patches.image)
    np.testing.assert_allclose(canvas[mask], whole.image[mask], rtol=0, atol=1e-12)
    target = jnp.asarray(np.random.default_rng(0).standard_normal(whole.image.shape)) * mask[..., None]

    def regional(splats):
        return jnp.sum(render(splats, camera, tiles=tiles, plan=local).image * gather_tiles(target, tiles))

    def full(splats):
        return jnp.sum(render(splats, camera, plan=plan).image * target)

    one, other = jax.jit(jax.grad(regional))(splats), jax.jit(jax.grad(full))(splats)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12 * max(1, float(jnp.abs(b).max())))


def _inside(tiles, alpha):
    return gather_tiles(jnp.ones_like(alpha), tiles)[..., None]


def test_a_distant_region_costs_no_room():
    splats, camera = make_splats(2000, scale=0.05), make_camera(160, 120)
    corner = plan_render(splats, camera, tiles=jnp.asarray([0]), config=RenderConfig())
    assert corner.intersections * 4 < plan_render(splats, camera).intersections


_DEVICES = """
import jax, jax.numpy as jnp, numpy as np
from render_scenes import make_camera, make_splats
from ltgs_jax.geometry import stack_cameras
from ltgs_jax.render import plan_render, render, render_sharded
splats = make_splats(40, dtype=jnp.float32)
cameras = stack_cameras([make_camera(24, 20, dtype=jnp.float32, seed=seed) for seed in range(4)])
plan = plan_render(splats, cameras)
def loss(draw):
    return jax.jit(jax.value_and_grad(lambda s: jnp.sum(jnp.sin(draw(s).image))))(splats)
image = render(splats, cameras, plan=plan).image
value, gradient = loss(lambda s: render(s, cameras, plan=plan))
for count in (1, 2, 4):
    mesh = jax.make_mesh((count,), ("cameras",), devices=jax.devices()[:count])
    output = render_sharded(splats, cameras, mesh=mesh, plan=plan)
    assert int(output.overflow) == 0
    np.testing.assert_allclose(output.image, image, atol=2e-6)
    other, other_gradient = loss(lambda s: render_sharded(s, cameras, mesh=mesh, plan=plan))
    np.testing.assert_allclose(other, value, rtol=1e-6)
    for a, b in zip(jax.tree.leaves(other_gradient), jax.tree.leaves(gradient), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5 * float(jnp.abs(b).max()))
print("equal on", len(jax.devices()))
"""


@pytest.mark.slow
def test_cameras_over_devices_give_equal_images_and_gradients():
    folder = Path(__file__).parent
    paths = os.pathsep.join([str(folder), str(folder.parent)])
    environment = os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=4", "PYTHONPATH": paths}
    run = subprocess.run([sys.executable, "-c", _DEVICES], env=environment, capture_output=True, text=True, timeout=600)
    assert run.returncode == 0, run.stderr
    assert run.stdout.strip() == "equal on 4"
