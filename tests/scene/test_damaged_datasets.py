"""Datasets with one fault each: one sentence and an exit code, quickly and with little memory.

All of them go through one process, which is what bounds its memory.
"""

import contextlib
import functools
import io
import json
import os
import shutil
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.support.colmap_writer import CameraEntry, ColmapModel, ImageEntry, PointEntry, write_scene

pytestmark = pytest.mark.slow

SECONDS, BYTES = 5.0, 1 << 30
CAMERA = CameraEntry(1, "PINHOLE", 64, 48, (60.0, 60.0, 32.0, 24.0))
NAMES = [f"{i}.png" for i in range(6)]


def healthy(**changes: object) -> ColmapModel:
    """Six cameras in a row that look at points four units away."""
    images = [ImageEntry(name, translation=(0.3 * i - 0.8, 0.0, 4.0)) for i, name in enumerate(NAMES)]
    points = [PointEntry((0.2 * (i % 7) - 0.6, 0.2 * (i // 7) - 0.6, 0.05 * (i % 3))) for i in range(49)]
    return replace(ColmapModel([CAMERA], images, points), **changes)


def scene(path: Path, model: ColmapModel | None = None, kind: str = "bin", newline: str = "\n") -> Path:
    """Write a model and a photograph for each image."""
    model = model or healthy()
    write_scene(path, model, kind, newline)
    rng = np.random.default_rng(0)
    for image in model.images:
        photo(path / "images" / image.name, rng.integers(0, 256, (48, 64, 3)).astype(np.uint8))
    return path


PIXELS = np.arange(48 * 64 * 3).reshape(48, 64, 3).astype(np.uint8)


def photo(path: Path, pixels: np.ndarray) -> None:
    _, encoded = cv2.imencode(path.suffix, pixels)
    path.write_bytes(encoded.tobytes())


def cut(stem: str) -> Callable[[Path], None]:
    def damage(path: Path) -> None:
        file = scene(path) / "sparse" / "0" / f"{stem}.bin"
        file.write_bytes(file.read_bytes()[:-9])

    return damage


def counted(stem: str, count: int) -> Callable[[Path], None]:
    def damage(path: Path) -> None:
        file = scene(path) / "sparse" / "0" / f"{stem}.bin"
        file.write_bytes(struct.pack("<Q", count) + file.read_bytes()[8:])

    return damage


def with_images(*entries: ImageEntry) -> Callable[[Path], object]:
    return lambda path: write_scene(path, healthy(images=list(entries)))


def with_photo(write: Callable[[Path], object]) -> Callable[[Path], None]:
    """A healthy scene whose third photograph is something else."""

    def damage(path: Path) -> None:
        file = scene(path) / "images" / NAMES[2]
        file.unlink()
        write(file)

    return damage


def without(name: str) -> Callable[[Path], None]:
    def damage(path: Path) -> None:
        target = scene(path) / name
        shutil.rmtree(target) if target.is_dir() else target.unlink()

    return damage


def changed(**fields: object) -> Callable[[Path], None]:
    """The third image, or the camera, with other values."""

    def damage(path: Path) -> None:
        if "camera_entry" in fields:
            scene(path, healthy(cameras=[replace(CAMERA, **fields["camera_entry"])]))
            return
        images = list(healthy().images)
        images[2] = replace(images[2], **fields)
        write_scene(path, healthy(images=images))
        for name in NAMES:
            photo(path / "images" / name, PIXELS)

    return damage


def transforms(**changes: object) -> Callable[[Path], None]:
    def damage(path: Path) -> None:
        path.mkdir()
        for name in NAMES:
            photo(path / name, PIXELS)
        frames = [{"file_path": name, "transform_matrix": np.eye(4).tolist()} for name in NAMES]
        table = {"fl_x": 60, "w": 64, "h": 48, "frames": frames}
        first = {key: value for key, value in changes.items() if key != "table"}
        table["frames"][0] |= first
        (path / "transforms.json").write_text(json.dumps(table | changes.get("table", {})))

    return damage


def cyclic_folder(path: Path) -> None:
    images = scene(path) / "images"
    shutil.rmtree(images)
    images.symlink_to(images)


def larger_second_model(path: Path) -> None:
    scene(path)
    write_scene(path / "other", healthy(images=healthy().images[:2]))
    (path / "sparse" / "0").rename(path / "sparse" / "1")
    (path / "other" / "sparse" / "0").rename(path / "sparse" / "0")


def bomb(path: Path) -> None:
    """A PNG that declares 60 000 x 60 000 pixels."""
    photo(path, np.zeros((2, 2, 3), np.uint8))
    data = bytearray(path.read_bytes())
    data[16:24] = struct.pack(">II", 60000, 60000)
    path.write_bytes(data)


MISSING = "image files are missing"
CASES: dict[str, tuple[Callable[[Path], object], int, str]] = {
    # name: (how to make it, exit code, what is said)
    "healthy": (scene, 0, ""),
    "cameras cut": (cut("cameras"), 3, "cameras.bin: byte"),
    "images cut": (cut("images"), 3, "images.bin: byte"),
    "points cut": (cut("points3D"), 3, "points3D.bin: byte"),
    "too few cameras counted": (counted("cameras", 0), 3, "cameras.bin: byte 8"),
    "too many images counted": (counted("images", 9), 3, "images.bin: byte"),
    "too few points counted": (counted("points3D", 3), 3, "points3D.bin: byte"),
    "a huge count of images": (counted("images", 2**63), 3, "images.bin: byte 8"),
    "a huge count of points": (counted("points3D", 2**40), 3, "points3D.bin: byte 8"),
    "no images registered": (lambda path: write_scene(path, healthy(images=[])), 3, "has no images"),
    "a photograph is missing": (without(f"images/{NAMES[2]}"), 3, MISSING),
    "the photographs are missing": (without("images"), 3, MISSING),
    "no points": (without("sparse/0/points3D.bin"), 0, ""),
    "no cameras file": (without("sparse/0/cameras.bin"), 3, "no cameras.bin or cameras.txt"),
    "a folder of links to itself": (cyclic_folder, 3, MISSING),
    "a photograph that links to itself": (with_photo(lambda file: file.symlink_to(file)), 3, MISSING),
    "a photograph that is a folder": (with_photo(lambda file: file.mkdir()), 3, "it is a folder"),
    "a photograph that is a pipe": (with_photo(lambda file: os.mkfifo(file)), 3, "it is a pipe"),
    "a photograph that is empty": (with_photo(lambda file: file.touch()), 3, "the file is empty"),
    "a photograph that is text": (with_photo(lambda file: file.write_text("no")), 3, "not an image"),
    "a photograph of another size": (
        with_photo(lambda file: photo(file, np.zeros((20, 64, 3), np.uint8))),
        3,
        "64x20 pixels",
    ),
    "a photograph that is a bomb": (with_photo(bomb), 3, "not an image"),
    "a photograph of 16 bits": (with_photo(lambda file: photo(file, np.zeros((48, 64, 3), np.uint16))), 0, ""),
    "a gray photograph": (with_photo(lambda file: photo(file, np.zeros((48, 64), np.uint8))), 0, ""),
    "a path that leads out": (with_images(ImageEntry("../../a.png")), 3, "not a path below"),
    "an absolute path": (with_images(ImageEntry("/etc/passwd")), 3, "not a path below"),
    "two images of a name": (
        lambda path: scene(path, healthy(images=[ImageEntry("0.png")] * 2)),
        3,
        "are named '0.png'",
    ),
    "an unknown camera": (changed(camera=7), 3, "has camera 7"),
    "a pose that is not a number": (changed(translation=(float("nan"), 0, 0)), 3, "the pose of '2.png'"),
    "a pose without rotation": (changed(quaternion=(0, 0, 0, 0)), 3, "the pose of '2.png'"),
    "a far camera": (changed(translation=(1e7, 0.0, 4.0)), 0, ""),
    "a negative focal length": (
        changed(camera_entry={"params": (-60.0, 60.0, 32.0, 24.0)}),
        3,
        "positive size",
    ),
    "a camera of no size": (changed(camera_entry={"width": 0}), 3, "0x48"),
    "all points behind the cameras": (
        lambda path: scene(path, healthy(points=[PointEntry((0.1 * i, 0, -9)) for i in range(9)])),
        3,
        "behind all training cameras",
    ),
    "a larger second model": (larger_second_model, 0, ""),
    "Windows line ends": (lambda path: scene(path, kind="txt", newline="\r\n"), 0, ""),
    "names with spaces and accents": (lambda path: scene(path, named("mit Ä {}.png")), 0, ""),
    "a number that is a word": (
        lambda path: replace_text(scene(path, kind="txt") / "sparse" / "0" / "cameras.txt", "64", "wide"),
        3,
        "cameras.txt: line 2",
    ),
    "JSON that is a list": (lambda path: json_text(path, "[1]"), 3, "a list of objects named `frames`"),
    "JSON that is cut": (lambda path: json_text(path, '{"frames": ['), 3, "not a JSON file"),
    "JSON that is deep": (lambda path: json_text(path, "[" * 100_000), 3, "not a JSON file"),
    "JSON without frames": (transforms(table={"frames": []}), 3, "has no images"),
    "JSON whose path leads out": (transforms(file_path="../a.png"), 3, "not a path below"),
    "JSON whose pose is not a number": (transforms(transform_matrix=[[float("nan")] * 4] * 4), 3, "transform_matrix"),
    "JSON without a focal length": (transforms(table={"fl_x": None}), 3, "fl_x"),
    "a folder of photographs alone": (without("sparse"), 3, "no dataset found"),
    "an empty folder": (lambda path: path.mkdir(), 3, "no dataset found"),
    "no folder": (lambda path: None, 3, "no such folder"),
}


def named(pattern: str) -> ColmapModel:
    model = healthy()
    return replace(model, images=[replace(image, name=pattern.format(i)) for i, image in enumerate(model.images)])


def replace_text(file: Path, old: str, new: str) -> None:
    file.write_text(file.read_text().replace(old, new))


def json_text(path: Path, text: str) -> None:
    path.mkdir()
    (path / "transforms.json").write_text(text)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, object]]:
    """Exit code, output and seconds of every case."""
    base = tmp_path_factory.mktemp("damaged")
    for i, (make, _, _) in enumerate(CASES.values()):
        make(base / f"{i:02d}")
    before = {path: path.lstat().st_mtime_ns for path in base.rglob("*")}
    command = [sys.executable, "-m", "tests.scene.test_damaged_datasets", str(base), str(len(CASES))]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=Path(__file__).parents[2])
    assert done.returncode == 0, done.stderr[-2000:]
    assert {path: path.lstat().st_mtime_ns for path in base.rglob("*")} == before, "written beside the run folder"
    results = json.loads(done.stdout.splitlines()[-1])
    assert results["peak"] < BYTES
    return dict(zip(CASES, results["cases"], strict=True))


def fault_of(name: str, result: dict[str, object]) -> str:
    """What is wrong with the end of a case, if anything."""
    _, code, text = CASES[name]
    lines = [line for line in str(result["errors"]).splitlines() if line]
    if result["code"] != code or "Traceback" in str(result["errors"]):
        return f"{name}: ended with {result['code']}, expected {code}: {lines}"
    if not code:
        return "" if all(line.startswith("warning: ") for line in lines) else f"{name}: {lines}"
    is_sentence = len(lines) == 1 and lines[0].startswith("error: ") and text in lines[0]
    return "" if is_sentence and result["seconds"] < SECONDS else f"{name}: {result['seconds']} s, {lines}"


@pytest.mark.large
def test_damaged_dataset_gives_one_sentence_and_a_code(results):
    faults = [fault for name in CASES if (fault := fault_of(name, results[name]))]
    assert not faults, "\n".join(faults)


def main(base: Path, count: int) -> None:
    """Give every dataset to the command line, in this process."""
    from clsplat.core import terminal
    from clsplat.opencl import device

    device.create_context, device.build = functools.cache(device.create_context), functools.cache(device.build)
    terminal.STDERR_CONSOLE.width = 10_000
    cases = []
    for i in range(count):
        start = time.process_time()  # waiting for other processes does not count
        out = base.parent / f"{base.name}-out" / f"{i:02d}"
        arguments = ["run", "smoke", "--scene", str(base / f"{i:02d}"), "--out", str(out)]
        cases.append(run_command_line([*arguments, "--set", "optimize.steps=2"]))
        cases[-1]["seconds"] = time.process_time() - start
    print(json.dumps({"cases": cases, "peak": peak_memory()}))


def peak_memory() -> int:
    """Bytes.  Linux counts in ru_maxrss what the parent held before it started this process; VmHWM is our own."""
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.is_file() else []
    own = [1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM:")]
    if own or sys.platform == "win32":  # which tells neither
        return own[0] if own else 0
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def run_command_line(arguments: list[str]) -> dict[str, object]:
    """Run the command line; catch what it prints as errors, and how it ends."""
    from clsplat import cli
    from clsplat.core import terminal

    code: object = 0
    sys.argv = ["clsplat", *arguments]
    with terminal.STDERR_CONSOLE.capture() as errors, contextlib.redirect_stdout(io.StringIO()):
        try:
            cli.main()
        except SystemExit as end:
            code = end.code or 0
    return {"code": code, "errors": errors.get()}


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
