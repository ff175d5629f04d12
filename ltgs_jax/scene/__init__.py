"""Rank 1: the scene's state as frozen pytrees."""

from .chronology import Chronology as Chronology
from .chronology import Template as Template
from .chronology import compose as compose
from .chronology import drop_hidden as drop_hidden
from .chronology import ground_layers as ground_layers
from .chronology import light as light
from .chronology import owner_of as owner_of
from .shadows import Shadows as Shadows
from .shadows import ground_gain as ground_gain
from .splats import Splats as Splats
from .splats import concatenate_splats as concatenate_splats
from .splats import pad_splats as pad_splats
from .splats import shade_splats as shade_splats
from .splats import transform_splats as transform_splats
