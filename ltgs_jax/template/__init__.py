"""Rank 4: the splats of each object, and where they stand."""

from .arrival import Placement as Placement
from .arrival import Search as Search
from .arrival import build_template as build_template
from .arrival import middle_of as middle_of
from .arrival import place_template as place_template
from .arrival import search_template as search_template
from .arrival import settle_template as settle_template
from .arrival import support_below as support_below
from .background import color_from_photographs as color_from_photographs
from .background import fill_under as fill_under
from .config import TemplateConfig as TemplateConfig
from .firm import firm_part as firm_part
from .locate import Crop as Crop
from .locate import Refiner as Refiner
from .locate import explained as explained
from .locate import make_crop as make_crop
from .locate import unlikeness as unlikeness
from .removal import Removal as Removal
from .removal import find_removed as find_removed
from .removal import gone_evidence as gone_evidence
from .removal import share_of as share_of
from .removal import taken_down as taken_down
from .removal import with_foot as with_foot
from .support import Support as Support
from .support import Vantage as Vantage
from .support import fit_support as fit_support
