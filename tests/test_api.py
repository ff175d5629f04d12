"""The names that `import ltgs_jax` hands on, and the README's example."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import ltgs_jax as ltgs
from ltgs_jax.io import read_pixels, read_ply
from ltgs_jax.render import render

ROOT = Path(__file__).parents[1]


def _readme_example() -> str:
    """The Python of README's "From Python"."""
    text = (ROOT / "README.md").read_text().split("## From Python", 1)[1]
    return re.search(r"```python\n(.*?)```", text, re.DOTALL).group(1)


def test_readme_example_runs(tiny_run, tmp_path, monkeypatch, capsys):
    """On the folder of a run that ended, which the example takes up again."""
    example = _readme_example()
    assert len(example.splitlines()) <= 15
    for made, name in zip(tiny_run, ("CAPTURE", "DIR"), strict=True):
        shutil.copytree(made, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(compile(example, "README.md", "exec"), names)
    camera = ltgs.cameras("DIR")["t1/0.png"]
    scene = ltgs.compose(names["chronology"], 1)
    shown = read_pixels(tmp_path / "visit1.png")[..., :3] / 255.0
    np.testing.assert_allclose(shown, np.clip(render(scene, camera).image, 0, 1), atol=1 / 255)
    np.testing.assert_allclose(ltgs.render(read_ply(tmp_path / "visit1.ply"), camera), names["image"], atol=1e-4)
    photograph = read_pixels(tmp_path / "CAPTURE" / "images" / "t1" / "0.png") / 255.0
    before = np.asarray(ltgs.render(ltgs.compose(names["chronology"], 0), camera))
    errors = [np.abs(image - photograph).mean() for image in (np.asarray(names["image"]), before)]
    assert errors[0] < 0.6 * errors[1], "the second visit's scene must look like its photograph, the first's must not"
    assert "moved" in capsys.readouterr().out


def test_the_room_and_the_function_share_a_name_in_any_order_of_imports():
    program = (
        "import ltgs_jax as ltgs\n{0}\nassert callable(ltgs.render), ltgs.render\n"
        "from ltgs_jax.render import RenderConfig\nimport ltgs_jax.render as room\n"
        "assert room.RenderConfig is RenderConfig and callable(ltgs.render)\n"
        "assert set(ltgs.__all__) <= set(dir(ltgs))\n"
        "try: ltgs.nothing\nexcept AttributeError as error: print(error)"
    )
    for first in ("ltgs.compose", "import ltgs_jax.render"):
        done = subprocess.run(
            [sys.executable, "-c", program.format(first)], capture_output=True, text=True, cwd=ROOT, check=False
        )
        assert done.returncode == 0, done.stderr
        assert "has no attribute 'nothing'" in done.stdout


def test_every_name_is_there_and_says_what_it_does():
    for name in ltgs.__all__:
        assert getattr(ltgs, name).__doc__, name


def test_wrong_arguments_are_named(tmp_path):
    with pytest.raises(ValueError, match="preset: expected one of"):
        ltgs.update(tmp_path, preset="slow")
    with pytest.raises(ValueError, match="no photographs"):
        ltgs.update(tmp_path)
