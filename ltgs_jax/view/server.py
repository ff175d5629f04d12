"""The viewer: a local web server whose page shows a chronology, with a slider over visits."""

import contextlib
import threading
import time
from pathlib import Path

import numpy as np

from ltgs_jax.io import load_chronology
from ltgs_jax.report import Run, Shot, color_of, difference, fitted, happenings, read_run, read_shown, up_direction
from ltgs_jax.scene import Chronology, ground_layers, light, owner_of

from .layers import Layer, Viewpoint, extent_of, layer_of, place_at, viewpoint_of

_SECONDS_OF_MOVING, _FRAMES_OF_MOVING = 0.8, 20
_PANEL_IMAGE_WIDTH = 480
_NO_IMAGE = np.zeros((3, 4, 3), np.uint8)
_SHOWN = ("photograph", "render", "difference", "first visit's scene")


def serve(folder: str | Path, *, host: str = "localhost", port: int = 8080) -> None:
    """Show the chronology in `folder` until interrupted; the address is printed.

    Raises InputError that names the file when the folder holds no whole chronology, ImportError without viser.
    """
    viewer = start(folder, host=host, port=port)
    print(f"http://{host}:{viewer.server.get_port()}  (Ctrl-C ends)", flush=True)
    with contextlib.suppress(KeyboardInterrupt):
        while True:
            time.sleep(3600)
    viewer.server.stop()


def start(folder: str | Path, *, host: str = "localhost", port: int = 8080) -> "Viewer":
    """The viewer of the chronology in `folder`, serving in the background at `port` or the next free one.

    Raises InputError that names the file when the folder holds no whole chronology, ImportError without viser.
    """
    import viser

    chronology, run = load_chronology(folder), read_run(Path(folder))
    server = viser.ViserServer(host=host, port=port, label="ltgs", verbose=False)
    return Viewer(server, chronology, run)


class Viewer:
    """The scene and the panel of one server; what the panel does can be done from Python too."""

    def __init__(self, server, chronology: Chronology, run: Run) -> None:
        self.server, self._chronology, self._run = server, chronology, run
        self.visit = 0
        self._hidden: set[int] = set()
        self._highlighted: int | None = None
        self._labels: list = []
        self._moving = threading.Lock()
        self._wanted = 0
        self._shots = [shot for shot in run.shots if shot.camera is not None]
        self._viewpoints = {shot.name: viewpoint_of(shot.camera) for shot in self._shots if shot.camera is not None}
        self._build_scene()
        self._build_panel()
        self._refresh()

    def show_visit(self, visit: int, *, animated: bool = True) -> None:
        """Go to a visit; objects move along their poses on the way when it is `animated`."""
        self._wanted = visit
        with self._moving:  # one move at a time; one that is overtaken ends early
            if self.visit == visit:
                return
            start, steps = self.visit, _FRAMES_OF_MOVING if animated else 1
            for i in range(1, steps + 1):
                if self._wanted != visit:
                    return
                self._place_objects(start + (visit - start) * i / steps)
                if animated:
                    time.sleep(_SECONDS_OF_MOVING / steps)
            self.visit = visit
            self._light()
            self._refresh()
        self._slider.value = visit

    def highlight(self, identity: int | None) -> None:
        """Tint one object in its colour and name it; None for none."""
        if identity == self._highlighted:
            return
        self._highlighted = identity
        self._chosen.value = _name_of(identity)
        self._tint_objects()
        self._label_highlighted()

    def hide(self, identity: int, hidden: bool = True) -> None:
        """Hide an object, or show it again."""
        (self._hidden.add if hidden else self._hidden.discard)(identity)
        self._refresh()

    def fly_to(self, name: str) -> None:
        """Put every open page's camera where the photograph was taken."""
        for client in self.server.get_clients().values():
            _look_from(client, self._viewpoints[name])

    def _build_scene(self) -> None:
        scene, chronology = self.server.scene, self._chronology
        ground = {t: layer_of(splats) for t, splats in ground_layers(chronology).items()}
        middle, reach = extent_of(ground[0])
        up = up_direction([shot.camera for shot in self._shots if shot.camera is not None])
        scene.set_up_direction(tuple(up))
        self._ground = {t: _add_splats(scene, f"background_{t}", layer) for t, layer in ground.items()}
        self._layers = [layer_of(template.splats) for template in chronology.templates]
        self._objects = [_add_splats(scene, f"template_{k}", layer) for k, layer in enumerate(self._layers)]
        self._frusta = {shot.name: self._add_frustum(shot, 0.12 * reach) for shot in self._shots}
        first = next((self._viewpoints[shot.name] for shot in self._shots), None)
        side = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
        start = middle + 2.5 * reach * (side / np.linalg.norm(side) + 0.5 * up)

        @self.server.on_client_connect
        def _(client) -> None:
            client.camera.up_direction = up
            if first is not None:
                _look_from(client, first)
            else:
                client.camera.position, client.camera.look_at = start, middle

    def _add_frustum(self, shot: Shot, scale: float):
        view = self._viewpoints[shot.name]
        thumbnail = _small(read_shown(shot.capture), 160)
        frustum = self.server.scene.add_camera_frustum(
            f"photographs/{shot.name}",
            view.fov,
            view.aspect,
            scale=scale,
            color=(226, 115, 64) if shot.role == "update" else (130, 140, 150),
            image=thumbnail,
            wxyz=view.wxyz,
            position=view.position,
        )

        @frustum.on_click
        def _(_) -> None:
            self._photograph.value = shot.name
            self.fly_to(shot.name)

        return frustum

    def _build_panel(self) -> None:
        gui, visits = self.server.gui, self._run.visits
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        self._slider = gui.add_slider("visit", 0, max(1, len(visits) - 1), 1, 0, disabled=len(visits) < 2)
        self._happened = gui.add_markdown("")

        @self._slider.on_update
        def _(_) -> None:
            self.show_visit(int(self._slider.value))

        self._build_objects_folder(gui)
        if self._shots:
            self._build_photographs_folder(gui)

    def _build_objects_folder(self, gui) -> None:
        identities = sorted({template.identity for template in self._chronology.templates})
        if not identities:
            return
        with gui.add_folder("objects"):
            names = {_name_of(identity): identity for identity in (None, *identities)}
            self._chosen = gui.add_dropdown("highlight", list(names))
            self._chosen.on_update(lambda _: self.highlight(names[self._chosen.value]))
            for identity in identities:
                box = gui.add_checkbox(_name_of(identity), True)
                box.on_update(lambda event, k=identity: self.hide(k, not event.target.value))

    def _build_photographs_folder(self, gui) -> None:
        with gui.add_folder("photographs"):
            self._photograph = gui.add_dropdown("photograph", [shot.name for shot in self._shots])
            self._shown = gui.add_dropdown("shown", list(_SHOWN))
            first = _image_of(self._shots[0], _SHOWN[0])
            self._image = gui.add_image(_NO_IMAGE if first is None else first, format="jpeg")
            fly = gui.add_button("fly there")
            self._show_frusta = gui.add_checkbox("show where they were taken", False)
            self._photograph.on_update(lambda _: self._refresh_image())
            self._shown.on_update(lambda _: self._refresh_image())
            fly.on_click(lambda _: self.fly_to(self._photograph.value))
            self._show_frusta.on_update(lambda _: self._refresh())

    def _place_objects(self, moment: float) -> None:
        with self.server.atomic():
            for since, handle in self._ground.items():
                handle.visible = since <= moment
            for k, (template, handle) in enumerate(zip(self._chronology.templates, self._objects, strict=True)):
                place = place_at(self._chronology, k, moment)
                handle.wxyz, handle.position = place.wxyz, place.xyz
                handle.visible = place.visible and template.identity not in self._hidden

    def _tint_objects(self) -> None:
        for template, layer, handle in zip(self._chronology.templates, self._layers, self._objects, strict=True):
            chosen = template.identity == self._highlighted
            handle.rgbs = layer.tinted(color_of(template.identity)) if chosen else layer.rgbs

    def _light(self) -> None:
        """Colours as they are lit at the visit."""
        chronology = self._chronology
        if chronology.shade is None and chronology.shadows is None:
            return
        ground, objects = light(chronology, self.visit)
        since = np.zeros(ground.count) if chronology.since is None else np.asarray(chronology.since)
        for t, handle in self._ground.items():
            handle.rgbs = layer_of(ground[since == t]).rgbs
        owner = owner_of(chronology)
        self._layers = [layer_of(objects[owner == k]) for k in range(len(self._objects)) if objects is not None]
        self._tint_objects()

    def _refresh(self) -> None:
        """Bring everything that depends on the visit and on what is hidden up to date."""
        self._place_objects(self.visit)
        self._happened.content = self._events()
        if not self._shots:
            return
        for shot in self._shots:
            self._frusta[shot.name].visible = self._show_frusta.value and shot.visit == self.visit
        names = tuple(shot.name for shot in self._shots if shot.visit == self.visit)
        if names and self._photograph.value not in names:
            self._photograph.options = names
            self._photograph.value = names[0]
        self._refresh_image()

    def _label_highlighted(self) -> None:
        """The label hangs on the object, so that it moves and hides with it."""
        for label in self._labels:
            label.remove()
        chosen = [k for k, entry in enumerate(self._chronology.templates) if entry.identity == self._highlighted]
        self._labels = [
            self.server.scene.add_label(
                f"template_{k}/label", _name_of(self._highlighted), position=extent_of(self._layers[k])[0]
            )
            for k in chosen
        ]

    def _events(self) -> str:
        """The name of the visit and what happened at it, as Markdown."""
        lines = [f"**{self._run.visits[self.visit]}**"]
        for entry in happenings(self._run, self.visit):
            sure = "" if entry.state.confidence is None else f" ({entry.state.confidence:.2f})"
            lines.append(f"- {_name_of(entry.thing.identity)} {entry.sentence}{sure}")
        if len(lines) == 1:
            lines.append("first visit" if self.visit == 0 else "nothing changed")
        return "\n".join(lines)

    def _refresh_image(self) -> None:
        shot = next((shot for shot in self._shots if shot.name == self._photograph.value), None)
        image = None if shot is None else _image_of(shot, self._shown.value)
        self._image.visible = image is not None
        if image is not None and not np.array_equal(image, self._image.image):
            self._image.image = image


def _name_of(identity: int | None) -> str:
    return "none" if identity is None else f"object {identity}"


def _add_splats(scene, name: str, layer: Layer):
    return scene.add_gaussian_splats(name, layer.centers, layer.covariances, layer.rgbs, layer.opacities)


def _look_from(client, view: Viewpoint) -> None:
    with client.atomic():
        client.camera.wxyz, client.camera.position, client.camera.fov = view.wxyz, view.position, view.fov


def _image_of(shot: Shot, shown: str) -> np.ndarray | None:
    """What the panel shows of a photograph, 8 bit; None when there is no such image."""
    paths = {"photograph": shot.capture, "render": shot.render, "first visit's scene": shot.initial}
    if shown in paths:
        return _small(read_shown(paths[shown]), _PANEL_IMAGE_WIDTH)
    capture, render = read_shown(shot.capture), read_shown(shot.render)
    if capture is None or render is None:
        return None
    return _small(difference(fitted(capture, (render.shape[1], render.shape[0])), render), _PANEL_IMAGE_WIDTH)


def _small(image: np.ndarray | None, width: int) -> np.ndarray | None:
    if image is None:
        return None
    width = min(width, image.shape[1])
    size = (width, max(1, round(image.shape[0] * width / image.shape[1])))
    return np.rint(np.clip(fitted(image, size), 0, 1) * 255).astype(np.uint8)
