"""Defaults of rules with a script. A rule may override each of them.

log, benchmark  <results>/{logs,benchmarks}/<one folder for each wildcard>/<rule>.{log,tsv}
conda           the locked environment, for `--sdm conda` (not tried)
params.code     digest of the script, of the library modules behind it, and of own laws that other parameters name: an
                edit there reruns the rule
resources       `RESOURCES`, and one thread (Snakemake's own default)
"""

import os
import shutil
from collections.abc import Callable, Collection
from importlib.metadata import version
from pathlib import Path

from neuma_lib.mechanics.catalogue import DEFINED_IN
from workflow.provenance import code_digest, digest_of_files, law_files

RESOURCES = {"gpu": 0, "mem_mb": 4000, "runtime": 60}  # GPUs, MB, minutes
CONDA = "../../envs/conda.yaml"  # relative to the files of the rules


def has_gpu() -> bool:
    """Whether an NVIDIA driver is there and `CUDA_VISIBLE_DEVICES` does not hide all devices. Blender can use them."""
    return shutil.which("nvidia-smi") is not None and os.environ.get("CUDA_VISIBLE_DEVICES") not in ("", "-1")


def torch_has_gpu() -> bool:
    """Whether torch can probably use a GPU: its build has CUDA, too. `torch.cuda.is_available` is exact, but the import
    takes seconds.
    """
    return has_gpu() and not version("torch").endswith("+cpu")


def complete(workflow, results: str, known: Collection[str] = ()) -> None:
    """Complete every rule of a workflow. Call it when all rules are known.

    `snakemake.workflow.Workflow.rule` makes a rule of its directives (`rule.ruleinfo`). This does the same for the
    directives that are missing.

    Args:
        workflow: Snakemake's.
        results: folder of the results, which holds logs and benchmarks.
        known: names of rules that are complete already.
    """
    for rule in workflow.rules:
        if not rule.script or rule.name in known:
            continue
        info, path = rule.ruleinfo, _wildcard_path(rule)
        rule.log_modifier = rule.benchmark_modifier = rule.output_modifier
        if not info.log:
            rule.set_log(f"{results}/logs/{path}.log")
        if not info.benchmark:
            rule.benchmark = f"{results}/benchmarks/{path}.tsv"
        if not info.conda_env:
            rule.conda_env = CONDA
        if "code" not in rule.params.keys():
            rule.set_params(code=digest_of(_script(rule)))
        if DEFINED_IN:
            code = list(rule.params).index(rule.params.code)
            rule.params[code] = rule.params.code = _with_laws(
                rule.params.code, [p for p in rule.params if p is not rule.params.code]
            )
        resources = type(rule.resources).from_mapping(dict(RESOURCES))
        resources.update(info.resources[1] if info.resources else {})
        resources.update(workflow.resource_settings._parsed_overwrite_resources.get(rule.name, {}))
        rule.resources.update(resources)


def _script(rule) -> Path:
    path = rule.basedir.join(rule.script).get_path_or_uri(secret_free=True)
    return Path(path).resolve()


def digest_of(file: Path) -> Callable:
    """`code_digest` of a file as a parameter of a rule: worked out where a job of the rule is planned, and only there.

    Digests of all rules would be two fifths of what Snakemake takes to start, twice for each job of a cluster.
    """
    return lambda wildcards: code_digest(file)


def _with_laws(code: Callable, others: list) -> Callable:
    """A digest of code that includes the files of own laws which the other parameters name."""

    def digest(wildcards):
        files = law_files([value(wildcards) if callable(value) else value for value in others])
        return code(wildcards) + (f" {digest_of_files(files)}" if files else "")

    return digest


def _wildcard_path(rule) -> str:
    """The rule's name in a folder for each of its wildcards, in the order of its first output."""
    output = str(rule.output[0])
    wildcards = sorted(rule.wildcard_names, key=lambda name: output.index("{" + name))
    return "/".join([*(f"{{{name}}}" for name in wildcards), rule.name])
