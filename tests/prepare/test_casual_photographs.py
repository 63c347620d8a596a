"""Casual photographs: rotated by EXIF, from several lenses, and sets that give no model."""

import math
import struct
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from clsplat.core.errors import DataError, shell_quote
from clsplat.prepare import diagnosis as reasons_tool
from clsplat.prepare import mapping
from clsplat.prepare.cache import fingerprint
from clsplat.prepare.database import open_database, read_image_names
from clsplat.prepare.diagnosis import MatchGraph, diagnose, explain_unregistered
from clsplat.prepare.features import FeatureOptions, detect_sift, find_features
from clsplat.prepare.gather import gather, list_photographs, warnings_for
from clsplat.prepare.mapping import map_cameras
from clsplat.prepare.matching import match_features
from clsplat.prepare.rotation_only import explain_missing_depth
from clsplat.scene.images import copy_exif, read_exif_exposure, read_exif_optics, read_gray, read_header, read_image
from tests.support.pictures import blocks
from tests.support.refusals import refusal

# ---- lenses


@pytest.mark.parametrize("damage", ["a text for a place", "no focal length", "cut"])
def test_damaged_exif_gives_no_lens(tmp_path, damage):
    segment = bytearray(exif())
    if damage == "a text for a place":
        segment[segment.index(struct.pack("<HH", 0x8769, 4)) + 2] = 2
    if damage == "no focal length":
        segment[-4:] = bytes(4)  # its divisor
    path = take(tmp_path / "a.jpg", (16, 16), bytes(segment[:60] if damage == "cut" else segment))
    assert read_exif_optics(path) is None
    assert (read_exif_exposure(path) is None) == (damage != "no focal length")


def exif(orientation: int = 1, focal: float = 4.2, model: str = "Phone 1") -> bytes:
    """An Exif segment: orientation, make, model, exposure and focal length."""
    texts, rationals = [b"Maker\0", model.encode() + b"\0"], [(1, 50), (18, 10), (round(focal * 100), 100)]
    outer, inner = 8 + 2 + 12 * 4 + 4, 2 + 12 * 4 + 4
    ends = [outer + inner, outer + inner + len(texts[0])]
    data = ends[1] + len(texts[1])
    block = b"II*\0" + struct.pack("<IH", 8, 4)
    block += struct.pack("<HHII", 0x010F, 2, len(texts[0]), ends[0])
    block += struct.pack("<HHII", 0x0110, 2, len(texts[1]), ends[1])
    block += struct.pack("<HHIHH", 0x0112, 3, 1, orientation, 0) + struct.pack("<HHII", 0x8769, 4, 1, outer) + bytes(4)
    block += struct.pack("<H", 4)
    for place, tag in enumerate((0x829A, 0x829D)):
        block += struct.pack("<HHII", tag, 5, 1, data + 8 * place)
    block += struct.pack("<HHIHH", 0x8827, 3, 1, 100, 0) + struct.pack("<HHII", 0x920A, 5, 1, data + 16) + bytes(4)
    block += b"".join(texts) + b"".join(struct.pack("<II", *pair) for pair in rationals)
    return b"\xff\xe1" + struct.pack(">H", len(block) + 8) + b"Exif\0\0" + block


def take(path: Path, size: tuple[int, int], segment: bytes = b"", seed: int = 0) -> Path:
    """A photograph of `size` (width, height) with an Exif segment."""
    pixels = cv2.GaussianBlur(
        np.random.default_rng(seed).integers(0, 256, (*size[::-1], 3)).astype(np.uint8), (0, 0), 2
    )
    _, data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 95])
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data.tobytes()[:2] + segment + data.tobytes()[2:])
    return path


def test_turned_photographs_keep_exif_except_for_the_rotation(tmp_path):
    for i in range(3):
        take(tmp_path / "p" / f"{i}.jpg", (64, 48), exif(6), seed=i)
    (tmp_path / "images").mkdir()
    gather(tmp_path / "p", tmp_path / "images", ["0.jpg", "1.jpg", "2.jpg"])
    source, rotated_view = tmp_path / "p" / "0.jpg", tmp_path / "images" / "0.jpg"
    assert not rotated_view.is_symlink()
    assert (read_header(source).orientation, read_header(rotated_view).orientation) == (6, 1)
    assert (read_header(rotated_view).width, read_header(rotated_view).height) == (48, 64)
    assert read_exif_optics(rotated_view) == read_exif_optics(source) == ("Maker", "Phone 1", 4.2, "")
    assert read_exif_exposure(rotated_view) == read_exif_exposure(source)
    assert read_exif_exposure(rotated_view).value == pytest.approx(math.log2(100 / 50 / 1.8**2))
    assert np.abs(read_image(rotated_view).astype(int) - read_image(source, upright=True)).max() < 12


def test_big_endian_and_missing_exif_are_handled(tmp_path):
    _, jpeg = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))
    block = b"MM\0*" + struct.pack(">IHHHIHHI", 8, 1, 0x0112, 3, 1, 3, 0, 0)
    head = jpeg.tobytes()[:2] + b"\xff\xe1" + struct.pack(">H", len(block) + 8) + b"Exif\0\0" + block
    (tmp_path / "a.jpg").write_bytes(copy_exif(head, jpeg.tobytes()))
    assert read_header(tmp_path / "a.jpg").orientation == 1
    assert b"MM\0*" in (tmp_path / "a.jpg").read_bytes()
    assert copy_exif(jpeg.tobytes(), jpeg.tobytes()) == jpeg.tobytes()


@pytest.mark.parametrize(("cameras", "groups"), [("auto", 4), ("one", 2), ("per_folder", 3), ("per_image", 8)])
def test_photographs_share_cameras_by_size_and_lens(tmp_path, cameras, groups, caplog):
    """Of one lens: across, and turned; of another; and without EXIF data."""
    pycolmap = pytest.importorskip("pycolmap")
    caplog.set_level("INFO")
    for i, orientation in enumerate((1, 6, 1, 8)):
        take(tmp_path / "p" / f"{i}.jpg", (96, 72), exif(orientation), seed=i)
    for i, segment in enumerate((exif(focal=9.0), exif(focal=9.0), b"", b"")):
        take(tmp_path / "p" / "b" / f"{i}.jpg", (96, 72), segment, seed=9 + i)
    (tmp_path / "out").mkdir()
    figures = find_features(tmp_path / "p", tmp_path / "out", FeatureOptions(96, 50), cameras=cameras)
    assert figures["cameras"] == groups
    with open_database(pycolmap, tmp_path / "out" / "database.db") as rows:
        images, cameras_found = rows.read_all_images(), rows.read_all_cameras()
    assert [image.name for image in images] == read_image_names(pycolmap, tmp_path / "out" / "database.db")
    assert {image.camera_id for image in images} == set(range(1, groups + 1))
    if cameras == "auto":
        shared = {image.name: image.camera_id for image in images}
        assert shared["0.jpg"] == shared["2.jpg"] != shared["1.jpg"] == shared["3.jpg"]
        assert {(item.width, item.height) for item in cameras_found} == {(96, 72), (72, 96)}
        assert "2 photos have no lens data in EXIF, so those of the same size share a camera (1 camera" in caplog.text


# ---- features


def test_downscaled_photographs_report_their_scale(tmp_path):
    """A JPEG of an odd size, made smaller by its decoder first; a spot stays where it is."""
    pixels = np.full((901, 1203, 3), 60, np.uint8)
    cv2.circle(pixels, (1000, 700), 24, (200, 200, 200), -1)
    cv2.imwrite(str(tmp_path / "a.jpg"), pixels)
    for long_side in (2000, 800, 300, 160):
        gray, (across, down) = read_gray(tmp_path / "a.jpg", long_side)
        assert max(gray.shape) == min(long_side, 1203)
        weight = np.maximum(gray.astype(float) - 80, 0)
        y, x = (np.indices(gray.shape) * weight).sum(axis=(1, 2)) / weight.sum()
        np.testing.assert_allclose([(x + 0.5) * across, (y + 0.5) * down], [1000.5, 700.5], atol=0.3)


@pytest.mark.parametrize("min_side", [0, 200])
def test_features_are_at_the_spots(min_side):
    pixels = np.full((120, 160), 90, np.float32)
    y, x = np.indices(pixels.shape) + 0.5
    spots = [(40.0, 30.0), (110.25, 70.75), (60.5, 95.0)]
    for at in spots:
        pixels += 120 * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2 * 3.0**2))
    keypoints, descriptors = detect_sift(np.rint(pixels).astype(np.uint8), FeatureOptions(count=50, min_side=min_side))
    for at in spots:
        assert np.linalg.norm(keypoints[:, :2] - at, axis=1).min() < 0.1
    assert descriptors.dtype == np.uint8
    assert descriptors.shape == (len(keypoints), 128)
    np.testing.assert_allclose((descriptors.astype(float) ** 2).sum(axis=1), 512**2, rtol=0.1)
    assert len(detect_sift(np.rint(pixels).astype(np.uint8), FeatureOptions(count=2))[0]) == 2


# ---- photographs that cannot be registered


def test_unreadable_files_come_with_a_conversion_command(tmp_path, caplog):
    for name in ("a.jpg", "b.jpg", "c.jpg", "d.HEIC", "e.dng"):
        (tmp_path / name).touch()
    assert len(list_photographs(tmp_path)) == 3
    assert "1 HEIC file cannot be read (d.HEIC)" in caplog.text
    assert "1 DNG file cannot be read (e.dng)" in caplog.text
    (tmp_path / "a.jpg").unlink()
    text = refusal(list_photographs, tmp_path)
    assert "has 2 photos" in text
    assert "heif-convert" in text


def test_misnamed_files_come_with_a_conversion_command(tmp_path):
    for i in range(3):
        take(tmp_path / "p" / f"{i}.jpg", (64, 48), seed=i)
    for name, brand in (("h.jpg", b"heic"), ("m.JPG", b"mif1"), ("v.png", b"avif"), ("o.jpg", b"isom")):
        (tmp_path / "p" / name).write_bytes(b"\0\0\0\x18ftyp" + brand + bytes(40))
    (tmp_path / "images").mkdir()
    kept, damaged = gather(tmp_path / "p", tmp_path / "images", list_photographs(tmp_path / "p"))
    assert kept == ["0.jpg", "1.jpg", "2.jpg"]
    assert damaged == {
        "h.jpg": "contains HEIC data",
        "m.JPG": "contains HEIC data",
        "v.png": "contains AVIF data",
        "o.jpg": "not an image, or a damaged one",
    }
    (told,) = warnings_for({"photographs": 3, "damaged": damaged})
    assert "convert HEIC files to JPEG, for example with heif-convert" in told
    assert "for example with ffmpeg" in told
    assert told.endswith("; export the others again")
    assert warnings_for({"photographs": 3, "damaged": {"a": "cut"}})[0].endswith("(cut); export them again")
    (tmp_path / "p" / "0.jpg").unlink()
    text = refusal(gather, tmp_path / "p", tmp_path / "images", ["1.jpg", "2.jpg", "h.jpg"])
    assert "only 2 of 3 photos can be read: h.jpg (contains HEIC data); convert HEIC files" in text


@pytest.mark.parametrize("read", [list_photographs, lambda path: fingerprint(path, path)])
def test_video_instead_of_a_folder_names_the_command(tmp_path, read):
    (tmp_path / "my walk.AVI").write_bytes(b"RIFF")
    (tmp_path / "notes").touch()
    command = f"`clsplat data video {shell_quote(tmp_path / 'my walk.AVI')} FOLDER`"
    assert command in refusal(read, tmp_path / "my walk.AVI")
    assert "is a file; expected a folder of photos" in refusal(read, tmp_path / "notes")
    assert "no such folder" in refusal(read, tmp_path / "none.avi")


def matched(tmp_path: Path) -> MatchGraph:
    """Photographs: three in the model, and three soft ones, two of the same place and one of another."""
    names = ["a", "b", "c", "blurred", "soft", "elsewhere", "plain", "alone", "pair", "other", "few", "many"]
    soft = ("blurred", "soft", "elsewhere")
    for name in names:
        pixels = np.random.default_rng(0).integers(0, 256, (60, 80, 3)).astype(np.uint8)
        cv2.imwrite(str(tmp_path / name) + ".png", cv2.GaussianBlur(pixels, (0, 0), 3) if name in soft else pixels)
        (tmp_path / f"{name}.png").rename(tmp_path / name)
    pairs = {("a", "b"): 200, ("b", "c"): 150, ("pair", "other"): 90, ("few", "a"): 18, ("many", "a"): 80}
    pairs |= {("blurred", "a"): 60, ("soft", "a"): 20}
    return MatchGraph(tmp_path, {name: 40 if name == "plain" else 3000 for name in names}, pairs)


def test_each_unregistered_photograph_has_a_reason(tmp_path):
    result = explain_unregistered(matched(tmp_path), [{"a", "b", "c"}])
    assert result == {
        "blurred": "blurred",
        "soft": "few matches, at most 20, with a; it may be blurred",
        "elsewhere": "matches no other photo; it may be blurred",
        "plain": "only 40 features: blurred, dark, or a plain surface",
        "alone": "matches no other photo",
        "pair": "matches only other, which is not registered either",
        "other": "matches only pair, which is not registered either",
        "few": "few matches, at most 18, with a",
        "many": "80 matches with a, but too few on points of the model",
    }
    assert (
        explain_unregistered(matched(tmp_path), [{"a", "b", "c"}, {"pair", "other"}])["pair"]
        == "in a separate reconstruction, with other"
    )
    figures = {"registered": 3, "not_registered": ["plain"], "reasons": result, "other_models": [2]}
    missing, others = warnings_for(figures)
    assert "1 of 4 photos could not be registered and are not used: plain (only 40 features: blurred" in missing
    assert missing.endswith("viewpoints in between, or find more features (find_features.long_side)")
    remedy = "add photos that connect the models"
    assert others == f"only the largest model is used, without 1 smaller model of 2 photos; {remedy}"
    missing, others = warnings_for({**figures, "other_models": [3, 1], "denser_tried": True})
    assert missing.endswith("viewpoints in between")
    assert others.startswith("only the largest model is used, without 2 smaller models of 3, 1 photo; add")


def test_failed_mapping_is_described_by_groups(tmp_path):
    result = matched(tmp_path)
    assert diagnose(result) == (
        "they do not connect: 2 groups with good matches, the largest with 5 (a, b, blurred, c, many), and 5 "
        "without a good match (alone, elsewhere, few, plain, soft); take photos of one scene, with more overlap"
    )
    joined = replace(result, pairs={**result.pairs, ("a", "pair"): 30})
    assert diagnose(joined).startswith("take more photos, sharp"), "seven of twelve belong together"
    weak = replace(result, pairs={("a", "b"): 20, ("b", "c"): 29})
    assert diagnose(weak).startswith("no two of them overlap enough: at most 29 features match; take")
    two = MatchGraph(tmp_path, dict.fromkeys("abc", 3000), {("a", "b"): 200})
    assert "the largest with 2 (a, b), and 1 without a good match (c); take" in diagnose(two)


def test_blur_differs_from_a_soft_but_sharp_photograph(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    wide = blocks(1, 900, 600)
    pictures = {f"{i}.png": wide[:, 60 * i : 60 * i + 700] for i in range(3)}
    pictures |= {"blurred.png": cv2.GaussianBlur(wide[:, 90:790], (0, 0), 2)}
    pictures |= {"elsewhere.png": cv2.GaussianBlur(blocks(2, 700, 600), (0, 0), 2)}
    for name in ("photographs", "features", "matches"):
        (tmp_path / name).mkdir()
    for name, pixels in pictures.items():
        cv2.imwrite(str(tmp_path / "photographs" / name), pixels)
    find_features(tmp_path / "photographs", tmp_path / "features", FeatureOptions(700, 3000))
    match_features(tmp_path / "features", tmp_path / "matches")
    result = MatchGraph.from_database(pycolmap, tmp_path / "matches" / "database.db", tmp_path / "photographs")
    assert explain_unregistered(result, [{"0.png", "1.png", "2.png"}]) == {
        "blurred.png": "blurred",
        "elsewhere.png": "matches no other photo; it may be blurred",
    }


def rotated_view(number: int) -> np.ndarray:
    """Return the view of a camera that turns in front of a far wall, by 6 degrees each time."""
    angle = math.radians(6 * number - 15)
    turn = np.array([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
    near, far = (
        np.array([[250, 0, 120], [0, 250, 90], [0, 0, 1.0]]),
        np.array([[250, 0, 300], [0, 250, 150], [0, 0, 1]]),
    )
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpPerspective(blocks(1, 600, 300), far @ turn @ np.linalg.inv(near), (240, 180), flags=flags)


def unrelated_photograph(number: int) -> np.ndarray:
    return blocks(10 + number, 240, 180)


def prepared(tmp_path: Path, pictures: list[np.ndarray], **matching: object) -> tuple[Path, Path]:
    """The folder of matches of pictures, and an empty one for their cameras."""
    pytest.importorskip("pycolmap")
    for name in ("photographs", "features", "matches", "cameras"):
        (tmp_path / name).mkdir()
    for number, picture in enumerate(pictures):
        cv2.imwrite(str(tmp_path / "photographs" / f"{number:02}.png"), picture)
    find_features(tmp_path / "photographs", tmp_path / "features", FeatureOptions(240, 600))
    match_features(tmp_path / "features", tmp_path / "matches", **matching)
    return tmp_path / "matches", tmp_path / "cameras"


@pytest.fixture
def dense(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mapping, "DENSER", FeatureOptions(240, 1000, 0.01))


@pytest.mark.parametrize(
    ("pixels", "sentence"),
    [
        (rotated_view, "look as if the camera only rotated in place"),
        (
            lambda number: (rotated_view if number else unrelated_photograph)(number),
            "look as if the camera only rotated",
        ),
        (unrelated_photograph, "no two of them show the same features"),
        (lambda number: rotated_view(1), "photos are all the same"),
        (
            lambda number: np.full((180, 240, 3), np.linspace(90, 180 + number, 240)[:, None]).astype(np.uint8),
            "none has features, where thousands",
        ),
        (
            lambda number: np.full((180, 240, 3), 9, np.uint8) if number else rotated_view(1),
            "half of them have no features",
        ),
    ],
    ids=["turned", "turned, with a stranger", "other places", "copies", "a wall", "a wall, with one of texture"],
)
def test_unusable_sets_end_with_one_sentence(tmp_path, dense, pixels, sentence):
    matches, cameras = prepared(tmp_path, [pixels(number) for number in range(6)])
    with pytest.raises(DataError, match=sentence):
        map_cameras(matches, cameras)


def test_featureless_photographs_end_with_one_sentence(tmp_path, dense):
    """Photographs without features are matched with more pairs."""
    ramp = np.linspace(60, 120, 240)[None, :, None] * np.ones((180, 1, 3))
    plain = [(ramp + number).astype(np.uint8) for number in range(12)]
    matches, cameras = prepared(tmp_path, plain, matching="sequential", neighbors=2)
    with pytest.raises(DataError, match="none has features, where thousands"):
        map_cameras(matches, cameras)


def test_only_performed_attempts_count(tmp_path, dense, caplog):
    """All pairs were matched, so there are no more to try."""
    caplog.set_level("INFO")
    matches, cameras = prepared(tmp_path, [unrelated_photograph(number) for number in range(4)])
    with pytest.raises(DataError, match="no two of them show the same features"):
        map_cameras(matches, cameras, attempts=3)
    tried = [text.rpartition(" with ")[2] for text in caplog.messages if "retrying" in text]
    assert tried == ["smaller angles and fewer matches", "denser features"]


def test_copies_do_not_count_as_camera_motion(tmp_path, dense):
    """Three neighbors that shift before a wall, each with two copies, which match it best: it has not turned."""
    wide = blocks(1, 400, 180)
    matches, _ = prepared(tmp_path, [wide[:, 30 * (number // 3) :][:, :240] for number in range(9)])
    pycolmap = pytest.importorskip("pycolmap")
    assert explain_missing_depth(pycolmap, matches / "database.db") == ""
    assert "all the same" in explain_missing_depth(pycolmap, matches / "database.db", {"00.png", "01.png", "02.png"})


def test_model_counts_only_photographs_outside_larger_models(tmp_path):
    class Model:
        def __init__(self, *numbers: int) -> None:
            self.numbers = numbers
            self.images = {number: SimpleNamespace(name=f"{number}.jpg") for number in numbers}

        def reg_image_ids(self) -> tuple[int, ...]:
            return self.numbers

        def write(self, path: str) -> None: ...

        def num_points3D(self) -> int:
            return 9

        def compute_mean_reprojection_error(self) -> float:
            return 0.5

    models = [Model(1, 2, 3, 4), Model(3, 4, 5), Model(2, 4, 5)]
    figures = mapping._write_best(models, tmp_path, [f"{number}.jpg" for number in range(1, 7)])
    assert figures["other_models"] == [1]
    assert figures["not_registered"] == ["5.jpg", "6.jpg"]


def test_rotation_only_model_is_refused_among_unrelated_photos(tmp_path, dense):
    """Before there is one, too few photographs match to know."""
    matches, cameras = prepared(
        tmp_path, [rotated_view(number) if number < 6 else unrelated_photograph(number) for number in range(14)]
    )
    with pytest.raises(DataError, match=r"the \d registered photos of 14 look as if"):
        map_cameras(matches, cameras)
    assert not (cameras / "sparse").exists()


def test_unrelated_photographs_are_not_searched_again(tmp_path, dense, monkeypatch, caplog):
    monkeypatch.setattr(reasons_tool, "MIN_TEXTURED", 100)
    caplog.set_level("INFO")
    matches, cameras = prepared(tmp_path, [unrelated_photograph(number) for number in range(6)])
    with pytest.raises(DataError, match="no two of them show the same features"):
        map_cameras(matches, cameras)
    assert "with denser features" not in caplog.text


@pytest.mark.parametrize(
    ("features", "pairs", "expected"),
    [
        (3000, "", True),
        (3000, "ab bc ad ef", True),
        (3000, "ab bc ad ae", False),
        (900, "", False),
    ],
    ids=["no pair", "chance pairs", "half of them", "plain surfaces"],
)
def test_unrelated_photographs_are_detected(tmp_path, features, pairs, expected):
    """Ten photographs; however few matches a pair has."""
    graph = MatchGraph(tmp_path, dict.fromkeys("abcdefghij", features), {(a, b): 15 for a, b in pairs.split()})
    assert graph.has_unrelated_photographs() == expected


@pytest.mark.parametrize(("names", "pairs"), [("abc", "ab"), ("abcd", "ab cd")], ids=["one is loose", "two pairs"])
def test_photographs_are_related_if_two_of_few_match(tmp_path, names, pairs):
    graph = MatchGraph(tmp_path, dict.fromkeys(names, 3000), {(a, b): 200 for a, b in pairs.split()})
    assert not graph.has_unrelated_photographs()
