"""The commands.  Each prints one line for an error, and exits with that error's code."""

import json
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from clsplat import terminal
from clsplat.errors import ClsplatError, ConfigError, DeviceError
from clsplat.terminal import CONSOLE, ERRORS

app = typer.Typer(
    help="3D Gaussian Splatting on any OpenCL device.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
DeviceOption = Annotated[
    str | None,
    typer.Option(help="Part of a runtime's or device's name, as `clsplat devices` prints them; `:1` for the second."),
]
SceneOption = Annotated[Path, typer.Option(help="A COLMAP, Blender or nerfstudio folder.")]
debugging = False


@app.callback()
def common(
    debug: Annotated[bool, typer.Option(help="Show tracebacks and every log line.")] = False,
    plugin: Annotated[list[Path] | None, typer.Option(help="A Python file with variants; may be repeated.")] = None,
) -> None:
    from clsplat import plugins

    global debugging
    debugging = debug
    terminal.start_logging(debug)
    plugins.load_installed()
    for file in plugin or []:
        plugins.load_file(file)


@app.command()
def run(
    pipeline: Annotated[str, typer.Argument(help="A pipeline file, or the name of a shipped one.")],
    scene: Annotated[Path | None, typer.Option(help="A COLMAP, Blender or nerfstudio folder.")] = None,
    out: Annotated[Path | None, typer.Option(help="The run folder; default: runs/NAME.")] = None,
    device: DeviceOption = None,
    set_: Annotated[list[str] | None, typer.Option("--set", help="stage.key=value; may be repeated.")] = None,
    resume: Annotated[bool, typer.Option(help="Go on from the newest checkpoint.")] = False,
    dry_run: Annotated[bool, typer.Option(help="Check everything and say what would run.")] = False,
) -> None:
    """Run a pipeline."""
    from clsplat import experiment, runner
    from clsplat.matrix import load_experiment
    from clsplat.pipeline import load

    overrides = list(set_ or [])
    if scene is not None:
        overrides.append(f"scene.path={json.dumps(str(scene.resolve()))}")
    if found := load_experiment(pipeline, overrides):
        folder = out or runner.free_folder(Path("runs") / found.name, None, resume)
        if dry_run:
            CONSOLE.print(experiment.describe(found, folder), markup=False)
        else:
            experiment.run(found, folder, device, resume)
        return
    checked = load(pipeline, overrides)
    folder = out or runner.free_folder(Path("runs") / checked.settings.name, checked, resume)
    if dry_run:
        CONSOLE.print(runner.describe(checked, folder, device), markup=False)
        return
    if runner.up_to_date(checked, checked.preparation(folder), folder):
        CONSOLE.print(f"{folder}: up to date; change a setting, or give another --out, to run again", markup=False)
    else:
        experiment.run_pipeline(checked, folder, device, resume)
    terminal.summary(folder)


@app.command()
def check(
    pipeline: Annotated[str, typer.Argument(help="A pipeline file, or the name of a shipped one.")] = "",
    schema: Annotated[bool, typer.Option(help="Print the JSON schema of pipeline files, for editors.")] = False,
) -> None:
    """Validate a pipeline without running it."""
    from clsplat.matrix import load_experiment
    from clsplat.pipeline import load
    from clsplat.schema import json_schema

    if schema:
        print(json.dumps(json_schema(), indent=1))
        return
    if not pipeline:
        raise ConfigError("check: expected a pipeline, or --schema")
    if found := load_experiment(pipeline):
        CONSOLE.print(
            f"{found.path}: {len(found.cells)} cells: {', '.join(cell.name for cell in found.cells)}: fine",
            markup=False,
        )
        return
    checked = load(pipeline)
    names = [*(step.stage for step in checked.settings.prepare), *(stage.stage for stage in checked.stages)]
    CONSOLE.print(f"{checked.path}: {', '.join(names)}: fine", markup=False)


@app.command()
def devices(
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """List OpenCL devices, the limits that matter, and whether each works; exit 4 when none does."""
    from dataclasses import asdict

    from clsplat.opencl.device import list_devices

    found = [(info, info.fault()) for info in list_devices()]
    if as_json:
        print(json.dumps([{**asdict(info), "fault": fault} for info, fault in found], indent=1))
    else:
        for info, fault in found:
            CONSOLE.print(terminal.device_text(info, fault), markup=False)
    if all(fault for _, fault in found):
        raise DeviceError(
            "no OpenCL device works; install a runtime: pip install 'clsplat[pocl]', pip install 'clsplat[intel]', "
            "apt install pocl-opencl-icd, or your GPU's driver"
        )


@app.command()
def render(
    model: Annotated[Path, typer.Argument(help="A splat PLY.")],
    scene: SceneOption,
    split: Annotated[Literal["test", "train", "all"], typer.Option(help="Which views.")] = "test",
    scale: Annotated[float, typer.Option(min=1, help="Divide image sizes by this.")] = 1,
    out: Annotated[Path, typer.Option(help="Folder for the images.")] = Path("renders"),
    format_: Annotated[
        Literal["png", "npy"], typer.Option("--format", help="8-bit images, or float32 arrays.")
    ] = "png",
    device: DeviceOption = None,
) -> None:
    """Render a model at the views of a scene, one file for each, named as the view."""
    from clsplat.model_file import ModelFile

    opened = ModelFile(model, scene, device, scale)
    count = opened.render(split, out, format_)
    CONSOLE.print(f"{count} images written to {out}", markup=False)


@app.command()
def evaluate(
    model: Annotated[Path, typer.Argument(help="A splat PLY.")],
    scene: SceneOption,
    scales: Annotated[str, typer.Option(help="Downscale factors, separated by commas.")] = "1",
    metrics: Annotated[str, typer.Option(help="Of psnr, ssim, ms_ssim and flip, separated by commas.")] = "psnr,ssim",
    lpips: Annotated[Path | None, typer.Option(help="An ONNX file of LPIPS; without it lpips is null.")] = None,
    lpips_input: Annotated[Literal["-1..1", "0..1"], typer.Option(help="The values LPIPS is given.")] = "-1..1",
    out: Annotated[Path | None, typer.Option(help="Write the metrics here as JSON; default: print them.")] = None,
    device: DeviceOption = None,
) -> None:
    """Measure a model on a scene's test and training views."""
    from clsplat.files import write_text
    from clsplat.metrics.perceptual import Perceptual, metric_names
    from clsplat.model_file import ModelFile

    try:
        factors = [float(text) for text in scales.split(",")]
    except ValueError:
        raise ConfigError(f"--scales {scales}: expected numbers separated by commas, for example 1,2,4") from None
    perceptual = Perceptual.open(metric_names(metrics.split(",")), lpips, lpips_input)
    text = json.dumps(ModelFile(model, scene, device).evaluate(factors, perceptual), indent=1) + "\n"
    if out is None:
        print(text, end="")
    else:
        write_text(out, text)


@app.command()
def compare(
    runs: Annotated[list[Path], typer.Argument(help="Run folders; that of a matrix stands for all its runs.")],
    out: Annotated[Path, typer.Option(help="The page to write.")] = Path("compare.html"),
) -> None:
    """Show runs side by side on one page that opens offline."""
    from clsplat.compare.page import write_comparison

    count = write_comparison(runs, out)
    CONSOLE.print(f"{count} runs compared in {out}", markup=False)


@app.command(add_help_option=False, context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
def data(context: typer.Context) -> None:
    """Prepare datasets: photos, video, undistort, resize, masks, multiscale, synthetic, fetch."""
    from data_tools.__main__ import app as tools

    tools(context.args, prog_name="clsplat data", standalone_mode=False)


@app.command()
def inspect(
    scene: Annotated[Path, typer.Argument(help="A COLMAP, Blender or nerfstudio folder.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    page: Annotated[Path | None, typer.Option("--html", help="Write a page with the cameras and points in 3D.")] = None,
) -> None:
    """Tell whether a dataset will train, and what is wrong with it; exit 3 when it cannot train."""
    from clsplat.errors import DataError
    from clsplat.inspect.inspection import Inspection
    from clsplat.inspect.page import write_page
    from clsplat.inspect.table import show

    inspection = Inspection.of(scene)
    if as_json:
        print(json.dumps(inspection.data(), indent=1))
    else:
        show(inspection, CONSOLE)
    if page is not None:
        write_page(inspection, page)
    if not inspection.trainable:
        raise DataError(inspection.verdict)


@app.command()
def bench(
    scenes: Annotated[str, typer.Option(help="Fixed scenes, of A, B and C, separated by commas.")] = "A",
    model: Annotated[Path | None, typer.Option(help="Also time this splat or point cloud (PLY), at --scene.")] = None,
    scene: Annotated[Path | None, typer.Option(help="The scene of --model.")] = None,
    pipeline: Annotated[str, typer.Option(help="What a step is of: losses, statistics, filter.")] = "splat",
    repeats: Annotated[int, typer.Option(min=1, help="Steps of each scene.")] = 20,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    against: Annotated[Path | None, typer.Option(help="Compare with the JSON of an earlier run.")] = None,
    schedule: Annotated[Literal["auto", "wide", "simt"], typer.Option(help="wide for CPUs, simt for GPUs.")] = "auto",
    growth: Annotated[
        Path | None, typer.Option(help="Only time 50 000 to a million Gaussians; an SVG is written.")
    ] = None,
    device: DeviceOption = None,
) -> None:
    """Time the stages of a training step on fixed scenes, beside the device's measured peaks."""
    from dataclasses import asdict

    from clsplat.bench.cases import run_bench
    from clsplat.bench.peaks import measure_peaks
    from clsplat.bench.scenes import SIZES, case, grown, real_case
    from clsplat.bench.table import growth_chart, growth_table, table
    from clsplat.files import write_text
    from clsplat.opencl.device import Device, choose
    from clsplat.pipeline import load

    names = [name for name in scenes.split(",") if name]
    if unknown := [name for name in names if name not in SIZES]:
        raise ConfigError(f"--scenes: no scene named '{unknown[0]}'; there are {', '.join(SIZES)}")
    if (model is None) != (scene is None):
        raise ConfigError("bench: --model and --scene go together")
    settings = load(pipeline).settings
    earlier = _read_json(against) if against else None
    if earlier and (was := earlier.get("pipeline", "splat")) != settings.name:
        raise ConfigError(f"{against}: expected the pipeline '{settings.name}', it has '{was}'; use --pipeline {was}")
    opened = Device(choose(device), schedule)
    peaks = measure_peaks(opened)
    if growth is not None:
        sizes = [run_bench({"": one}, peaks, repeats)[""] for one in grown(opened, settings)]
        write_text(growth, growth_chart(sizes))
        CONSOLE.print(f"device: {opened.text}\n{growth_table(sizes)}", markup=False)
        return
    cases = {name: case(opened, *SIZES[name], settings) for name in names}
    if model is not None and scene is not None:
        cases[model.stem] = real_case(opened, model, scene, settings)
    results = run_bench(cases, peaks, repeats)
    if as_json:
        data = {"device": opened.text, "pipeline": settings.name, "peaks": asdict(peaks)}
        print(json.dumps({**data, "scenes": {name: asdict(result) for name, result in results.items()}}, indent=1))
        return
    CONSOLE.print(f"device: {opened.text}", markup=False)
    CONSOLE.print(f"peaks: {peaks.gflops:.0f} GFLOP/s, {peaks.gexp:.1f} Gexp/s, copy {peaks.gbytes:.1f} GB/s")
    for name, result in results.items():
        CONSOLE.print(table(name, result, (earlier or {}).get("scenes", {}).get(name)), markup=False)


def _read_json(path: Path) -> dict[str, Any]:
    try:
        data = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: expected the JSON of an earlier `clsplat bench --json` ({error})") from error
    return data if isinstance(data, dict) else {}


def _one_set_each(arguments: list[str]) -> list[str]:
    """Let `--set a=1 b=2` stand for `--set a=1 --set b=2`."""
    spread: list[str] = []
    for argument in arguments:
        follows = len(spread) >= 2 and spread[-2] == "--set"
        spread += ["--set", argument] if follows and "=" in argument and argument[0] != "-" else [argument]
    return spread


def main() -> None:
    """Run the command line; errors the user can mend end as one line."""
    try:
        app(_one_set_each(sys.argv[1:]), standalone_mode=False)
    except ClsplatError as error:
        if debugging:
            raise
        ERRORS.print(f"error: {error}", markup=False)
        sys.exit(error.exit_code)
    except typer.Abort:
        sys.exit(130)
    except KeyboardInterrupt:
        ERRORS.print("error: stopped at once; --resume goes on from the last checkpoint")
        sys.exit(130)
    except MemoryError:
        ERRORS.print("error: out of memory; use smaller images (scene.downscale) or fewer of them")
        sys.exit(5)
    except Exception as error:  # typer's usage errors carry their own message
        if hasattr(error, "format_message"):
            ERRORS.print(f"error: {error.format_message()}", markup=False)
            sys.exit(2)
        raise
