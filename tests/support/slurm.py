"""A real SLURM on this machine, for as long as a command runs:

    python tests/support/slurm.py --gpus 1 -- bash          # then: sinfo, sbatch, snakemake --workflow-profile ...

munged, slurmctld and slurmd run with their own key, configuration, sockets and states in a temporary folder.
They listen on the loopback interface only, on free ports, as whoever starts them (root in a container will do); nothing
of an installed SLURM's configuration is read or changed. There are no cgroups and there is no accounting database: what
a job may use is still enforced, memory by checks of its processes (``OverMemoryKill``) and time by the controller.
GPUs are empty files: jobs ask and wait for them, and find none.
"""

import argparse
import getpass
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "srun", "squeue", "scontrol", "scancel")
SBIN = "/usr/local/sbin:/usr/sbin:/sbin"  # not everybody has them on the path
NODE = "here"

CONFIGURATION = """\
ClusterName=neuma
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
CommunicationParameters=NoCtldInAddrAny,NoInAddrAny
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
MpiDefault=none
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
SchedulerParameters=batch_sched_delay=0,sched_interval=1,sched_min_interval=0
SlurmdParameters=config_overrides
ReturnToService=2
KillWait=5
MinJobAge={min_job_age}
AccountingStorageType=accounting_storage/none
JobAcctGatherType=jobacct_gather/linux
JobAcctGatherFrequency=1
JobAcctGatherParams=OverMemoryKill
JobCompType=jobcomp/filetxt
JobCompLoc={folder}/completed.txt
GresTypes=gpu
NodeName={node} NodeHostname={host} NodeAddr=127.0.0.1 CPUs={cores} RealMemory={memory}{gres}
PartitionName=all Nodes={node} Default=YES MaxTime=INFINITE State=UP
"""


class Cluster:
    """A running SLURM; made by `cluster`.

    Attributes:
        folder: where configuration, logs (``slurmctld.log``, ``slurmd.log``) and states lie.
        environment: variables of processes that are to see this SLURM.
    """

    def __init__(self, folder: Path, environment: dict[str, str]):
        self.folder, self.environment = folder, environment

    def ask(self, *words: str) -> str:
        """Output of a command of SLURM."""
        done = subprocess.run(words, env=self.environment, capture_output=True, text=True, timeout=60)
        if done.returncode:
            raise RuntimeError(f"{' '.join(words)}: {done.stderr.strip() or done.stdout.strip()}")
        return done.stdout

    def completed(self) -> list[dict[str, str]]:
        """Ended jobs in the order of their ends, as SLURM's completion log has them: JobId, JobState, Limit, ..."""
        log = self.folder / "completed.txt"
        lines = log.read_text().splitlines() if log.exists() else []
        return [dict(word.split("=", 1) for word in line.split() if "=" in word) for line in lines]


def missing() -> str | None:
    """What to do if SLURM is not installed; None if it is."""
    absent = [name for name in PROGRAMS if not shutil.which(name, path=_path())]
    return f"no {', '.join(absent)}: apt-get install slurm-wlm munge (Debian, Ubuntu)" if absent else None


@contextmanager
def cluster(
    cores: int | None = None, memory: int | None = None, gpus: int = 0, min_job_age: int = 300
) -> Iterator[Cluster]:
    """Start SLURM with one node, and stop it with all its jobs at the end.

    Args:
        cores: how many the node offers, whether or not it has them; all of this machine's by default.
        memory: MB that the node offers; all of this machine's by default.
        gpus: how many empty files the node offers as GPUs.
        min_job_age: seconds for which the controller remembers ended jobs.

    Raises:
        RuntimeError: SLURM is not installed, or a daemon did not start; names it, with the end of its log.
    """
    if problem := missing():
        raise RuntimeError(problem)
    with ExitStack() as stack:
        folder = Path(tempfile.mkdtemp(prefix="neuma-slurm-"))
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        running = Cluster(folder, _environment(folder))
        _configure(folder, cores, memory, gpus, min_job_age)
        for ready, *command in (
            (lambda: (folder / "munge.socket").is_socket(), "munged", *_munge(folder)),
            (lambda: "UP" in running.ask("scontrol", "ping"), "slurmctld", "-D"),
            (lambda: running.ask("sinfo", "-h", "-o", "%T").strip() == "idle", "slurmd", "-D", "-N", NODE),
        ):
            _wait(ready, _start(stack, running, *command), running)
        stack.callback(_cancel_all, running)
        yield running


def _path() -> str:
    return f"{os.environ.get('PATH', os.defpath)}:{SBIN}"


def _environment(folder: Path) -> dict[str, str]:
    """This process's environment with the paths of the cluster in `folder`.

    The executor's jobs clear variables of SLURM before they call srun, which then would look for its configuration in
    /etc: a script of its name, first on the path, restores the variable.
    """
    shim = folder / "bin" / "srun"
    shim.parent.mkdir()
    srun = shutil.which("srun", path=_path())
    shim.write_text(f'#!/bin/sh\nSLURM_CONF={folder}/slurm.conf exec {srun} "$@"\n')
    shim.chmod(0o755)
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("SLURM_", "SBATCH_"))}
    return {**kept, "SLURM_CONF": f"{folder}/slurm.conf", "PATH": f"{shim.parent}:{_path()}"}


def _configure(folder: Path, cores: int | None, memory: int | None, gpus: int, min_job_age: int) -> None:
    for name in ("state", "spool"):
        (folder / name).mkdir()
    installed = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2**20
    text = CONFIGURATION.format(
        folder=folder,
        host=socket.gethostname().split(".")[0],
        user=getpass.getuser(),
        ports=_free_ports(2),
        node=NODE,
        cores=cores or len(os.sched_getaffinity(0)),
        memory=memory or installed,
        gres=f" Gres=gpu:{gpus}" if gpus else "",
        min_job_age=min_job_age,
    )
    (folder / "slurm.conf").write_text(text)
    devices = [folder / f"gpu{number}" for number in range(gpus)]
    for device in devices:
        device.touch()
    lines = [f"NodeName={NODE} Name=gpu File={device}\n" for device in devices]
    (folder / "gres.conf").write_text("".join(lines))
    key = folder / "munge.key"
    key.write_bytes(secrets.token_bytes(128))
    key.chmod(0o600)


def _munge(folder: Path) -> list[str]:
    files = {"key-file": "key", "socket": "socket", "pid-file": "pid", "log-file": "log", "seed-file": "seed"}
    # --force: the folder of the socket need not be one that everybody can enter.
    return ["--foreground", "--force", *(f"--{option}={folder}/munge.{end}" for option, end in files.items())]


def _free_ports(count: int) -> list[int]:
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for each in sockets:
            each.bind(("127.0.0.1", 0))
        return [each.getsockname()[1] for each in sockets]


def _start(stack: ExitStack, running: Cluster, name: str, *words: str) -> subprocess.Popen:
    """Start a daemon that ends with `stack`."""
    with open(running.folder / f"{name}.out", "w") as out:
        daemon = subprocess.Popen(
            [shutil.which(name, path=_path()), *words],
            env=running.environment,
            stdout=out,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    stack.callback(_stop, daemon)
    return daemon


def _stop(daemon: subprocess.Popen) -> None:
    daemon.terminate()
    try:
        daemon.wait(15)
    except subprocess.TimeoutExpired:
        daemon.kill()
        daemon.wait()


def _wait(
    ready: Callable[[], bool], daemon: subprocess.Popen, running: Cluster, seconds: float = 30.0
) -> None:
    """Wait until a daemon is at work."""
    end = time.monotonic() + seconds
    while daemon.poll() is None and time.monotonic() < end:
        with suppress(RuntimeError):
            if ready():
                return
        time.sleep(0.2)
    logs = "".join(log.read_text() for log in sorted(running.folder.glob("*.out")))
    raise RuntimeError(f"{Path(daemon.args[0]).name} did not start; SLURM's daemons logged:\n{logs[-3000:]}")


def _cancel_all(running: Cluster) -> None:
    running.ask("scancel", "--quiet", "--user", getpass.getuser())
    end = time.monotonic() + 30
    while running.ask("squeue", "-h") and time.monotonic() < end:
        time.sleep(0.5)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cores", type=int, help="cores that the node offers (default: this machine's)")
    parser.add_argument("--memory", type=int, help="MB that the node offers (default: this machine's)")
    parser.add_argument("--gpus", type=int, default=0, help="empty files that the node offers as GPUs")
    parser.add_argument("command", nargs="+", help="what to run, after --")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that the daemons are stopped then too
    try:
        with cluster(options.cores, options.memory, options.gpus) as running:
            return subprocess.run(options.command, env=running.environment).returncode
    except RuntimeError as error:
        print(error, file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
