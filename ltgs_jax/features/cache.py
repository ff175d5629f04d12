"""Answers of a front end, kept on disk by content: computed once per image, reused by every stage and run."""

import contextlib
import hashlib
import os
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from .protocol import Correspondences, Dense, FrontEnd, Image, Proposals


def content_hash(*parts: np.ndarray | str | None) -> str:
    """SHA-256 of arrays (shape, dtype, bytes) and words, in order."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            digest.update(f"array {part.shape} {part.dtype.str} ".encode())
            digest.update(np.ascontiguousarray(part).data)
        else:
            digest.update(f"word {part!r} ".encode())
    return digest.hexdigest()


@dataclass(frozen=True)
class Cached:
    """A front end whose answers are kept in `folder` as npz files (no pickle), named by what they were computed from.

    A file is written beside its place and renamed; one that cannot be read is computed again. Descriptors are kept in
    half precision, and handed out so at the first call too: the answer never depends on whether the cache was warm.
    """

    front_end: FrontEnd
    folder: Path

    def fingerprint(self) -> str:
        """That of the front end behind it: the cache changes no answer."""
        return self.front_end.fingerprint()

    def describe(self, image: Image) -> Dense:
        """See the front end."""

        def compute() -> dict[str, np.ndarray]:
            dense = self.front_end.describe(image)
            numbers = np.array([dense.stride, dense.colour_dims])
            return {"features": dense.features.astype(np.float16), "numbers": numbers}

        kept = self._kept(("describe", image), compute)
        stride, colour_dims = kept["numbers"].tolist()
        return Dense(kept["features"].astype(np.float32), stride, colour_dims)

    def propose(self, image: Image, *, guide: Float[np.ndarray, "h w"] | None = None) -> Proposals:
        """See the front end."""

        def compute() -> dict[str, np.ndarray]:
            proposals = self.front_end.propose(image, guide=guide)
            return {"leaves": proposals.leaves, "members": proposals.members}

        return Proposals(**self._kept(("propose", image, guide), compute))

    def keypoints(self, image: Image) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m d"]]:
        """See the front end."""

        def compute() -> dict[str, np.ndarray]:
            xy, descriptors = self.front_end.keypoints(image)
            return {"xy": xy, "descriptors": descriptors}

        kept = self._kept(("keypoints", image), compute)
        return kept["xy"], kept["descriptors"]

    def match(
        self,
        image_a: Image,
        image_b: Image,
        *,
        mask_a: Bool[np.ndarray, "ha wa"] | None = None,
        mask_b: Bool[np.ndarray, "hb wb"] | None = None,
        fundamental: Float[np.ndarray, "3 3"] | None = None,
    ) -> Correspondences:
        """See the front end."""

        def compute() -> dict[str, np.ndarray]:
            found = self.front_end.match(image_a, image_b, mask_a=mask_a, mask_b=mask_b, fundamental=fundamental)
            return {"xy_a": found.xy_a, "xy_b": found.xy_b, "score": found.score}

        line = None if fundamental is None else np.asarray(fundamental, np.float64)
        return Correspondences(**self._kept(("match", image_a, image_b, mask_a, mask_b, line), compute))

    def _kept(self, key: tuple, compute: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
        """The arrays of a file, which is written first where it is missing or broken."""
        parts = [part if part is None or isinstance(part, str) else np.asarray(part) for part in key]
        name = content_hash(self.fingerprint(), *parts)
        path = Path(self.folder) / name[:2] / f"{name}.npz"
        broken = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)
        # The file is opened here because np.load leaves it open where it is broken.
        with contextlib.suppress(*broken), path.open("rb") as handle, np.load(handle) as file:
            return {name: file[name] for name in file.files}
        arrays = compute()
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, beside = tempfile.mkstemp(prefix=".", suffix=".npz", dir=path.parent)
        try:
            with os.fdopen(handle, "wb") as file:
                np.savez(file, **arrays)
            os.replace(beside, path)
        finally:
            Path(beside).unlink(missing_ok=True)
        return arrays
