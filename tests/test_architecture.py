"""The house rules of docs/architecture.md, read from the sources: who imports whom, how long, how fast."""

import ast
import statistics
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

PACKAGE = Path(__file__).parents[1] / "ltgs_jax"

RANKS = {
    "geometry": 0,
    "scene": 1,
    "metrics": 1,
    "io": 2,
    "render": 2,
    "features": 2,
    "demo": 3,  # writes its captures through io
    "localize": 3,
    "detect": 3,
    "match": 3,
    "register": 3,
    "template": 4,
    "fit": 4,
    "pipeline": 5,
    "report": 6,
    "api": 6,  # what `import ltgs_jax` hands on, lazily
    "view": 7,  # says what happened in the report's words
    "cli": 8,  # starts the viewer and writes the report
}
HEART = {"geometry", "scene", "metrics", "render", "register", "template", "fit"}
JAX_STACK = {"jax", "equinox", "jaxtyping", "optax", "optimistix", "lineax", "numpy", "scipy"}
# What a room may import beyond the JAX stack, anywhere; and what it may import inside a function only.
FOREIGN = {
    "io": {"OpenImageIO", "cv2", "safetensors", "pycolmap"},
    "features": {"cv2", "skimage"},
    "localize": {"cv2", "pycolmap"},
    "detect": {"cv2", "skimage"},
    "match": {"cv2", "skimage"},
    "pipeline": {"cv2", "safetensors"},
    "cli": {"tyro", "rich"},
    "report": {"cv2"},
    "demo": {"cv2"},
}
LAZY = {
    "metrics": {"OpenImageIO", "onnxruntime"},
    "features": {"onnxruntime"},
    "io": {"zstandard"},
    "demo": {"embreex"},
    "view": {"viser", "cv2"},
}


class _Import(NamedTuple):
    path: Path
    line: int
    module: str
    lazy: bool

    @property
    def room(self) -> str:
        """First part below the package; the package's own `__init__` is no room."""
        return self.path.relative_to(PACKAGE).parts[0].removesuffix(".py")

    def __str__(self) -> str:
        return f"{self.path.relative_to(PACKAGE.parent)}:{self.line} imports {self.module}"


def _modules() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def _imports(path: Path) -> Iterator[_Import]:
    tree = ast.parse(path.read_text(), str(path))
    package = (PACKAGE.name, *path.relative_to(PACKAGE).parent.parts)

    def visit(node: ast.AST, lazy: bool) -> Iterator[_Import]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.Import):
                for alias in child.names:
                    yield _Import(path, child.lineno, alias.name, lazy)
            elif isinstance(child, ast.ImportFrom):
                base = package[: len(package) - child.level + 1] if child.level else ()
                module = ".".join((*base, *(child.module or "").split("."))).rstrip(".")
                below_package = module == PACKAGE.name or (child.level and not child.module)
                for alias in child.names if below_package else [None]:
                    yield _Import(path, child.lineno, module if alias is None else f"{module}.{alias.name}", lazy)
            else:
                yield from visit(child, lazy or isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef))

    yield from visit(tree, False)


def test_imports_are_read_rightly(tmp_path, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "PACKAGE", tmp_path / "ltgs_jax")
    path = PACKAGE / "fit" / "pose.py"
    path.parent.mkdir(parents=True)
    path.write_text(
        "import cv2\nfrom ..io import x\nfrom .. import render\nfrom . import a\nfrom .b import c\n"
        "from ltgs_jax import cli\ndef f():\n    if True:\n        import jax.numpy as jnp\n"
    )
    assert [(found.room, found.module, found.lazy) for found in _imports(path)] == [
        ("fit", "cv2", False),
        ("fit", "ltgs_jax.io", False),
        ("fit", "ltgs_jax.render", False),
        ("fit", "ltgs_jax.fit.a", False),
        ("fit", "ltgs_jax.fit.b", False),
        ("fit", "ltgs_jax.cli", False),
        ("fit", "jax.numpy", True),
    ]


def _all_imports() -> list[_Import]:
    return [found for path in _modules() for found in _imports(path)]


def test_every_room_has_a_rank():
    rooms = {path.relative_to(PACKAGE).parts[0].removesuffix(".py") for path in _modules()} - {"__init__", "__main__"}
    assert rooms <= set(RANKS), f"rooms without a rank: {sorted(rooms - set(RANKS))}"


def test_imports_run_to_lower_ranks_only():
    wrong = []
    for found in _all_imports():
        parts = found.module.split(".")
        if parts[0] != PACKAGE.name or len(parts) < 2 or found.room not in RANKS:
            continue
        if parts[1] in RANKS and parts[1] != found.room and RANKS[parts[1]] >= RANKS[found.room]:
            wrong.append(str(found))
    assert not wrong, "\n".join(wrong)


def test_third_party_packages_stay_in_their_rooms():
    own = set(sys.stdlib_module_names) | {PACKAGE.name} | JAX_STACK
    wrong = []
    for found in _all_imports():
        package = found.module.split(".")[0]
        allowed = FOREIGN.get(found.room, set()) | (LAZY.get(found.room, set()) if found.lazy else set())
        if package not in own | allowed:
            wrong.append(str(found) + ("" if found.lazy else " at module level"))
    assert not wrong, "\n".join(wrong)


def test_the_heart_asks_for_nothing_but_the_jax_stack():
    """The table above must not loosen design.md's own rule."""
    assert all(room not in FOREIGN for room in HEART)
    assert {room for room in LAZY if room in HEART} == {"metrics"}


def test_private_names_stay_in_their_room():
    wrong = []
    for found in _all_imports():
        parts = found.module.split(".")
        if parts[0] == PACKAGE.name and len(parts) > 2 and parts[1] != found.room:
            wrong += [str(found)] if any(part.startswith("_") for part in parts[1:]) else []
    assert not wrong, "\n".join(wrong)


def test_zlib_comes_before_pycolmap():
    """pycolmap's own zlib otherwise takes over, and the next PNG or npz aborts the process."""
    wrong = []
    for path in _modules():
        found = [(item.module.split(".")[0], item.line) for item in _imports(path)]
        zlib = min((line for module, line in found if module == "zlib"), default=sys.maxsize)
        wrong += [f"{path}:{line}" for module, line in found if module == "pycolmap" and line < zlib]
    assert not wrong, "\n".join(wrong)


def test_modules_are_small():
    lengths = {path: len(path.read_text().splitlines()) for path in _modules()}
    too_long = {str(path.relative_to(PACKAGE)): length for path, length in lengths.items() if length > 600}
    assert not too_long, too_long
    assert statistics.median(lengths.values()) <= 250


@pytest.mark.parametrize(
    "path", [p for p in _modules() if p.name == "__init__.py" and p.parent != PACKAGE], ids=lambda p: p.parent.name
)
def test_rooms_hand_names_on_only(path):
    """A room's `__init__` holds a docstring and `from .x import X as X`."""
    for node in ast.parse(path.read_text()).body[1:]:
        assert isinstance(node, ast.ImportFrom), f"{path}:{node.lineno}"
        assert all(alias.asname == alias.name for alias in node.names), f"{path}:{node.lineno}"


def test_importing_the_package_is_quick():
    """Under a second of processor time beyond jax itself, and none of the heavy packages come with it."""
    program = (
        "import time, sys, jax; start = time.process_time(); import ltgs_jax; "
        "print(time.process_time() - start); "
        "heavy = {'pycolmap', 'cv2', 'skimage', 'OpenImageIO', 'trimesh', 'viser'}; "
        "print(*sorted(heavy & set(sys.modules)))"
    )
    out = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=PACKAGE.parent
    )
    seconds, heavy = out.stdout.split("\n")[:2]
    assert float(seconds) < 1
    assert heavy == ""
