"""Constants of the image formation, options, static capacities and results of the renderer."""

import dataclasses

import equinox as eqx
from jaxtyping import Array, Float, Int

EPS2D = 0.3  # px², added to the projected covariance: a splat is never thinner than about half a pixel
ALPHA_MIN = 1 / 255  # a contribution below one 8-bit level is skipped
ALPHA_MAX = 0.99  # keeps 1 − α away from 0, so that transmittance can be divided out in the gradient
TRANSMITTANCE_STOP = 1e-4  # splats behind this transmittance are not blended


@dataclasses.dataclass(frozen=True)
class RenderConfig:
    """Static options of the renderer.

    `tile_size` [px] side of a square tile; `chunk` splats blended per step of a tile; `tiles_per_block` tiles that
    advance together (None: 64 on CPUs, where a block should stay in the cache, all tiles on other devices);
    `near` [scene units] camera z below which a splat is culled.
    """

    tile_size: int = 8
    chunk: int = 16
    tiles_per_block: int | None = None
    near: float = 0.01


@dataclasses.dataclass(frozen=True)
class RenderPlan:
    """Static capacities of one rendering program; hashable, so it may be a static argument of a jitted function.

    `intersections` pairs of splat and tile over all cameras of the batch; `rounds` steps of `chunk` splats, summed over
    blocks of tiles.
    """

    intersections: int
    rounds: int


class RenderOutput(eqx.Module):
    """What a camera sees; batched over cameras when the camera was.

    `image` [h w 3] linear colours (as many channels as `colors` had), `alpha` [h w] = 1 − final transmittance, `depth`
    [h w] expected camera z Σwz/Σw in scene units, 0 where alpha is 0; `overflow` pairs of splat and tile that the plan
    had no room for: anything but 0 means that the image is wrong and a larger plan is needed.
    """

    image: Float[Array, "... h w ch"]
    alpha: Float[Array, "... h w"]
    depth: Float[Array, "... h w"]
    overflow: Int[Array, ""]
