"""The page of results, from a made-up chronology folder; looked at in Chromium where there is one."""

import base64
import json
import re
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest
from headless import browse

from ltgs_jax.io import InputError
from ltgs_jax.report import write_report
from ltgs_jax.report.pictures import color_of, crop_box, difference, read_shown
from ltgs_jax.report.run import read_run
from ltgs_jax.report.shots import make_gallery
from ltgs_jax.report.words import caution, counted, duration, happenings, movement, number, summary

VISITS = ["before", "<after> & co", "later"]


def _image(rng, boxes, shape=(90, 120)):
    image = np.full((*shape, 3), 90, np.uint8) + rng.integers(0, 20, (*shape, 3), dtype=np.uint8)
    for identity, (top, left, size) in boxes.items():
        image[top : top + size, left : left + size] = color_of(identity)[::-1]
    return image


def _state(visit, event, visible, *, degrees=0.0, xyz=(0.0, 0.0, 0.0), confidence=0.9):
    half = np.radians(degrees) / 2
    pose = {"wxyz": [np.cos(half), 0, 0, np.sin(half)], "xyz": list(xyz)}
    return {
        "visit": visit, "event": event, "visible": visible, "world_from_template": pose, "confidence": confidence,
        "inliers": 50, "residual": 0.004, "ambiguous_axis": None,
    }  # fmt: skip


def _object(identity, source, states):
    known = {"id": identity, "source_visit": source, "splats": 10, "center": [1.0, 0.0, 0.0], "size": 0.5}
    return {**known, "states": states}


@pytest.fixture
def chronology(tmp_path):
    """Three visits: object 1 moves, then stays; object 2 goes and comes back; object 3 comes and is not seen later."""
    rng = np.random.default_rng(0)
    places = [
        {1: (10, 10, 20), 2: (40, 60, 24)},
        {1: (50, 10, 20), 3: (20, 80, 20)},
        {1: (50, 10, 20), 2: (40, 60, 24)},
    ]
    photographs = []
    for visit, boxes in enumerate(places):
        for i in range(2):
            stem = f"{visit}_{i}"
            paths = {key: tmp_path / "images" / f"{key}_{stem}.png" for key in ("capture", "render", "initial", "mask")}
            paths["capture"].parent.mkdir(exist_ok=True)
            ids = np.zeros((90, 120), np.uint8)
            for identity, (top, left, size) in boxes.items():
                ids[top : top + size, left : left + size] = identity
            shown = {"capture": boxes, "render": boxes, "initial": places[0]}
            images = {key: _image(rng, what) for key, what in shown.items()}
            for key, pixels in {**images, "mask": ids}.items():
                cv2.imwrite(str(paths[key]), pixels)
            photographs.append(
                {
                    "name": f"{VISITS[visit]}/{i}.png", "visit": visit, "role": "update" if i == 0 else "test",
                    "capture_path": str(paths["capture"]), "render_path": f"images/render_{stem}.png",
                    "initial_render_path": f"images/initial_{stem}.png", "mask_path": f"images/mask_{stem}.png",
                    "psnr": 24.25, "initial_psnr": 19.5,
                }
            )  # fmt: skip
    tracks = {
        "version": 1,
        "visits": VISITS,
        "photographs": [
            {"name": "before/0.png", "status": "given", "inliers": None, "reason": None},
            {"name": "later/9.png", "status": "rejected", "inliers": 7, "reason": "7 inliers, fewer than <20>"},
        ],
        "objects": [
            _object(
                1, 0, [_state(1, "moved", True, degrees=90, xyz=(0, 0, 0.5)), _state(2, "still", True, degrees=90)]
            ),
            _object(2, 0, [_state(1, "removed", False), _state(2, "added", True, xyz=(0.3, 0.4, 0), confidence=0.3)]),
            _object(3, 1, [_state(1, "added", True), _state(2, "unseen", True)]),
        ],
    }
    rows = [
        {"key": key, "visit": visit, "region": region, "value": value, "unit": unit, "direction": "higher"}
        for visit, offset in ((VISITS[1], 0), (VISITS[2], 3), (None, 1))
        for region in ("full", "changed")
        for key, value, unit in (("psnr", 20.0 + offset, "dB"), ("ssim", None if visit is None else 0.8, "1"))
    ]
    stages = [
        {"stage": name, "status": "done", "seconds": seconds, "compile_seconds": 1.5, "peak_bytes": 3 << 28,
         "counts": {"masks": 4}, "resumed": False}
        for name, seconds in (("detect", 12.5), ("fit", 61.0))
    ]  # fmt: skip
    bought = {
        "visit": VISITS[1], "what": "object 1 moved", "parameters": 7, "bytes": 28, "gain_db": 3.25,
        "evidence": "matches",
    }  # fmt: skip
    stages.append({"stage": "ledger", "status": "done", "counts": {"ledger": [bought]}})
    for name, value in {
        "tracks": tracks, "metrics": rows, "stages": stages, "report": {"photographs": photographs},
        "config": {"fit": {"steps": 5}},
        "cameras": {"capture": "/somewhere/kitchen", "photographs": {}}, "env": {"jax": "0.10.2"},
    }.items():  # fmt: skip
        (tmp_path / f"{name}.json").write_text(json.dumps(value))
    return tmp_path


_VOID = {"meta", "link", "img", "input"}


class _Reader(HTMLParser):
    """Collects text, references and whether tags close in order."""

    def __init__(self):
        super().__init__()
        self.text, self.references, self.anchors, self.stack = [], [], set(), []

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.references += [attributes[name] for name in ("src", "href") if name in attributes]
        self.anchors.add(attributes.get("id"))
        if tag not in _VOID:
            self.stack.append(tag)

    def handle_startendtag(self, tag, attrs):
        pass

    def handle_endtag(self, tag):
        assert self.stack.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def _read(page: str) -> tuple[str, _Reader]:
    reader = _Reader()
    reader.feed(page)
    reader.close()
    assert not reader.stack
    return " ".join("".join(reader.text).split()), reader


def test_the_page_is_one_file_that_needs_no_other(chronology):
    path = write_report(chronology)
    assert path == chronology / "report.html"
    page = path.read_text()
    text, reader = _read(page)
    assert all(reference.startswith(("data:", "#")) for reference in reader.references)
    assert {reference[1:] for reference in reader.references if reference.startswith("#")} <= reader.anchors
    assert not re.search(r"https?://|@import|url\(", page)
    assert "prefers-color-scheme: dark" in page and "width=device-width" in page
    assert "What changed: kitchen" in text


def test_the_page_says_what_happened(chronology):
    text, _ = _read(write_report(chronology).read_text())
    assert "3 visits, 2 photographs (1 left out), 3 objects, 4 changes, 1 min 13 s" in text
    assert "object 1 (first seen at before) moved by 1.5 (3.0 × its size), turned 90° confidence 0.90" in text
    assert "object 2 (first seen at before) came back, 0.5 (1.0 × its size) from where it was" in text
    assert "object 3 came confidence 0.90" in text
    assert "object 3 (first seen at <after> & co) was not seen" in text
    assert "later/9.png: 7 inliers, fewer than <20>" in text
    assert "1 moved, 1 went" in text or "1 came, 1 went, 1 moved" in text
    assert "20.000" in text and "–" in text and "768 MiB" in text and "61.0" in text


def test_the_page_says_what_each_visit_added_and_bought(chronology):
    page = write_report(chronology).read_text()
    text, _ = _read(page)
    assert "object 1 moved" in text and "3.250" in text and "dB bought" in text
    assert "Poses of known objects: 1 by matches." in text
    assert '<th class="number">KiB</th>' in page and "<th>seconds</th>" in page  # beside the seconds a bar is drawn
    (chronology / "stages.json").write_text(json.dumps([{"stage": "ledger", "counts": {"ledger": 7}}]))
    text, _ = _read(write_report(chronology).read_text())
    assert "dB bought" not in text  # what cannot be read as rows is left out


def test_a_poor_first_scene_is_said_where_it_matters(chronology):
    rows = json.loads((chronology / "metrics.json").read_text())
    for visit, region, value in ((1, "full", 17.0), (1, "static", 22.0), (2, "full", 25.0), (2, "static", 14.4)):
        rows.append({"key": "psnr_initial", "visit": VISITS[visit], "region": region, "value": value, "unit": "dB"})
    (chronology / "metrics.json").write_text(json.dumps(rows))
    run = read_run(chronology)
    assert caution(run, 1) is None, "what changed must not count"
    assert "(14 dB)" in caution(run, 2)
    text, _ = _read(write_report(chronology).read_text())
    assert text.count("Changes may have been missed") == 1 and "psnr of the first visit's scene" in text


def test_words(chronology):
    run = read_run(chronology)
    thing = run.objects[0]
    distance, angle = movement(thing, 1)
    assert distance == pytest.approx(np.linalg.norm([-1, 1, 0.5])) and angle == pytest.approx(90)
    assert movement(run.objects[2], 1) is None, "an object that was never there has not moved"
    assert [entry.thing.identity for entry in happenings(run, 1)] == [1, 2, 3]
    assert counted(run, 2) == "1 came"
    assert [number(value) for value in (0, 0.0433, 2, 123.4, 2.5e-7)] == ["0", "0.043", "2", "123", "2.5e-07"]
    assert [duration(value) for value in (0.44, 59.9, 60, 3725)] == ["0.4 s", "59.9 s", "1 min 0 s", "62 min 5 s"]
    assert summary(run).startswith("3 visits")


def test_what_is_missing_is_left_out(chronology):
    for name in ("metrics", "stages", "config", "env", "report"):
        (chronology / f"{name}.json").unlink()
    text, _ = _read(write_report(chronology).read_text())
    assert "object 1" in text and "Scores" not in text and "Photographs" not in text


def test_photographs_that_cannot_be_read_are_no_fault(chronology):
    for path in (chronology / "images").glob("capture_*"):
        path.write_bytes(b"no image")
    for path in (chronology / "images").glob("mask_*"):
        path.unlink()
    text, reader = _read(write_report(chronology).read_text())
    assert "first visit's scene | render" in text and "photograph | render" not in text
    assert sum(reference.startswith("data:image/jpeg") for reference in reader.references) == 12


@pytest.mark.parametrize(
    "name, content",
    [
        ("tracks", "{}"),
        ("tracks", "[1"),
        ("tracks", '{"visits": ["a"], "objects": [{"id": 1}]}'),
        ("report", '{"photographs": [{}]}'),
        ("cameras", '{"photographs": {"a": {"K": 1}}}'),
    ],
)
def test_a_broken_file_is_named(chronology, name, content):
    (chronology / f"{name}.json").write_text(content)
    with pytest.raises(InputError, match=rf"{name}\.json"):
        write_report(chronology)


def test_a_visit_beyond_the_list_is_named(chronology):
    tracks = json.loads((chronology / "tracks.json").read_text())
    tracks["objects"][0]["states"][0]["visit"] = 7
    (chronology / "tracks.json").write_text(json.dumps(tracks))
    with pytest.raises(InputError, match=r"tracks\.json"):
        write_report(chronology)


def test_many_photographs_stay_a_small_page(chronology):
    rng = np.random.default_rng(1)
    large = rng.integers(0, 255, (600, 800, 3), dtype=np.uint8)  # noise: the worst case for JPEG
    cv2.imwrite(str(chronology / "large.jpg"), cv2.GaussianBlur(large, (0, 0), 1))
    photographs = [
        {"name": f"later/{i}.jpg", "visit": "later", "capture_path": "large.jpg", "render_path": "large.jpg"}
        for i in range(150)
    ]
    (chronology / "report.json").write_text(json.dumps({"photographs": photographs}))
    path = write_report(chronology)
    assert path.stat().st_size < 15e6
    assert "30 more photographs are not shown" in path.read_text()


def test_pictures():
    ids = np.zeros((50, 60), int)
    ids[10:20, 30:50] = 4
    assert crop_box(ids, 4) == (0, 30, 20, 60)
    assert crop_box(ids, 5) is None
    assert len({color_of(identity) for identity in range(1, 40)}) == 39
    image = np.zeros((4, 4, 3), np.float32)
    shades = [difference(image, image + level).sum(-1).mean() for level in (0.0, 0.1, 0.4, 1.0)]
    assert shades[0] < 0.05 < shades[1] < shades[2] == shades[3]


def test_a_photograph_is_turned_to_lie_as_its_render(tmp_path):
    path = tmp_path / "phone.jpg"
    _, content = cv2.imencode(".jpg", np.zeros((20, 40, 3), np.uint8))
    orientation = b"\xff\xe1\x00\x22Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    path.write_bytes(content.tobytes()[:2] + orientation + content.tobytes()[2:])
    assert read_shown(path).shape[:2] == (20, 40)
    assert read_shown(path, landscape=True).shape[:2] == (20, 40)
    assert read_shown(path, landscape=False).shape[:2] == (40, 20)


_PROBE = """<script>addEventListener("load", () => {
  const out = {};
  const column = () => [...document.querySelectorAll("#scores tbody tr")].map((row) => row.cells[2].textContent);
  const head = document.querySelector("#scores th:nth-child(3)");
  head.click(); out.ascending = column();
  head.click(); out.descending = column();
  const shot = document.querySelector(".shot"), frame = shot.querySelector(".frame");
  const visible = () => [...frame.querySelectorAll("img")]
    .filter((image) => getComputedStyle(image).display !== "none").map((image) => image.dataset.layer);
  out.first = visible();
  shot.querySelectorAll("[data-show]")[2].click(); out.difference = visible();
  shot.querySelector("[data-outline]").click(); out.outlined = visible();
  const range = frame.querySelector("input");
  range.value = 25; range.dispatchEvent(new Event("input"));
  out.cut = frame.style.getPropertyValue("--cut");
  const box = frame.getBoundingClientRect();
  const at = { clientX: box.left + 0.75 * box.width, pointerId: 1, isPrimary: true, buttons: 1 };
  frame.setPointerCapture = () => {};
  frame.dispatchEvent(new PointerEvent("pointerdown", at));
  out.dragged = frame.style.getPropertyValue("--cut");
  out.wide = document.documentElement.scrollWidth - document.documentElement.clientWidth;
  out.images = [...document.images].filter((image) => image.complete && image.naturalWidth === 0 && image.src).length;
  out.dark = getComputedStyle(document.body).backgroundColor;
  document.title = "probe " + JSON.stringify(out);
});</script>"""


@pytest.mark.parametrize("window, scheme", [("390,800", "dark"), ("1280,900", "light")])
def test_the_page_works_in_a_browser(chronology, tmp_path, window, scheme):
    page = chronology / "probe.html"
    page.write_text(write_report(chronology).read_text() + _PROBE)
    # blink's own numbers: 0 dark, 1 light
    flags = (f"--window-size={window}", f"--blink-settings=preferredColorScheme={int(scheme == 'light')}", "--dump-dom")
    dom, console = browse(page.as_uri(), tmp_path / "profile", *flags)
    assert not console
    found = json.loads(re.search(r"<title>probe (.*?)</title>", dom).group(1))
    assert found["ascending"] == ["20.000", "20.000", "21.000", "21.000", "23.000", "23.000"]
    assert found["descending"] == found["ascending"][::-1]
    assert found["first"] == ["capture", "render"]
    assert found["difference"] == ["difference"] and found["outlined"] == ["difference", "masks"]
    assert (found["cut"], found["dragged"]) == ("25%", "75%")
    assert found["wide"] == 0, "the page scrolls sideways"
    assert found["images"] == 0, "an image is broken"
    assert (found["dark"] == "rgb(21, 24, 28)") == (scheme == "dark")


def test_an_object_that_no_mask_shows_is_cut_out_where_its_pose_puts_it(chronology):
    """Object 2 of the fixture without masks: a camera that looks at its middle from 4 away sees it in the middle."""
    manifest = json.loads((chronology / "report.json").read_text())
    for entry in manifest["photographs"]:
        entry.pop("mask_path")
    (chronology / "report.json").write_text(json.dumps(manifest))
    pose = {"wxyz": [1, 0, 0, 0], "xyz": [-1, 0, 4]}
    placed = {"K": [[200, 0, 60], [0, 200, 45], [0, 0, 1]], "width": 120, "height": 90, "cam_from_world": pose}
    cameras = {"capture": "/somewhere/kitchen", "photographs": {"before/0.png": placed}}
    (chronology / "cameras.json").write_text(json.dumps(cameras))
    run = read_run(chronology)
    crops = make_gallery(run).crops
    assert [crop.name for crop in crops[2]] == ["before/0.png"] and crops[2][0].render
    content = base64.b64decode(crops[2][0].capture.split(",")[1])
    assert cv2.imdecode(np.frombuffer(content, np.uint8), 1).shape == (30, 30, 3)  # 2 × 0.6 × 0.5 × 200 / 4
    placed["cam_from_world"]["xyz"] = [-1, 0, -4]
    (chronology / "cameras.json").write_text(json.dumps(cameras))
    assert not make_gallery(read_run(chronology)).crops.get(2), "it lies behind"
