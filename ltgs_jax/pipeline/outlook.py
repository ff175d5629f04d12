"""What a run will take, said before it starts."""

import os
from dataclasses import dataclass

from ltgs_jax.io import Capture, scaled_size

from .config import Config

# From peaks of runs on the CPU: 1.4 to 2.5 GB where photographs and splats are few (jax, OpenCV and COLMAP loaded,
# programs compiled, candidate poses rendered in batches), and 4.25 GB for 400 photographs of 1600×1200.
_BASE_BYTES = 2200 << 20
_BYTES_PER_PIXEL = 1100  # render and loss with their gradients, per pixel of the largest photograph
_COPIES = 8  # parameters, gradient, two moments of Adam, and what a step donates and copies


@dataclass(frozen=True)
class Outlook:
    """Photographs and splats of a run and the memory that it is expected to take, in bytes."""

    photographs: int
    visits: int
    size: tuple[int, int]
    decoded_bytes: int
    kept_bytes: int
    splats: int
    bytes: int

    def __str__(self) -> str:
        width, height = self.size
        kept = "" if self.kept_bytes == self.decoded_bytes else f", of which {_size(self.kept_bytes)} are kept decoded"
        return (
            f"{self.photographs} photographs of {self.visits} visits, at most {width}×{height} "
            f"({_size(self.decoded_bytes)}{kept}), {self.splats} splats: about {_size(self.bytes)} of memory"
        )


def look_ahead(capture: Capture, config: Config, given_splats: int | None) -> Outlook:
    """The plan of a run on a capture; `given_splats` is the size of a scene that is not fitted but given."""
    used = [p for p in capture.photographs if p.role in ("train", "update")]
    sizes = [scaled_size(p.width, p.height, config.io.max_side) for p in used] or [(0, 0)]
    decoded = sum(4 * width * height for width, height in sizes)  # three colours and the mask
    kept = min(decoded, config.io.photograph_bytes)
    splats = config.fit.initial.max_splats if given_splats is None else given_splats
    largest = max(sizes, key=lambda size: size[0] * size[1])
    floats = 3 + 4 + 3 + 1 + 3 * (config.fit.initial.sh_degree + 1) ** 2
    working = 4 * floats * splats * _COPIES + _BYTES_PER_PIXEL * largest[0] * largest[1]
    return Outlook(
        photographs=len(used),
        visits=len(capture.visits),
        size=largest,
        decoded_bytes=decoded,
        kept_bytes=kept,
        splats=splats,
        bytes=_BASE_BYTES + round(1.25 * kept) + working,
    )


def available_bytes() -> int | None:
    """Memory that the machine can still give; None where it does not say."""
    try:
        with open("/proc/meminfo") as file:
            rows = dict(line.split(":", 1) for line in file)
        return int(rows["MemAvailable"].split()[0]) << 10
    except (OSError, KeyError, ValueError):
        try:
            return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_AVPHYS_PAGES")
        except (ValueError, OSError):
            return None


def say_outlook(outlook: Outlook, progress) -> None:
    """State the plan; warn where the machine does not have the memory."""
    progress.note(f"plan: {outlook}")
    available = available_bytes()
    if available is not None and outlook.bytes > available:
        progress.warn(
            f"only {_size(available)} of memory are free; --max-splats and --max-side make a run smaller "
            "(and --io.photograph-bytes, which keeps fewer photographs decoded)"
        )


def _size(count: int) -> str:
    return f"{count / 2**30:.1f} GiB" if count >= 2**30 else f"{count / 2**20:.0f} MiB"
