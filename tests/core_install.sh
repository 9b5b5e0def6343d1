#!/usr/bin/env bash
# Build the package, install it without extras in a fresh environment, run an example and the tests marked `core` there:
# `make test-core`, or `make test-core VERSIONS=lowest`.
#
#   tests/core_install.sh FOLDER [newest|lowest] [pytest options]
#
# FOLDER receives the environment. `lowest` takes the lower bounds of pyproject.toml. torch is the version of
# envs/pins.txt in both cases: its newest releases come with CUDA libraries of several GB.
set -euo pipefail
cd "$(dirname "$0")/.."
folder=$1 versions=${2:-newest}
shift $(($# < 2 ? $# : 2))
python=${PYTHON:-python3.11}

rm -rf "$folder"
"$python" -m venv "$folder"
pip="$folder/bin/python -m pip --quiet --disable-pip-version-check"
$pip install build setuptools wheel
"$folder/bin/python" -m build --outdir "$folder/dist" . >"$folder/build.log"
grep '^torch==' envs/pins.txt >"$folder/constraints.txt"
if [ "$versions" = lowest ]; then
  "$folder/bin/python" - >>"$folder/constraints.txt" <<'PYTHON'
import tomllib
for line in tomllib.load(open("pyproject.toml", "rb"))["project"]["dependencies"]:
    if not line.startswith("torch>"):
        print(line.replace(">=", "=="))
PYTHON
fi
$pip install --constraint "$folder/constraints.txt" "$folder"/dist/*.whl pytest
"$folder/bin/python" -m pip freeze --disable-pip-version-check | tr '\n' ' '
echo

# A copy without neuma_lib, so that the installed package is tested.
work=$folder/work
mkdir "$work"
cp -r tests config benchmarks docs examples envs README.md Snakefile mkdocs.yml pyproject.toml "$work"
cd "$work"
neuma=$(realpath ../bin/neuma) python=$(realpath -s ../bin/python)
"$python" - <<'PYTHON'
import torch
import neuma_lib as nm

x = 0.3 * torch.rand(2000, 3) + torch.tensor([0.35, 0.30, 0.35])
vol0 = torch.full((2000,), 0.3**3 / 2000)
v = torch.tensor([0.0, -1.0, 0.0], requires_grad=True)
law = nm.Law.from_spec({"elasticity": {"name": "neo_hookean", "E": 1e5, "nu": 0.3}})
state = nm.State(x, v, mass=1000 * vol0, vol0=vol0)
path = nm.simulate(nm.MPM(grid=24, dt=1e-3), law, state, frames=range(0, 201, 10))
path.x[-1, :, 1].mean().backward()
assert torch.isfinite(v.grad).all() and "site-packages" in nm.__file__
print("example:", tuple(path.x.shape), v.grad.tolist())
PYTHON
"$neuma" check
"$python" -m pytest -q -m "core and not slow" -p no:cacheprovider tests "$@"
