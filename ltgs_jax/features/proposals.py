"""Class-agnostic regions: graph segmentations (Felzenszwalb & Huttenlocher 2004) at several scales over superpixels,
and every region that appears while the finest one is merged by likeness (selective search, Uijlings et al. 2013)."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from .protocol import Image, Proposals, check_image


def _graph_cells(lab: Float[np.ndarray, "h w c"], *, scale: float, min_area: int) -> Int[np.ndarray, "h w"]:
    """One graph segmentation, labels from 0 without gaps."""
    segmenter = cv2.ximgproc.segmentation.createGraphSegmentation(0.6, scale, min_area)
    labels = segmenter.processImage(np.ascontiguousarray(lab))
    return np.unique(labels, return_inverse=True)[1].reshape(labels.shape).astype(np.int32)


def _joint_cells(partitions: list[Int[np.ndarray, "h w"]]) -> tuple[Int[np.ndarray, "h w"], list[np.ndarray]]:
    """The common refinement of partitions, and for each of them the label of every joint cell."""
    key = np.zeros(partitions[0].shape, np.int64)
    for labels in partitions:
        key = key * (int(labels.max()) + 1) + labels
    _, first, leaves = np.unique(key.ravel(), return_index=True, return_inverse=True)
    return leaves.reshape(key.shape).astype(np.int32), [labels.ravel()[first] for labels in partitions]


def _borders(labels: Int[np.ndarray, "h w"], count: int) -> Float[np.ndarray, "n n"]:
    """Length of the common border of every two cells, in pixels."""
    length = np.zeros((count, count), np.float32)
    for a, b in ((labels[:, :-1], labels[:, 1:]), (labels[:-1], labels[1:])):
        different = a != b
        np.add.at(length, (a[different], b[different]), 1)
    return length + length.T


def _cell_statistics(
    labels: Int[np.ndarray, "h w"], lab: Float[np.ndarray, "h w c"], count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels, and sums of colour histograms (soft, 12 bins per channel) of every cell."""
    flat = labels.ravel()
    areas = np.bincount(flat, minlength=count).astype(np.float32)
    histograms = []
    for channel in np.moveaxis(lab, -1, 0):
        bins = np.clip((channel.ravel() * (12 / 256)).astype(np.int64), 0, 11)
        histograms.append(np.bincount(flat * 12 + bins, minlength=count * 12).reshape(count, 12))
    return areas, np.concatenate(histograms, axis=1).astype(np.float32)


def _merge_order(
    labels: Int[np.ndarray, "h w"], lab: Float[np.ndarray, "h w c"], *, size_weight: float, border_weight: float
) -> Bool[np.ndarray, "m n"]:
    """Greedy merging of adjacent cells, most alike first; returns each intermediate region as its cells.

    Likeness: intersection of colour histograms + `size_weight` · (small regions first) + `border_weight` · (share of
    the smaller one's outline that the two have in common, which fills holes and joins the two halves of a thing).
    """
    count = int(labels.max()) + 1
    border = _borders(labels, count)
    areas, histograms = _cell_statistics(labels, lab, count)
    outline = border.sum(axis=1)
    cells = np.eye(count, dtype=bool)
    regions, total = [], float(labels.size)
    channels = lab.shape[-1]

    def likeness(i: int, others: np.ndarray) -> np.ndarray:
        mine, theirs = histograms[i] / areas[i], histograms[others] / areas[others, None]
        colour = np.minimum(mine, theirs).sum(axis=1) / channels
        size = 1 - (areas[i] + areas[others]) / total
        shared = border[i, others] / np.maximum(np.minimum(outline[i], outline[others]), 1)
        return colour + size_weight * size + border_weight * shared

    score = np.full((count, count), -np.inf, np.float32)
    for i in range(count):
        others = np.flatnonzero(border[i])
        score[i, others] = likeness(i, others)
    for _ in range(count - 1):
        i, j = np.unravel_index(np.argmax(score), score.shape)
        if not np.isfinite(score[i, j]):
            break
        areas[i] += areas[j]
        histograms[i] += histograms[j]
        outline[i] += outline[j] - 2 * border[i, j]
        border[i] += border[j]
        border[:, i] = border[i]
        border[i, i] = 0
        border[j] = border[:, j] = 0
        score[j] = score[:, j] = score[i] = score[:, i] = -np.inf
        others = np.flatnonzero(border[i])
        score[i, others] = score[others, i] = likeness(i, others)
        cells[i] |= cells[j]
        regions.append(cells[i].copy())
    return np.stack(regions) if regions else np.zeros((0, count), bool)


def _guide_cells(guide: Float[np.ndarray, "h w"], *, min_area: int) -> list[Int[np.ndarray, "h w"]]:
    """Connected components of the guide above a ladder of shares of its peak; label 0 is what lies below."""
    smooth = cv2.GaussianBlur(guide.astype(np.float32), (0, 0), 1.5)
    peak = float(np.quantile(smooth, 0.995))
    partitions = []
    for share in (0.25, 0.4, 0.55, 0.7):
        above = (smooth > share * peak).astype(np.uint8)
        _, labels, stats, _ = cv2.connectedComponentsWithStats(above, connectivity=4)
        large = stats[:, cv2.CC_STAT_AREA] >= min_area
        large[0] = False
        relabel = np.where(large, np.cumsum(large), 0).astype(np.int32)
        if large.any():
            partitions.append(relabel[labels])
    return partitions


def _distinct(
    members: Bool[np.ndarray, "m l"], cell_areas: Float[np.ndarray, " l"], *, max_iou: float
) -> Int[np.ndarray, " k"]:
    """Indices of regions none of which repeats an earlier one at more than `max_iou`."""
    weighted = members * cell_areas.astype(np.float32)
    inter = weighted @ members.T.astype(np.float32)
    area = np.diag(inter)
    iou = inter / np.maximum(area[:, None] + area[None] - inter, 1)
    repeated = np.zeros(len(members), bool)
    for i in range(len(members)):
        if not repeated[i]:
            repeated[i + 1 :] |= iou[i, i + 1 :] > max_iou
    return np.flatnonzero(~repeated)


def segment_proposals(
    image: Image,
    *,
    guide: Float[np.ndarray, "h w"] | None = None,
    work_size: int = 400,
    min_area: float = 4e-4,
    max_area: float = 0.5,
    max_iou: float = 0.9,
) -> Proposals:
    """Regions of one photograph, a few hundred, at every size between the two areas.

    Args: `image` [h w 3] in [0, 1]; `guide` [h w] in [0, 1] takes part as a fourth channel and adds its own connected
    components; `work_size` px of the longer side while segmenting; `min_area`, `max_area` as shares of the image;
    `max_iou` above which two regions are one. Raises ValueError on a malformed image or a guide of another size.
    """
    image = check_image(image)
    h, w = image.shape[:2]
    if guide is not None and guide.shape != (h, w):
        raise ValueError(f"guide: expected the image's size {(h, w)}, got {guide.shape}")
    shrink = min(1.0, work_size / max(h, w))
    size = (max(1, round(w * shrink)), max(1, round(h * shrink)))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    lab = cv2.cvtColor(small, cv2.COLOR_RGB2Lab) * np.float32([2.55, 1, 1]) + np.float32([0, 128, 128])
    pixels = size[0] * size[1]
    least = max(12, int(min_area * pixels))
    # Chroma counts twice: shading and soft shadows change lightness, objects change chroma.
    channels = lab * np.float32([1, 2, 2])
    partitions = [_graph_cells(channels, scale=s, min_area=least // 2) for s in (80.0, 240.0, 800.0)]
    if guide is not None:
        small_guide = cv2.resize(guide.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        guided = np.concatenate([channels, 255 * small_guide[..., None]], axis=-1)
        partitions.append(_graph_cells(guided, scale=200.0, min_area=least // 2))
        partitions += _guide_cells(small_guide, min_area=least)
    leaves, labels_of = _joint_cells(partitions)
    cell_areas = np.bincount(leaves.ravel()).astype(np.float32)
    regions = []
    for position, labels in enumerate(labels_of):
        is_component = guide is not None and position > 3
        regions.append(labels[None] == np.arange(1 if is_component else 0, labels.max() + 1)[:, None])
    for source, weights in ((0, (0.5, 0.5)), (1, (0.2, 1.5)), (1, (1.0, 0.3))):
        merged = _merge_order(partitions[source], lab, size_weight=weights[0], border_weight=weights[1])
        regions.append(merged[:, labels_of[source]])
    members = np.concatenate(regions)
    areas = members @ cell_areas
    members = members[(areas >= least) & (areas <= max_area * pixels)]
    members = members[_distinct(members, cell_areas, max_iou=max_iou)]
    return Proposals(cv2.resize(leaves, (w, h), interpolation=cv2.INTER_NEAREST_EXACT), members)
