"""The documents and the code name the same things."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ROOMS = sorted(path.parent for path in (ROOT / "ltgs_jax").glob("*/__init__.py"))
SHOWN_BY_COMMAND = {"cli", "demo"}  # what these do is said by `ltgs --help`


@pytest.mark.parametrize("room", [room for room in ROOMS if room.name not in SHOWN_BY_COMMAND], ids=lambda r: r.name)
def test_a_room_s_page_lists_what_the_room_hands_on(room):
    tree = ast.parse((room / "__init__.py").read_text())
    handed_on = {alias.name for node in tree.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    pages = "\n".join(path.read_text() for path in (ROOT / "docs" / "rooms").glob("*.md"))
    listed = re.search(
        rf"^::: ltgs_jax\.{room.name}\n    options:\n      members:\n((?:        - \w+\n)+)", pages, re.M
    )
    assert listed is not None, f"no page of docs/rooms shows {room.name}"
    assert set(re.findall(r"- (\w+)", listed.group(1))) == handed_on


def test_every_page_is_in_the_menu_and_every_link_leads_somewhere():
    menu = set(re.findall(r": ([\w/]+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.M))
    pages = {path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")}
    assert menu == pages
    for page in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]:
        for link in re.findall(r"\]\((?!https?:)([^)#]+)", page.read_text()):
            assert (page.parent / link).exists(), f"{page}: {link}"
