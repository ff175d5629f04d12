"""Front ends that bring their own answers: the cache, arrays from disk, and ONNX files that the tests write."""

import builtins
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from ltgs_jax.features import Cached, Classical, FromDisk, FrontEnd, Onnx, OnnxModel, name_images
from ltgs_jax.features.onnx import _session

onnxruntime = pytest.importorskip("onnxruntime")


# The smallest writer of ONNX's protobuf that these tests need (field numbers: onnx.proto3).
def _varint(value):
    out = b""
    while True:
        value, low = value >> 7, value & 0x7F
        out += bytes([low | 0x80 if value else low])
        if not value:
            return out


def _field(number, content):
    if isinstance(content, int):
        return _varint(number << 3) + _varint(content)
    content = content.encode() if isinstance(content, str) else content
    return _varint(number << 3 | 2) + _varint(len(content)) + content


def _tensor(name, array):
    kind = {"float32": 1, "int64": 7}[array.dtype.name]
    dims = b"".join(_field(1, size) for size in array.shape)
    return dims + _field(2, kind) + _field(8, name) + _field(9, array.tobytes())


def _attribute(name, value):
    if isinstance(value, int):
        return _field(1, name) + _field(3, value) + _field(20, 2)
    return _field(1, name) + b"".join(_field(8, v) for v in value) + _field(20, 7)


def _node(op, inputs, output, **attributes):
    content = b"".join(_field(1, name) for name in inputs) + _field(2, output) + _field(4, op)
    return content + b"".join(_field(5, _attribute(name, value)) for name, value in attributes.items())


def _value(name, shape, kind=1):
    dims = b"".join(_field(1, _field(1, size)) for size in shape)
    return _field(1, name) + _field(2, _field(1, _field(1, kind) + _field(2, dims)))


def _write_model(path, nodes, inputs, outputs, constants=None):
    graph = b"".join(_field(1, node) for node in nodes) + _field(2, "tiny")
    graph += b"".join(_field(5, _tensor(name, array)) for name, array in (constants or {}).items())
    graph += b"".join(_field(11, _value(name, shape)) for name, shape in inputs.items())
    graph += b"".join(_field(12, _value(name, *shape)) for name, shape in outputs.items())
    Path(path).write_bytes(_field(1, 8) + _field(8, _field(1, "") + _field(2, 13)) + _field(7, graph))
    return str(path)


def _picture(seed=0, shape=(48, 64)):
    rng = np.random.default_rng(seed)
    return cv2.GaussianBlur(rng.random((*shape, 3)).astype(np.float32), (0, 0), 2) * 2 - 0.5


def test_tiny_model_gives_dense_descriptors(tmp_path):
    pool = _node("AveragePool", ["x"], "y", kernel_shape=[8, 8], strides=[8, 8])
    path = _write_model(tmp_path / "d.onnx", [pool], {"x": (1, 3, 48, 64)}, {"y": ((1, 3, 6, 8),)})
    image = np.clip(_picture(), 0.01, 1)
    front_end = Onnx(describe_model=OnnxModel(path, "dense", 64, 48))
    assert isinstance(front_end, FrontEnd)
    expected = image.reshape(6, 8, 8, 8, 3).mean(axis=(1, 3))
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    dense = front_end.describe(image)
    assert dense.stride == 8
    np.testing.assert_allclose(dense.features, expected, atol=1e-5)
    # Another image size: the grid follows the image, not the model.
    assert front_end.describe(_picture(1, (100, 90))).features.shape == (13, 12, 3)
    # Normalisation is the caller's: (255·x − 10) / 5 is what the model sees.
    scaled = Onnx(describe_model=OnnxModel(path, "dense", 64, 48, scale=255.0, mean=(10.0,) * 3, std=(5.0,) * 3))
    expected = (255 * image.reshape(6, 8, 8, 8, 3).mean(axis=(1, 3)) - 10) / 5
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    np.testing.assert_allclose(scaled.describe(image).features, expected, atol=1e-4)


def test_tiny_model_gives_tokens_behind_a_class_token(tmp_path):
    nodes = [
        _node("AveragePool", ["x"], "pooled", kernel_shape=[8, 8], strides=[8, 8]),
        _node("Reshape", ["pooled", "shape"], "flat"),
        _node("Transpose", ["flat"], "patches", perm=[0, 2, 1]),
        _node("Concat", ["class", "patches"], "y", axis=1),
    ]
    constants = {"shape": np.array([1, 3, 48]), "class": np.full((1, 1, 3), 9, np.float32)}
    path = _write_model(tmp_path / "t.onnx", nodes, {"x": (1, 3, 48, 64)}, {"y": ((1, 49, 3),)}, constants)
    image = np.clip(_picture(), 0.01, 1)
    expected = image.reshape(6, 8, 8, 8, 3).mean(axis=(1, 3))
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    dense = Onnx(describe_model=OnnxModel(path, "tokens", 64, 48)).describe(image)
    np.testing.assert_allclose(dense.features, expected, atol=1e-5)


def test_tiny_models_give_masks_and_labels(tmp_path):
    image = np.zeros((48, 64, 3), np.float32)
    image[10:20, 5:30, 0] = 1
    image[15:40, 20:50, 1] = 1
    truth = np.stack([image[..., 0] > 0.5, image[..., 1] > 0.5])
    path = _write_model(
        tmp_path / "m.onnx", [_node("Identity", ["x"], "y")], {"x": (1, 3, 48, 64)}, {"y": ((1, 3, 48, 64),)}
    )
    proposals = Onnx(propose_model=OnnxModel(path, "masks", 64, 48, threshold=0.5)).propose(image)
    np.testing.assert_array_equal(proposals.masks(), truth)  # the empty third is left out
    large = Onnx(propose_model=OnnxModel(path, "masks", 64, 48, threshold=0.5)).propose(
        cv2.resize(image, (128, 96), interpolation=cv2.INTER_NEAREST)
    )
    assert large.iou(cv2.resize(truth[0].astype(np.uint8), (128, 96)) > 0).max() > 0.9

    nodes = [_node("ArgMax", ["x"], "y", axis=1, keepdims=0)]
    path = _write_model(tmp_path / "l.onnx", nodes, {"x": (1, 3, 48, 64)}, {"y": ((1, 48, 64), 7)})
    labels = Onnx(propose_model=OnnxModel(path, "labels", 64, 48)).propose(image)
    assert len(labels) == 1
    np.testing.assert_array_equal(labels.mask(0), truth[1] & ~truth[0])


def test_tiny_model_gives_pairs(tmp_path):
    xy_a = np.array([[10.0, 10.0], [20.0, 30.0], [50.0, 40.0]], np.float32)
    xy_b = xy_a + np.float32([4, 0])
    constants = {"ca": xy_a, "cb": xy_b, "cs": np.array([0.2, 0.9, 0.5], np.float32)}
    nodes = [_node("Identity", [c], o) for c, o in (("ca", "a"), ("cb", "b"), ("cs", "s"))]
    # Unused inputs are allowed; both images must still be asked for.
    shapes = {"x": (1, 3, 48, 64), "z": (1, 3, 48, 64)}
    outputs = {"a": ((3, 2),), "b": ((3, 2),), "s": ((3,),)}
    path = _write_model(tmp_path / "p.onnx", nodes, shapes, outputs, constants)
    front_end = Onnx(match_model=OnnxModel(path, "pairs", 64, 48, outputs=("a", "b", "s")))
    big = _picture(0, (96, 128))
    found = front_end.match(big, _picture(1))
    np.testing.assert_allclose(found.score, [0.9, 0.5, 0.2])
    np.testing.assert_allclose(found.xy_a, 2 * xy_a[[1, 2, 0]])
    np.testing.assert_allclose(found.xy_b, xy_b[[1, 2, 0]])
    mask = np.zeros((96, 128), bool)
    mask[:30, :30] = True
    assert len(front_end.match(big, _picture(1), mask_a=mask)) == 1
    # A pure shift along x: epipolar lines are rows.
    rows = np.array([[0.0, 0, 0], [0, 0, -1], [0, 2.0, 0]])
    assert len(front_end.match(_picture(2), _picture(1), fundamental=rows)) == 0
    rows[2, 1] = 1
    assert len(front_end.match(_picture(2), _picture(1), fundamental=rows)) == 3


def test_wrong_models_are_named(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="layout"):
        OnnxModel("x.onnx", "tensor", 64, 48)
    with pytest.raises(ValueError, match="describe_model"):
        Onnx(describe_model=OnnxModel("x.onnx", "masks", 64, 48))
    with pytest.raises(ValueError, match=r"missing\.onnx: no such"):
        Onnx(describe_model=OnnxModel(str(tmp_path / "missing.onnx"), "dense", 64, 48)).describe(_picture())
    broken = tmp_path / "broken.onnx"
    broken.write_bytes(b"not a model")
    with pytest.raises(ValueError, match=r"broken\.onnx: is not a model"):
        Onnx(describe_model=OnnxModel(str(broken), "dense", 64, 48)).describe(_picture())
    path = _write_model(
        tmp_path / "i.onnx", [_node("Identity", ["x"], "y")], {"x": (1, 3, 48, 64)}, {"y": ((1, 3, 48, 64),)}
    )
    with pytest.raises(ValueError, match="its outputs are"):
        Onnx(describe_model=OnnxModel(path, "dense", 64, 48, outputs=("z",))).describe(_picture())
    with pytest.raises(ValueError, match="does not run on 32×48"):
        Onnx(describe_model=OnnxModel(path, "dense", 32, 48)).describe(_picture())

    plain_import = builtins.__import__

    def without(name, *args, **kwargs):
        if name == "onnxruntime":
            raise ImportError(name)
        return plain_import(name, *args, **kwargs)

    _session.cache_clear()
    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ImportError, match=r"ltgs-jax\[onnx\]"):
        Onnx(describe_model=OnnxModel(path, "dense", 64, 48)).describe(_picture())


def _shifted_pair(shared):
    photograph = shared / "captures" / "livingroom" / "images" / "IMG_0000" / "0040.jpg"
    image = cv2.cvtColor(cv2.imread(str(photograph)), cv2.COLOR_BGR2RGB).astype(np.float32) / 255
    warp = np.array([[0.97, -0.1, 40.0], [0.1, 0.97, -20.0]])
    to_index = warp.copy()
    to_index[:, 2] += warp[:, :2] @ [0.5, 0.5] - 0.5
    return image, cv2.warpAffine(image, to_index, image.shape[1::-1], borderMode=cv2.BORDER_REPLICATE), warp


def test_xfeat_finds_a_known_warp(shared):
    image, moved, warp = _shifted_pair(shared)
    model = OnnxModel(str(shared / "weights" / "xfeat" / "xfeat.onnx"), "cells", 640, 480, grey=True)
    found = Onnx(match_model=model).match(image, moved)
    error = np.linalg.norm(found.xy_b - (found.xy_a @ warp[:, :2].T + warp[:, 2]), axis=1)
    assert len(found) > 150
    assert np.mean(error < 3) > 0.7
    assert np.median(error) < 2
    # The model's input is 1.5 × 1.125 times smaller than the photograph; half a pixel's bias would show here.
    assert np.linalg.norm(np.median(found.xy_b - (found.xy_a @ warp[:, :2].T + warp[:, 2]), axis=0)) < 0.4


class _Counting:
    """A front end that counts its calls."""

    def __init__(self):
        self.calls, self.inner = 0, Classical()

    def fingerprint(self):
        return self.inner.fingerprint()

    def __getattr__(self, name):
        def call(*args, **kwargs):
            self.calls += 1
            return getattr(self.inner, name)(*args, **kwargs)

        return call


def test_cache_gives_the_same_answers_and_computes_once(tmp_path):
    counting = _Counting()
    cached = Cached(counting, tmp_path)
    a, b = np.clip(_picture(0, (120, 160)), 0, 1), np.clip(_picture(1, (120, 160)), 0, 1)
    guide = np.zeros((120, 160), np.float32)
    mask = np.ones((120, 160), bool)
    asks = [
        lambda f: f.describe(a),
        lambda f: f.propose(a),
        lambda f: f.propose(a, guide=guide + 0.5),
        lambda f: f.keypoints(a),
        lambda f: f.match(a, b),
        lambda f: f.match(a, a, mask_a=mask, fundamental=np.eye(3)),
    ]
    first = [ask(cached) for ask in asks]
    assert counting.calls == len(asks)
    again = [ask(Cached(counting, tmp_path)) for ask in asks]
    assert counting.calls == len(asks)
    np.testing.assert_array_equal(first[0].features, again[0].features)
    np.testing.assert_allclose(first[0].features, Classical().describe(a).features, atol=1e-3)
    assert first[0].stride == again[0].stride and first[0].colour_dims == again[0].colour_dims
    np.testing.assert_array_equal(first[1].masks(), again[1].masks())
    np.testing.assert_array_equal(first[3][1], again[3][1])
    np.testing.assert_array_equal(first[5].xy_b, again[5].xy_b)
    # Another image, another front end: computed anew. No file is left half written.
    cached.describe(b)
    Cached(Classical(stride=4), tmp_path).describe(a)
    assert counting.calls == len(asks) + 1
    assert not list(tmp_path.rglob(".*"))
    # A broken file is computed again.
    for path in tmp_path.rglob("*.npz"):
        path.write_bytes(path.read_bytes()[:40])
    np.testing.assert_array_equal(Cached(counting, tmp_path).describe(a).features, first[0].features)
    assert counting.calls == len(asks) + 2


def test_arrays_from_disk(tmp_path):
    a, b, c = (np.clip(_picture(seed), 0, 1) for seed in range(3))
    rng = np.random.default_rng(0)
    masks = rng.random((4, 24, 32)) > 0.5
    features = rng.standard_normal((6, 8, 5)).astype(np.float32)
    xy, descriptors = rng.random((9, 2)).astype(np.float32) * 40, rng.standard_normal((9, 7)).astype(np.float32)
    (tmp_path / "v").mkdir()
    np.savez(tmp_path / "v" / "a.png.npz", masks=masks, features=features, stride=8, xy=xy, descriptors=descriptors)
    np.savez(tmp_path / "v" / "b.png.npz", features=features, stride=8, xy=xy + 1, descriptors=descriptors)
    names = name_images([("v/a.png", a), ("v/b.png", b), ("v/c.png", c)])
    front_end = FromDisk(tmp_path, names)
    assert isinstance(front_end, FrontEnd)
    expected = np.repeat(np.repeat(masks, 2, axis=1), 2, axis=2)
    np.testing.assert_array_equal(front_end.propose(a).masks(), expected)
    np.testing.assert_allclose(np.linalg.norm(front_end.describe(a).features, axis=-1), 1, atol=1e-5)
    assert front_end.describe(a).stride == 8
    found = front_end.match(a, b)
    np.testing.assert_allclose(found.xy_b, found.xy_a + 1, atol=1e-6)
    assert len(found) == 9
    np.testing.assert_array_equal(front_end.propose(b).masks(), Classical().propose(b).masks())
    with pytest.raises(ValueError, match="cannot be mixed"):
        front_end.describe(c)
    fingerprint = front_end.fingerprint()
    np.savez(tmp_path / "v" / "c.png.npz", labels=np.kron([[0, 1], [2, 2]], np.ones((24, 32))).astype(int))
    assert front_end.fingerprint() != fingerprint
    assert front_end.propose(c).masks().sum(axis=(1, 2)).tolist() == [24 * 32, 2 * 24 * 32]
    (tmp_path / "v" / "a.png.npz").write_bytes(struct.pack("<I", 7))
    with pytest.raises(ValueError, match="cannot be read"):
        front_end.propose(a)
