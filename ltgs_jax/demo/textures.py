"""Procedural textures that look like packaging, wood, cloth and pictures: sRGB uint8, from a random generator."""

import colorsys
import itertools

import cv2
import numpy as np

_WORDS = ("CRUNCH", "OATS", "MILK", "PASTA", "TEA", "SALT", "RICE", "SUGO", "NUTS", "COCOA", "SOAP", "HONEY", "CORN")
_TITLES = ("ATLAS", "GARDEN", "RIVERS", "STARS", "BREAD", "MAPS", "BIRDS", "CODE", "SEEDS", "TALES")
_FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_TRIPLEX, cv2.FONT_HERSHEY_COMPLEX)


def palette(rng: np.random.Generator, count: int = 4) -> list[tuple[int, int, int]]:
    """Colours whose hues lie well apart, alternately light and dark."""
    hue = rng.random()
    colors = []
    for i in range(count):
        value, saturation = (0.84, 0.42) if i % 2 else (0.6, 0.62)
        rgb = colorsys.hsv_to_rgb((hue + i * 0.381966 + 0.05 * rng.random()) % 1, saturation, value)
        colors.append(tuple(int(255 * channel) for channel in rgb))
    return colors


def clouds(rng: np.random.Generator, height: int, width: int, *, coarsest: int = 4, octaves: int = 4) -> np.ndarray:
    """Fractal value noise [h w] in about −1…1."""
    total = np.zeros((height, width), np.float32)
    for octave in range(octaves):
        cells = coarsest * 2**octave
        shape = (max(2, round(cells * height / max(height, width))), max(2, round(cells * width / max(height, width))))
        values = rng.standard_normal(shape).astype(np.float32)
        total += cv2.resize(values, (width, height), interpolation=cv2.INTER_CUBIC) * 0.6**octave
    return total / 2


def speckled(rng: np.random.Generator, image: np.ndarray, *, strength: float = 9.0) -> np.ndarray:
    """The image with grain and soft blotches, so that nothing is perfectly flat."""
    height, width = image.shape[:2]
    grain = cv2.GaussianBlur(rng.standard_normal((height, width)).astype(np.float32), (0, 0), 0.8) * 1.5
    tone = strength * (clouds(rng, height, width) + grain)
    return np.clip(image + tone[..., None], 0, 255).astype(np.uint8)


def _canvas(height: int, width: int, color) -> np.ndarray:
    return np.full((height, width, 3), color, np.uint8)


def _label(image: np.ndarray, text: str, box: tuple[int, int, int, int], color, font: int) -> None:
    """Text that fills the box (x, y, width, height)."""
    x, y, width, height = box
    thickness = max(1, round(height / 7))
    (w, h), _ = cv2.getTextSize(text, font, 1.0, thickness)
    scale = min(width / w, height / h)
    (w, h), _ = cv2.getTextSize(text, font, scale, thickness)
    cv2.putText(image, text, (x + (width - w) // 2, y + (height + h) // 2), font, scale, color, thickness, cv2.LINE_AA)


def _paragraph(rng: np.random.Generator, image: np.ndarray, box: tuple[int, int, int, int], color, step: int) -> None:
    """Lines of word-like blocks."""
    x, y, width, height = box
    for row in range(y, y + height - step, 2 * step):
        at = x
        end = x + round(width * (0.6 + 0.4 * rng.random()))
        while at < end:
            word = int(rng.integers(step, 5 * step))
            cv2.rectangle(image, (at, row), (min(at + word, end), row + step - 1), color, -1)
            at += word + step


def packaging(rng: np.random.Generator, height: int, width: int, colors, *, front: bool) -> np.ndarray:
    """A side of a carton or a label: title, emblem, stripes (front) or text, table, bar code (back)."""
    image = _canvas(height, width, colors[0])
    light, dark = (250, 246, 235), (35, 30, 40)
    band = round(height * rng.uniform(0.16, 0.24))
    top = round(height * rng.uniform(0.05, 0.12))
    cv2.rectangle(image, (0, top), (width, top + band), colors[1], -1)
    word = str(rng.choice(_WORDS))
    font = int(rng.choice(_FONTS))
    _label(image, word, (round(0.06 * width), top + band // 6, round(0.88 * width), 2 * band // 3), light, font)
    below = top + band
    if front:
        centre = (round(width * rng.uniform(0.4, 0.6)), round(below + (height - below) * 0.42))
        radius = round(0.32 * min(width, height - below))
        cv2.circle(image, centre, radius, colors[3], -1, cv2.LINE_AA)
        for k in range(int(rng.integers(5, 9))):
            angle = 2 * np.pi * k / 7 + rng.random()
            tip = (centre[0] + round(radius * np.cos(angle)), centre[1] + round(radius * np.sin(angle)))
            cv2.line(image, centre, tip, colors[k % 3], max(2, radius // 6), cv2.LINE_AA)
        cv2.circle(image, centre, radius // 3, light, -1, cv2.LINE_AA)
        slope = int(rng.integers(6, 18))
        for x in range(-height, width, 2 * slope):
            start, end = (x, height - 1), (x + height // 8, height - height // 8)
            cv2.line(image, start, end, colors[2], slope // 2, cv2.LINE_AA)
    else:
        step = max(2, height // 55)
        inset = round(0.08 * width)
        _paragraph(rng, image, (inset, below + step * 2, width - 2 * inset, height // 3), light, step)
        x, y = inset, round(height * 0.68)
        w, h = round(width * 0.84), round(height * 0.25)
        cv2.rectangle(image, (x, y), (x + w, y + h), light, -1)
        at = x + 4
        while at < x + w // 2:
            bar = int(rng.integers(1, 5))
            cv2.rectangle(image, (at, y + 4), (at + bar - 1, y + h - 6), dark, -1)
            at += bar + int(rng.integers(2, 5))
        _paragraph(rng, image, (x + w // 2 + 4, y + 4, w // 2 - 8, h - 8), dark, step)
    return speckled(rng, image)


def wrapped(rng: np.random.Generator, height: int, width: int, colors) -> np.ndarray:
    """A label that runs round a can or a bottle: a front, a back and a third side between them."""
    third = width // 3
    sides = [packaging(rng, height, third, colors, front=i != 1) for i in range(2)]
    middle = _canvas(height, width - 2 * third, colors[2])
    for _ in range(14):
        spot = (int(rng.integers(middle.shape[1])), int(rng.integers(height)))
        cv2.circle(middle, spot, int(rng.integers(2, 4 + height // 8)), colors[int(rng.integers(4))], -1, cv2.LINE_AA)
    return np.concatenate([sides[0], speckled(rng, middle), sides[1]], axis=1)


def cover(rng: np.random.Generator, height: int, width: int, colors) -> np.ndarray:
    """A book's cover: frame, title, a patch of picture."""
    image = _canvas(height, width, colors[0])
    cv2.rectangle(image, (4, 4), (width - 5, height - 5), colors[1], 3)
    _label(image, str(rng.choice(_TITLES)), (12, height // 12, width - 24, height // 6), (250, 244, 228), 3)
    y, h = round(height * 0.32), round(height * 0.45)
    image[y : y + h, 14 : width - 14] = picture(rng, h, width - 28)
    _paragraph(rng, image, (width // 4, round(height * 0.83), width // 2, height // 8), (250, 244, 228), 3)
    return speckled(rng, image)


def pages(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """The edges of a book's pages."""
    rows = 215 + 25 * rng.standard_normal((height, 1))
    return speckled(rng, np.clip(np.repeat(rows, width, axis=1)[..., None] * [1, 0.96, 0.86], 0, 255), strength=5)


def picture(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """A landscape of hills below a sky, with a sun and dots of trees."""
    colors = palette(rng, 5)
    ramp = np.linspace(0, 1, height)[:, None, None]
    image = (1 - ramp) * np.array([110, 160, 225]) + ramp * np.array([250, 225, 190]) + np.zeros((height, width, 1))
    image = np.ascontiguousarray(image.astype(np.uint8))
    sun = (int(rng.integers(width // 6, 5 * width // 6)), int(height * rng.uniform(0.15, 0.35)))
    cv2.circle(image, sun, max(3, height // 9), (255, 240, 150), -1, cv2.LINE_AA)
    for layer in range(4):
        line = height * (0.4 + 0.15 * layer) + height * 0.12 * clouds(rng, 2, width, coarsest=5)[0]
        mask = np.arange(height)[:, None] > line[None]
        image[mask] = colors[layer]
        for _ in range(12):
            x = int(rng.integers(width))
            spot = (x, int(line[x]) + int(rng.integers(0, height // 6)))
            cv2.circle(image, spot, int(rng.integers(2, 3 + height // 20)), colors[(layer + 2) % 5], -1, cv2.LINE_AA)
    return speckled(rng, image, strength=6)


def wood(rng: np.random.Generator, height: int, width: int, *, planks: int, color) -> np.ndarray:
    """Planks along the width, each with its tone and its grain."""
    image = np.zeros((height, width, 3), np.float32)
    edges = np.linspace(0, height, planks + 1).astype(int)
    for low, high in itertools.pairwise(edges):
        grain = clouds(rng, 8 * (high - low), width, coarsest=5, octaves=5)
        grain = cv2.resize(grain, (width, high - low), interpolation=cv2.INTER_AREA)
        rings = np.sin(14 * cv2.GaussianBlur(grain, (0, 0), 2)) * 0.05 + grain * 0.16
        image[low:high] = np.array(color) * (1 + 0.09 * rng.standard_normal() + rings[..., None])
        if planks > 1:
            image[low] *= 0.55
            joint = int(rng.integers(width))
            image[low:high, joint : joint + 1] *= 0.6
    return speckled(rng, np.clip(image, 0, 255), strength=5)


def wallpaper(rng: np.random.Generator, height: int, width: int, colors) -> np.ndarray:
    """Soft plaster with a pattern of leaves, a little irregular."""
    base = np.array(colors[0]) * 0.14 + [184, 180, 170]
    image = np.ascontiguousarray(np.broadcast_to(base, (height, width, 3)).astype(np.uint8))
    step = 26
    for row, y in enumerate(range(step // 2, height, step)):
        for x in range((row % 2) * step // 2, width, step):
            spot = (x + int(rng.integers(-3, 4)), y + int(rng.integers(-3, 4)))
            tint = tuple(int(v) for v in base * rng.uniform(0.72, 0.92))
            axes = (int(rng.integers(4, 8)), int(rng.integers(2, 4)))
            cv2.ellipse(image, spot, axes, float(rng.uniform(0, 180)), 0, 360, tint, -1, cv2.LINE_AA)
    return speckled(rng, image, strength=7)


def rug(rng: np.random.Generator, height: int, width: int, colors) -> np.ndarray:
    """A woven rug: borders and rows of lozenges."""
    image = _canvas(height, width, colors[0])
    for inset, color in ((6, colors[1]), (14, colors[2])):
        cv2.rectangle(image, (inset, inset), (width - inset, height - inset), color, 4)
    for row, y in enumerate(range(34, height - 24, 26)):
        for column, x in enumerate(range(34, width - 24, 30)):
            size = 9 + 3 * ((row + column) % 2)
            points = np.array([(x - size, y), (x, y - size), (x + size, y), (x, y + size)])
            cv2.fillPoly(image, [points], colors[1 + (row * 2 + column) % 3], cv2.LINE_AA)
    return speckled(rng, image, strength=12)


def patches(rng: np.random.Generator, height: int, width: int, colors) -> np.ndarray:
    """Panels of a ball: gores of two colours with dots and a belt of text."""
    image = _canvas(height, width, colors[0])
    edges = np.linspace(0, width, 7).astype(int)
    for i, (low, high) in enumerate(itertools.pairwise(edges)):
        image[:, low:high] = colors[i % 4]
        for _ in range(5):
            spot = (int(rng.integers(low, high)), int(rng.integers(height)))
            cv2.circle(image, spot, int(rng.integers(3, 8)), colors[(i + 2) % 4], -1, cv2.LINE_AA)
    belt = height // 5
    cv2.rectangle(image, (0, (height - belt) // 2), (width, (height + belt) // 2), (245, 240, 230), -1)
    for i in range(3):
        box = (round(width * (i + 0.1) / 3), (height - belt) // 2 + 2, round(width * 0.26), belt - 4)
        _label(image, str(rng.choice(_TITLES)), box, colors[i % 3], cv2.FONT_HERSHEY_DUPLEX)
    return speckled(rng, image)


def plain(rng: np.random.Generator, height: int, width: int, color, *, strength: float = 8.0) -> np.ndarray:
    """One colour with grain."""
    return speckled(rng, _canvas(height, width, color), strength=strength)


def letter(rng: np.random.Generator, side: int, colors) -> np.ndarray:
    """A face of a toy block: a framed letter."""
    image = _canvas(side, side, (240, 226, 190))
    cv2.rectangle(image, (3, 3), (side - 4, side - 4), colors[int(rng.integers(4))], max(2, side // 12))
    glyph = chr(int(rng.integers(ord("A"), ord("Z") + 1)))
    _label(image, glyph, (side // 5, side // 5, 3 * side // 5, 3 * side // 5), colors[int(rng.integers(4))], 3)
    return speckled(rng, image)


def gable(rng: np.random.Generator, height: int, width: int, colors) -> np.ndarray:
    """A wall of a toy house: timber, windows, a door."""
    image = _canvas(height, width, (236, 222, 196))
    for x in np.linspace(2, width - 3, 4).astype(int):
        cv2.line(image, (x, 0), (x, height), colors[0], 4)
    cv2.line(image, (0, height // 2), (width, height // 2), colors[0], 4)
    w, h = width // 5, height // 4
    for x in (width // 8, width - width // 8 - w):
        for y in (height // 6, height // 2 + height // 8):
            cv2.rectangle(image, (x, y), (x + w, y + h), colors[int(rng.integers(1, 4))], -1)
            cv2.line(image, (x + w // 2, y), (x + w // 2, y + h), (245, 245, 240), 2)
    cv2.rectangle(image, (2 * width // 5, height - height // 3), (3 * width // 5, height), colors[2], -1)
    return speckled(rng, image)


def tiles(rng: np.random.Generator, height: int, width: int, color) -> np.ndarray:
    """Roof tiles in rows, each of its own tone."""
    image = np.zeros((height, width, 3), np.float32)
    step = max(5, height // 8)
    for row, y in enumerate(range(0, height, step)):
        for x in range(-(row % 2) * step // 2, width, step):
            tone = np.array(color) * (1 + 0.16 * rng.standard_normal())
            cv2.rectangle(image, (x, y), (x + step - 2, y + step - 2), tone.tolist(), -1)
    return speckled(rng, np.clip(image, 0, 255))
