"""Rank 2: the front end, image -> dense descriptors, region proposals, correspondences, behind one protocol."""

from .cache import Cached as Cached
from .cache import content_hash as content_hash
from .classical import Classical as Classical
from .dense import dense_descriptors as dense_descriptors
from .disk import FromDisk as FromDisk
from .disk import name_images as name_images
from .keypoints import epipolar_distances as epipolar_distances
from .keypoints import inside as inside
from .keypoints import match_descriptors as match_descriptors
from .keypoints import match_indices as match_indices
from .keypoints import root_sift as root_sift
from .onnx import Onnx as Onnx
from .onnx import OnnxModel as OnnxModel
from .proposals import segment_proposals as segment_proposals
from .protocol import Correspondences as Correspondences
from .protocol import Dense as Dense
from .protocol import FrontEnd as FrontEnd
from .protocol import Proposals as Proposals
from .protocol import check_image as check_image
from .protocol import proposals_from_masks as proposals_from_masks
