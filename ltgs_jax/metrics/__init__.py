"""Rank 1: how good an image is, and how right a list of changes is."""

from .image import SSIM_RADIUS as SSIM_RADIUS
from .image import psnr as psnr
from .image import ssim as ssim
from .image import ssim_map as ssim_map
