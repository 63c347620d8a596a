"""What pip installs: the wheel, made from the source distribution, and a checkout in place."""

import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
from pathlib import Path

import pytest

import clsplat
from clsplat.core.resources import _commit, full_version

ROOT = Path(__file__).parents[2]
SOURCES = "git ls-files --cached --others --exclude-standard"
PROBE = """
import importlib.util, clsplat
from clsplat.core.resources import resource_dir
print(clsplat.__version__, resource_dir("cl_kernels").is_dir(), resource_dir("pipelines").is_dir())
print([name for name in ("cl_kernels", "data_tools", "pipelines", "tests") if importlib.util.find_spec(name)])
print(importlib.util.find_spec("clsplat.data_tools.synthetic") is not None)
"""
SCENE = ["--size", "8", "--train", "1", "--test", "1"]


def pythons() -> dict[str, str]:
    """The Pythons of this machine that clsplat is for, by version; the running one first.  None of them is started."""
    actual = {"{}.{}".format(*sys.version_info): sys.executable}
    for python in sorted(Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")).glob("versions/3.*/bin/python")):
        version = python.parts[-3].rpartition(".")[0]
        if int(version.split(".")[1]) >= 11:
            actual.setdefault(version, str(python))
    for version in (f"3.{minor}" for minor in range(11, 20)):
        if python := shutil.which(f"python{version}"):
            actual.setdefault(version, python)
    return actual


RUNNING, *OTHERS = pythons()
WAYS = [(RUNNING, "wheel"), (RUNNING, "editable")]
WAYS += [(version, ("wheel", "editable")[i % 2]) for i, version in enumerate(OTHERS)]


def call(*words: str | Path, path: Path | None = None, cwd: Path | None = None) -> str:
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTHONHOME")}
    if path:
        environment["PYTHONPATH"] = str(path)
    done = subprocess.run([*map(str, words)], capture_output=True, text=True, env=environment, cwd=cwd, timeout=300)
    assert done.returncode == 0, f"{words}: {done.stdout[-2000:]}{done.stderr[-2000:]}"
    return done.stdout


@pytest.fixture(scope="module")
def checkout(tmp_path_factory) -> Path:
    """The files of this checkout without what was built in it."""
    copy = tmp_path_factory.mktemp("checkout")
    for name in subprocess.run(SOURCES.split(), cwd=ROOT, capture_output=True, text=True, check=True).stdout.split(
        "\n"
    ):
        if (ROOT / name).is_file():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, copy / name)
    return copy


@pytest.fixture(scope="module")
def backend(tmp_path_factory) -> Path:
    """The build backend, for all Pythons."""
    folder = tmp_path_factory.mktemp("backend")
    words = [sys.executable, "-m", "pip", "install", "-q", "--retries=0", "--timeout=10", "--target", str(folder)]
    done = subprocess.run([*words, "setuptools>=77"], capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"setuptools cannot be downloaded: {done.stderr.strip().splitlines()[-1]}")
    return folder


@pytest.fixture(scope="module")
def built(checkout, backend, tmp_path_factory) -> Path:
    """The folder of the source distribution, and of the wheel that is made from it."""
    folder = tmp_path_factory.mktemp("dist")
    call(sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, checkout, path=backend)
    return folder


def environment(place: Path, python: str) -> tuple[Path, Path]:
    """The interpreter and the site-packages of a new, empty environment."""
    if subprocess.run([python, "-c", "import venv"], capture_output=True).returncode:
        pytest.skip(f"{python} does not start, or has no venv")
    call(python, "-m", "venv", "--without-pip", place)
    own = place / "bin" / "python"
    return own, Path(call(own, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip())


@pytest.mark.slow
@pytest.mark.parametrize(("version", "way"), WAYS)
def test_wheel_installs_only_clsplat_and_its_commands_run(version, way, built, checkout, backend, tmp_path):
    python, site = environment(tmp_path / "env", pythons()[version])
    what = [next(built.glob("*.whl"))] if way == "wheel" else ["--no-build-isolation", "--editable", checkout]
    pip = [sys.executable, "-m", "pip", "--python", python, "install", "-q", "--no-deps", "--no-index", "--no-compile"]
    call(*pip, *what, path=backend)
    appeared = {path.name.partition("-")[0] for path in site.iterdir()} - {"__pycache__"}
    assert {name for name in appeared if not name.startswith("__editable__")} == {"clsplat"}, appeared
    result = call(python, "-c", PROBE, cwd=tmp_path).splitlines()
    assert result == [f"{clsplat.__version__} True True", "[]", "True"]
    if Path(pythons()[version]) == Path(sys.executable):  # which has what clsplat depends on
        (site / "dependencies.pth").write_text(f"{sysconfig.get_path('purelib')}\n")
        command = tmp_path / "env" / "bin" / "clsplat"
        assert "wrote s" in call(command, "data", "synthetic", "s", *SCENE, cwd=tmp_path)
        if way == "wheel":
            assert call(command, "--version", cwd=tmp_path).startswith(f"clsplat {clsplat.__version__}")
            assert "splat_7k" in call(command, "pipelines", cwd=tmp_path)


@pytest.mark.slow
def test_sdist_contains_docs_examples_and_the_changelog(built):
    with tarfile.open(next(built.glob("*.tar.gz"))) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    for folder in ("docs", "examples", "data_tools", "cl_kernels", "pipelines"):
        listed = subprocess.run(["git", "ls-files", folder], cwd=ROOT, capture_output=True, text=True, check=True)
        assert set(listed.stdout.split()) - names == set()
    assert {"CHANGELOG.md", "LICENSE", "README.md", "RELEASING.md", "pyproject.toml"} <= names
    assert not any(name.startswith("tests/") for name in names)


def test_version_names_the_commit_of_a_clean_checkout(tmp_path):
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b"]
    (tmp_path / "clsplat").mkdir()
    (tmp_path / "clsplat" / "a.py").write_text("a = 1\n")
    assert _commit(tmp_path) == ""
    call(*git, "init", "-q")
    call(*git, "add", ".")
    call(*git, "commit", "-q", "-m", "first")
    assert call(*git, "rev-parse", "HEAD").startswith(_commit(tmp_path))
    assert len(_commit(tmp_path)) >= 7
    (tmp_path / "clsplat" / "b.py").write_text("b = 1\n")
    assert _commit(tmp_path) == "", "a new module is a change"


def test_version_of_changed_code_differs(monkeypatch):
    compute = full_version.__wrapped__
    monkeypatch.setattr("clsplat.core.resources._commit", lambda root: "")
    monkeypatch.setattr("clsplat.core.resources.__version__", "1.0.dev0")
    first = compute()
    assert first.startswith("1.0.dev0+d")
    monkeypatch.setattr("clsplat.core.resources._list_code_files", lambda: ["other"])
    assert compute() not in (first, "1.0.dev0")
    monkeypatch.setattr("clsplat.core.resources.__version__", "1.0")
    assert compute() == "1.0"
