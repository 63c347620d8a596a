"""Hash the models that short training runs write, to compare the bits of two programs.

    python -m tests.support.bits [NAME ...] [--out FILE] [--jobs N] [--list]

prints a line `NAME SHA256` for each case, in the order of the names.  The hash is that of a PLY file's data, without
its header, which contains the version, or of the tables of a field.  Cases are all recipes in `pipelines/`, with STEPS
steps and growth, and training runs with settings that no recipe has.  All runs are started from the command line, so
that this file works before and after modules move.  Counts and skipped cases go to standard error.  Real scenes are
read from $CLSPLAT_DATA, or from `shared/data` next to the checkout.
"""

import argparse
import hashlib
import io
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml  # type: ignore[import-untyped]

from clsplat.data_tools.synthetic import write_dataset
from clsplat.pipeline.files import shipped_pipelines
from clsplat.pipeline.yaml_file import read_pipeline
from clsplat.scene.detect import read_scene
from clsplat.scene.images import read_image, write_image
from tests.support.city import City
from tests.support.moving_scene import Moving
from tests.support.multiscale_scene import write_multiscale

ROOT = Path(__file__).parents[2]
DATA = Path(os.environ.get("CLSPLAT_DATA") or ROOT.parent / "shared" / "data")
STEPS = 60
EDITS_EVERY = 10  # at least: growth doubles with each
STEP_KEYS = {"steps", "start", "stop", "until", "over", "every", "warm_up", "grow_until"}
FEW_GAUSSIANS = 3000  # of a budget: training reaches it
OPAQUE = 0.3  # so few steps do not recover from faint Gaussians
SIZES = {"rays": 64, "coarse_samples": 16, "fine_samples": 16, "width": 64, "color_width": 32, "entries": 4096}
ONE_THREAD = {"POCL_MAX_PTHREAD_COUNT": "1", "POCL_CPU_MAX_CU_COUNT": "1", "CL_CONFIG_CPU_TBB_NUM_WORKERS": "1"}
TWO_THREADS = dict.fromkeys(ONE_THREAD, "2")
LENS: dict[str, Any] = {"k1": -0.12, "k2": 0.03, "p1": 0.001, "p2": -0.002}
FISHEYE: dict[str, Any] = {"camera_model": "OPENCV_FISHEYE", "k1": 0.02, "k2": -0.01, "k3": 0.003, "k4": 0.0}
DEPTHS = "optimize.losses=[{type: l1, weight: 0.8}, {type: dssim, weight: 0.2}, {type: inverse_depth, weight: 0.5}]"
BEST = "optimize.keep=best", "scene.validation=2", "optimize.rates.means=[[40, 1.6e-4], [41, 0.3]]"  # not the last one
MANY = (
    "optimize.modules.exposure.model=affine", "optimize.modules.camera_optimizer={start: 4}",
    "optimize.modules.distractors={count: 30, start: 4}",
    "optimize.modules.dropout.probability=0.1", "rasterizer.harmonics=host",
)  # fmt: skip


class Skipped(Exception):
    """A case that cannot run here."""


class Failed(Exception):
    """A command that failed."""


@dataclass(frozen=True)
class Case:
    """A training: a recipe at a scene with other settings."""

    recipe: str = "splat_7k"
    scene: str = "still"
    settings: tuple[str, ...] = ()
    plugin: str = ""
    environment: dict[str, str] = field(default_factory=dict)
    is_killed: bool = False
    command: tuple[str, ...] = ()
    """Another command than `run`; {NAME} in it is a folder or file of the place where the cases run."""
    same_as: str = ""
    """The case that has the same bits."""


def sets(*settings: str, **others: Any) -> Case:
    return Case(settings=settings, **others)


NAMED = {
    "alpha_as_mask": sets("scene.alpha=mask"),
    "affine": sets("optimize.modules.exposure.model=affine"),
    "background_random": sets("optimize.modules.random_background={}"),
    "background_transparent": sets("optimize.modules.random_background.when=transparent", same_as="background_random"),
    "blocks_command": Case(
        command=("blocks", "{blocks}", "--scene", "{still}", "--coarse", "{model}", "--blocks", "3", "--out", "{out}")
    ),
    "blur": sets("optimize.views.transforms=[{type: blur, sigma: [[0, 3.0], [30, 0.5], [45, 0.0]]}]"),
    "camera_response": sets("optimize.modules.camera_response={}"),
    "city": sets(scene="city"),
    "compress_command": Case(
        command=("compress", "{model}", "--scene", "{still}", "--keep", "0.5", "--steps", "20", "--out", "{out}")
    ),
    "convert_glb": Case(command=("convert", "{model}", "{out}.glb")),
    "convert_sog": Case(command=("convert", "{model}", "{out}.sog")),
    "convert_splat": Case(command=("convert", "{model}", "{out}.splat")),
    "convert_spz": Case(command=("convert", "{model}", "{out}.spz")),
    "deferred": sets("optimize.update=deferred", same_as="splat_7k"),
    "distractors": sets("optimize.modules.distractors={count: 30, start: 4}"),
    "downscale": sets("scene.downscale=2"),
    "dropout": sets("optimize.modules.dropout.probability=0.3"),
    "entropy": sets(
        "optimize.losses=[{type: l1, weight: 0.8}, {type: dssim, weight: 0.2}, {type: opacity_entropy, weight: 0.01}]",
        plugin="opacity_entropy.py",
    ),
    "fisheye": sets(scene="fisheye"),
    "gain": sets("optimize.modules.exposure={}"),
    "grid": sets("optimize.modules.bilateral_grid={grid_shape: [3, 2, 4]}"),
    "haar": sets("optimize.modules.haar={learn: filter}"),
    "harmonics_on_host": sets("rasterizer.harmonics=host", same_as="splat_7k"),
    "inside": sets("stages.1.during.1.inside={low: [0, null, null]}"),
    "inverse_depth": sets(DEPTHS, "scene.downscale=8", scene="fox"),
    "keep_best": sets(*BEST),
    "keep_best_refit": sets(*BEST, "optimize.refit=true"),
    "killed_and_resumed": Case(is_killed=True, same_as="splat_7k"),
    "killed_field": Case("mip_grid", is_killed=True, same_as="mip_grid"),
    "killed_in_motion": Case("dynamic_7k", "moving", is_killed=True, same_as="dynamic_7k"),
    "killed_with_many": sets(*MANY, is_killed=True, same_as="many"),
    "killed_with_sky": sets("model.background=envmap", is_killed=True, same_as="sky"),
    "launch_tiles": sets("rasterizer.launch_tiles=2", same_as="splat_7k"),
    "lens": sets(scene="lens"),
    "levels": sets("scene.levels=3"),
    "many": sets(*MANY),
    "masks": sets("scene.masks='{masks}'", scene="lens"),
    "motion_of_degree_3": sets("model.time={degree: 3, rotation: true}", recipe="dynamic_7k", scene="moving"),
    "multiscale": sets("scene.levels=2", scene="multiscale"),
    "shuffle_order": sets("optimize.views.order=shuffle"),
    "pair_budget": sets("rasterizer.pair_budget=1", same_as="splat_7k"),
    "plugin_blur": sets(
        "optimize.views={transforms: [{type: box_blur, reach: [[0, 3], [40, 0]]}]}", plugin="box_blur.py"
    ),
    "plugin_response": sets(
        "optimize.modules.lens_and_curves={}", plugin="lens_and_curves.py", same_as="camera_response"
    ),
    "poses": sets("optimize.modules.camera_optimizer={start: 4}"),
    "random_points": sets("init.source=random", "init.count=3000"),
    "resolution": sets("optimize.views.resolution=[[0, 2], [20, 1]]"),
    "schedule_simt": sets("rasterizer.schedule=simt"),
    "seen": sets("optimize.update=seen"),
    "sky": sets("model.background=envmap"),
    "sky_as_sidecar": sets("model.background={type: envmap, side: 8}", "export.sky=sidecar"),
    "sweep": sets("init.source=points+sweep", scene="lens"),
    "threads_1": Case(environment=ONE_THREAD, same_as="splat_7k"),
    "threads_1_with_many": sets(*MANY, environment=ONE_THREAD, same_as="many"),
    "threads_2": Case(environment=TWO_THREADS, same_as="splat_7k"),
    "transients": sets("optimize.modules.transients={start: 4, outlier_ratio: 1, tail_ratio: 0}"),
}


def cases() -> dict[str, Case]:
    """Return all cases by name."""
    recipes = {}
    for name, path in shipped_pipelines().items():
        stages = yaml.safe_load(read_pipeline(path))["stages"]
        text = json.dumps(stages)
        needs_model = '"source": "model"' in text
        is_moving = "motion" in text
        settings = ("init.file='{model}'",) if needs_model else ()
        recipes[name] = Case(name, "moving" if is_moving else "still", settings)
    return dict(sorted({**recipes, **NAMED}.items()))


def shorten(recipe: dict[str, Any]) -> dict[str, Any]:
    """Return a recipe with STEPS steps.  The key paths of its settings do not change."""
    training_stages = [
        stage for stage in recipe["stages"] if isinstance(stage, dict) and "during" in next(iter(stage.values()))
    ]
    factor = STEPS / next(iter(training_stages[0].values()))["steps"]
    short: dict[str, Any] = scaled(recipe, factor)
    short.pop("prepare", None)
    dropped = ("evaluate", "render", "viewer", "report")
    short["stages"] = [s for s in short["stages"] if (s if isinstance(s, str) else next(iter(s))) not in dropped]
    for stage in short["stages"]:
        for name, settings in stage.items() if isinstance(stage, dict) else ():
            if name == "init" and "opacity" in settings:
                settings["opacity"] = max(settings["opacity"], OPAQUE)
            for transform in settings.get("views", {}).get("transforms", ()):
                if transform["type"] == "mean_filter":  # shares of the width, of wider photographs
                    points = transform["width"]["points"]
                    transform["width"]["points"] = [[step, 15 * width] for step, width in points]
            for inner in settings.get("during", ()):
                adjust(*next(iter(inner.items())))
    return short


def adjust(name: str, settings: dict[str, Any]) -> None:
    """Let what is done during a short training act, measurements aside, and leave Gaussians that can be seen."""
    if name == "evaluate":
        settings["every"] = 10**6
    elif name == "checkpoint":
        settings["every"] = STEPS // 3
    elif name not in ("raise_sh", "average") and settings["every"] != 1:
        settings["every"] = max(EDITS_EVERY, settings["every"])
        if "stop" in settings and settings["stop"] <= settings["every"]:
            settings["stop"] = settings["every"] + 1
    if "value" in settings:
        settings["value"] = max(settings["value"], OPAQUE)
    for rule in settings.get("rules", ()):
        if rule.get("statistic") == "gain":
            rule["gradient_above"] = 0.5  # so few steps promise little
        if "start" in rule:
            rule["start"] = min(rule["start"], EDITS_EVERY)
        if "ratio_above" in rule:
            rule["ratio_above"] = min(rule["ratio_above"], 2)
    if "gaussians" in (budget := settings.get("budget", ())):
        budget["gaussians"] = FEW_GAUSSIANS
    if "remove" in settings:
        settings["remove"] = min(settings["remove"], 0.3)


def scaled(node: Any, factor: float) -> Any:
    """Return settings with all numbers of steps multiplied."""
    if isinstance(node, dict):
        return {
            key: scaled_steps(value, factor, key)
            if key in STEP_KEYS and isinstance(value, int)
            else limited_value(key, scaled(value, factor))
            for key, value in node.items()
        }
    if isinstance(node, list) and node and all(is_point(item) for item in node):
        return [list(point) for point in {math.floor(step * factor): value for step, value in node}.items()]
    return [scaled(item, factor) for item in node] if isinstance(node, list) else node


def limited_value(key: str, value: Any) -> Any:
    return min(value, SIZES[key]) if key in SIZES and isinstance(value, int) else value


def is_point(item: Any) -> bool:
    """Return whether a value is a point of a schedule."""
    return isinstance(item, list) and len(item) == 2 and all(type(part) in (int, float) for part in item)


def scaled_steps(steps: int, factor: float, key: str) -> int:
    """Return a scaled number of steps; a stop stays behind the last act before it, and 1 is each step."""
    if key == "stop":
        return math.floor((steps - 1) * factor) + 1
    if key == "every":
        return min(steps, max(2, math.floor(steps * factor)))
    return max(int(key != "start"), math.floor(steps * factor))


class Place:
    """A folder with scenes, shortened recipes and runs."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def clsplat(self, *words: str, environment: dict[str, str] | None = None) -> None:
        """Run the command."""
        done = subprocess.run(**self._process(words, environment or {}), capture_output=True, text=True, check=False)
        if done.returncode:
            raise Failed(f"clsplat {' '.join(words)}: exit code {done.returncode}\n{done.stderr[-2000:]}")

    def _process(self, words: tuple[str, ...], environment: dict[str, str]) -> dict[str, Any]:
        path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
        return {
            "args": [sys.executable, "-m", "clsplat", *words],
            "cwd": self.folder,
            "env": {**os.environ, "PYTHONPATH": path, **environment},
        }

    def prepare(self, chosen: dict[str, Case]) -> None:
        """Make the scenes, the shortened recipes, and a model if a case starts from one."""
        self.clsplat("data", "synthetic", "still", "--size", "40", "--train", "8", "--test", "2")
        thin(self.folder / "still" / "points3d.ply")
        scenes = {case.scene for case in chosen.values()}
        if "moving" in scenes:
            write_dataset(self.folder / "moving", Moving(size=32, train=3, test=1, times=6), workers=1)
            thin(self.folder / "moving" / "points3d.ply")
        if "city" in scenes:
            write_dataset(self.folder / "city", City(size=40, train=8, test=2, lots=2), workers=1)
            thin(self.folder / "city" / "points3d.ply")
        if "multiscale" in scenes:
            write_multiscale(self.folder / "still", self.folder / "multiscale", 2)
        for name, lens in {"lens": LENS, "fisheye": FISHEYE}.items():
            self._write_lens(name, lens)
        self._write_masks()
        for path in shipped_pipelines().values():
            short = shorten(yaml.safe_load(read_pipeline(path)))
            (self.folder / path.name).write_text(yaml.safe_dump(short, sort_keys=False))
        if "model" in str(list(chosen.values())):
            self.clsplat("run", "splat_7k.yaml", "--scene", "still", "--out", "first")
            shutil.copy(self.folder / "first" / "point_cloud.ply", self.folder / "model.ply")

    def _write_masks(self) -> None:
        """Write the alpha of the photographs of `still` as masks."""
        for view in read_scene(self.folder / "still", holdout=0).views:
            white = read_image(view.image_path)[:, :, 3:] >= 0.5 * 255
            mask = np.where(white, 255, 0).astype(np.uint8).repeat(3, axis=2)
            write_image((self.folder / "masks" / view.name).with_suffix(".png"), mask)

    def _write_lens(self, name: str, lens: dict[str, Any]) -> None:
        """Write the photographs of `still` in nerfstudio's layout, as if a lens had taken them."""
        still, folder = self.folder / "still", self.folder / name
        shutil.copytree(still, folder, ignore=shutil.ignore_patterns("*.json"))
        parts = [json.loads((still / f"transforms_{part}.json").read_text()) for part in ("train", "test")]
        focal = 20 / math.tan(parts[0]["camera_angle_x"] / 2)
        frames = [{**frame, "file_path": f"{frame['file_path']}.png"} for part in parts for frame in part["frames"]]
        camera = {"w": 40, "h": 40, "fl_x": focal, "fl_y": focal, "cx": 20.0, "cy": 20.0, **lens}
        table = {**camera, "ply_file_path": "points3d.ply", "frames": frames}
        (folder / "transforms.json").write_text(json.dumps(table))

    def run(self, name: str, case: Case) -> str:
        """Run a case; return its hash."""
        if case.scene == "fox" and not (DATA / "fox").is_dir():
            raise Skipped(f"no dataset {DATA / 'fox'}; set CLSPLAT_DATA to the folder that holds it")
        out = self.folder / "runs" / name
        out.parent.mkdir(exist_ok=True)
        places = {
            "model": str(self.folder / "model.ply"),
            "masks": str(self.folder / "masks"),
            "out": str(out),
            "still": "still",
            "blocks": "blocks.yaml",
        }

        def filled(word: str) -> str:
            for key, value in places.items():
                word = word.replace(f"{{{key}}}", value)
            return word

        if case.command:
            self.clsplat(*map(filled, case.command))
            return self._hash_written(out)
        scene = str(DATA / case.scene) if case.scene == "fox" else case.scene
        plugin = ["--plugin", str(ROOT / "examples" / case.plugin)] if case.plugin else []
        words = [*plugin, "run", f"{case.recipe}.yaml", "--scene", scene, "--out", str(out)]
        words += [word for setting in case.settings for word in ("--set", filled(setting))]
        if case.is_killed:
            self._kill(words, out)
            words.append("--resume")
        self.clsplat(*words, environment=case.environment)
        return hash_model(out)

    def _hash_written(self, out: Path) -> str:
        """Return the hash of all models that a command wrote, as they are read back."""
        digests = []
        for file in sorted([*out.rglob("*.*"), *out.parent.glob(f"{out.name}.*")]):
            if file.suffix == ".ply":
                digests.append(hash_ply(file))
            elif file.suffix in (".sog", ".spz", ".splat", ".glb"):
                back = out.parent / f"back_{out.name}_{len(digests)}.ply"
                self.clsplat("convert", str(file), str(back))
                digests.append(hash_ply(back))
        if not digests:
            raise Failed(f"{out}: no model was written")
        return hashlib.sha256("".join(digests).encode()).hexdigest() if digests[1:] else digests[0]

    def _kill(self, words: list[str], out: Path) -> None:
        """Run the command up to its first checkpoint."""
        for _ in range(5):
            shutil.rmtree(out, ignore_errors=True)
            silent: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
            process = subprocess.Popen(**self._process(tuple(words), {}), **silent, start_new_session=True)
            while process.poll() is None and not list((out / "checkpoints").glob("step_*")):
                time.sleep(0.002)
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            if process.wait() == -signal.SIGKILL and not list(out.glob("*.ply")):
                return
        raise Failed(f"{out.name}: the run ended before it was killed")


def thin(file: Path) -> None:
    """Keep every tenth of a scene's points, so that growth stays cheap."""
    header, end, data = file.read_bytes().partition(b"end_header\n")
    count = next(line.split()[-1] for line in header.splitlines() if line.startswith(b"element vertex"))
    size = len(data) // int(count)
    kept = [data[i * size : (i + 1) * size] for i in range(0, int(count), 10)]
    header = header.replace(b"element vertex " + count, b"element vertex %d" % len(kept))
    file.write_bytes(header + end + b"".join(kept))


def hash_model(out: Path) -> str:
    """Return the hash of a run's Gaussians, or of the tables of its field."""
    if (out / "point_cloud.ply").exists():
        return hash_ply(out / "point_cloud.ply")
    digest = hashlib.sha256()
    with zipfile.ZipFile(out / "field.npz") as archive:
        for name in sorted(archive.namelist()):
            table = np.load(io.BytesIO(archive.read(name)))
            if table.dtype == np.float32 and table.ndim:
                digest.update(f"{name} {table.shape}".encode() + table.tobytes())
    return digest.hexdigest()


def hash_ply(file: Path) -> str:
    """Return the hash of what follows the header."""
    header, _, data = file.read_bytes().partition(b"end_header\n")
    count = next(line.split()[-1].decode() for line in header.splitlines() if line.startswith(b"element vertex"))
    print(f"  {file.parent.name}/{file.name}: {count} Gaussians", file=sys.stderr)
    return hashlib.sha256(data).hexdigest()


def hashes(chosen: dict[str, Case], jobs: int) -> Iterator[tuple[str, str]]:
    """Yield the names and hashes of cases; what failed or was skipped goes to standard error."""
    with tempfile.TemporaryDirectory(prefix="bits_") as folder, ThreadPoolExecutor(jobs) as pool:
        place = Place(Path(folder))
        place.prepare(chosen)
        running = {name: pool.submit(place.run, name, case) for name, case in chosen.items()}
        for name, future in running.items():
            try:
                yield name, future.result()
            except Skipped as reason:
                print(f"{name}: skipped: {reason}", file=sys.stderr)
            except (Failed, OSError) as reason:
                print(f"{name}: FAILED: {reason}", file=sys.stderr)
                yield name, "FAILED"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help="cases; default: all")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the lines there too")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="runs at a time; default: 2")
    parser.add_argument("--list", action="store_true", help="print the names")
    arguments = parser.parse_args()
    known = cases()
    if unknown := sorted(set(arguments.names) - set(known)):
        parser.error(f"no case named {', '.join(unknown)}; --list prints the names")
    chosen = {name: case for name, case in known.items() if not arguments.names or name in arguments.names}
    if arguments.list:
        print(*chosen, sep="\n")
        return 0
    results = {}
    for name, digest in hashes(chosen, arguments.jobs):
        results[name] = digest
        print(name, digest, flush=True)
    if arguments.out:
        arguments.out.write_text("".join(f"{name} {digest}\n" for name, digest in results.items()))
    differ = [name for name in results if results[name] != results.get(chosen[name].same_as, results[name])]
    for name in differ:
        print(f"{name}: other bits than {chosen[name].same_as}", file=sys.stderr)
    return int(bool(differ) or "FAILED" in results.values())


if __name__ == "__main__":
    sys.exit(main())
