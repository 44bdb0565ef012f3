"""The ./run script's messages and usage, and the lock file, without making an environment."""

import os
import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest


ROOT = Path(__file__).parent.parent
TOOLS = ["awk", "cat", "cmp", "df", "dirname", "head", "ln", "mkdir", "readlink", "rm", "sleep"]

OLD = 'case "$2" in *version_info*) echo 309 ;; *) exit 1 ;; esac'
NO_VENV = 'case "$2" in *version_info*) echo 312 ;; *) exit 1 ;; esac'
NO_NETWORK = """
case "$*" in
    *version_info*) echo 312 ;;
    "-c import ensurepip"*) ;;
    "-m venv "*) mkdir -p "$3/bin" && echo home >"$3/pyvenv.cfg" && cp "$0" "$3/bin/python" ;;
    *) echo "no route to the registry" >&2; exit 1 ;;
esac
"""


@pytest.fixture
def checkout(tmp_path):
    """A copy of what ./run needs, and a PATH with the standard tools and no Python."""
    tree, tools = tmp_path / "check out", tmp_path / "tools"
    tree.mkdir()
    tools.mkdir()
    for name in ["run", "requirements.lock", "pyproject.toml"]:
        shutil.copy(ROOT / name, tree)
    for name in [*TOOLS, "cp", "sh"]:
        (tools / name).symlink_to(shutil.which(name))
    return tree, tools


def stub(folder, name, body):
    path = folder / name
    path.unlink(missing_ok=True)
    path.write_text(f"#!/bin/sh\n{body}\n")
    path.chmod(0o755)


def call(checkout, *args, **options):
    tree, tools = checkout
    env = {"PATH": str(tools), "HOME": str(tree.parent / "home")}
    return subprocess.run(
        [tree / "run", *args], env=env, capture_output=True, text=True, timeout=60, **options
    )


def assert_one_sentence(result, *words):
    assert result.returncode == 2
    last = result.stderr.strip().splitlines()[-1]
    assert last.startswith("run: ")
    for word in words:
        assert word in last


@pytest.mark.parametrize("shell", ["sh", "dash", "bash", "busybox"])
def test_syntax(shell):
    if not shutil.which(shell):
        pytest.skip(f"{shell} is not installed")
    command = [shell, "sh"] if shell == "busybox" else [shell]
    subprocess.run([*command, "-n", ROOT / "run"], check=True)


def test_scripts_are_executable():
    assert os.access(ROOT / "run", os.X_OK)
    assert os.access(ROOT / ".ci" / "run", os.X_OK)


@pytest.mark.parametrize("args", [[], ["help"], ["-h"], ["--help"]])
def test_usage(checkout, args):
    result = call(checkout, *args)
    assert result.returncode == 0
    for verb in ["demo", "test", "check", "marlyap", "python"]:
        assert f"  {verb} " in result.stdout
    assert not (checkout[0] / ".venv").exists()


def test_unknown_verb(checkout):
    assert_one_sentence(call(checkout, "tset"), "no verb 'tset'")


def test_no_python(checkout):
    assert_one_sentence(call(checkout, "demo"), "no python3", "3.11")


def test_python_too_old(checkout):
    stub(checkout[1], "python3", OLD)
    assert_one_sentence(call(checkout, "demo"), "Python 3.9 is too old", "3.11")


def test_newer_python_is_found_beside_an_old_one(checkout):
    stub(checkout[1], "python3", OLD)
    stub(checkout[1], "python3.13", NO_VENV)
    assert_one_sentence(call(checkout, "demo"), "venv")


def test_no_venv_module(checkout):
    stub(checkout[1], "python3", NO_VENV)
    assert_one_sentence(call(checkout, "demo"), "venv module is missing", "python3-venv")


def test_full_disk(checkout):
    stub(checkout[1], "python3", NO_NETWORK)
    stub(checkout[1], "df", "echo header; echo disk 9999999 9000000 204800 98% /")
    assert_one_sentence(call(checkout, "demo"), "1.5 GB", "200 MB")


def test_no_network_then_again(checkout):
    stub(checkout[1], "python3", NO_NETWORK)
    for _ in range(2):
        assert_one_sentence(call(checkout, "demo"), "could not be downloaded", "again")
    assert not (checkout[0] / ".venv" / ".marlyap-stamp").exists()
    assert not (checkout[0] / ".venv" / ".marlyap-lock").is_symlink()


def test_a_foreign_environment_is_not_deleted(checkout):
    venv = checkout[0] / ".venv"
    (venv / "bin").mkdir(parents=True)
    (venv / "pyvenv.cfg").write_text("home = nowhere\n")
    stub(venv / "bin", "python", OLD)
    assert_one_sentence(call(checkout, "demo"), ".venv", "delete")
    assert (venv / "pyvenv.cfg").exists()


def ready(checkout, python="exit 1"):
    """An environment that ./run takes for complete."""
    tree, _ = checkout
    bin = tree / ".venv" / "bin"
    bin.mkdir(parents=True)
    stub(bin, "python", python)
    sources = (tree / "requirements.lock").read_text() + (tree / "pyproject.toml").read_text()
    (tree / ".venv" / ".marlyap-stamp").write_text(f"{tree.resolve()}\n{sources}")


def test_ready_environment_is_used_at_once(checkout, tmp_path):
    ready(checkout, 'pwd; for arg; do echo "<$arg>"; done; exit 7')
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    result = call(checkout, "python", "a b", "*", cwd=elsewhere)
    assert result.returncode == 7
    assert result.stdout.splitlines() == [str(elsewhere), "<a b>", "<*>"]
    result = call(checkout, "demo", "--out", "here", cwd=elsewhere)
    assert result.stdout.splitlines()[1:] == ["<-m>", "<marlyap>", "<demo>", "<--out>", "<here>"]
    result = call(checkout, "marlyap", "train", cwd=elsewhere)
    assert result.stdout.splitlines()[1:] == ["<-m>", "<marlyap>", "<train>"]


@pytest.mark.parametrize("change", ["lock", "project", "half made", "moved"])
def test_stale_environment_is_not_used(checkout, change):
    ready(checkout, "echo used")
    tree, tools = checkout
    if change == "lock":
        (tree / "requirements.lock").open("a").write("# changed\n")
    elif change == "project":
        (tree / "pyproject.toml").open("a").write("# changed\n")
    elif change == "half made":
        (tree / ".venv" / ".marlyap-building").touch()
    else:
        checkout = tree.rename(tree.parent / "moved"), tools
    assert_one_sentence(call(checkout, "python"), "no python3")


def test_lock_of_a_dead_process_is_taken_over(checkout):
    dead = subprocess.Popen(["true"])
    dead.wait()
    (checkout[0] / ".venv").mkdir()
    (checkout[0] / ".venv" / ".marlyap-lock").symlink_to(str(dead.pid))
    assert_one_sentence(call(checkout, "demo"), "no python3")


def test_waits_for_another_run(checkout):
    tree, tools = checkout
    (tree / ".venv").mkdir()
    link = tree / ".venv" / ".marlyap-lock"
    link.symlink_to(str(os.getpid()))
    stub(tools, "sleep", f'rm "{link}"')
    result = call(checkout, "demo")
    assert f"waiting for process {os.getpid()}" in result.stderr
    assert_one_sentence(result, "no python3")


def test_tests_run_from_any_folder(checkout, tmp_path):
    ready(checkout, 'for arg; do echo "<$arg>"; done; echo "$JAX_COMPILATION_CACHE_DIR"')
    tree, _ = checkout
    (tmp_path / "test_mine.py").touch()
    lines = call(checkout, "test", "-k", "fast", cwd=tmp_path).stdout.splitlines()
    assert lines[-2] == f"<{tree}/tests>"
    assert lines[-1] == str(tmp_path / "home" / ".cache" / "marlyap" / "jax")
    lines = call(checkout, "test", "test_mine.py::test_a", cwd=tmp_path).stdout.splitlines()
    assert lines[-6:-1] == ["<-n>", "<2>", "<--dist>", "<loadfile>", "<test_mine.py::test_a>"]


def test_check_stops_at_the_first_failure(checkout):
    ready(checkout, 'case "$*" in *"ruff check"*) exit 1 ;; esac')
    result = call(checkout, "check")
    assert result.returncode == 1
    assert "== lint ==" in result.stdout
    assert "== types ==" not in result.stdout
    assert result.stderr.strip() == "run: check failed at: lint"


def test_check_fast_leaves_the_tests_out(checkout):
    ready(checkout, "exit 0")
    result = call(checkout, "check", "--fast")
    assert result.returncode == 0
    assert "== types ==" in result.stdout
    assert "== tests ==" not in result.stdout


def locked():
    """The lock's requirements, each as its name, version and number of hashes."""
    text = (ROOT / "requirements.lock").read_text().replace("\\\n", " ")
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    found = [re.match(r"([a-z0-9-]+)==([^ ;]+)", line) for line in lines]
    assert all(found)
    return [
        (match[1], match[2], len(re.findall(r"--hash=sha256:[0-9a-f]{64}", line)))
        for match, line in zip(found, lines, strict=True)
    ]


def test_lock_is_hashed_and_names_no_host():
    assert "://" not in (ROOT / "requirements.lock").read_text()
    assert all(hashes > 0 for _, _, hashes in locked())


def project():
    return tomllib.loads((ROOT / "pyproject.toml").read_text())


def declared():
    """Every requirement that the lock is to hold."""
    data = project()
    return (
        data["project"]["dependencies"]
        + data["dependency-groups"]["dev"]
        + data["build-system"]["requires"]
    )


@pytest.mark.parametrize("requirement", declared())
def test_lock_holds_each_requirement(requirement):
    name, minimum = requirement.split(">=")
    versions = [version for locked_name, version, _ in locked() if locked_name == name]
    assert versions

    def key(version):
        return [int(part) for part in version.split(".")]

    assert all(key(version) >= key(minimum) for version in versions)


def test_only_lower_bounds():
    data = project()
    extras = sum(data["project"]["optional-dependencies"].values(), [])
    for requirement in [*declared(), *extras]:
        assert re.fullmatch(r"[a-z0-9-]+>=[0-9.]+", requirement), requirement
    assert data["project"]["requires-python"] == ">=3.11"
