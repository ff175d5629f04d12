"""Images of a finished run."""

from pathlib import Path

from ltgs_jax.io import InputError, load_chronology, write_image
from ltgs_jax.scene import compose, drop_hidden

from .looks import Eye
from .outputs import read_cameras


def render_visit(out_dir: str | Path, visit: int, camera_name: str | None, all_test: bool, folder: str | Path) -> None:
    """Write the scene of one visit as seen by one photograph's camera, or by those of all test photographs.

    Raises InputError when there is no such photograph.
    """
    out, folder = Path(out_dir), Path(folder)
    scene = drop_hidden(compose(load_chronology(out), visit))
    _, cameras = read_cameras(out)
    if all_test:
        names = [name for name, (_, role, _) in cameras.items() if role == "test"]
        if not names:
            raise InputError(f"--all-test: {out} has no test photographs")
    elif camera_name in cameras:
        names = [camera_name]
    else:
        raise InputError(f"--camera {camera_name}: no such placed photograph in {out / 'cameras.json'}")
    eye = Eye()
    for name in names:
        write_image(folder / Path(name).with_suffix(".png"), eye.image(scene, cameras[name][2]))
