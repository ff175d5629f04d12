"""Long-term Gaussian scene chronology in JAX: what changed in a room, which object it was, the scene at any visit.

`import ltgs_jax as ltgs` brings the names of `ltgs_jax.api`, each loaded when it is first used.
"""

import sys
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .api import Camera as Camera
    from .api import Capture as Capture
    from .api import Chronology as Chronology
    from .api import Splats as Splats
    from .api import cameras as cameras
    from .api import compose as compose
    from .api import load as load
    from .api import read_capture as read_capture
    from .api import read_splats as read_splats
    from .api import read_tracks as read_tracks
    from .api import render as render
    from .api import update as update
    from .api import write_image as write_image
    from .api import write_splats as write_splats

__version__ = "0.1.0"
__all__ = (
    "Camera", "Capture", "Chronology", "Splats", "cameras", "compose", "load", "read_capture", "read_splats",
    "read_tracks", "render", "update", "write_image", "write_splats",
)  # fmt: skip


class _RenderRoom(ModuleType):
    """The room `ltgs_jax.render`, which can also be called: the package has one name for the room and the function."""

    def __call__(self, splats, camera):
        from .api import render

        return render(splats, camera)


class _Package(ModuleType):
    """The package, which loads the names of the API when they are used."""

    def __setattr__(self, name: str, value) -> None:
        if name == "render" and isinstance(value, ModuleType):  # the import system hands the room over
            value.__class__ = _RenderRoom
        super().__setattr__(name, value)

    def __getattr__(self, name: str):
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from . import api

        return getattr(api, name)

    def __dir__(self):
        return sorted({*super().__dir__(), *__all__})


sys.modules[__name__].__class__ = _Package
