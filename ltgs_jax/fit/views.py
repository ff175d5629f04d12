"""Photographs as the fit sees them."""

from collections.abc import Callable, Iterable, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ltgs_jax.geometry import Camera
from ltgs_jax.render import RenderPlan, plan_render
from ltgs_jax.scene import Splats


class View(eqx.Module):
    """One photograph to fit: camera, image [h w 3] uint8, and the pixels that count [h w]."""

    camera: Camera
    image: np.ndarray
    mask: np.ndarray


class Budget:
    """Bytes of decoded photographs that may be kept, shared by some streamed views; and the one decoded last."""

    def __init__(self, total: int) -> None:
        self.total = self.left = total
        self.latest: tuple[object, View] | None = None


class StreamedView:
    """A view whose pixels are decoded when they are needed, and kept as long as the budget allows.

    What fits is kept for good, what does not is decoded each time: over photographs drawn at random no cache of the
    same size does better. Stands wherever a `View` does.
    """

    def __init__(self, camera: Camera, load: Callable[[], View], budget: Budget) -> None:
        self.camera, self.load, self.budget = camera, load, budget
        self._kept: View | None = None

    @property
    def image(self) -> np.ndarray:
        """[h w 3] uint8."""
        return self._view().image

    @property
    def mask(self) -> np.ndarray:
        """[h w] bool."""
        return self._view().mask

    def check(self) -> None:
        """Decode the photograph, so that what is wrong with it comes out now."""
        self._view()

    def _view(self) -> View:
        if self._kept is not None:
            return self._kept
        budget = self.budget
        if budget.latest is not None and budget.latest[0] is self:
            return budget.latest[1]
        view = self.load()
        size = view.image.nbytes + view.mask.nbytes
        if size <= budget.left:
            budget.left -= size
            self._kept = view
        else:
            budget.latest = (self, view)
        return view


class VisitView(eqx.Module):
    """A photograph and the visit whose scene it shows."""

    view: View | StreamedView
    visit: int


def halved(views: Sequence[View | StreamedView]) -> list[View | StreamedView]:
    """All views at half resolution; streamed ones stay streamed, with a quarter of their budget."""
    budgets: dict[Budget, Budget] = {}

    def half(view: View | StreamedView) -> View | StreamedView:
        if isinstance(view, View):
            return half_size(view)
        budget = budgets.setdefault(view.budget, Budget(view.budget.total // 4))
        return StreamedView(half_camera(view.camera), lambda: half_size(view), budget)

    return [half(view) for view in views]


def size_of(view: View | StreamedView) -> tuple[int, int]:
    """Width and height in pixels."""
    return view.camera.width, view.camera.height


def half_camera(camera: Camera) -> Camera:
    """The camera of `half_size`'s image."""
    K = camera.K * jnp.asarray([[0.5], [0.5], [1]], camera.K.dtype)
    return Camera(camera.cam_from_world, K, camera.width // 2, camera.height // 2)


def half_size(view: View | StreamedView) -> View:
    """The view at half resolution, by averaging 2×2 pixels; an odd last row or column is left out."""
    h, w = view.image.shape[0] // 2, view.image.shape[1] // 2
    blocks = view.image[: 2 * h, : 2 * w].astype(np.float32).reshape(h, 2, w, 2, 3)
    mask = view.mask[: 2 * h, : 2 * w].reshape(h, 2, w, 2).all(axis=(1, 3))
    return View(half_camera(view.camera), np.rint(blocks.mean(axis=(1, 3))).astype(np.uint8), mask)


def scene_extent(cameras: Sequence[Camera]) -> float:
    """1.1 × the largest distance of a camera from their mean, as 3DGS scales its step for the means."""
    centers = np.stack([np.asarray(camera.center()) for camera in cameras])
    return float(1.1 * np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()) or 1.0


def plan_for(pairs: Iterable[tuple[Splats, Camera]], *, slack: float = 1.3) -> RenderPlan:
    """One plan that serves each of these renders alone, so that one compilation does."""
    plans = [plan_render(splats, camera, slack=slack) for splats, camera in pairs]
    return RenderPlan(max(p.intersections for p in plans), max(p.rounds for p in plans))
