"""Rank 2: splats to images, alpha and depth, differentiable both ways."""

from .config import RenderConfig as RenderConfig
from .config import RenderOutput as RenderOutput
from .config import RenderPlan as RenderPlan
from .plan import plan_render as plan_render
from .rasterize import render as render
from .rasterize import splat_votes as splat_votes
from .reference import render_reference as render_reference
from .sharded import render_sharded as render_sharded
from .tiles import gather_tiles as gather_tiles
from .tiles import scatter_tiles as scatter_tiles
from .tiles import tiles_of_mask as tiles_of_mask
