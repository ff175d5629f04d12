"""Front ends from model files that the user names, run by onnxruntime."""

import functools
import hashlib
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float

from .classical import Classical
from .keypoints import inside, match_descriptors
from .protocol import Correspondences, Dense, FrontEnd, Image, Proposals, check_image, proposals_from_masks

LAYOUTS = {
    "dense": ("features [1 d h' w']",),
    "tokens": ("tokens [1 n d], the last h'·w' of them in rows over the image",),
    "masks": ("masks [m h' w'] or [1 m h' w'], inside where above `threshold`",),
    "labels": ("labels [h' w'] or [1 h' w'], 0 = no region",),
    "cells": (
        "features [1 d h/8 w/8]",
        "logits of the 64 pixels of each 8 × 8 cell and of no keypoint [1 65 h/8 w/8]",
        "reliability [1 1 h/8 w/8]",
    ),
    "pairs": ("xy_a [m 2] px of the input", "xy_b [m 2]", "score [m] in [0, 1]"),
}
"""What a model must output, in this order, for each layout."""
ROLES = {"describe": ("dense", "tokens"), "propose": ("masks", "labels"), "match": ("cells", "pairs")}


@dataclass(frozen=True)
class OnnxModel:
    """A model file and how to talk to it.

    `layout` one of `LAYOUTS`; `width`, `height` px of its input, to which images are scaled; `grey` one channel
    instead of three (planes first: [1 c h w]); the input is (value · `scale` − `mean`) / `std` of values in [0, 1].
    `outputs` names its outputs in the order of the layout (empty: the file's own order). `threshold` of masks.
    Exports that fit: XFeat and SuperPoint-like heads (`cells`); DINOv2 with patch tokens (`tokens`), or with these
    laid on their grid (`dense`); SAM with its prompts and decoder inside the graph (`masks`); MASt3R, LoFTR and the
    like with two image inputs (`pairs`).
    """

    path: str
    layout: str
    width: int
    height: int
    grey: bool = False
    scale: float = 1.0
    mean: tuple[float, ...] = (0.0,)
    std: tuple[float, ...] = (1.0,)
    outputs: tuple[str, ...] = ()
    threshold: float = 0.0

    def __post_init__(self):
        if self.layout not in LAYOUTS:
            raise ValueError(f"layout: expected one of {', '.join(LAYOUTS)}, got {self.layout!r}")
        needed = len(LAYOUTS[self.layout])
        if self.outputs and len(self.outputs) != needed:
            raise ValueError(f"outputs: {self.layout} needs {needed} ({'; '.join(LAYOUTS[self.layout])})")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"width, height: expected pixels, got {self.width} × {self.height}")


@functools.lru_cache(maxsize=4)
def _session(path: str, size: int, changed: int):
    """The loaded model; size and time of change are part of the key, so that a replaced file is loaded again."""
    del size, changed
    try:
        import onnxruntime
    except ImportError:
        raise ImportError("ONNX front ends need onnxruntime: pip install 'ltgs-jax[onnx]'") from None
    try:
        known = ("CUDAExecutionProvider", "CPUExecutionProvider")
        providers = [name for name in known if name in onnxruntime.get_available_providers()]
        return onnxruntime.InferenceSession(path, providers=providers)
    except Exception as error:
        raise ValueError(f"{path}: is not a model that onnxruntime can load ({error})") from None


def run_model(model: OnnxModel, *images: Image) -> list[np.ndarray]:
    """The model's outputs for its images, in the order of its layout.

    Raises ValueError naming the file when it is missing, does not load, lacks an output or takes another input.
    """
    path = Path(model.path)
    if not path.is_file():
        raise ValueError(f"{path}: no such model file")
    stat = path.stat()
    session = _session(str(path), stat.st_size, stat.st_mtime_ns)
    inputs, available = [i.name for i in session.get_inputs()], [o.name for o in session.get_outputs()]
    if len(inputs) != len(images):
        raise ValueError(f"{path}: expected {len(images)} image inputs for layout {model.layout}, has {inputs}")
    wanted = list(model.outputs) or available[: len(LAYOUTS[model.layout])]
    missing = [name for name in wanted if name not in available]
    if missing or len(wanted) < len(LAYOUTS[model.layout]):
        raise ValueError(
            f"{path}: {model.layout} needs {'; '.join(LAYOUTS[model.layout])}; its outputs are {available}"
        )
    feed = {name: _input(model, image) for name, image in zip(inputs, images, strict=True)}
    try:
        return [np.asarray(output) for output in session.run(wanted, feed)]
    except Exception as error:
        raise ValueError(f"{path}: does not run on {model.width}×{model.height} px ({error})") from None


def _input(model: OnnxModel, image: Image) -> Float[np.ndarray, "1 c h w"]:
    image = check_image(image)
    smaller = model.width * model.height < image.shape[0] * image.shape[1]
    how = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    scaled = cv2.resize(image, (model.width, model.height), interpolation=how)
    if model.grey:
        scaled = cv2.cvtColor(scaled, cv2.COLOR_RGB2GRAY)[..., None]
    scaled = (scaled * np.float32(model.scale) - np.float32(model.mean)) / np.float32(model.std)
    return np.ascontiguousarray(np.moveaxis(scaled, -1, 0)[None], dtype=np.float32)


def _on_grid(features: Float[np.ndarray, "d hm wm"], height: int, width: int) -> Float[np.ndarray, "h w d"]:
    """Features sampled bilinearly on another grid over the same image, and scaled to unit norm."""
    # OpenCV's images have at most 128 channels in some builds.
    parts = [
        cv2.resize(np.ascontiguousarray(np.moveaxis(features[i : i + 64], 0, -1)), (width, height))
        for i in range(0, len(features), 64)
    ]
    grid = np.concatenate([part.reshape(height, width, -1) for part in parts], axis=-1)
    return grid / np.maximum(np.linalg.norm(grid, axis=-1, keepdims=True), 1e-12)


def _decode_cells(
    model: OnnxModel, outputs: list[np.ndarray], *, max_keypoints: int, min_score: float
) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m d"]]:
    """Keypoints in pixels of the model's input and unit descriptors, best first (as XFeat, Potje et al. 2024)."""
    features, logits, reliability = (np.asarray(output[0], np.float32) for output in outputs)
    cells_h, cells_w = logits.shape[1:]
    shifted = np.exp(logits - logits.max(axis=0, keepdims=True))
    chance = (shifted / shifted.sum(axis=0, keepdims=True))[:64].reshape(8, 8, cells_h, cells_w)
    heat = chance.transpose(2, 0, 3, 1).reshape(8 * cells_h, 8 * cells_w)
    trust = cv2.resize(np.ascontiguousarray(reliability[0]), heat.shape[::-1], interpolation=cv2.INTER_LINEAR)
    peak = (heat == cv2.dilate(heat, np.ones((5, 5)))) & (heat > min_score)
    rows, columns = np.nonzero(peak)
    best = np.argsort(-(heat * trust)[rows, columns], kind="stable")[:max_keypoints]
    xy = np.stack([columns[best], rows[best]], axis=1).astype(np.float32) + np.float32(0.5)
    at = xy / 8 - np.float32(0.5)
    low = np.clip(np.floor(at).astype(int), 0, [cells_w - 1, cells_h - 1])
    high = np.minimum(low + 1, [cells_w - 1, cells_h - 1])
    part = np.clip(at - low, 0, 1)
    top = features[:, low[:, 1], low[:, 0]] * (1 - part[:, 0]) + features[:, low[:, 1], high[:, 0]] * part[:, 0]
    bottom = features[:, high[:, 1], low[:, 0]] * (1 - part[:, 0]) + features[:, high[:, 1], high[:, 0]] * part[:, 0]
    descriptors = (top * (1 - part[:, 1]) + bottom * part[:, 1]).T
    return xy, descriptors / np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-12)


@dataclass(frozen=True)
class Onnx:
    """Any of the three roles from a model file; roles without one are left to `otherwise`.

    `stride` px of the grid on which descriptors are handed out; `max_keypoints`, `min_score` of a `cells` model;
    `max_ratio`, `min_cosine`, `epipolar_px` of the matches (learned descriptors bear a laxer ratio than SIFT's).
    Raises ValueError when a model's layout does not fit its role.
    """

    describe_model: OnnxModel | None = None
    propose_model: OnnxModel | None = None
    match_model: OnnxModel | None = None
    otherwise: FrontEnd = field(default_factory=Classical)
    stride: int = 8
    max_keypoints: int = 4096
    min_score: float = 0.05
    max_ratio: float = 0.9
    min_cosine: float = 0.8
    epipolar_px: float = 4.0

    def __post_init__(self):
        for role, layouts in ROLES.items():
            model = getattr(self, f"{role}_model")
            if model is not None and model.layout not in layouts:
                raise ValueError(f"{role}_model: expected a layout of {', '.join(layouts)}, got {model.layout}")

    def fingerprint(self) -> str:
        """The options, and the bytes of the model files."""
        models = [m for m in (self.describe_model, self.propose_model, self.match_model) if m is not None]
        content = [_file_hash(model.path, Path(model.path).stat().st_mtime_ns) for model in models]
        return f"onnx-1 {self!r} {content} {self.otherwise.fingerprint()}"

    def describe(self, image: Image) -> Dense:
        """The model's features on a grid of `stride` pixels."""
        if self.describe_model is None:
            return self.otherwise.describe(image)
        model, output = self.describe_model, run_model(self.describe_model, image)[0][0]
        if model.layout == "tokens":
            patch = np.sqrt(model.width * model.height / len(output))
            rows, columns = _token_grid(model, len(output), patch)
            output = output[len(output) - rows * columns :].T.reshape(-1, rows, columns)
        height, width = (-(-side // self.stride) for side in image.shape[:2])
        return Dense(_on_grid(output.astype(np.float32), height, width), self.stride)

    def propose(self, image: Image, *, guide: Float[np.ndarray, "h w"] | None = None) -> Proposals:
        """The model's masks at the image's size; the guide is for front ends that look for themselves."""
        if self.propose_model is None:
            return self.otherwise.propose(image, guide=guide)
        model, output = self.propose_model, run_model(self.propose_model, image)[0]
        if model.layout == "labels":
            labels = output.reshape(output.shape[-2:])
            masks = (labels[None] == np.unique(labels[labels != 0])[:, None, None]).astype(np.float32) - 0.5
            level = 0.0
        else:
            masks, level = output.reshape(-1, *output.shape[-2:]).astype(np.float32), model.threshold
        height, width = image.shape[:2]
        stack = [cv2.resize(mask, (width, height), interpolation=cv2.INTER_LINEAR) > level for mask in masks]
        found = proposals_from_masks(np.stack(stack) if stack else np.zeros((0, height, width), bool))
        return found.subset(found.areas() > 0)

    def keypoints(self, image: Image) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m d"]]:
        """Keypoints of a `cells` model, in the image's pixels; a `pairs` model has none of one image alone."""
        if self.match_model is None or self.match_model.layout != "cells":
            return self.otherwise.keypoints(image)
        model = self.match_model
        outputs = run_model(model, image)
        xy, descriptors = _decode_cells(model, outputs, max_keypoints=self.max_keypoints, min_score=self.min_score)
        return xy * _pixels_per_input(model, image), descriptors

    def match(
        self,
        image_a: Image,
        image_b: Image,
        *,
        mask_a: Bool[np.ndarray, "ha wa"] | None = None,
        mask_b: Bool[np.ndarray, "hb wb"] | None = None,
        fundamental: Float[np.ndarray, "3 3"] | None = None,
    ) -> Correspondences:
        """Matches of the model, inside the masks and near the epipolar lines where given."""
        if self.match_model is None:
            masks = {"mask_a": mask_a, "mask_b": mask_b}
            return self.otherwise.match(image_a, image_b, **masks, fundamental=fundamental)
        if self.match_model.layout == "pairs":
            return self._match_pairs(image_a, image_b, mask_a, mask_b, fundamental)
        chosen = []
        for image, mask in ((image_a, mask_a), (image_b, mask_b)):
            xy, descriptors = self.keypoints(image)
            free = inside(xy, mask)
            chosen.append((xy[free], descriptors[free]))
        options = {"max_ratio": self.max_ratio, "min_cosine": self.min_cosine, "epipolar_px": self.epipolar_px}
        return match_descriptors(*chosen, fundamental=fundamental, **options)

    def _match_pairs(self, image_a, image_b, mask_a, mask_b, fundamental) -> Correspondences:
        model = self.match_model
        xy_a, xy_b, score = (np.asarray(output, np.float32) for output in run_model(model, image_a, image_b))
        xy_a = xy_a.reshape(-1, 2) * _pixels_per_input(model, image_a)
        xy_b = xy_b.reshape(-1, 2) * _pixels_per_input(model, image_b)
        keep = inside(xy_a, mask_a) & inside(xy_b, mask_b)
        if fundamental is not None:
            lines = np.concatenate([xy_a, np.ones_like(xy_a[:, :1])], axis=1) @ np.asarray(fundamental).T
            offset = np.sum(lines * np.concatenate([xy_b, np.ones_like(xy_b[:, :1])], axis=1), axis=1)
            keep &= np.abs(offset) <= self.epipolar_px * np.maximum(np.linalg.norm(lines[:, :2], axis=1), 1e-12)
        order = np.flatnonzero(keep)[np.argsort(-score.ravel()[keep], kind="stable")]
        return Correspondences(xy_a[order], xy_b[order], score.ravel()[order])


@functools.lru_cache(maxsize=16)
def _file_hash(path: str, changed: int) -> str:
    del changed
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def _token_grid(model: OnnxModel, count: int, patch: float) -> tuple[int, int]:
    """Rows and columns of square patches, of which there are `count` less some leading class tokens."""
    for side in range(max(1, int(patch)), max(model.width, model.height) + 1):
        if model.height % side == 0 and model.width % side == 0:
            rows, columns = model.height // side, model.width // side
            if rows * columns <= count:
                return rows, columns
    raise ValueError(f"{model.path}: {count} tokens are no grid of square patches over {model.width}×{model.height} px")


def _pixels_per_input(model: OnnxModel, image: Image) -> Float[np.ndarray, "2"]:
    return np.array([image.shape[1] / model.width, image.shape[0] / model.height], np.float32)
