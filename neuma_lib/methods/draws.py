"""Laws drawn from the uncertainty of constants that `identify` fitted, and of corrections of their law."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from neuma_lib.evaluation.bands import corrected_draws
from neuma_lib.evaluation.constants_draws import constants_draws
from neuma_lib.io.files import read_json
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.mechanics.law import Law
from neuma_lib.mechanics.structured import StructuredLaw


def draws(
    inputs: Mapping[str, str],
    law: Law,
    F: Tensor | None,
    uncertainty: Mapping[str, Any],
    body: str | None = None,
    **drawn: Any,
) -> list[Law]:
    """As `Method.draws`, from ``identified`` and, for a correction without F, ``rollout``."""
    if not inputs:
        return []
    identified = read_json(inputs["identified"])
    if body is not None:
        identified = identified["bodies"][body]
    if not isinstance(law, StructuredLaw):
        return constants_draws(identified, uncertainty["model_std"], **drawn)
    if law.elasticity.form != "stretch":
        return []
    if F is None:
        F = torch.from_numpy(read_arrays(inputs["rollout"], required=("F",), only=("F",))[0]["F"])
    return corrected_draws(law, identified["best"], F, **uncertainty, **drawn)
