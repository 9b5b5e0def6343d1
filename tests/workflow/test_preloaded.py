"""Scripts that run in copies of a process with imported libraries."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.project import wait_for
from workflow import preloaded

INTERPRETER = Path(preloaded.__file__).parent / "interpreter"
REPORT = """\
import json, os, sys
print(json.dumps([sys.argv, os.getcwd(), os.environ["OWN"], os.getppid(), "xmlrpc" in sys.modules, __name__]))
"""


@pytest.fixture
def server(monkeypatch):
    """A preloaded process, with one small library; it is ended after the test."""
    monkeypatch.setenv(preloaded.VARIABLE, "")
    process = preloaded.start(("xmlrpc",))
    yield process
    process.stdin.close()
    process.wait(10)


@pytest.fixture
def start(tmp_path):
    """Starts a script as Snakemake does."""

    def begin(text, *words, **variables):
        script = tmp_path / ".snakemake" / "scripts" / "job.py"
        script.parent.mkdir(parents=True, exist_ok=True)
        script.write_text(text)
        known = {
            **os.environ,
            "PYTHONPATH": str(INTERPRETER),
            "OWN": "7",
            "OMP_NUM_THREADS": "1",
            **variables,
        }
        return subprocess.Popen(
            [sys.executable, script, *words],
            cwd=tmp_path,
            env=known,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            process_group=0,
        )

    return begin


def test_a_script_finds_its_arguments_folder_environment_and_libraries(server, start, tmp_path):
    output, _ = start(REPORT, "one", "two").communicate(timeout=20)
    script = str(tmp_path / ".snakemake" / "scripts" / "job.py")
    assert json.loads(output) == [[script, "one", "two"], str(tmp_path), "7", server.pid, True, "__main__"]


def test_a_script_without_a_server_runs_as_usual(start):
    output, _ = start(REPORT, **{preloaded.VARIABLE: f"/none:{sys.executable}"}).communicate(timeout=20)
    *_, parent, has_library, name = json.loads(output)
    assert (parent, has_library, name) == (os.getpid(), False, "__main__")


def test_a_server_without_its_libraries_leaves_scripts_alone(monkeypatch, start):
    monkeypatch.setenv(preloaded.VARIABLE, "")
    process = preloaded.start(("no_such_library",))
    output, _ = start(REPORT).communicate(timeout=20)
    assert json.loads(output)[3] == os.getpid()
    assert process.wait(10) == 1


@pytest.mark.parametrize(
    ("text", "status"),
    [
        ("", 0),
        ("import sys; sys.exit(3)", 3),
        ("import sys; sys.exit()", 0),
        ("import sys; sys.exit('bad')", 1),
        ("1 / 0", 1),
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", -signal.SIGSEGV),
    ],
)
def test_the_status_of_a_script_is_that_of_its_copy(server, start, text, status):
    script = start(text)
    _, errors = script.communicate(timeout=20)
    assert script.returncode == status
    assert ("ZeroDivisionError" in errors, "bad\n" in errors) == (text == "1 / 0", "'bad'" in text)


def test_the_end_of_a_copy_is_that_of_a_process(server, start, tmp_path):
    text = """
import atexit, tempfile, threading, time
folder = tempfile.TemporaryDirectory(dir=".")
atexit.register(print, "at exit")
threading.Thread(target=lambda: (time.sleep(0.2), print("thread"))).start()
print("end", end=" ")
"""
    output, _ = start(text).communicate(timeout=20)
    assert output == "end thread\nat exit\n"
    assert [file.name for file in tmp_path.iterdir()] == [".snakemake"]


def test_scripts_run_at_the_same_time(server, start):
    echo = "print(input(), flush=True)"
    first, second = start(echo), start(echo)
    assert second.communicate("2", timeout=20)[0] == "2\n"
    assert first.communicate("1", timeout=20)[0] == "1\n"


def running(process):
    status = Path(f"/proc/{process}/stat")
    return status.exists() and status.read_text().rpartition(")")[2].split()[0] != "Z"


@pytest.mark.parametrize("killed", ["script", "server's Snakemake"])
def test_a_copy_ends_with_its_script_and_with_snakemake(server, start, killed):
    script = start("import os, time; print(os.getpid(), flush=True); time.sleep(60)")
    copy = int(script.stdout.readline())
    assert running(copy) and copy != script.pid
    if killed == "script":
        script.kill()
    else:
        server.stdin.close()
    wait_for(lambda: not running(copy), 10)
    assert script.wait(10) != 0


def test_ctrl_c_reaches_the_copy_once(server, start):
    script = start(
        "import time\ntry:\n    print(flush=True)\n    time.sleep(60)\nexcept KeyboardInterrupt:\n    time.sleep(0.3)\n"
        "    print('interrupted')",
    )
    script.stdout.readline()
    os.killpg(script.pid, signal.SIGINT)
    assert script.communicate(timeout=20)[0] == "interrupted\n"
    assert script.returncode == 0
