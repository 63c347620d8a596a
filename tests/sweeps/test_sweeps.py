"""Sweeps: a matrix with a store, its folder, and the engines that run its cells."""

import json
import os
import re
import shlex
import shutil
import subprocess
from contextlib import suppress
from pathlib import Path
from unittest.mock import ANY

import pytest

from clsplat.api import commands
from clsplat.api import commands as sweeps
from clsplat.core.errors import ClsplatError, ConfigError, DeviceError
from clsplat.pipeline.execution import Execution, Tls, from_options, read_execution
from clsplat.pipeline.recipes import json_schema
from clsplat.runs.state import RunState
from clsplat.sweeps import batch, engines
from clsplat.sweeps import batch as single
from clsplat.sweeps.cell import CellRun, code_digest
from clsplat.sweeps.devices import DeviceSlot
from clsplat.sweeps.engines import Dispatcher, PendingCell
from clsplat.sweeps.experiment import Job
from clsplat.sweeps.status import store_status
from clsplat.sweeps.store import Store
from clsplat.sweeps.task import CellOptions
from tests.support.cells import SPEC, WRITES, command
from tests.support.commands import clsplat
from tests.support.pipelines import STAGES

psutil = pytest.importorskip("psutil", exc_type=ImportError)  # of Dask

SLOT = DeviceSlot("inline", "a device", "b")


@pytest.fixture
def file(tiny_scene: Path, tmp_path: Path) -> Path:
    path = tmp_path / "x.yaml"
    path.write_text(f"name: sweep\nmatrix: {{scenes: ['{tiny_scene}'], seeds: [0, 1]}}\n{STAGES}")
    return path


@pytest.fixture
def execution_file(tmp_path: Path) -> Path:
    path = tmp_path / "on.yaml"
    path.write_text(f"{{engine: inline, store: '{tmp_path / 'store'}'}}\n")
    return path


@pytest.fixture
def runs(few_steps: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """What stands for a run: it takes a finished one, but for the seeds that end otherwise, by `seed: N`."""
    ends: dict[str, str] = {}

    def run_command(device, plugins):
        code = f"import sys, shutil\ntext, ends = open(sys.argv[1]).read(), {ends!r}\n"
        code += "for seed, code in ends.items():\n    if seed in text: sys.exit(code)\n"
        return command(code + f"shutil.copytree({str(few_steps)!r}, sys.argv[2], dirs_exist_ok=True)")

    monkeypatch.setattr(engines, "run_command", run_command)
    monkeypatch.setattr(single, "run_command", run_command)
    for module in (batch, single):
        monkeypatch.setattr(module, "find_slots", lambda worker, devices=None: [SLOT])
    return ends


def test_matrix_folder_is_the_same_with_a_store(file, execution_file, runs, few_steps, tmp_path):
    out = commands.run(file, out=tmp_path / "out", on=execution_file)
    assert sorted(path.name for path in out.iterdir() if path.is_dir()) == ["tiny-seed=0", "tiny-seed=1"]
    assert "sweep: 2 runs" in (out / "compare.html").read_text()
    status = json.loads((out / "status.json").read_text())
    assert (status["state"], status["cells"], status["done"], status["failed"]) == ("done", 2, 2, {})
    model = out / "tiny-seed=0" / "point_cloud.ply"
    assert model.read_bytes() == (few_steps / "point_cloud.ply").read_bytes()
    store = Store(tmp_path / "store")
    (key,) = [key for _, cells in store.sweeps() for name, key in cells.items() if name == "tiny-seed=0"]
    result = store.folder(key).result
    assert os.path.samefile(model, result / "point_cloud.ply")
    assert not os.path.samefile(model.with_name("metrics.jsonl"), result / "metrics.jsonl"), "a run appends to it"
    shutil.rmtree(out / "tiny-seed=1")
    (out / "tiny-seed=0" / "metrics.json").unlink()  # as a kill while it was placed would leave it
    runs["seed"] = "it is not run again"
    assert commands.resume(out, on=execution_file) == out
    for cell in ("tiny-seed=0", "tiny-seed=1"):
        assert (out / cell / "metrics.json").is_file()
    assert [event["event"] for event in store.events()].count("start") == 2


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_job_array_tasks_run_the_cells_of_a_matrix(file, runs, tmp_path):
    """With a stand-in for sbatch, which runs the tasks in turn, and one for the command, which notes its arguments."""
    programs, calls, store = tmp_path / "bin", tmp_path / "calls", tmp_path / "store"
    programs.mkdir()
    tasks = """range=${1#--array=}; shift
        for task in $(seq "${range%-*}" "${range#*-}"); do SLURM_ARRAY_TASK_ID=$task bash "$@" || exit; done"""
    for name, text in {"sbatch": tasks, "clsplat": f'echo "$@" >> {shlex.quote(str(calls))}'}.items():
        (programs / name).write_text(f"#!/bin/sh\n{text}\n")
        (programs / name).chmod(0o755)
    script = Path(__file__).parents[2] / "examples" / "deploy" / "array.sh"
    path = {**os.environ, "PATH": f"{programs}:{os.environ['PATH']}"}
    subprocess.run([programs / "sbatch", "--array=0-1", script, file, store], env=path, timeout=60, check=True)
    for line in calls.read_text().splitlines():
        clsplat(*line.split())
    assert [cell["state"] for cell in store_status(store)["cells"]] == ["published"] * 2


def test_run_continued_in_a_matrix_folder_is_no_cell(file, execution_file, runs, few_steps, tmp_path):
    out = commands.run(file, out=tmp_path / "out", on=execution_file)
    first = out / "tiny-seed=0"
    model, expected = first / "point_cloud.ply", (few_steps / "point_cloud.ply").read_bytes()
    model.unlink()
    model.write_bytes(b"another")
    commands.run(file, out=out, start="resume", on=execution_file)
    assert model.read_bytes() == expected
    pipeline = first / "pipeline.yaml"
    pipeline.unlink()
    pipeline.write_text((few_steps / "pipeline.yaml").read_text() + "# trained for longer\n")
    (first / "checkpoints" / "step_000020.npz").write_bytes(b"later")
    with pytest.raises(
        ClsplatError, match=r"seed=0: the run was continued with other settings .*; move that folder"
    ) as error:
        commands.run(file, out=out, start="resume", on=execution_file)
    assert error.value.exit_code == 2
    assert "# trained" in pipeline.read_text(), "it stays"
    commands.run(file, out=out, start="restart", on=execution_file)
    assert pipeline.read_bytes() == (few_steps / "pipeline.yaml").read_bytes()
    assert not (first / "checkpoints" / "step_000020.npz").exists()


def test_failing_cell_keeps_the_others_and_sets_the_exit_code(file, execution_file, runs, tmp_path):
    runs["seed: 1"] = 3
    with pytest.raises(ClsplatError, match=r"1 of 2 cells failed; the first, tiny-seed=1: .* exit code 3") as error:
        commands.run(file, out=tmp_path / "out", on=execution_file)
    assert error.value.exit_code == 3
    assert "tiny-seed=1 failed and is not shown" in (tmp_path / "out" / "compare.html").read_text()
    assert commands.status(tmp_path / "store")["counts"] == {"failed": 1, "published": 1}


def test_unreadable_scene_fails_only_its_cells(file, execution_file, runs, tmp_path):
    (tmp_path / "empty").mkdir()
    file.write_text(file.read_text().replace("scenes: [", f"scenes: ['{tmp_path / 'empty'}', "))
    with pytest.raises(ClsplatError, match=r"2 of 4 cells failed; the first, empty-seed=0: ") as error:
        commands.run(file, out=tmp_path / "out", on=execution_file)
    assert error.value.exit_code == 3
    assert json.loads((tmp_path / "out" / "status.json").read_text())["done"] == 4
    assert commands.status(tmp_path / "store")["counts"] == {"published": 2}


def test_cell_command_runs_a_cell_by_number(file, runs, tmp_path):
    result = sweeps.run_cell(file, tmp_path / "store", index=1)
    assert sweeps.run_cell(file, tmp_path / "store", index=1) == result
    spec = json.loads((result.parent / "spec.json").read_text())
    assert (spec["pipeline"]["seed"], spec["bits"]) == (1, "b")
    with pytest.raises(ConfigError, match="--index 0 to 1"):
        sweeps.run_cell(file, tmp_path / "store")
    runs["seed: 0"] = 6
    with pytest.raises(ClsplatError, match="cell tiny-seed=0: its process ended with exit code 6") as error:
        sweeps.run_cell(file, tmp_path / "store", index=0)
    assert error.value.exit_code == 6


def test_on_option_replaces_the_execution_of_a_file(file, tmp_path):
    execution_file = tmp_path / "lab.yaml"
    file.write_text(f"execution: {{engine: local}}\n{file.read_text()}")
    job = Job.open(str(file), out=tmp_path / "out")
    assert job.work.execution.store_folder(job.out) == tmp_path / "out" / "store", "a store is in the run folder"
    execution_file.write_text("{engine: 'dask://far:1', insecure: true, store: away, retries: 4}\n")
    job = Job.open(str(file), out=tmp_path / "out", execution=read_execution(execution_file))
    assert (job.work.execution.engine, job.work.execution.store) == ("dask://far:1", "away")
    assert not {"execution", "far", "away", "insecure"} & set(re.findall(r"\w+", job.work.text))
    with pytest.raises(ConfigError, match="--on is for a file with `matrix:`"):
        Job.open("smoke", execution=read_execution(execution_file))


def test_sweep_resumes_only_in_its_first_store(file, execution_file, runs, tmp_path):
    out = tmp_path / "out"
    runs["seed: 1"] = 6
    with pytest.raises(ClsplatError, match="1 of 2 cells failed"):
        commands.run(file, out=out, on=execution_file)
    with pytest.raises(ConfigError, match=r"out: was started with --on; its cells are in .*store; pass --on again"):
        commands.resume(out)


def test_existing_result_is_not_run_again(file, execution_file, runs, tmp_path, monkeypatch):
    monkeypatch.setattr(RunState, "is_complete", lambda state, pipeline: state.out.name == "tiny-seed=0")
    out = commands.run(file, out=tmp_path / "out", on=execution_file)
    shutil.rmtree(tmp_path / "store")
    shutil.rmtree(out / "tiny-seed=1")
    commands.resume(out, on=execution_file)
    assert [cell["name"] for cell in store_status(tmp_path / "store")["cells"]] == ["tiny-seed=1"]
    assert json.loads((out / "status.json").read_text())["done"] == 2


def test_cells_run_unchanged_without_a_store(file, tmp_path, monkeypatch):
    ran = []
    monkeypatch.setattr(Job, "run", lambda job, *options: ran.append(options))
    execution_file = tmp_path / "lab.yaml"
    execution_file.write_text("engine: inline\n")
    commands.run(file, out=tmp_path / "out", on=execution_file)
    assert ran == [(None, None, None)]


ONLY_ON = "a pipeline file may not set this; set it in a file for --on"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("engin: local", "engin: unknown key 'engin'"),
        ("retries: 0", "retries: expected a value of at least 1"),
        ("retries: 2", "retries has no effect with engine inline: it needs a store"),
        ("placement: {bits: any}", "placement has no effect with engine inline: it needs a store"),
        ("devices: [pocl]", "devices has no effect with engine inline: it needs a store"),
        ("store: ../elsewhere", f"execution.store: {ONLY_ON}"),
        ("insecure: true", f"execution.insecure: {ONLY_ON}"),
        ("tls: {ca: a, cert: b, key: c}", f"execution.tls: {ONLY_ON}"),
        ("engine: 'dask://127.0.0.1:1'", "execution.engine: expected inline or local; .* for --on, got 'dask://127"),
    ],
)
def test_invalid_execution_is_refused_with_its_line(tmp_path, text, words):
    file = tmp_path / "x.yaml"
    file.write_text(f"name: a\nmatrix: {{seeds: [0]}}\nexecution:\n  {text}\n{STAGES}")
    for call in (commands.check, commands.run):
        with pytest.raises(ConfigError, match=rf"x.yaml:[34]: .*{words}"):
            call(file)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("engin: local", "engin: unknown key 'engin'"),
        ("store: ''", "store: expected the path of a folder, got ''"),
        (
            "engine: local, tls: {ca: a, cert: b, key: c}",
            "tls has no effect with engine local: it applies only to engine tls://",
        ),
        (
            "engine: local, insecure: true",
            "insecure has no effect with engine local: it applies only to engine dask://",
        ),
        (
            "engine: dask://127.0.0.1:1, devices: [a]",
            "devices has no effect with engine dask://127.0.0.1:1: the workers",
        ),
        ("engine: dask://far:1", "expected tls:// for another machine, or insecure: true"),
        ("engine: tls://far:1", "tls://far:1: expected tls: "),
        ("engine: ray", "engine: expected inline, local, or the address of a scheduler"),
        ("engine: dask://h:99999", "engine: expected inline, local, or the address of a scheduler"),
    ],
)
def test_invalid_file_for_on_is_refused_with_its_line(tmp_path, text, words):
    execution_file = tmp_path / "lab.yaml"
    execution_file.write_text(f"{{{text}}}\n")
    with pytest.raises(ConfigError, match=f"lab.yaml:1: .*{words}"):
        read_execution(execution_file)


def test_schema_has_the_execution_keys():
    assert json_schema()["properties"]["execution"] == {"$ref": "#/$defs/LocalExecution"}
    assert {"LocalExecution", "Placement"} <= json_schema()["$defs"].keys()


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"engine": "dask://far:1"}, r"expected tls:// for another machine, or insecure: true \(--insecure\)"),
        ({"engine": "tls://far:1"}, r"\(--tls-ca, --tls-cert, and --tls-key\)"),
        ({"engine": "tls://far:1", "tls": {"ca": "a", "key": "b"}}, "^--tls-cert: 'cert' is missing"),
        ({"engine": "tcp://10.0.0.1:8786"}, r"^--scheduler: .*dask://HOST:PORT \(tcp:// in Dask\)"),
    ],
)
def test_invalid_worker_option_is_named(given, words):
    with pytest.raises(ConfigError, match=words):
        from_options(given)


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Tls:
    """A self-signed certificate."""
    folder = tmp_path_factory.mktemp("tls")
    if not (openssl := shutil.which("openssl")):
        pytest.skip("needs openssl")
    curve = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1"]
    words = ["req", "-x509", *curve, "-days", "2", "-subj", "/CN=localhost"]
    for name, locked in {"a": ["-nodes"], "b": ["-passout", "pass:word"]}.items():
        files = ["-keyout", f"{folder}/{name}.key", "-out", f"{folder}/{name}.pem"]
        subprocess.run([openssl, *words, *locked, *files], check=True, capture_output=True)
    (folder / "no.pem").write_text("no certificate")
    return Tls(ca=f"{folder}/a.pem", cert=f"{folder}/a.pem", key=f"{folder}/a.key")


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"ca": "gone.pem"}, r"tls.ca \(--tls-ca\): .*gone.pem: .*No such file"),
        ({"key": "gone.pem"}, r"tls.key \(--tls-key\): .*gone.pem: .*No such file"),
        ({"ca": "no.pem"}, r"tls.ca \(--tls-ca\): .*no.pem: expected a certificate in PEM"),
        ({"cert": "b.pem"}, r"b.pem, .*a.key: expected .* \(KEY_VALUES_MISMATCH\)"),
        ({"cert": "b.pem", "key": "b.key"}, "b.pem, .*b.key: expected .*, without a password"),
    ],
)
def test_unusable_certificates_are_named(authority, changed, words):
    library = pytest.importorskip("clsplat.sweeps.dask")
    folder = Path(authority.ca).parent
    assert library.make_security(authority).require_encryption
    with pytest.raises(ConfigError, match=words):
        library.make_security(authority.model_copy(update={key: str(folder / name) for key, name in changed.items()}))


def test_worker_checks_certificates_before_it_checks_a_device(authority, monkeypatch):
    pytest.importorskip("clsplat.sweeps.dask")
    monkeypatch.setattr("clsplat.sweeps.dask.find_slots", lambda *words: pytest.fail("a device is proved"))
    with pytest.raises(ConfigError, match=r"tls.ca \(--tls-ca\): gone.pem"):
        sweeps.run_worker("tls://127.0.0.1:1", tls=("gone.pem", authority.cert, authority.key))


def test_device_is_not_chosen_for_a_scheduler(file, tmp_path):
    execution_file = tmp_path / "lab.yaml"
    execution_file.write_text("engine: dask://127.0.0.1:1\n")
    with pytest.raises(ConfigError, match="--device: with a scheduler, workers choose the devices"):
        commands.run(file, out=tmp_path / "out", on=execution_file, device="pocl")


def test_local_scheduler_needs_no_tls():
    for address in ("dask://127.0.0.1:1", "dask://localhost:1"):
        assert Execution(engine=address).is_local


class FakeClient:
    """The client of a scheduler, with workers by their addresses."""

    def __init__(self, **workers: str) -> None:
        """workers: the version of the program of each."""
        self.status = "running"
        told = {name: {"metrics": {"clsplat": self.told(code)}} for name, code in workers.items()}
        self.info = {"workers": told}

    @staticmethod
    def told(code: str) -> str:
        return json.dumps({"host": "h", "device": "d", "bits": "b", "memory": 8, "code": code})

    def scheduler_info(self, n_workers):
        return self.info

    def submit(self, *words, **options):
        raise RuntimeError("the client is closed")


def test_sweep_ends_if_all_workers_have_another_version(tmp_path, monkeypatch):
    scheduler = pytest.importorskip("clsplat.sweeps.dask")
    monkeypatch.setattr(scheduler, "NO_DEVICE_TIMEOUT_S", -1.0)
    with pytest.raises(DeviceError, match=r"no worker of this version has been connected \(1 of another version get"):
        scheduler.Cluster(FakeClient(old="another"), Store(tmp_path)).slots()


@pytest.mark.parametrize("starter", ["nobody", "this machine"])
def test_cell_stays_with_the_worker_of_its_device(tmp_path, monkeypatch, starter):
    scheduler = pytest.importorskip("clsplat.sweeps.dask")
    client, sent = FakeClient(), []
    monkeypatch.setattr(client, "submit", lambda *words, **options: sent.append(options["workers"]))
    actual, starts = [SLOT] if starter == "this machine" else None, starter != "nobody"
    scheduler.Cluster(client, Store(tmp_path), object() if starts else None, actual).start(
        CellRun("a", SPEC, ""), SLOT, CellOptions(0.0)
    )
    assert sent == [None if actual else [SLOT.worker]], "the workers of this machine have the same devices"


def test_lost_worker_gets_no_cell(tmp_path):
    scheduler = pytest.importorskip("clsplat.sweeps.dask")
    client = FakeClient(one=code_digest())
    cluster = scheduler.Cluster(client, Store(tmp_path))
    assert [slot.worker for slot in cluster.slots()] == ["one"]
    client.info = {"workers": {}}
    cluster._last_check = -scheduler.WORKERS_INTERVAL_S
    assert cluster.slots() == []


def test_stopped_scheduler_is_reported_with_a_remedy(tmp_path):
    scheduler = pytest.importorskip("clsplat.sweeps.dask")
    client = FakeClient()
    cluster = scheduler.Cluster(client, Store(tmp_path))
    client.info, client.status = {}, "closed"
    for call in (cluster.slots, lambda: cluster.start(CellRun("a", SPEC, ""), SLOT, CellOptions(0.0))):
        with pytest.raises(DeviceError, match=r"the scheduler exited; .* with --resume"):
            call()


def listening() -> set[str]:
    """The addresses on which this process and those that it has started listen."""
    this, results = psutil.Process(), []
    for process in (this, *this.children(recursive=True)):
        with suppress(psutil.NoSuchProcess):  # it has ended
            results += process.net_connections("inet")
    return {item.laddr.ip for item in results if item.status == psutil.CONN_LISTEN}


def test_local_engine_runs_cells_in_parallel_on_loopback(tmp_path, monkeypatch):
    scheduler = pytest.importorskip("clsplat.sweeps.dask")
    library = pytest.importorskip("clsplat.sweeps.dask")
    slots = [DeviceSlot("local", "one", "b"), DeviceSlot("local", "two", "b")]
    monkeypatch.setattr(scheduler, "find_slots", lambda worker, devices, packing: slots)
    store, ended, seen = Store(tmp_path / "store"), [], set()
    before = {key: library.dask.config.get(key) for key in library.SETTINGS}
    cluster = scheduler.open_engine(Execution(engine="local"), store, None)
    try:
        cluster.make_command = lambda device: command(WRITES + f"; print({device!r})")
        cells = [PendingCell(CellRun(f"cell {i}", {**SPEC, "scene": str(i)}, ""), i) for i in range(4)]
        drive = Dispatcher(store, cluster, True, CellOptions(store.now()), on_end=lambda *end: ended.append(end))
        drive.poll = lambda: seen.update(listening())
        drive.run(cells)
    finally:
        cluster.close()
    assert {cell.name: outcome.state for cell, outcome in ended} == {f"cell {i}": "published" for i in range(4)}
    assert seen == {"127.0.0.1"}
    assert {key: library.dask.config.get(key) for key in before} == before, "what this process had set"
    assert len({event["worker"] for event in store.events() if event["event"] == "start"}) == 1


def test_only_the_cell_with_a_changed_spec_fails(file, execution_file, runs, tmp_path):
    commands.run(file, out=tmp_path / "out", on=execution_file)
    store = Store(tmp_path / "store")
    (key,) = [cells["tiny-seed=1"] for _, cells in store.sweeps()]
    (store.folder(key).path / "spec.json").write_text("{}")
    runs["seed"] = "no cell is run again"
    with pytest.raises(ClsplatError, match=r"1 of 2 cells failed; the first, tiny-seed=1: .*remove .* to run it again"):
        commands.run(file, out=tmp_path / "out", start="resume", on=execution_file)


def test_damaged_store_records_do_not_stop_status(file, execution_file, runs, tmp_path):
    commands.run(file, out=tmp_path / "out", on=execution_file)
    store = Store(tmp_path / "store")
    before = store_status(store.root)
    (store.root / "events" / "x.jsonl").write_text('3\n[1]\n{"time": "x"}\n{"time": null}\n{"ti')
    (store.root / "events" / "y.jsonl").mkdir()
    assert store_status(store.root) == {**before, "time": ANY}
    for damage in ("[1]", '{"pipeline": 3}'):
        for folder in store.folders():
            (folder.path / "spec.json").write_text(damage)
        assert store_status(store.root)["counts"] == before["counts"]


def test_cell_number_is_refused_for_a_single_pipeline(runs, tmp_path):
    with pytest.raises(ConfigError, match="remove --index"):
        single.run_one("smoke", tmp_path / "store", index=1)
