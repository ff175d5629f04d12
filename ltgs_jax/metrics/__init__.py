"""Rank 1: how good an image is, and how right a list of changes is."""

from .detection import NO_CHANGE as NO_CHANGE
from .detection import assign_objects as assign_objects
from .detection import event_f1 as event_f1
from .detection import mask_f1 as mask_f1
from .detection import mask_iou as mask_iou
from .detection import rotation_deg as rotation_deg
from .detection import translation_rel as translation_rel
from .image import SSIM_RADIUS as SSIM_RADIUS
from .image import psnr as psnr
from .image import ssim as ssim
from .image import ssim_map as ssim_map
from .perceptual import flip as flip
from .perceptual import flip_map as flip_map
from .perceptual import lpips as lpips
from .record import Metric as Metric
from .record import metric as metric
