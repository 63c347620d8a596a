"""Files for deployment: the container file, the service, the jobs, and their page."""

import fnmatch
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from ruamel.yaml import YAML

import clsplat
from clsplat.core.errors import ClsplatError

ROOT = Path(__file__).parents[2]
FILE = ROOT / "docker" / "Dockerfile"
PAGE = (ROOT / "docs" / "deploy.md").read_text("utf-8")
UNIT = (ROOT / "examples" / "deploy" / "clsplat@.service").read_text("utf-8")
JOB = YAML(typ="safe").load(ROOT / "examples" / "deploy" / "job.yaml")
NOT_AGAIN = [2, 3, 6]


def steps() -> list[tuple[str, str]]:
    """The instructions of the container file, each with what follows it, continued lines joined."""
    text = re.sub(r"\\\n(\s*#.*\n)*", " ", FILE.read_text("utf-8"))
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    return [(line.split(maxsplit=1)[0], line.split(maxsplit=1)[1]) for line in lines]


def copied() -> list[str]:
    """The paths of this repository that the container file copies."""
    actual = [shlex.split(rest) for name, rest in steps() if name == "COPY" and "--from" not in rest]
    return [path for words in actual for path in words[:-1]]


def test_containerfile_copies_existing_files_for_the_wheel():
    assert [path for path in copied() if not (ROOT / path).exists()] == []
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    folders = {name.split(".")[0] for name in project["tool"]["setuptools"]["packages"]}
    folders |= set(project["tool"]["setuptools"]["package-dir"].values())
    assert folders | {"pyproject.toml", project["project"]["readme"], "LICENSE"} == set(copied())


def test_copied_files_are_not_ignored():
    rules = (FILE.parent / f"{FILE.name}.dockerignore").read_text("utf-8").split()
    assert rules[0] == "*"
    kept = [rule[1:] for rule in rules if rule.startswith("!")]
    assert [path for path in copied() if not any(fnmatch.fnmatch(path, rule) for rule in kept)] == []


def test_container_runs_without_root_and_leaves_no_lists():
    last = max(i for i, (name, _) in enumerate(steps()) if name == "FROM")
    users = [rest for name, rest in steps()[last:] if name == "USER"]
    assert users
    assert "root" not in users[-1]
    assert int(users[-1].split(":")[0]) > 0, "a number, so that Kubernetes can see that it is not root"
    for name, rest in steps():
        assert name in {"ARG", "FROM", "RUN", "WORKDIR", "COPY", "ENV", "USER", "STOPSIGNAL", "ENTRYPOINT", "CMD"}
        if "apt-get install" in rest:
            assert "--no-install-recommends" in rest
            assert "rm -rf /var/lib/apt/lists/*" in rest
    entry = dict(steps())["ENTRYPOINT"]
    assert entry == '["clsplat"]', "a list: signals reach the program"


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
def test_systemd_accepts_the_service(tmp_path):
    unit = tmp_path / "clsplat@lego.service"
    unit.write_text(UNIT.replace("/opt/clsplat/bin/clsplat", sys.executable))
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(unit)], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    assert unit.name not in done.stderr


def test_service_and_job_retry_only_useful_exit_codes():
    codes = {ClsplatError.exit_code, *(kind.exit_code for kind in ClsplatError.__subclasses__())}
    assert set(NOT_AGAIN) < codes
    assert f"RestartPreventExitStatus={' '.join(map(str, NOT_AGAIN))}\n" in UNIT
    assert "SuccessExitStatus=130\n" in UNIT
    assert "Restart=on-failure\n" in UNIT
    spec = JOB["spec"]
    rules = spec["podFailurePolicy"]["rules"]
    assert [rule["onExitCodes"]["values"] for rule in rules if rule["action"] == "FailJob"] == [NOT_AGAIN]
    assert spec["template"]["spec"]["restartPolicy"] == "Never", "what a podFailurePolicy asks for"
    for code in sorted(codes):
        row = re.search(rf"^\| {code} \| .* \| (.*?) *\|$", PAGE, re.M)
        assert row, f"docs/deploy.md has no row for exit code {code}"
        assert row[1].startswith("no") == (code in NOT_AGAIN)


def test_job_uses_this_image():
    pod = JOB["spec"]["template"]["spec"]
    (container,) = pod["containers"]
    assert (JOB["apiVersion"], JOB["kind"]) == ("batch/v1", "Job")
    assert container["image"] == f"clsplat:{clsplat.__version__}"
    (policy,) = [rule["onExitCodes"] for rule in JOB["spec"]["podFailurePolicy"]["rules"] if "onExitCodes" in rule]
    assert policy["containerName"] == container["name"]
    user = int(next(rest for name, rest in reversed(steps()) if name == "USER").split(":")[0])
    assert pod["securityContext"]["runAsUser"] == user
    assert container["securityContext"]["readOnlyRootFilesystem"]
    mounts = {mount["name"]: mount["mountPath"] for mount in container["volumeMounts"]}
    assert {volume["name"] for volume in pod["volumes"]} == set(mounts)
    assert {"/cache", "/runs"} <= set(mounts.values())
    out = container["args"][container["args"].index("--out") + 1]
    assert f"{out}/status.json" in container["livenessProbe"]["exec"]["command"][-1]
    for arguments in (container["args"], shlex.split(re.search(r"^ExecStart=\S+ (.*)$", UNIT, re.M)[1])):
        assert arguments[0] == "run"
        assert "--resume" in arguments


def test_probe_detects_a_heartbeat_and_its_end(tmp_path):
    """The command of the job, on a file that was written now, and on one that is ten minutes old."""
    probe = JOB["spec"]["template"]["spec"]["containers"][0]["livenessProbe"]["exec"]["command"]
    file = tmp_path / "status.json"
    command = [part.replace("/runs/lego/status.json", str(file)) for part in probe]
    assert subprocess.run(command, stderr=subprocess.DEVNULL, check=False).returncode != 0
    file.touch()
    assert subprocess.run(command, check=False).returncode == 0
    subprocess.run(["touch", "-d", "10 minutes ago", str(file)], check=True)
    assert subprocess.run(command, check=False).returncode != 0


def test_page_explains_every_key_of_the_status():
    table = PAGE[PAGE.index("## status.json") : PAGE.index("**Is the run alive?**")]
    named = set(
        re.findall(r"`(\w+)`", " ".join(line.split("|")[1] for line in table.splitlines() if line[:3] == "| `"))
    )
    assert named == set(clsplat.status_schema()["properties"])
    states = clsplat.status_schema()["properties"]["state"]["enum"]
    assert [state for state in states if f"`{state}`" not in table] == []
