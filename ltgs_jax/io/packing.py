"""Quantisations that several splat formats share."""

import numpy as np

from ltgs_jax.geometry import C0

_SQRT2 = np.float32(np.sqrt(2))


def logit_of_byte(alpha: np.ndarray) -> np.ndarray:
    """Logit of an opacity stored in 8 bits; 0 and 255 a quarter of a step inwards, so that they stay finite."""
    value = np.clip(alpha.astype(np.float32) / 255, 0.25 / 255, 1 - 0.25 / 255)
    return np.log(value / (1 - value))


def byte_of_logit(logits: np.ndarray) -> np.ndarray:
    """Opacity in 8 bits."""
    with np.errstate(over="ignore"):
        return to_byte(255 / (1 + np.exp(-np.asarray(logits, np.float64))))


def to_byte(values: np.ndarray) -> np.ndarray:
    """Nearest value of 0…255."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def sh_of_color(color: np.ndarray) -> np.ndarray:
    """Coefficient of degree 0 of a colour in 0..1."""
    return (color.astype(np.float32) - np.float32(0.5)) / np.float32(C0)


def color_of_sh(dc: np.ndarray) -> np.ndarray:
    """Colour of a coefficient of degree 0; in 0..1 where it can be shown."""
    return np.asarray(dc, np.float64) * C0 + 0.5


def fill_largest(largest: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Unit quaternions [n 4] from the place of their largest component and the other three [n 3], in order."""
    rest = np.sqrt(np.clip(1 - np.sum(others * others, axis=1), 0, 1))
    quats = np.zeros((len(largest), 4), np.float32)
    places = np.argsort(np.arange(4)[None] == largest[:, None], axis=1, kind="stable")
    np.put_along_axis(quats, places, np.column_stack([others, rest]).astype(np.float32), axis=1)
    return quats


def drop_largest(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The inverse: place of the largest component, which is made positive, and the other three, each within ±√½."""
    quats = np.asarray(quats, np.float64)
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    unit = np.where(norms > 0, quats / np.where(norms > 0, norms, 1), [1, 0, 0, 0])
    largest = np.argmax(np.abs(unit), axis=1)
    top = np.take_along_axis(unit, largest[:, None], axis=1)
    unit = unit * np.where(top < 0, -1, 1)
    places = np.argsort(np.arange(4)[None] == largest[:, None], axis=1, kind="stable")
    return largest, np.take_along_axis(unit, places, axis=1)[:, :3]


def unpack_quats_10(packed: np.ndarray) -> np.ndarray:
    """Quaternions of 2 + 3 × 10 bits, each component an offset from −√½ (SuperSplat)."""
    fields = np.stack([(packed >> shift) & 1023 for shift in (20, 10, 0)], axis=1).astype(np.float32)
    return fill_largest(packed >> 30, (fields / 1023 - np.float32(0.5)) * _SQRT2)


def pack_quats_10(quats: np.ndarray) -> np.ndarray:
    """The inverse of `unpack_quats_10`."""
    largest, others = drop_largest(quats)
    fields = np.clip(np.rint((others / np.sqrt(2) + 0.5) * 1023), 0, 1023).astype(np.uint32)
    return largest.astype(np.uint32) << 30 | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]


def unpack_quats_sign9(packed: np.ndarray) -> np.ndarray:
    """Quaternions of 2 + 3 × (sign + 9 bits) (SPZ from version 3)."""
    fields = np.stack([(packed >> shift) & 1023 for shift in (20, 10, 0)], axis=1)
    size = (fields & 511).astype(np.float32) / (511 * _SQRT2)
    return fill_largest(packed >> 30, np.where(fields >> 9 == 1, -size, size))


def pack_quats_sign9(quats: np.ndarray) -> np.ndarray:
    """The inverse of `unpack_quats_sign9`."""
    largest, others = drop_largest(quats)
    size = np.clip(np.rint(np.abs(others) * np.sqrt(2) * 511), 0, 511).astype(np.uint32)
    fields = (others < 0).astype(np.uint32) << 9 | size
    return largest.astype(np.uint32) << 30 | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]
