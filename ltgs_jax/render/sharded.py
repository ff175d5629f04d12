"""A batch of cameras over several devices."""

import jax
from jax.sharding import AxisType, Mesh
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, Float

from ltgs_jax.geometry import Camera
from ltgs_jax.scene import Splats

from .config import RenderConfig, RenderOutput, RenderPlan
from .plan import plan_render
from .rasterize import render


def render_sharded(
    splats: Splats,
    cameras: Camera,
    *,
    mesh: Mesh,
    background: Float[Array, " ch"] | None = None,
    plan: RenderPlan | None = None,
    colors: Float[Array, "n ch"] | None = None,
    config: RenderConfig | None = None,
) -> RenderOutput:
    """`render` of a batch, its cameras dealt out over the devices of a one-axis mesh, splats on all of them.

    The same program on one device, on several, and over hosts (after `jax.distributed.initialize`); images and
    gradients are those of `render`, gradients of splats summed over devices. `plan` is for the cameras of one device;
    without it, one with room for the whole batch is made. `overflow` is the sum over devices.

    Raises ValueError when the cameras are no batch, or do not divide among the devices.
    """
    if cameras.K.ndim != 3 or cameras.K.shape[0] % mesh.size or len(mesh.axis_names) != 1:
        raise ValueError(
            f"cameras: expected a batch divisible by the {mesh.size} devices of a mesh of one axis, got intrinsics of "
            f"shape {cameras.K.shape} and axes {mesh.axis_names}"
        )
    config = config or RenderConfig()
    if plan is None:
        plan = plan_render(*jax.lax.stop_gradient((splats, cameras)), config=config, slack=1)
    (axis,) = mesh.axis_names
    # An explicitly typed mesh would ask the caller to place every argument first.
    mesh = Mesh(mesh.devices, mesh.axis_names, axis_types=(AxisType.Auto,))

    def one_device(splats, cameras, background, colors):
        output = render(splats, cameras, background=background, plan=plan, colors=colors, config=config)
        overflow = jax.lax.psum(output.overflow, axis)
        return RenderOutput(output.image, output.alpha, output.depth, overflow)

    shares = RenderOutput(P(axis), P(axis), P(axis), P())
    return jax.shard_map(one_device, mesh=mesh, in_specs=(P(), P(axis), P(), P()), out_specs=shares, check_vma=False)(
        splats, cameras, background, colors
    )
