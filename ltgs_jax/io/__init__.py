"""Rank 2: captures, COLMAP models, splat files, chronologies on disk: foreign files and conventions end here."""

from .capture import Capture as Capture
from .capture import Observations as Observations
from .capture import Photograph as Photograph
from .capture import distort_labels as distort_labels
from .capture import load_image as load_image
from .capture import load_mask as load_mask
from .capture import read_capture as read_capture
from .colmap import ColmapImage as ColmapImage
from .colmap import ColmapModel as ColmapModel
from .colmap import find_colmap as find_colmap
from .colmap import read_colmap as read_colmap
from .colmap_text import write_colmap as write_colmap
from .files import InputError as InputError
from .files import read_json as read_json
from .files import replacing as replacing
from .files import write_bytes as write_bytes
from .files import write_json as write_json
from .images import read_labels as read_labels
from .images import scaled_size as scaled_size
from .images import write_image as write_image
from .images import write_labels as write_labels
from .lens import CameraModel as CameraModel
from .ply import read_ply as read_ply
from .ply import write_ply as write_ply
