"""glTF and OpenUSD: validity, axes, nodes, and invalid declarations."""

import base64
import gzip
import json
import struct

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clsplat.core.errors import DataError
from clsplat.core.harmonics import basis
from clsplat.core.reading import sha256
from clsplat.formats.gltf import write_glb
from clsplat.formats.splats import SH_C0, WriteOptions, flip_axes, normalize_quats, opacities
from clsplat.formats.table import detect, model_files, read, write
from clsplat.gaussians.model import Model, load
from tests.support.models import angles, assert_close, interop, join_glb, round_trip, splats, split_glb, spz_tree

KHR = "KHR_gaussian_splatting"
SIZES = {5121: 1, 5126: 4}


def attribute(tree, binary, name):
    accessor = tree["accessors"][tree["meshes"][0]["primitives"][0]["attributes"][name]]
    view = tree["bufferViews"][accessor["bufferView"]]
    kind = {5121: "u1", 5126: "<f4"}[accessor["componentType"]]
    rows = np.frombuffer(binary, kind, view["byteLength"] // SIZES[accessor["componentType"]], view["byteOffset"])
    return rows.reshape(accessor["count"], -1)


@pytest.mark.parametrize(("count", "degree"), [(1, 3), (200, 0), (200, 1), (200, 2)])
def test_glb_round_trip_is_within_its_precision(tmp_path, rng, count, degree):
    source = splats(rng, count, degree, "mip")
    copy = round_trip(tmp_path / "a.glb", source)
    assert detect(tmp_path / "a.glb").name == "GLB"
    assert (copy.mode, copy.rendering) == ("mip", source.rendering)
    assert_close(copy, source, 1e-3, means=0, log_scales=1e-6, opacity=1e-6, sh_base=0, sh_rest=0)


def test_glb_follows_the_specification(tmp_path, rng):
    source = splats(rng, 100, 2)
    write(tmp_path / "a.glb", source)
    tree, binary = split_glb((tmp_path / "a.glb").read_bytes())
    assert tree["extensionsUsed"] == [KHR]
    (primitive,) = tree["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    assert primitive["extensions"][KHR] == {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    coefficients = [f"{KHR}:SH_DEGREE_{d}_COEF_{m}" for d in range(3) for m in range(2 * d + 1)]
    own = [f"{KHR}:{name}" for name in ("ROTATION", "SCALE", "OPACITY")]
    assert set(primitive["attributes"]) == {"POSITION", "COLOR_0", *own, *coefficients}
    position = tree["accessors"][primitive["attributes"]["POSITION"]]
    values = attribute(tree, binary, "POSITION")
    np.testing.assert_array_equal(np.float32(position["min"]), values.min(axis=0))
    np.testing.assert_array_equal(np.float32(position["max"]), values.max(axis=0))
    np.testing.assert_array_equal(values, source.parameters["means"] * np.float32([1, -1, -1]))
    rotation = attribute(tree, binary, f"{KHR}:ROTATION")
    np.testing.assert_allclose(np.linalg.norm(rotation, axis=1), 1, atol=1e-6)
    w, x, y, z = normalize_quats(source.parameters["quats"]).T
    np.testing.assert_allclose(rotation, np.stack([x, -y, -z, w], axis=1), atol=1e-6)
    np.testing.assert_allclose(
        attribute(tree, binary, f"{KHR}:SCALE"), np.exp(source.parameters["log_scales"]), rtol=1e-6
    )
    color = np.clip(0.28209479 * source.parameters["sh_base"] + 0.5, 0, 1)
    linear = np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)
    shown = attribute(tree, binary, "COLOR_0")
    np.testing.assert_allclose(shown[:, :3] / 255, linear, atol=0.0021)
    np.testing.assert_allclose(shown[:, 3:] / 255, opacities(source.parameters["logit_opacity"]), atol=0.0021)
    assert all(view["byteOffset"] % 4 == 0 for view in tree["bufferViews"])


def test_glb_of_another_program_equals_its_source():
    """splat-transform turns a model by half about z, where the axes of glTF ask for half about x."""
    source, pipeline = load(interop("train1000.ply")), load(interop("train1000.glb"))
    half = source.transformed(rotation=np.diag([-1.0, 1, -1]))
    np.testing.assert_allclose(pipeline.means, half.means, atol=1e-5)
    np.testing.assert_allclose(pipeline.sh_rest, half.sh_rest, atol=1e-5)
    np.testing.assert_allclose(pipeline.log_scales, half.log_scales, atol=1e-5)
    np.testing.assert_allclose(covariances(pipeline), covariances(half), atol=1e-5)


def covariances(model):
    """Of each Gaussian, [N, 3, 3]: several quaternions, by half turns about its own axes, give the same."""
    axes = Rotation.from_quat(np.roll(normalize_quats(model.quats), -1, axis=1)).as_matrix() * model.scales[:, None, :]
    return axes @ axes.transpose(0, 2, 1)


def moved(tmp_path, rng, **node):
    write(tmp_path / "a.glb", splats(rng, 20))
    tree, binary = split_glb((tmp_path / "a.glb").read_bytes())
    tree["nodes"] = [{"children": [1], "translation": [0, 1, 0]}, {"mesh": 0, **node}]
    (tmp_path / "b.glb").write_bytes(join_glb(tree, binary))
    return tmp_path / "a.glb", tmp_path / "b.glb"


def test_moved_turned_and_scaled_node_moves_its_gaussians(tmp_path, rng):
    """A quarter about glTF's y, up, is a quarter about ours the other way."""
    rotation = [0, 0.5**0.5, 0, 0.5**0.5]
    plain, other = moved(tmp_path, rng, rotation=rotation, scale=[2, 2, 2], translation=[1, 0, 0])
    expected = load(plain).transformed(2.0, np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]), (1, -1, 0))
    pipeline = load(other)
    for name, table in expected.tables().items():
        if name != "quats":
            np.testing.assert_allclose(getattr(pipeline, name), table, atol=2e-6, err_msg=name)
    np.testing.assert_allclose(
        np.abs((normalize_quats(pipeline.quats) * normalize_quats(expected.quats)).sum(axis=1)), 1, atol=1e-6
    )


def test_low_precision_rotation_is_accepted(tmp_path, rng):
    plain, other = moved(tmp_path, rng, rotation=[0, 0.70710, 0, 0.70710])
    turned = load(plain).transformed(1.0, np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]), (0, -1, 0))
    np.testing.assert_allclose(load(other).means, turned.means, atol=2e-6)


@pytest.mark.parametrize("rotation", [[0, 0, 0, 0], [0, float("nan"), 0, 1], [0, 1e400, 0, 1]])
def test_zero_rotation_is_refused(rotation, tmp_path, rng):
    _, other = moved(tmp_path, rng, rotation=rotation)
    with pytest.raises(
        DataError, match=r"b\.glb: the rotation of node 1 .* of length (0|nan|inf); expected .*; export"
    ):
        load(other)


@pytest.mark.parametrize("scale", [[1, 2, 1], [-1, 1, 1], [0, 0, 0]])
def test_node_that_stretches_or_mirrors_is_refused(scale, tmp_path, rng):
    _, other = moved(tmp_path, rng, scale=scale)
    with pytest.raises(DataError, match="the transform of a node is not supported"):
        load(other)


def test_integers_and_strides_are_read(tmp_path, rng):
    write(tmp_path / "a.glb", splats(rng, 5, 0))
    tree, binary = split_glb((tmp_path / "a.glb").read_bytes())
    rows = np.zeros((5, 8), "<i2")
    rows[:, :4] = [0, 32767, 0, -32768]
    tree["bufferViews"].append({"buffer": 0, "byteOffset": len(binary), "byteLength": 80, "byteStride": 16})
    tree["buffers"][0]["byteLength"] += 80
    number = tree["meshes"][0]["primitives"][0]["attributes"][f"{KHR}:ROTATION"]
    tree["accessors"][number] |= {"componentType": 5122, "normalized": True, "bufferView": len(tree["bufferViews"]) - 1}
    (tmp_path / "b.glb").write_bytes(join_glb(tree, binary + rows.tobytes()))
    np.testing.assert_array_equal(read(tmp_path / "b.glb").parameters["quats"], [[-1, 0, -1, 0]] * 5)


def change(place, value):
    def changed(tree):
        *steps, last = place
        for step in steps:
            tree = tree[step]
        tree[last] = value

    return changed


REFUSED = {
    "count": (
        change(["accessors", 0, "count"], 10**9),
        "has 1000000000 elements, more than fit into its buffer view of 48 bytes",
    ),
    "counts": (change(["accessors", 0, "count"], 3), "different counts"),
    "stride": (change(["bufferViews", 0, "byteStride"], 4), "are 4 bytes apart; expected at least 12"),
    "no stride": (change(["bufferViews", 0, "byteStride"], 0), "are 0 bytes apart; expected at least 12"),
    "short view": (
        change(["bufferViews", 0, "byteLength"], 1),
        "has 4 elements, more than fit into its buffer view of 1 bytes",
    ),
    "long view": (change(["bufferViews", 0, "byteLength"], 10**9), "at 0, more than its buffer of [0-9]+ bytes"),
    "length of a view": (
        change(["bufferViews", 0, "byteLength"], "a"),
        "expected a whole number of at least 0, got 'a'",
    ),
    "short buffer": (
        change(["buffers", 0, "byteLength"], 3),
        "more than its buffer of 3 bytes; copy or export it again",
    ),
    "other buffer": (change(["buffers"], [{"byteLength": 0}] * 2), "more than its buffer of 0 bytes"),
    "view": (change(["accessors", 0, "bufferView"], 99), r"its JSON is damaged \(IndexError"),
    "negative": (change(["bufferViews", 0, "byteOffset"], -4), "expected a whole number of at least 0, got -4"),
    "kind": (change(["accessors", 0, "componentType"], 7), r"its JSON is damaged \(KeyError: 7\)"),
    "text": (change(["nodes", 0], "x"), "its JSON is damaged"),
    "circle": (change(["nodes", 0], {"children": [0]}), "not a tree"),
    "doubled": (change(["nodes"], [*({"children": [i + 1] * 2} for i in range(50)), {}]), "not a tree"),
    "shared": (change(["nodes"], [{"children": [1, 2]}, {"children": [2]}, {"mesh": 0}]), "node 2 occurs twice"),
    "no place": (change(["nodes", 0, "translation"], [float("nan"), 0, 0]), "node 0 has no finite transform"),
    "far place": (
        change(["nodes"], [{"children": [1], "scale": [1e200] * 3}, {"mesh": 0, "scale": [1e200] * 3}]),
        "node 1 has no finite transform",
    ),
    "bomb": (change(["nodes"], [{"children": [*range(1, 20)]}] + [{"mesh": 0}] * 19), "share too much data"),
    "asset": (change(["asset"], []), "its JSON is damaged"),
    "no splats": (change(["meshes", 0, "primitives", 0, "extensions"], {}), "has no Gaussians"),
    "kernel": (change(["meshes", 0, "primitives", 0, "extensions", KHR, "kernel"], "box"), "kernel is 'box'"),
    "required extension": (
        change(["extensionsRequired"], [KHR, "KHR_materials_unlit", "EXT_mesh_gpu_instancing"]),
        "requires 'EXT_mesh_gpu_instancing', which clsplat does not support; export it again without them",
    ),
    "web": (
        change(["buffers", 0, "uri"], "https://a.org/a.bin"),
        "buffer 0 is at 'https://a.org/a.bin', .* not read from the web; download it",
    ),
    "elsewhere": (
        change(["buffers", 0, "uri"], "../a.bin"),
        "buffer 0 is '../a.bin'; expected data in the file, or a file in its folder",
    ),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_damaged_glb_is_refused(fault, tmp_path, rng):
    changed, words = REFUSED[fault]
    write_glb(tmp_path / "a.glb", splats(rng, 4, 0), WriteOptions())
    tree, binary = split_glb((tmp_path / "a.glb").read_bytes())
    changed(tree)
    (tmp_path / "a.glb").write_bytes(join_glb(tree, binary))
    with pytest.raises(DataError, match=words):
        read(tmp_path / "a.glb")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"[" * 100_000, "RecursionError: maximum recursion depth"),
        (b'{"a" 1}', "JSONDecodeError: Expecting ':' delimiter: line 1 column 6"),
        (b'{"a": "\xff"}', "UnicodeDecodeError: "),
    ],
)
def test_invalid_json_is_refused(text, words, tmp_path):
    text += b" " * (-len(text) % 4)
    chunk = struct.pack("<2I", len(text), 0x4E4F534A) + text
    (tmp_path / "a.glb").write_bytes(struct.pack("<4s2I", b"glTF", 2, 12 + len(chunk)) + chunk)
    with pytest.raises(DataError) as caught:
        read(tmp_path / "a.glb")
    assert f"a.glb: its JSON is damaged ({words}" in str(caught.value)


def test_too_long_json_is_refused_with_the_limit(tmp_path, rng, monkeypatch):
    monkeypatch.setattr("clsplat.formats.gltf.MAX_JSON", 100)
    write(tmp_path / "a.glb", splats(rng, 4, 0))
    with pytest.raises(DataError, match=r"its JSON has \d+ bytes; expected at most 100"):
        read(tmp_path / "a.glb")


def test_nodes_without_a_scene_use_their_parents(tmp_path, rng):
    _, path = moved(tmp_path, rng, translation=[1, 0, 0])
    tree, binary = split_glb(path.read_bytes())
    del tree["scenes"], tree["scene"]
    expected = load(path).means
    path.write_bytes(join_glb(tree, binary))
    np.testing.assert_array_equal(load(path).means, expected)


def test_truncated_glb_is_refused(tmp_path, rng):
    write(tmp_path / "a.glb", splats(rng, 4, 0))
    data = (tmp_path / "a.glb").read_bytes()
    for size in (4, 19, 40, len(data) - 1):
        (tmp_path / "a.glb").write_bytes(data[:size])
        with pytest.raises(DataError, match="copy or export it again"):
            read(tmp_path / "a.glb")


def test_openusd_holds_every_number(tmp_path, rng):
    """Read back by splitting: a viewer of OpenUSD sees these values."""
    source = splats(rng, 700, 1)
    write(tmp_path / "a.usda", source)
    lines = (tmp_path / "a.usda").read_text().splitlines()
    assert lines[0] == "#usda 1.0"
    assert '    def ParticleField3DGaussianSplat "Gaussians"' in lines
    assert "        uniform int radiance:sphericalHarmonicsDegree = 1" in lines
    tables = {}
    for line in lines:
        if " = [" in line:
            name, _, text = line.strip().partition(" = ")
            tables[name.split()[1]] = np.float32(eval(text))
    p = source.parameters
    np.testing.assert_array_equal(tables["positions"], p["means"] * np.float32([1, -1, -1]))
    np.testing.assert_allclose(tables["scales"], np.exp(p["log_scales"]), rtol=1e-6)
    np.testing.assert_allclose(tables["opacities"], opacities(p["logit_opacity"])[:, 0], rtol=1e-6)
    np.testing.assert_allclose(tables["orientations"], normalize_quats(p["quats"]) * [1, 1, -1, -1], atol=1e-6)
    harmonics = tables["radiance:sphericalHarmonicsCoefficients"].reshape(700, 4, 3)
    np.testing.assert_array_equal(harmonics[:, 0], p["sh_base"])
    np.testing.assert_array_equal(harmonics[:, 1:], p["sh_rest"].reshape(700, 3, 3) * np.float32([[-1], [-1], [1]]))
    assert (tables["extent"][0] < tables["positions"].min(axis=0)).all()
    assert_close(read(tmp_path / "a.usda"), source, 1e-3, means=0, log_scales=1e-6, opacity=1e-6, sh_base=0, sh_rest=0)


@pytest.mark.parametrize("name", ["a.glb", "a.usda", "a.spz", "a.sog", "a.splat", "a.ply"])
def test_same_model_gives_the_same_bytes(name, tmp_path, rng):
    source = splats(rng, 300, 3, "mip")
    sums = [write(tmp_path / folder / name, source) for folder in ("a", "b")]
    assert sums == [sha256(tmp_path / folder / name) for folder in ("a", "b")]
    assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_world_filter_is_baked_except_in_ply(tmp_path, rng):
    source = splats(rng, 50, 0).parameters
    model = Model(**source, filter_variance=np.full((50, 1), 0.01, np.float32))
    for name in ("a.ply", "a.glb"):
        model.save(tmp_path / name)
    assert load(tmp_path / "a.ply").filter_variance is not None
    pipeline, baked = load(tmp_path / "a.glb"), model.baked()
    np.testing.assert_allclose(pipeline.log_scales, baked.log_scales, atol=1e-6)
    np.testing.assert_allclose(pipeline.opacities, baked.opacities, atol=1e-6)
    assert angles(read(tmp_path / "a.glb"), read(tmp_path / "a.ply")).max() < 1e-3


@pytest.mark.parametrize(("name", "said"), [("a.splat", True), ("a.usda", True), ("a.spz", False), ("a.sog", False)])
def test_lost_mip_mark_is_reported(name, said, tmp_path, rng, caplog):
    write(tmp_path / name, splats(rng, 5, 0, "mip"))
    assert ("cannot mark a mip model" in caplog.text) is said


def test_lost_render_settings_are_reported(tmp_path, rng, caplog):
    source = splats(rng, 5, 0, "mip")
    for name in ("a.ply", "a.sog", "a.glb"):
        assert round_trip(tmp_path / name, source).rendering == source.rendering
    assert "does not store" not in caplog.text
    source.rendering["near"] = 5
    write(tmp_path / "a.spz", source)
    assert "SPZ does not store near = 5; PLY, SOG, and GLB do" in caplog.text
    caplog.clear()
    source.rendering["near"] = 0.05  # a file without a near plane is drawn with a similar one
    write(tmp_path / "a.spz", source)
    assert "does not store" not in caplog.text


def parted(tmp_path, rng, degree=1, count=40):
    """A model as .glb, and the JSON and the binary chunk of that file."""
    source = splats(rng, count, degree)
    write(tmp_path / "a.glb", source)
    return source, *split_glb((tmp_path / "a.glb").read_bytes())


def assert_same(actual, expected):
    for name, table in expected.parameters.items():
        np.testing.assert_array_equal(actual.parameters[name], table, err_msg=name)


@pytest.mark.parametrize("where", ["data:application/octet-stream;base64,", "a%20b/c.bin"])
def test_gltf_is_its_glb_twin(where, tmp_path, rng):
    _, tree, binary = parted(tmp_path, rng)
    if where.startswith("data"):
        where += base64.b64encode(binary).decode()
    else:
        (tmp_path / "a b").mkdir()
        (tmp_path / "a b" / "c.bin").write_bytes(binary)
    tree["buffers"][0]["uri"] = where
    path = tmp_path / "B.GLTF"
    path.write_text(json.dumps(tree, indent=1))
    assert detect(path).name == "glTF"
    assert_same(read(path), read(tmp_path / "a.glb"))
    assert len(model_files(path)) == 1 + where.endswith(".bin")


@pytest.mark.parametrize("uri", ["../c.bin", "%2e%2e/c.bin", "/etc/hostname", "file:///etc/hostname", 7, "data:,abc"])
def test_buffer_outside_of_the_folder_is_refused(uri, tmp_path, rng):
    _, tree, binary = parted(tmp_path, rng)
    (tmp_path / "c.bin").write_bytes(binary)
    (tmp_path / "d").mkdir()
    tree["buffers"][0]["uri"] = uri
    (tmp_path / "d" / "a.gltf").write_text(json.dumps(tree))
    with pytest.raises(DataError, match=r"a\.gltf: (buffer 0 is|its JSON is damaged)|hostname: cannot be read"):
        read(tmp_path / "d" / "a.gltf")


@pytest.mark.parametrize("quantity", ["SCALE", "OPACITY"])
def test_logarithms_and_logits_are_recognized(quantity, tmp_path, rng, caplog):
    source, tree, binary = parted(tmp_path, rng)
    view = tree["bufferViews"][tree["meshes"][0]["primitives"][0]["attributes"][f"{KHR}:{quantity}"]]
    name = {"SCALE": "log_scales", "OPACITY": "logit_opacity"}[quantity]
    data, start = source.parameters[name].tobytes(), view["byteOffset"]
    (tmp_path / "b.glb").write_bytes(join_glb(tree, binary[:start] + data + binary[start + len(data) :]))
    np.testing.assert_array_equal(read(tmp_path / "b.glb").parameters[name], source.parameters[name])
    assert len(caplog.messages) == 1
    assert "they are read as log" in caplog.text


def test_linear_colors_become_srgb(tmp_path, rng, caplog):
    """Exactly without harmonics, also in a part of a larger degree; otherwise the closest colors."""
    source, tree, binary = parted(tmp_path, rng, 3)
    first = tree["meshes"][0]["primitives"][0]
    first["extensions"][KHR]["colorSpace"] = "lin_rec709_display"
    few = {name: number for name, number in first["attributes"].items() if "SH_DEGREE_" not in name or "_0_" in name}
    tree["meshes"][0]["primitives"] = [{**first, "attributes": few}, first]
    (tmp_path / "b.glb").write_bytes(join_glb(tree, binary))
    actual = read(tmp_path / "b.glb").parameters
    assert caplog.text.count("its colors are linear") == 1
    linear = np.maximum(source.parameters["sh_base"] * SH_C0 + 0.5, 0)
    shown = actual["sh_base"][:40] * SH_C0 + 0.5
    back = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(back, linear, atol=1e-5)
    assert not actual["sh_rest"][:40].any()
    directions = normalize_quats(rng.normal(size=(50, 4)))[:, :3]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)

    def colors(base, rest):
        return base[:, None] * SH_C0 + 0.5 + np.einsum("dk,nkc->ndc", basis(directions), rest.reshape(-1, 15, 3))

    before = np.maximum(colors(source.parameters["sh_base"], source.parameters["sh_rest"]), 0)
    wanted = np.where(before <= 0.0031308, 12.92 * before, 1.055 * before ** (1 / 2.4) - 0.055)
    error = np.abs(colors(actual["sh_base"][40:], actual["sh_rest"][40:]) - wanted)
    assert error.mean() < 0.02 < np.abs(before - wanted).mean() / 3


def test_parts_of_other_degrees_and_transforms_are_joined(tmp_path, rng):
    _, tree, binary = parted(tmp_path, rng, 2, 20)
    first = tree["meshes"][0]["primitives"][0]
    few = {name: number for name, number in first["attributes"].items() if "SH_DEGREE_2" not in name}
    tree["meshes"].append({"primitives": [{**first, "attributes": few}]})
    tree["nodes"] = [{"mesh": 0, "translation": [1, 2, 3], "scale": [2, 2, 2]}, {"mesh": 1, "rotation": [0, 1, 0, 1]}]
    for nodes in ([0, 1], [0], [1]):
        tree["scenes"] = [{"nodes": nodes}]
        (tmp_path / f"{len(nodes)}{nodes[0]}.glb").write_bytes(join_glb(tree, binary))
    both, one, other = (load(tmp_path / f"{name}.glb") for name in ("20", "10", "11"))
    assert (both.sh_degree, one.sh_degree, other.sh_degree) == (2, 2, 1)
    for found, expected in ((both[:20], other), (both[20:], one)):  # the last node comes first
        np.testing.assert_allclose(found.means, expected.means, atol=1e-4)
        np.testing.assert_allclose(found.log_scales, expected.log_scales, atol=1e-5)
        np.testing.assert_allclose(covariances(found), covariances(expected), atol=1e-3)
        width = expected.sh_rest.shape[1]
        np.testing.assert_allclose(found.sh_rest[:, :width], expected.sh_rest, atol=1e-5)
        assert not found.sh_rest[:, width:].any()


def test_spz_in_a_glb_has_the_axes_that_its_bounds_show(tmp_path, rng):
    """Its axes are x left, y up, z front; some programs keep those of SPZ."""
    write(tmp_path / "a.spz", splats(rng, 30, 1, "mip"))
    data, plain = (tmp_path / "a.spz").read_bytes(), read(tmp_path / "a.spz")
    as_gltf = flip_axes(plain.parameters)["means"]
    half = flip_axes(plain.parameters, (-1.0, 1.0, -1.0))
    for bounds, expected in ((None, half), (as_gltf * [-1, 1, -1], half), (as_gltf, plain.parameters)):
        (tmp_path / "b.glb").write_bytes(join_glb(spz_tree(data, bounds), data))
        result = read(tmp_path / "b.glb")
        assert result.mode == "mip"
        for name, table in result.parameters.items():
            np.testing.assert_array_equal(table, expected[name], err_msg=name)
    (tmp_path / "b.glb").write_bytes(join_glb(spz_tree(data[:-9]), data[:-9]))
    with pytest.raises(DataError, match=r"b\.glb: is truncated before the checksum"):
        read(tmp_path / "b.glb")
    (tmp_path / "b.glb").write_bytes(join_glb(spz_tree(data, name="EXT_other_compression"), data))
    with pytest.raises(DataError, match="is compressed with 'EXT_other_compression'; export it without compression"):
        read(tmp_path / "b.glb")


def test_many_spz_in_a_glb_unpack_to_a_share_of_it(tmp_path):
    header = struct.pack("<4s2I4B", b"NGSP", 2, 100_000, 3, 12, 0, 0)
    data = gzip.compress(header + bytes(64 * 100_000), 1)
    tree = spz_tree(data)
    tree["meshes"][0]["primitives"] *= 20
    (tmp_path / "b.glb").write_bytes(join_glb(tree, data))
    with pytest.raises(DataError, match=r"its SPZ data decompresses to [0-9]{9} bytes"):
        read(tmp_path / "b.glb")
