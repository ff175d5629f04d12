"""Rank 0: rigid motions, spherical harmonics, cameras."""

from .camera import Camera as Camera
from .camera import stack_cameras as stack_cameras
from .se3 import SE3 as SE3
from .se3 import multiply_quats as multiply_quats
from .se3 import normalize_quats as normalize_quats
from .se3 import quat_from_rotmat as quat_from_rotmat
from .se3 import rotation_angle as rotation_angle
from .se3 import rotmat_entries as rotmat_entries
from .se3 import rotmat_from_quat as rotmat_from_quat
from .sh import C0 as C0
from .sh import eval_sh as eval_sh
from .sh import rotate_sh as rotate_sh
from .sh import sh_basis as sh_basis
from .sh import sh_degree as sh_degree
from .sh import sh_rotations as sh_rotations
