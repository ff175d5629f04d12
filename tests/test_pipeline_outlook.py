"""The plan of a run, said before it starts."""

from dataclasses import replace
from pathlib import Path

from tiny_capture import write_tiny_capture

from ltgs_jax import pipeline
from ltgs_jax.io import read_capture
from ltgs_jax.pipeline import outlook
from ltgs_jax.pipeline.config import Config, IoConfig


class _Said:
    def __init__(self):
        self.notes, self.warnings = [], []

    def note(self, text):
        self.notes.append(text)

    def warn(self, text):
        self.warnings.append(text)


def test_the_plan_counts_what_is_used(tmp_path):
    capture = read_capture(write_tiny_capture(tmp_path))
    found = outlook.look_ahead(capture, pipeline.PRESETS["tiny"], None)
    assert (found.photographs, found.visits, found.size, found.splats) == (9, 2, (96, 72), 6000)
    assert found.decoded_bytes == found.kept_bytes == 9 * 96 * 72 * 4
    assert outlook.look_ahead(capture, pipeline.PRESETS["tiny"], 77).splats == 77
    small = replace(Config(), io=IoConfig(max_side=48, photograph_bytes=1000))
    less = outlook.look_ahead(capture, small, None)
    assert less.size == (48, 36) and less.kept_bytes == 1000 and less.bytes < found.bytes + (200 << 20)
    assert "9 photographs of 2 visits" in str(found) and "kept" in str(less) and "kept" not in str(found)


def test_four_hundred_large_photographs_are_planned_within_eight_gigabytes(tmp_path):
    """The measured peak of the fit alone is 4.25 GB (tests/test_fit_memory.py)."""
    capture = read_capture(write_tiny_capture(tmp_path))
    many = tuple(replace(p, name=f"t0/{i}.png", width=1600, height=1200, role="train")
                 for i in range(400) for p in capture.photographs[:1])  # fmt: skip
    found = outlook.look_ahead(replace(capture, photographs=many), replace(Config(), io=IoConfig(max_side=1600)), None)
    assert 4.25e9 < found.bytes < 8e9
    assert found.kept_bytes == 1 << 30 and found.decoded_bytes == 400 * 1600 * 1200 * 4


def test_a_machine_that_is_too_small_is_told(tmp_path, monkeypatch):
    capture = read_capture(write_tiny_capture(Path(tmp_path)))
    found = outlook.look_ahead(capture, Config(), None)
    for free, warned in ((1 << 30, 1), (1 << 40, 0), (None, 0)):
        monkeypatch.setattr(outlook, "available_bytes", lambda free=free: free)
        said = _Said()
        outlook.say_outlook(found, said)
        assert len(said.notes) == 1 and len(said.warnings) == warned
        assert all("--max-splats" in line for line in said.warnings)
    monkeypatch.undo()
    assert outlook.available_bytes() > 1 << 20
