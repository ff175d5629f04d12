"""Rank 3: robust registration of two point sets whose correspondences are mostly wrong."""

from .correspond import match_features as match_features
from .entry import register as register
from .outcome import RegisterConfig as RegisterConfig
from .outcome import Registration as Registration
from .outcome import Result as Result
from .overlap import Overlap as Overlap
from .overlap import chamfer as chamfer
from .overlap import verify_overlap as verify_overlap
